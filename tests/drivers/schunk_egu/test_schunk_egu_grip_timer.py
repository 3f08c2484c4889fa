"""When a grip is to be stopped."""

from __future__ import annotations

import math

import pytest

from rtee.drivers.schunk_egu.driver import GripTimer


def moving(speed: float) -> GripTimer:
    """Return a timer of a grip with a speed [µm/s], seen last at 0.04 s."""
    timer = GripTimer()
    timer.begin(1000.0)
    for at in (0.0, 0.02, 0.04):
        timer.see(1000.0 + speed * at, at, at)
    return timer


def test_a_grip_is_stopped_when_its_speed_brings_it_there() -> None:
    assert moving(50_000.0).due(1000.0, 1) == pytest.approx(0.06)


def test_each_write_takes_its_time_before() -> None:
    timer = moving(50_000.0)
    timer.writing = 0.004
    assert timer.due(1000.0, 2) == pytest.approx(0.052)


def test_one_that_does_not_move_is_not_due() -> None:
    timer = moving(0.0)
    assert timer.due(1000.0, 1) == math.inf


def test_until_a_grip_has_two_positions_the_speed_of_the_last_one_counts() -> None:
    timer = moving(50_000.0)
    timer.begin(3000.0)
    assert timer.due(1000.0, 1) == math.inf
    timer.see(3100.0, 1.0, 1.0)
    assert timer.due(1000.0, 1) == pytest.approx(1.02)


def test_a_position_is_of_the_middle_between_question_and_answer() -> None:
    timer = GripTimer()
    timer.begin(0.0)
    timer.see(100.0, 0.000, 0.004)
    timer.see(200.0, 0.004, 0.012)
    assert timer.due(100.0, 1) == pytest.approx(0.014)
