"""Correspondence kernels against a brute-force search for the nearest facing vertex (Eq. II.22)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import warp as wp
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from handtrack.kernels import correspond
from handtrack.kernels.crop import CROP_SIZE
from oracles.correspondence import facing, match_points, pixels
from oracles.device_arrays import GARBAGE, download, poisoned, upload
from oracles.scenes import rounded

TIE = 1e-6
"""Distances closer than this are ties in float32 [m]."""
SIZE, BIN, STRIDE = 64, 4, 2
NBIN = SIZE // BIN

Float = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class View:
    """How the crop sees the hand."""

    subcell: float = 0.0
    """Farthest that the pixel a cell shows lies from the cell's centre [cells]."""
    aspect: float = 0.98
    """fy / fx."""
    aside: float = 0.0
    """How far beside the optical axis the hand is, as x / z."""

    def crop(self, z: float = 0.45, span: float = 0.27) -> Float:
        """Crop that sees `span` metres at distance z."""
        crop = np.zeros(CROP_SIZE)
        crop[:2] = SIZE * z / span * np.array([1.0, self.aspect])
        crop[2:4] = (SIZE - 1) / 2 + np.array([2.3, -1.7])
        crop[2] -= crop[0] * self.aside
        return crop


CENTRAL = View()
VIEWS = {
    "central": CENTRAL,
    # A crop no finer than the image starts between pixels.
    "pixels beside the cells": View(subcell=0.5),
    "oblong pixels": View(aspect=1.4),
    # The kernel's early stop holds for views up to 74 degrees: x / z up to 0.75.
    "at the border": View(aside=0.45),
}


@dataclass(kw_only=True)
class Observation:
    """What the camera saw, per hand."""

    crops: Float
    cells: Float
    points: Float
    normals: Float


def observe(
    posed,
    rng: np.random.Generator,
    *,
    noise: float,
    unknown: float = 0.1,
    view: View = CENTRAL,
) -> Observation:
    """Points on the rays of cells, at about the depth of the facing vertex next to each ray."""
    nhand = len(posed.hands)
    crops = np.stack([view.crop(0.45 + 0.01 * h) for h in range(nhand)])
    cells = np.zeros((nhand, SIZE, SIZE))
    points = np.zeros((nhand, SIZE, SIZE, 3))
    normals = np.zeros((nhand, SIZE, SIZE, 3))
    for hand in range(nhand):
        row = posed.row_hand.index(hand)
        vertices, vertex_normals = posed.skin(row)
        uv = pixels(vertices, crops[hand])
        seen = np.flatnonzero(facing(vertices, vertex_normals))
        for v, u in np.ndindex(SIZE, SIZE):
            gap = ((uv[seen] - (u, v)) ** 2).sum(1)
            if gap.min() > 9:
                continue
            nearest = seen[gap.argmin()]
            z = vertices[nearest, 2] + noise * rng.standard_normal()
            if rng.random() < 0.05:
                z += 0.06
            pixel = np.array([u, v]) + view.subcell * rng.uniform(-1, 1, 2)
            points[hand, v, u, :2] = (pixel - crops[hand, 2:4]) / crops[hand, :2] * z
            points[hand, v, u, 2] = z
            normals[hand, v, u] = vertex_normals[nearest] + 0.5 * rng.standard_normal(3)
            cells[hand, v, u] = z
    lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
    normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    kind = rng.random(cells.shape)
    cells[kind < unknown] = np.inf
    normals[kind > 1 - 2 * unknown] = 0.0
    return Observation(
        crops=rounded(crops), cells=rounded(cells), points=rounded(points), normals=rounded(normals)
    )


