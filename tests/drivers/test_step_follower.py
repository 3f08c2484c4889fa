"""What a gripper that takes one target at a time is sent while its reference moves."""

from __future__ import annotations

import asyncio

import pytest

from rtee.drivers.step_follower import Order, StepFollower

FORCE = 10.0


def follower(settle: float = 0.0, step: float = 5.0) -> StepFollower:
    """Return one in millimetres and newtons."""
    return StepFollower(settle, step, same=1.0, reached=0.3)


def sent(made: StepFollower, target: float, here: float, force: float = FORCE) -> StepFollower:
    """Return it after it was sent to a target."""
    assert made.next(target, force, here, busy=False, held=False) is Order.GO
    made.sent()
    return made


def test_a_gripper_just_attached_to_is_left_alone_while_it_is_asked_to_stay() -> None:
    made = follower()
    assert made.next(50.8, FORCE, 50.0, busy=False, held=True) is Order.NOTHING
    assert made.force is None
    assert made.next(20.0, FORCE, 50.0, busy=True, held=False) is Order.NOTHING
    assert made.next(20.0, FORCE, 50.0, busy=False, held=False) is Order.GO


def test_a_moving_reference_is_followed_in_steps_and_a_resting_one_exactly() -> None:
    made = follower(settle=1e3)
    assert made.next(46.0, FORCE, 50.0, busy=False, held=False) is Order.NOTHING
    assert made.next(44.0, FORCE, 50.0, busy=False, held=False) is Order.GO
    made = sent(follower(), 44.0, 50.0)
    assert made.next(42.0, FORCE, 44.0, busy=False, held=False) is Order.GO
    made.sent()
    assert made.next(42.0, FORCE, 42.2, busy=False, held=False) is Order.NOTHING


def test_a_motion_goes_on_unless_it_leads_past_the_reference() -> None:
    made = sent(follower(), 20.0, 50.0)
    assert made.next(10.0, FORCE, 40.0, busy=True, held=False) is Order.NOTHING
    assert made.next(20.2, FORCE, 40.0, busy=True, held=False) is Order.NOTHING
    assert made.next(30.0, FORCE, 40.0, busy=True, held=False) is Order.STOP
    made.sent()
    assert made.next(30.0, FORCE, 38.0, busy=False, held=False) is Order.GO


def test_a_reference_that_turns_back_stops_the_motion() -> None:
    made = sent(follower(), 20.0, 50.0)
    assert made.next(60.0, FORCE, 40.0, busy=True, held=False) is Order.STOP


def test_a_lesser_force_stops_a_motion_and_a_greater_one_waits() -> None:
    made = sent(follower(), 20.0, 50.0)
    assert made.next(20.0, 2.0 * FORCE, 40.0, busy=True, held=False) is Order.NOTHING
    assert made.next(20.0, 0.5 * FORCE, 40.0, busy=True, held=False) is Order.STOP


def test_what_holds_is_left_alone_until_it_opens_or_its_force_changes() -> None:
    made = sent(follower(), 20.0, 50.0)
    assert made.next(0.0, FORCE, 35.0, busy=False, held=True) is Order.NOTHING
    assert made.next(0.0, 2.0 * FORCE, 35.0, busy=False, held=True) is Order.GO
    made.sent()
    assert made.next(60.0, 2.0 * FORCE, 35.0, busy=False, held=True) is Order.GO


@pytest.mark.anyio
async def test_a_command_without_effect_is_given_again_after_half_a_second() -> None:
    made = sent(follower(), 20.0, 50.0)
    assert made.next(20.0, FORCE, 50.0, busy=False, held=False) is Order.NOTHING
    await asyncio.sleep(0.49)
    assert made.next(20.0, FORCE, 50.0, busy=False, held=False) is Order.NOTHING
    await asyncio.sleep(0.02)
    assert made.next(20.0, FORCE, 50.0, busy=False, held=False) is Order.GO


def test_after_a_stop_from_outside_it_is_as_just_attached() -> None:
    made = sent(follower(), 20.0, 50.0)
    made.forget()
    assert made.next(40.5, FORCE, 40.0, busy=False, held=False) is Order.NOTHING
    made = sent(follower(), 20.0, 50.0)
    made.halted(40.0)
    assert made.next(40.5, FORCE, 40.0, busy=False, held=False) is Order.GO
