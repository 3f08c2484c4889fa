"""What a driver's stop may hold: what was measured, unless it cannot be."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rtee import monotonic
from rtee.drivers.standstill import Standstill
from rtee.sample import ActuatorState
from rtee.testing.case import actuator
from rtee.types import DeviceSpec, Reference

TICK = 0.01
SPECS = (actuator("a", 0.0, 2.0), actuator("b", -1.0, 1.0))


class Moved:
    """A device that follows its references at once, unless told otherwise."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        monkeypatch.setattr(monotonic, "now", lambda: self.now)
        self.standstill = Standstill(DeviceSpec("d", "h", "d", SPECS))
        self.at = [0.5, 0.0]

    def tick(self, *asked: float, measured: list[float] | None = None) -> None:
        """Pass a tick as the loop does."""
        self.now += TICK
        state = ActuatorState.measured(self.at if measured is None else measured, self.now)
        self.standstill.measured(state)
        if asked:
            self.standstill.asked(Reference.at(list(asked)))
            self.at = list(asked)

    def move(self, ticks: int = 20) -> None:
        """Move both actuators by 0.01 in each tick."""
        for _ in range(ticks):
            self.tick(self.at[0] + 0.01, self.at[1] + 0.01)


@pytest.fixture
def moved(monkeypatch: pytest.MonkeyPatch) -> Moved:
    found = Moved(monkeypatch)
    found.tick()
    return found


def test_what_is_measured_is_held(moved: Moved) -> None:
    moved.move()
    assert moved.standstill.instead([0.69, 0.19]) == {}
    # Again: it holds there now, and no longer follows the reference.
    assert moved.standstill.instead([1.5, 0.19]) == {0: 0.69}


@pytest.mark.parametrize("wrong", [1.5, 0.0, 30.0, -30.0, math.nan, math.inf])
@pytest.mark.parametrize("earlier", [0, 1, 10])
def test_what_cannot_be_is_not(moved: Moved, wrong: float, earlier: int) -> None:
    moved.move()
    for _ in range(earlier):
        moved.tick(*moved.at, measured=[wrong, moved.at[1]])
    assert moved.standstill.instead([wrong, 0.2]) == {0: pytest.approx(0.7)}


def test_a_frozen_encoder_is_not_held(moved: Moved) -> None:
    frozen = list(moved.at)
    for _ in range(20):
        moved.tick(moved.at[0] + 0.01, moved.at[1] + 0.01, measured=frozen)
    found = moved.standstill.instead(frozen)
    assert found == {0: pytest.approx(0.7), 1: pytest.approx(0.2)}


def test_who_was_moved_by_others_is_held_where_it_is(moved: Moved) -> None:
    moved.move(1)
    for _ in range(60):
        moved.tick(measured=[1.5, moved.at[1]])
    assert moved.standstill.instead([1.5, moved.at[1]]) == {}


def test_without_a_reference_it_stays_where_it_rested(moved: Moved) -> None:
    assert moved.standstill.instead([1.9, math.nan]) == {0: 0.5, 1: 0.0}
    moved.standstill.forget()
    assert moved.standstill.instead([1.9, 0.0]) == {}, "nothing is known that speaks against it"


def test_only_what_is_commanded_counts(moved: Moved) -> None:
    moved.move()
    mask = np.array([True, False])
    nowhere = np.array([0.9, 0.9])
    moved.standstill.asked(Reference.at(nowhere, mask=mask))
    assert moved.standstill.instead([0.8, 0.6]) == {1: pytest.approx(0.2)}
