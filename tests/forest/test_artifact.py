"""Forests as files: what is written is read again, and what could lead a kernel astray is not."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, fields, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from handtrack.errors import DamagedFileError, MissingFileError
from handtrack.forest.artifact import (
    FINGER_KEYPOINTS,
    MIDDLE_POINT,
    PALM_KEYPOINTS,
    Forest,
    ForestStage,
    join_trees,
)
from oracles.forest import leaf_of

HALF = 2.0**-11
"""Relative rounding of a float16."""

LEAST_HALF = 1e-7
"""What float16 loses next to zero."""


@pytest.fixture
def forest(tiny) -> Forest:
    return replace(tiny.forest, facts={"command": "handtrack train-forest", "frames": 120})


@pytest.fixture
def saved(forest: Forest, tmp_path: Path) -> Path:
    path = tmp_path / "forest.npz"
    forest.save(path)
    return path


def contents(path: Path) -> dict[str, NDArray]:
    with np.load(path, allow_pickle=False) as data:
        return dict(data)


def test_a_forest_is_read_as_it_was_written(forest: Forest, saved: Path) -> None:
    read = Forest.load(saved)
    assert read.config == forest.config and read.facts == forest.facts
    np.testing.assert_array_equal(read.anchor_vertices, forest.anchor_vertices)
    assert len(read.palm) == len(forest.palm) and len(read.fingers) == len(forest.fingers)
    assert forest.presence is not None and read.presence is not None
    pairs = zip(
        [*read.palm, *read.fingers, read.presence],
        [*forest.palm, *forest.fingers, forest.presence],
        strict=True,
    )
    for found, expected in pairs:
        for field in fields(ForestStage):
            one, other = getattr(found, field.name), getattr(expected, field.name)
            if field.name in ("offsets", "updates", "leaf_weights"):
                np.testing.assert_allclose(one, other, rtol=HALF, atol=LEAST_HALF)
            else:
                np.testing.assert_array_equal(one, other)
            assert one.dtype in (np.int32, np.float32)


def test_writing_what_was_read_changes_nothing(
    saved: Path, tmp_path: Path, assert_same_forest
) -> None:
    read = Forest.load(str(saved))
    read.save(str(tmp_path / "again.npz"))
    assert_same_forest(Forest.load(tmp_path / "again.npz"), read)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["again.npz", "forest.npz"]


def test_a_forest_without_presence_is_read_without(forest: Forest, tmp_path: Path) -> None:
    replace(forest, presence=None).save(tmp_path / "f.npz")
    assert Forest.load(tmp_path / "f.npz").presence is None


def test_a_forest_is_small_on_disk(forest: Forest, saved: Path) -> None:
    arrays = sum(
        getattr(stage, field.name).nbytes
        for stage in (*forest.palm, *forest.fingers, forest.presence)
        for field in fields(ForestStage)
    )
    assert saved.stat().st_size < 0.6 * arrays


def test_keypoints_of_palm_and_fingers_are_all_keypoints_but_no_other_twice() -> None:
    assert sorted((*PALM_KEYPOINTS, *FINGER_KEYPOINTS)) == list(range(21))
    assert PALM_KEYPOINTS[MIDDLE_POINT] == 9


def test_a_missing_forest_tells_how_to_train_one(tmp_path: Path) -> None:
    path = tmp_path / "nothing.npz"
    with pytest.raises(MissingFileError, match="train-forest") as caught:
        Forest.load(path)
    assert str(path) in str(caught.value)
    with pytest.raises(MissingFileError):
        Forest.load(tmp_path)


def put(name: str, value: object) -> Callable[[dict[str, NDArray]], None]:
    """Set one array, or some of its numbers by a function."""

    def change(arrays: dict[str, NDArray]) -> None:
        arrays[name] = value(arrays[name]) if callable(value) else np.asarray(value)

    return change


def first(number: float) -> Callable[[NDArray], NDArray]:
    def change(array: NDArray) -> NDArray:
        array = array.copy()
        array.flat[0] = number
        return array

    return change


def settings(**changes: object) -> Callable[[dict[str, NDArray]], None]:
    def change(arrays: dict[str, NDArray]) -> None:
        facts = json.loads(str(arrays["facts"]))
        facts["config"].update(changes)
        arrays["facts"] = np.array(json.dumps(facts))

    return change


def cut_trees(arrays: dict[str, NDArray]) -> None:
    """The second stage of the palm loses a tree."""
    for name in ("roots", "tree_parts"):
        arrays[f"palm_1_{name}"] = arrays[f"palm_1_{name}"][:-1]


def swap_parts(arrays: dict[str, NDArray]) -> None:
    arrays["fingers_0_tree_parts"] = arrays["fingers_0_tree_parts"][::-1]


def drop(name: str) -> Callable[[dict[str, NDArray]], None]:
    def change(arrays: dict[str, NDArray]) -> None:
        for key in [key for key in arrays if key.startswith(name)]:
            del arrays[key]

    return change


DAMAGES = {
    "another version": put("format_version", 2),
    "no version": drop("format_version"),
    "no facts": drop("facts"),
    "facts that are no JSON": put("facts", "{"),
    "a setting out of range": settings(stages=0),
    "an unknown setting": settings(colour="blue"),
    "no stages": drop("palm_"),
    "no fingers": drop("fingers_"),
    "half a stage": drop("palm_0_thresholds"),
    "an anchor beyond the vertices": put("palm_0_anchors", first(320)),
    "an anchor below -1": put("palm_0_anchors", first(-2)),
    "a vertex below 0": put("anchor_vertices", first(-1)),
    "a point that is not there": put("fingers_1_node_points", first(48)),
    "a part that is not there": put("fingers_0_tree_parts", first(5)),
    "parts out of order": swap_parts,
    "a root that is not there": put("palm_0_roots", first(10000)),
    "a root below 0": put("palm_0_roots", first(-1)),
    "a child that is not there": put("palm_0_children", first(10000)),
    "a child before its parent": put("palm_0_children", first(0)),
    "a leaf that is not there": put("palm_0_children", first(-10000)),
    "an update that is not a number": put("palm_1_updates", first(np.nan)),
    "an endless offset": put("palm_0_offsets", first(np.inf)),
    "other points than it moves": put("palm_0_updates", lambda a: a[:, :, :5]),
    "updates without directions": put("fingers_0_updates", lambda a: a[..., 0]),
    "another number of modes": put("palm_0_updates", lambda a: a.repeat(2, axis=1)),
    "fewer points than settings": settings(points=49),
    "fewer trees in a later stage": cut_trees,
    "fewer thresholds than nodes": put("palm_0_thresholds", lambda a: a[:-1]),
    "updates of presence for a palm": put("presence_0_updates", lambda a: a.repeat(6, axis=2)),
    "a table instead of children": put("palm_0_children", lambda a: a[:, None]),
    "words": put("palm_0_thresholds", np.array(["a", "b"])),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_file_with_something_wrong_is_refused_by_name(saved: Path, damage: str) -> None:
    arrays = contents(saved)
    DAMAGES[damage](arrays)
    with saved.open("wb") as file:
        np.savez(file, **arrays)
    with pytest.raises(DamagedFileError) as caught:
        Forest.load(saved)
    assert str(saved) in str(caught.value)


def test_the_other_version_is_told(saved: Path) -> None:
    arrays = contents(saved)
    arrays["format_version"] = np.array(7)
    np.savez(saved, **arrays)
    with pytest.raises(DamagedFileError, match=r"format 7; this version reads 1"):
        Forest.load(saved)


@pytest.mark.parametrize("kind", ["empty", "text", "cut", "flipped", "array", "pickle"])
def test_a_file_that_is_no_forest_is_refused_by_name(saved: Path, kind: str) -> None:
    data = saved.read_bytes()
    if kind == "array":
        with saved.open("wb") as file:
            np.save(file, np.zeros(3))
    elif kind == "pickle":
        arrays = contents(saved)
        arrays["palm_0_updates"] = np.array([{"a": 1}], dtype=object)
        with saved.open("wb") as file:
            np.savez(file, **arrays)
    else:
        # Somewhere in the compressed numbers, away from the archive's own tables.
        middle = len(data) // 2
        damaged = {
            "empty": b"", "text": b"forest\n" * 50, "cut": data[:-200],
            "flipped": data[:middle] + bytes(b ^ 255 for b in data[middle : middle + 64])
            + data[middle + 64 :],
        }  # fmt: skip
        saved.write_bytes(damaged[kind])
    with pytest.raises(DamagedFileError) as caught:
        Forest.load(saved)
    assert str(saved) in str(caught.value)


def test_nothing_is_left_when_writing_fails(forest: Forest, tmp_path: Path) -> None:
    with pytest.raises(TypeError):
        replace(forest, facts={"what": object()}).save(tmp_path / "f.npz")
    assert not list(tmp_path.iterdir())


def test_joined_trees_lead_where_each_alone_leads(tiny, rng) -> None:
    stage = tiny.forest.palm[0]
    values = rng.normal(0.0, 0.05, (20, tiny.forest.config.points))
    files = sorted(tiny.work.glob("tree-*-palm-0-*.npz"))
    trees = []
    for path in files:
        with np.load(path) as data:
            trees.append(ForestStage(**{f.name: data[f.name] for f in fields(ForestStage)}))
    assert len(trees) == 3
    joined = join_trees(stage, trees)
    for field in fields(ForestStage):
        np.testing.assert_array_equal(getattr(joined, field.name), getattr(stage, field.name))
    for row in values:
        for number, tree in enumerate(trees):
            alone = leaf_of(0, tree.node_points, tree.thresholds, tree.children, row)
            leaf = leaf_of(
                int(joined.roots[number]), joined.node_points, joined.thresholds, joined.children,
                row,
            )  # fmt: skip
            np.testing.assert_array_equal(joined.updates[leaf], tree.updates[alone])
            np.testing.assert_array_equal(joined.leaf_weights[leaf], tree.leaf_weights[alone])


def test_the_settings_are_written_as_they_are(forest: Forest, saved: Path) -> None:
    facts = json.loads(str(contents(saved)["facts"]))
    assert facts["config"] == asdict(forest.config)
    assert facts["frames"] == 120
