"""CSV, JSON lines and NPZ: every frame, the same numbers, what is not known marked as such."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handtrack.export.arrays import arrays
from handtrack.export.frame_document import result_document, to_json
from handtrack.export.json_lines import json_lines
from handtrack.export.table import table
from handtrack.export.track import Track
from handtrack.hand.kinematics import bone_frames, keypoints
from handtrack.hand.skeleton import ANGLES, BONES, KEYPOINTS
from handtrack.tracking.result import HandResult
from handtrack.transforms import quat_to_matrix

SCHEMA = Path(__file__).parents[2] / "docs" / "frame.schema.json"


def read_lines(track: Track) -> list[dict[str, Any]]:
    return [json.loads(line) for line in json_lines(track).decode("utf-8").splitlines()]


def numbers(values: Any) -> np.ndarray:
    return np.array(values, np.float64)


def test_the_table_is_results_csv(track: Track, folder: Path) -> None:
    assert table(track).decode() == (folder / "results.csv").read_text("utf-8")


def test_the_table_holds_the_same_metres_and_radians(track: Track) -> None:
    rows = list(csv.DictReader(io.StringIO(table(track).decode())))
    assert [row["state"] for row in rows] == [state.value for state in track.states]
    for row, pose, points in zip(rows, track.poses, track.keypoints, strict=True):
        if row["state"] == "no_hand":
            assert row["tx_m"] == "" and row["index_tip_x_m"] == ""
            continue
        assert float(row["tz_m"]) == pytest.approx(pose[2], abs=1e-6)
        assert float(row["index_pip_flexion_rad"]) == pytest.approx(pose[7 + 7], abs=1e-6)
        assert float(row["index_tip_y_m"]) == pytest.approx(points[8, 1], abs=1e-6)


def test_lines_hold_the_same_metres_and_radians(track: Track) -> None:
    rotations, _ = bone_frames(track.hand, track.poses)
    documents = read_lines(track)
    assert [document["state"] for document in documents] == [s.value for s in track.states]
    for place, document in enumerate(documents):
        assert document["frame"] == place and document["time"] == track.times[place]
        if document["state"] == "no_hand":
            assert document["keypoints"] is None and document["problem"] == "nothing there"
            continue
        np.testing.assert_allclose(document["keypoints"], track.keypoints[place], atol=1e-7)
        pose = [*document["translation"], *document["orientation"]]
        pose += [document["angles"][name] for name in ANGLES]
        np.testing.assert_allclose(pose, track.poses[place], atol=1e-7)
        turns = quat_to_matrix(document["bone_orientations"])
        np.testing.assert_allclose(turns, rotations[place], atol=1e-6)
        if document["state"] == "lost":
            assert document["keypoint_std"] is None
        else:
            np.testing.assert_allclose(
                document["keypoint_std"], track.keypoint_std[place], atol=1e-7
            )


def test_lines_are_what_the_publisher_sends(track: Track, hand_results: list[HandResult]) -> None:
    lines = json_lines(track).decode("utf-8").splitlines()
    for place, result in enumerate(hand_results):
        sent = json.loads(to_json(result_document(place, track.times[place], result)))
        line = json.loads(lines[place])
        assert sent.keys() == line.keys()
        for name in ("frame", "time", "side", "state", "problem", "angles", "keypoints"):
            assert sent[name] == line[name]


def test_lines_keep_to_the_documented_schema(track: Track) -> None:
    jsonschema = pytest.importorskip(
        "jsonschema", reason="jsonschema, which checks documents, is not installed"
    )
    schema = json.loads(SCHEMA.read_text("utf-8"))
    validator = jsonschema.Draft202012Validator(schema)
    validator.check_schema(schema)
    documents = read_lines(track)
    for document in documents:
        validator.validate(document)
    for name, wrong in (
        ("version", 2), ("keypoints", None), ("orientation", [1.0, 0.0, 0.0]), ("state", "no_hand"),
        ("angles", {"thumb_tm_flexion": 0.0}), ("more", 1),
    ):  # fmt: skip
        assert not validator.is_valid({**documents[5], name: wrong}), name
        assert validator.is_valid(documents[5])


def test_the_schema_names_the_angles() -> None:
    angles = json.loads(SCHEMA.read_text("utf-8"))["properties"]["angles"]["oneOf"][0]
    assert angles["required"] == list(ANGLES)


def test_nan_never_becomes_json() -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        to_json({"time": float("nan")})


def test_arrays_hold_the_same_numbers_and_the_bones(track: Track) -> None:
    with np.load(io.BytesIO(arrays(track)), allow_pickle=False) as data:
        found = dict(data)
    assert found["side"] == track.side and found["bone_names"].tolist() == list(BONES)
    assert found["keypoint_names"].tolist() == list(KEYPOINTS)
    np.testing.assert_array_equal(found["keypoints"], track.keypoints)
    pose = np.hstack([found["translation"], found["orientation"], found["angles"]])
    np.testing.assert_array_equal(pose, track.poses)
    np.testing.assert_array_equal(found["followed"], track.followed)
    frames = found["T_camera_bone"]
    unknown = np.isnan(frames).any(axis=(1, 2, 3))
    assert unknown.tolist() == [state.value == "no_hand" for state in track.states]
    # A fingertip put through the distal bone's matrix is the keypoint.
    tips = frames[~unknown, 6] @ np.append(track.hand.tip_offsets[1], 1.0)
    np.testing.assert_allclose(tips[:, :3], track.keypoints[~unknown, 8], atol=1e-7)
    np.testing.assert_allclose(tips[:, 3], 1.0)


def test_bones_have_the_size_of_their_frame(track: Track) -> None:
    sizes = np.where(np.arange(len(track)) < 6, 0.95, 1.0)
    points = np.stack(
        [
            keypoints(track.hand.scaled(size), pose)
            for size, pose in zip(sizes, track.poses, strict=True)
        ]
    )
    with np.load(io.BytesIO(arrays(replace(track, keypoints=points)))) as data:
        frames, found = data["T_camera_bone"], data["size"]
    known = np.isfinite(points).all(axis=(1, 2))
    np.testing.assert_allclose(found[known], sizes[known], rtol=1e-12)
    np.testing.assert_allclose(frames[known, 15, :3, 3], points[known, 19], atol=1e-12)
