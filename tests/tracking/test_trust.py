"""Trust in a track over frames, and patience with scenes that hold no hand."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.errors import InputError
from handtrack.tracking.patience import LONGEST, Patience
from handtrack.tracking.trust import Trust, TrustConfig, odds_of


def test_one_good_look_is_believed_and_one_fair_look_is_not() -> None:
    trust = Trust(TrustConfig())
    trust.hear(odds_of(0.9))
    assert trust.believes(sure=False)
    trust.forget(known=False)
    trust.hear(odds_of(0.6))
    assert not trust.believes(sure=False) and trust.believes(sure=True) and not trust.refuses


def test_a_believed_track_survives_one_bad_look_but_not_many() -> None:
    trust = Trust(TrustConfig())
    for _ in range(4):
        trust.hear(2.0)
    trust.hear(-4.0)
    assert trust.believes(sure=True) and trust.doubtful
    for _ in range(6):
        trust.hear(-4.0)
    assert not trust.believes(sure=True)


def test_a_pose_that_was_given_needs_much_to_be_dropped() -> None:
    trust = Trust(TrustConfig())
    trust.forget(known=True)
    assert trust.believes(sure=False)
    trust.hear(-3.0)
    assert trust.believes(sure=True)


def test_infinite_odds_do_not_decide_for_ever() -> None:
    trust = Trust(TrustConfig())
    trust.hear(-np.inf)
    assert trust.refuses
    for _ in range(8):
        trust.hear(3.0)
    assert trust.believes(sure=False)


def test_a_track_that_looks_well_is_judged_now_and_then() -> None:
    trust = Trust(TrustConfig(period=3))
    trust.hear(2.0)
    assert [trust.due for _ in range(3)] == [False, False, True]
    trust.hear(-2.0)
    assert trust.due


@pytest.mark.parametrize(
    "settings", [{"start_chance": 1.0}, {"drop_chance": 0.9}, {"period": 0}, {"memory": 0.5}]
)
def test_bad_settings_are_told(settings) -> None:
    with pytest.raises(InputError):
        TrustConfig(**settings)


PLACES = np.array([[0.0, 0.0, 0.5], [0.2, 0.0, 0.8]])


def searches(patience: Patience, frames: int) -> list[int]:
    """Frames in which a scene that never changes is searched, always in vain."""
    found = []
    for frame in range(frames):
        if not (patience.refused and patience.waits(PLACES)):
            found.append(frame)
            patience.refuse(PLACES)
    return found


def test_a_scene_that_does_not_change_is_searched_less_and_less() -> None:
    times = searches(Patience(), 60)
    gaps = np.diff(times)
    assert gaps[0] == 1 and (np.diff(gaps) >= 0).all() and gaps[-1] == LONGEST


def test_something_new_is_looked_at_at_once() -> None:
    patience = Patience()
    searches(patience, 20)
    patience.refuse(PLACES)
    assert patience.waits(PLACES + 0.01)
    assert not patience.waits(np.concatenate([PLACES, [[-0.2, 0.1, 0.4]]]))


def test_an_empty_scene_is_left_alone() -> None:
    patience = Patience()
    patience.refuse(PLACES)
    patience.refuse(PLACES)
    assert patience.waits(np.empty((0, 3)))
    patience.forget()
    assert not patience.refused
