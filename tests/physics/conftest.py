"""One hand and its solids, for every test of physics."""

from __future__ import annotations

import pytest

from handtrack.hand.model import HandModel, ShapedHand
from handtrack.physics.bone_solids import BoneSolid, bone_solids

pytest.importorskip("mujoco")


@pytest.fixture(scope="session")
def hand() -> ShapedHand:
    """The mean right hand."""
    return HandModel.load().shaped()


@pytest.fixture(scope="session")
def solids(hand: ShapedHand) -> tuple[BoneSolid, ...]:
    """Its solids."""
    return bone_solids(hand)
