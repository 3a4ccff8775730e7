"""A hand and its grip modes on a device."""

from __future__ import annotations

import pytest

from handtrack.errors import InputError
from handtrack.grasp.grip_device import GripDevice
from handtrack.grasp.motion_model import GraspMotionModel, GripModel
from oracles.scenes import shaped_hand


@pytest.fixture(scope="module")
def models() -> list[GripModel]:
    return list(GraspMotionModel.load().grips.values())[:3]


def test_grip_modes_keep_the_numbers_of_their_models(models: list[GripModel]) -> None:
    grips = GripDevice(shaped_hand(), models, device="cpu")
    assert [grips.number(model.grip) for model in models] == [0, 1, 2]
    assert [pads.bones.size for pads in grips.pads] == [
        int((row >= 0).sum()) for row in grips.contacts[0].numpy()
    ]
    assert grips.motions.nweight == max(model.nweight for model in models)
    with pytest.raises(InputError, match="no grip 'fist'"):
        grips.number("fist")


def test_unusable_arguments_are_refused(models: list[GripModel]) -> None:
    hand = shaped_hand()
    with pytest.raises(InputError, match="no motion models"):
        GripDevice(hand, [], device="cpu")
    with pytest.raises(InputError, match="threads is 0"):
        GripDevice(hand, models, threads=0, device="cpu")
    with pytest.raises(InputError, match="skin_points is 0"):
        GripDevice(hand, models, skin_points=0, device="cpu")
