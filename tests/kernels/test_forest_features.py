"""Shape-indexed features, the frames they hang on, and the way through trees (II.4.1, II.4.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from handtrack.forest.artifact import MIDDLE_POINT, PALM_KEYPOINTS
from handtrack.hand.kinematics import bone_frames, keypoints
from handtrack.kernels.forest_features import (
    frame_parts,
    sample_points,
    traverse_trees,
)
from handtrack.transforms import rotvec_to_matrix
from oracles.device_arrays import download, poisoned, upload
from oracles.forest import depth_value, leaf_of
from oracles.scenes import rounded

Float = NDArray[np.float64]

RANGE = 0.12
"""Values are clipped to so much [m]."""

GATE = 0.1
"""What is farther from the middle of a row's hand is background [m]."""

AHEAD = np.array([0.0, 0.0, 0.45])
"""Where the hands of the scenes are [m]."""

UNSURE_CELLS = 1e-3
"""A pixel closer than this to a cell's border may fall on either side in float32 [cells]."""

UNSURE_METRES = 1e-5
"""Likewise a point to the gate's surface [m]."""

VALUE_TOLERANCE = 1e-6
"""Some roundings of float32 at half a metre [m]."""


@dataclass(frozen=True)
class Scene:
    """Crops with cells of every kind, and rows of parts in front of them."""

    cells: Float
    cameras: Float
    centres: Float
    row_image: NDArray
    frames: Float
    places: Float
    vertices: Float
    anchors: NDArray
    offsets: Float

    @classmethod
    def random(cls, rng: np.random.Generator, nrow: int = 7, size: int = 24) -> Scene:
        nimage, npart, npoint, nanchor = 3, 2, 40, 9
        cells = rng.uniform(0.38, 0.52, (nimage, size, size))
        kind = rng.random(cells.shape)
        for share, value in ((0.05, 0.0), (0.1, np.inf), (0.15, np.nan), (0.2, -1.0)):
            cells[(kind < share) & (kind >= share - 0.05)] = value
        # One image lies elsewhere: rows of other images must not see it.
        cells[2, :] = 0.0
        place = rng.normal(0.0, 0.03, (nrow, npart, 3)) + AHEAD
        turns = rng.standard_normal((nrow, npart, 3))
        return cls(
            cells=rounded(cells),
            cameras=rounded(
                np.array([size, size * 1.03, size / 2, size / 2 - 1.0, 0.0])
                + rng.normal(0.0, 0.7, (nimage, 5))
            ),
            centres=rounded(AHEAD + rng.normal(0.0, 0.01, (nrow, 3))),
            row_image=rng.integers(0, 3, nrow),
            frames=rounded(rotvec_to_matrix(turns)),
            places=rounded(place),
            vertices=rounded(rng.normal(0.0, 0.06, (nrow, nanchor, 3)) + AHEAD),
            anchors=rng.integers(-1, nanchor, (npart, npoint)),
            offsets=rounded(rng.normal(0.0, 0.06, (npart, npoint, 3))),
        )

    @property
    def shape(self) -> tuple[int, int, int]:
        return (*self.places.shape[:2], self.anchors.shape[1])

    def point(self, row: int, part: int, k: int) -> Float:
        """A vertex, or the part's origin, and the offset turned into the camera's frame."""
        anchor = self.anchors[part, k]
        base = self.places[row, part] if anchor < 0 else self.vertices[row, anchor]
        return base + self.frames[row, part] @ self.offsets[part, k]

    def expected(self, mirror: float) -> tuple[Float, NDArray[np.bool_]]:
        """Values, and which of them float32 cannot decide otherwise."""
        values, sure = np.zeros(self.shape), np.ones(self.shape, bool)
        for row, part, k in np.ndindex(self.shape):
            image = self.row_image[row]
            if k > 0:
                values[row, part, k], cells, metres = depth_value(
                    self.point(row, part, k), self.places[row, part], self.cells[image],
                    self.cameras[image], np.append(self.centres[row], GATE), mirror=mirror,
                    depth_range=RANGE,
                )  # fmt: skip
                sure[row, part, k] = cells > UNSURE_CELLS and metres > UNSURE_METRES
        return values, sure

    def sampled(self, device: str, mirror: float = 1.0) -> Float:
        values = poisoned(self.shape, device)
        sample_points(
            upload(self.anchors, device), upload(self.offsets, device, wp.vec3),
            upload(self.row_image, device), upload(self.cells, device),
            upload(self.cameras, device), upload(self.centres, device, wp.vec3),
            upload(self.frames, device, wp.mat33), upload(self.places, device, wp.vec3),
            upload(self.vertices, device, wp.vec3),
            mirror=mirror, gate_radius=GATE, depth_range=RANGE, values=values,
        )  # fmt: skip
        return download(values)

    def changed(self, **changes: NDArray) -> Scene:
        return Scene(**{**self.__dict__, **changes})


