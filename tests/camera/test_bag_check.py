"""The check that keeps damaged bags from librealsense, which some of them would crash."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="rosbags is not installed: pip install 'handtrack[rosbag]'")

from camera.ros_bags import write_realsense_bag
from handtrack.camera.camera import Camera
from handtrack.camera.readers.bag_check import check_bag
from handtrack.errors import DamagedFileError

CAMERA = Camera(width=16, height=12, fx=20.0, fy=20.0, cx=8.0, cy=6.0)


@pytest.fixture
def bag(tmp_path):
    steps = np.full((4, *CAMERA.shape), 500, np.uint16)
    return write_realsense_bag(tmp_path / "camera.bag", CAMERA, steps, 0.001)


def test_a_good_bag_passes(bag):
    check_bag(bag)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.9, 0.9999])
def test_a_bag_that_is_cut_off_is_noticed_wherever(bag, share):
    data = bag.read_bytes()
    bag.write_bytes(data[: int(share * len(data))])
    with pytest.raises(DamagedFileError, match=r"camera\.bag"):
        check_bag(bag)


def test_a_bag_that_was_never_finished_can_be_repaired_and_says_so(bag):
    data = bytearray(bag.read_bytes())
    place = data.index(b"index_pos=") + len(b"index_pos=")
    data[place : place + 8] = bytes(8)
    bag.write_bytes(data)
    with pytest.raises(DamagedFileError, match="rosbag reindex"):
        check_bag(bag)


@pytest.mark.parametrize("name", [b"op=\x05", b"op=\x02", b"op=\x07", b"compression=none"])
@pytest.mark.parametrize("value", [0, 255])
def test_a_broken_length_in_any_kind_of_record_is_noticed(bag, name, value):
    data = bytearray(bag.read_bytes())
    place = data.rindex(name) - 4
    data[place : place + 4] = bytes([value] * 4)
    bag.write_bytes(data)
    with pytest.raises(DamagedFileError, match=r"camera\.bag is damaged"):
        check_bag(bag)


def test_bytes_that_are_no_record_are_noticed(bag):
    data = bytearray(bag.read_bytes())
    place = data.index(b"op=\x05") + 3
    data[place] = 99
    bag.write_bytes(data)
    with pytest.raises(DamagedFileError, match="no record"):
        check_bag(bag)