def search(posed, seen: Observation, device: str, **options: float) -> tuple[NDArray, dict]:
    """Matches of all rows, and the options used."""
    options = {
        "window": 2, "max_distance": 0.04, "min_cosine": 0.3, "wrist_x": -0.005, **options
    }  # fmt: skip
    heads = poisoned((posed.nrow, NBIN * NBIN), device, int)
    following = poisoned((posed.nrow, posed.nvert), device, int)
    matches = poisoned((posed.nrow, (SIZE // STRIDE) ** 2), device, int)
    correspond.bin_vertices(
        posed.rows, upload(seen.crops, device), posed.vertices, posed.normals,
        bin_size=BIN, nbin=NBIN, heads=heads, following=following,
    )  # fmt: skip
    correspond.match_points(
        posed.rows, upload(seen.crops, device), upload(seen.cells, device),
        upload(seen.points, device, wp.vec3), upload(seen.normals, device, wp.vec3),
        posed.vertices, posed.normals, heads, following, posed.rotations, posed.origins,
        stride=STRIDE, bin_size=BIN, nbin=NBIN, matches=matches, **options,
    )  # fmt: skip
    return download(matches), options


def expected_of(posed, seen: Observation, row: int, options: dict) -> list:
    hand = posed.row_hand[row]
    vertices, normals = download(posed.vertices)[row], download(posed.normals)[row]
    return match_points(
        seen.crops[hand], seen.cells[hand], seen.points[hand], seen.normals[hand],
        vertices, normals, posed.palm(row), stride=STRIDE, bin_size=BIN, **options,
    )  # fmt: skip


def test_every_facing_vertex_in_the_crop_is_in_its_bin_once(make_posed, device) -> None:
    posed = make_posed(device, seed=11, bend=1.0)
    # A narrow crop, so that some vertices fall outside.
    crops = rounded(np.stack([CENTRAL.crop(span=0.15) for _ in posed.hands]))
    heads = poisoned((posed.nrow, NBIN * NBIN), device, int)
    following = poisoned((posed.nrow, posed.nvert), device, int)
    correspond.bin_vertices(
        posed.rows, upload(crops, device), posed.vertices, posed.normals,
        bin_size=BIN, nbin=NBIN, heads=heads, following=following,
    )  # fmt: skip
    heads_host, following_host = download(heads), download(following)
    assert GARBAGE not in heads_host and GARBAGE not in following_host
    for row in range(posed.nrow):
        vertices, normals = download(posed.vertices)[row], download(posed.normals)[row]
        cell = np.floor(pixels(vertices, crops[posed.row_hand[row]]) + 0.5).astype(int)
        inside = (cell >= 0).all(1) & (cell < SIZE).all(1)
        binned = facing(vertices, normals) & inside
        assert (facing(vertices, normals) & ~inside).any()
        listed = []
        for number, vertex in enumerate(heads_host[row]):
            while vertex >= 0:
                assert tuple(cell[vertex] // BIN) == (number % NBIN, number // NBIN)
                listed.append(vertex)
                vertex = following_host[row, vertex]
        assert sorted(listed) == np.flatnonzero(binned).tolist()


def move_aside(posed, view: View) -> None:
    """Shift all hands to where the view looks."""
    shift = np.array([0.45 * view.aside, 0.0, 0.0])
    posed.poses[:, :3] += shift
    for array in (posed.vertices, posed.origins):
        array.assign(array.numpy() + shift.astype(np.float32))


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("noise", [0.0, 0.001, 0.015])
@pytest.mark.parametrize("side", ["right", "left"])
def test_matches_equal_brute_force(make_posed, device, rng, side, noise, view) -> None:
    posed = make_posed(device, side=side, seed=12, bend=0.7, turn=0.3)
    move_aside(posed, VIEWS[view])
    seen = observe(posed, rng, noise=noise, view=VIEWS[view])
    matches, options = search(posed, seen, device)
    assert GARBAGE not in matches
    kinds = []
    for row in range(posed.nrow):
        vertices = download(posed.vertices)[row]
        sampled = seen.points[posed.row_hand[row]][STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
        for found, answer, p in zip(
            matches[row], expected_of(posed, seen, row, options), sampled.reshape(-1, 3),
            strict=True,
        ):  # fmt: skip
            kinds.append(answer.kind)
            if answer.kind != "vertex":
                assert found == {"none": -2, "far": -1}[answer.kind]
            elif found != answer.vertex:
                assert found >= 0
                assert np.linalg.norm(vertices[found] - p) <= answer.distance + TIE
    counts = {kind: kinds.count(kind) for kind in ("none", "far", "vertex")}
    assert counts["none"] > 100 and counts["vertex"] > 300
    assert counts["far"] > 3


@settings(
    deadline=None,
    max_examples=8,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(seed=st.integers(0, 2**32 - 1), window=st.integers(0, 3))
def test_the_window_hides_no_nearest_vertex_that_lies_in_it(
    make_posed, device, seed, window
) -> None:
    rng = np.random.default_rng(seed)
    posed = make_posed(device, seed=seed, row_hand=(0,), bend=0.8)
    seen = observe(posed, rng, noise=0.01, unknown=0.0)
    matches, options = search(posed, seen, device, window=window)
    vertices = download(posed.vertices)[0]
    sampled = seen.points[0][STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE].reshape(-1, 3)
    for found, answer, p in zip(
        matches[0], expected_of(posed, seen, 0, options), sampled, strict=True
    ):
        if answer.kind == "none" or not answer.in_window:
            continue
        nearest = np.linalg.norm(vertices[answer.nearest_anywhere] - p)
        assert found >= 0
        assert abs(np.linalg.norm(vertices[found] - p) - nearest) <= TIE


def test_a_wide_window_searches_everything(make_posed, device, rng) -> None:
    posed = make_posed(device, seed=13, row_hand=(0,))
    seen = observe(posed, rng, noise=0.02)
    matches, _ = search(posed, seen, device, window=NBIN, max_distance=10.0, min_cosine=-1.0)
    vertices, normals = download(posed.vertices)[0], download(posed.normals)[0]
    uv = np.floor(pixels(vertices, seen.crops[0]) + 0.5)
    admissible = facing(vertices, normals) & (uv >= 0).all(1) & (uv < SIZE).all(1)
    sampled = seen.points[0][STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE].reshape(-1, 3)
    for found, p in zip(matches[0], sampled, strict=True):
        if found != -2:
            nearest = np.linalg.norm(vertices[admissible] - p, axis=1).min()
            assert np.linalg.norm(vertices[found] - p) <= nearest + TIE


def test_the_forearm_is_not_the_hands(make_posed, device, rng) -> None:
    posed = make_posed(device, seed=14, row_hand=(0,), bend=0.2)
    seen = observe(posed, rng, noise=0.0, unknown=0.0)
    rotation, origin = posed.palm(0)
    sampled = seen.points[0][STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE].reshape(-1, 3)
    empty = sampled[:, 2] == 0
    palm_x = (sampled - origin) @ rotation[:, 0]
    for wrist_x in (-1.0, 0.03, 1.0):
        matches, _ = search(posed, seen, device, wrist_x=wrist_x)
        clear = np.abs(palm_x - wrist_x) > TIE
        np.testing.assert_array_equal(
            (matches[0] == -2)[clear], (empty | (palm_x < wrist_x))[clear]
        )


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e30, -1e30])
def test_garbage_vertices_match_nothing_and_harm_nothing(make_posed, device, rng, bad) -> None:
    posed = make_posed(device, seed=15)
    seen = observe(posed, rng, noise=0.002)
    clean, _ = search(posed, seen, device)
    vertices = posed.vertices.numpy().copy()
    vertices[1] = bad
    posed.vertices.assign(vertices)
    matches, _ = search(posed, seen, device)
    assert (matches[1] < 0).all()
    np.testing.assert_array_equal(matches[[0, 2]], clean[[0, 2]])