@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_values_are_the_depths_where_points_project(device, rng, mirror) -> None:
    scene = Scene.random(rng)
    values, sure = scene.expected(mirror)
    found = scene.sampled(device, mirror)
    np.testing.assert_allclose(found[sure], values[sure], atol=VALUE_TOLERANCE)
    assert sure.mean() > 0.97
    background = values == RANGE
    assert 0.2 < background.mean() < 0.9, "the scene shows the hand and more"
    assert (values == -RANGE).any() or (np.abs(values) < RANGE).mean() > 0.1


def test_the_first_point_is_the_parts_own_depth(device, rng) -> None:
    np.testing.assert_array_equal(Scene.random(rng).sampled(device)[..., 0], 0.0)


def test_points_without_a_vertex_hang_on_the_frames_origin(device, rng) -> None:
    scene = Scene.random(rng)
    scene = scene.changed(
        anchors=np.full_like(scene.anchors, -1), vertices=np.full_like(scene.vertices, np.nan)
    )
    values, sure = scene.expected(1.0)
    np.testing.assert_allclose(scene.sampled(device)[sure], values[sure], atol=VALUE_TOLERANCE)
    assert (np.abs(values) < RANGE).any()


def test_values_are_clipped_before_and_behind(device, rng) -> None:
    scene = Scene.random(rng)
    for shift, bound in ((-0.3, RANGE), (0.3, -RANGE)):
        places = scene.places + shift * np.array([0.0, 0.0, 1.0])
        seen = scene.changed(places=places, anchors=np.abs(scene.anchors)).sampled(device)
        assert set(np.unique(seen[..., 1:])) <= {np.float32(RANGE), np.float32(bound)}
        assert (seen[..., 1:] == np.float32(bound)).any()


def test_a_mirrored_image_shows_the_same_in_the_mirror(device, rng) -> None:
    scene = Scene.random(rng)
    cameras = scene.cameras.copy()
    cameras[:, 2] = scene.cells.shape[2] - 1 - cameras[:, 2]
    flipped = scene.changed(cells=scene.cells[:, :, ::-1], cameras=cameras)
    _, sure = scene.expected(1.0)
    np.testing.assert_allclose(
        flipped.sampled(device, -1.0)[sure], scene.sampled(device)[sure], atol=VALUE_TOLERANCE
    )


def test_nothing_in_the_gate_is_background(device, rng) -> None:
    scene = Scene.random(rng)
    for change in (
        {"centres": scene.centres + 3.0},
        {"cells": np.full_like(scene.cells, np.inf)},
        {"cells": np.full_like(scene.cells, np.nan)},
        {"cells": np.zeros_like(scene.cells)},
    ):
        found = scene.changed(**change).sampled(device)
        np.testing.assert_allclose(found[..., 1:], RANGE)


@pytest.mark.parametrize("place", [np.nan, np.inf, -np.inf, 1e6, -1e6, 1e12, -1e30])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_point_anywhere_else_is_background(device, rng, place, axis) -> None:
    scene = Scene.random(rng)
    vertices = scene.vertices.copy()
    vertices[1, :, axis] = place
    anchors = np.abs(scene.anchors)
    found = scene.changed(vertices=vertices, anchors=anchors).sampled(device)
    # At the end of the line of sight a point still looks at the middle of the image.
    if not (axis == 2 and place in (np.inf, 1e6, 1e12)):
        np.testing.assert_allclose(found[1, :, 1:], RANGE)
    assert np.isfinite(found).all()
    others = np.delete(np.arange(len(found)), 1)
    alone = scene.changed(anchors=anchors).sampled(device)
    np.testing.assert_array_equal(found[others], alone[others])


def test_values_of_a_row_do_not_depend_on_the_others(device, rng) -> None:
    scene = Scene.random(rng)
    together = scene.sampled(device)
    for row in (0, 6):
        one = slice(row, row + 1)
        alone = scene.changed(
            row_image=scene.row_image[one], centres=scene.centres[one],
            frames=scene.frames[one], places=scene.places[one], vertices=scene.vertices[one],
        ).sampled(device)  # fmt: skip
        np.testing.assert_array_equal(alone[0], together[row])


PARTS = (0, 1, 4, 7, 10, 13)


def framed(posed, device: str, rows: slice = slice(None)) -> tuple[Float, Float, Float]:
    hands = np.array(posed.row_hand)[rows]
    rest = np.zeros(28)
    rest[3] = 1.0
    palm_points = np.stack([keypoints(hand, rest)[list(PALM_KEYPOINTS)] for hand in posed.hands])
    frames = poisoned((len(hands), len(PARTS)), device, wp.mat33)
    places = poisoned((len(hands), len(PARTS)), device, wp.vec3)
    centres = poisoned(len(hands), device, wp.vec3)
    frame_parts(
        posed.model.bone_rotations, posed.model.bone_origins, upload(np.array(PARTS), device),
        upload(palm_points, device, wp.vec3), upload(hands, device),
        upload(posed.poses[rows], device),
        middle_point=MIDDLE_POINT, frames=frames, places=places, centres=centres,
    )  # fmt: skip
    return download(frames), download(places), download(centres)


