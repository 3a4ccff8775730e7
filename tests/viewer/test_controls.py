"""The user's wishes: what is wanted once is granted once, a change wakes the loop."""

from __future__ import annotations

import threading
import time

import pytest

from handtrack.errors import InputError
from handtrack.viewer.controls import SPEEDS, Controls, Wishes


@pytest.fixture
def controls() -> Controls:
    return Controls(Wishes(tracker="hybrid"))


def test_steps_and_jumps_are_granted_once_and_steps_add_up(controls: Controls) -> None:
    controls.step()
    controls.step(2)
    controls.go_to(12)
    taken = controls.take()
    assert (taken.steps, taken.place, taken.paused) == (3, 12, True)
    again = controls.take()
    assert (again.steps, again.place, again.paused) == (0, None, True)


def test_lasting_wishes_last(controls: Controls) -> None:
    controls.change(tracker="pso", speed=SPEEDS["1/4"], repeat=False)
    for _ in range(2):
        taken = controls.take()
        assert (taken.tracker, taken.speed, taken.repeat) == ("pso", 0.25, False)


def test_a_change_ends_a_wait_at_once(controls: Controls) -> None:
    controls.take()
    threading.Timer(0.05, controls.stop).start()
    begin = time.perf_counter()
    assert controls.wait(10.0)
    assert time.perf_counter() - begin < 5.0
    assert controls.take().stopped


def test_without_a_change_a_wait_takes_its_time(controls: Controls) -> None:
    controls.take()
    controls.change(speed=1.0)  # what it was before
    begin = time.perf_counter()
    assert not controls.wait(0.05)
    assert time.perf_counter() - begin >= 0.045


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan")])
def test_a_speed_that_goes_nowhere_is_refused(controls: Controls, speed: float) -> None:
    with pytest.raises(InputError, match="speed"):
        controls.change(speed=speed)
