"""A gripper's word about contact, made steady."""

from __future__ import annotations

from rtee.drivers.robotiq_common import SteadyContact


def test_a_new_request_in_the_same_direction_takes_nothing_back() -> None:
    grip = SteadyContact()
    assert not grip.steady(False, True, 60, 200)
    assert grip.steady(True, False, 90, 200)
    assert grip.steady(False, True, 91, 210)
    assert grip.steady(True, False, 91, 210)


def test_fingers_that_move_on_hold_nothing() -> None:
    grip = SteadyContact()
    assert grip.steady(True, False, 90, 200)
    assert not grip.steady(False, True, 95, 200)
    assert not grip.steady(False, True, 90, 200), "what was lost is not found again"


def test_a_request_in_the_other_direction_ends_it() -> None:
    grip = SteadyContact()
    assert grip.steady(True, False, 90, 200)
    assert not grip.steady(False, True, 90, 3)


def test_an_arrival_ends_it() -> None:
    grip = SteadyContact()
    assert grip.steady(True, False, 90, 200)
    assert not grip.steady(False, False, 90, 90)