@pytest.mark.parametrize("side", ["right", "left"])
def test_parts_are_framed_by_the_palm_and_the_roots_of_straight_fingers(
    make_posed, device, side
) -> None:
    posed = make_posed(device, side=side, seed=71)
    frames, places, _ = framed(posed, device)
    for row in range(posed.nrow):
        straight = np.concatenate([posed.poses[row, :7], np.zeros(21)])
        rotations, origins = bone_frames(posed.hand(row), straight)
        np.testing.assert_allclose(frames[row], rotations[list(PARTS)], atol=1e-6)
        np.testing.assert_allclose(places[row], origins[list(PARTS)], atol=1e-6)


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_middle_of_a_rows_hand_is_its_middle_knuckle(make_posed, device, side) -> None:
    posed = make_posed(device, side=side, seed=73)
    _, _, centres = framed(posed, device)
    for row in range(posed.nrow):
        knuckle = keypoints(posed.hand(row), posed.poses[row])[9]
        np.testing.assert_allclose(centres[row], knuckle, atol=1e-6)


def test_frames_of_a_row_do_not_depend_on_the_others(make_posed, device) -> None:
    posed = make_posed(device, seed=72, row_hand=(0, 1, 1, 0, 1, 0, 1))
    together = framed(posed, device)
    for row in (0, 6):
        for alone, all_rows in zip(
            framed(posed, device, slice(row, row + 1)), together, strict=True
        ):
            np.testing.assert_array_equal(alone[0], all_rows[row])


@dataclass(frozen=True)
class Trees:
    """Random trees: some are a single leaf, and children of a node lie side by side behind it."""

    tree_parts: NDArray
    roots: NDArray
    node_points: NDArray
    thresholds: Float
    children: NDArray

    @classmethod
    def random(cls, rng: np.random.Generator, *, ntree: int, npart: int, npoint: int) -> Trees:
        children: list[int] = []
        roots = []
        leaves = 0
        for tree in range(ntree):
            roots.append(len(children))
            level, children = [len(children)], [*children, 0]
            for depth in range(6):
                below = []
                for node in level:
                    if tree == 0 or depth == 5 or rng.random() < 0.2:
                        children[node], leaves = -1 - leaves, leaves + 1
                    else:
                        children[node] = len(children)
                        below += [len(children), len(children) + 1]
                        children += [0, 0]
                level = below
        return cls(
            tree_parts=rng.integers(0, npart, ntree), roots=np.array(roots),
            node_points=rng.integers(0, npoint, (len(children), 2)),
            thresholds=rounded(rng.normal(0.0, 0.05, len(children))), children=np.array(children),
        )  # fmt: skip

    def leaves(self, device: str, values: Float) -> NDArray:
        found = poisoned((len(values), len(self.roots)), device, int)
        traverse_trees(
            upload(self.tree_parts, device), upload(self.roots, device),
            upload(self.node_points, device), upload(self.thresholds, device),
            upload(self.children, device), upload(values, device), leaves=found,
        )  # fmt: skip
        return download(found)


def steps(rng: np.random.Generator, shape: tuple[int, ...]) -> Float:
    """Values and thresholds in sixteenths: their differences are exact in float32."""
    return rng.integers(-4, 5, shape) / 16


def test_trees_lead_where_plain_recursion_leads(device, rng) -> None:
    trees = Trees.random(rng, ntree=9, npart=3, npoint=12)
    values = steps(rng, (50, 3, 12))
    # Differences that equal the threshold go right: exact steps make them frequent.
    trees = Trees(**{**trees.__dict__, "thresholds": steps(rng, trees.thresholds.shape)})
    found = trees.leaves(device, values)
    for row, tree in np.ndindex(found.shape):
        assert found[row, tree] == leaf_of(
            trees.roots[tree], trees.node_points, trees.thresholds, trees.children,
            values[row, trees.tree_parts[tree]],
        )  # fmt: skip
    assert len(np.unique(found)) > 30


def test_values_that_are_not_numbers_still_lead_to_a_leaf(device, rng) -> None:
    trees = Trees.random(rng, ntree=9, npart=3, npoint=12)
    values = np.full((2, 3, 12), np.nan)
    values[1] = np.inf
    found = trees.leaves(device, values)
    leaves = -1 - trees.children[trees.children < 0]
    assert set(found.ravel()) <= set(leaves)


def test_leaves_of_a_row_do_not_depend_on_the_others(device, rng) -> None:
    trees = Trees.random(rng, ntree=5, npart=2, npoint=8)
    values = rounded(rng.normal(0.0, 0.05, (7, 2, 8)))
    together = trees.leaves(device, values)
    for row in (0, 6):
        np.testing.assert_array_equal(trees.leaves(device, values[row : row + 1])[0], together[row])
