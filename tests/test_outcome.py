"""One word says how a goal ended, and whether it has succeeded."""

from __future__ import annotations

from typing import Any

import pytest

from rtee.loop.plan import Plan
from rtee.messages.goals import goal_of
from rtee.types import Aim, OnContact, Outcome, Result


@pytest.mark.parametrize(
    ("aim", "found", "outcome"),
    [
        (Aim.POSTURE, {"reached": True}, Outcome.REACHED),
        (Aim.POSTURE, {"stalled": True}, Outcome.STALLED),
        (Aim.POSTURE, {"stalled": True, "grasped": True}, Outcome.HELD),
        (Aim.POSTURE, {"stalled": True, "touched": ("thumb",)}, Outcome.TOUCHED),
        (Aim.POSTURE, {"stalled": True, "unknown": True}, Outcome.CLOSED),
        (Aim.POSTURE, {"grasped": True, "timed_out": True}, Outcome.TIMED_OUT),
        (Aim.OBJECT, {"grasped": True, "within": True}, Outcome.HELD),
        (Aim.OBJECT, {"grasped": True, "within": None}, Outcome.HELD),
        (Aim.OBJECT, {"grasped": True, "within": False}, Outcome.WRONG_WIDTH),
        (Aim.OBJECT, {"reached": True}, Outcome.EMPTY),
        (Aim.OBJECT, {"stalled": True, "touched": ("thumb",)}, Outcome.STALLED),
        (Aim.OBJECT, {"stalled": True, "unknown": True}, Outcome.UNKNOWN),
        (Aim.CONTACT, {"stalled": True, "touched": ("thumb",)}, Outcome.TOUCHED),
        (Aim.CONTACT, {"reached": True}, Outcome.EMPTY),
        (Aim.CONTACT, {"stalled": True}, Outcome.EMPTY),
        (Aim.CONTACT, {"touched": ("thumb",), "cancelled": True}, Outcome.CANCELLED),
        (Aim.OBJECT, {"preempted": True, "aborted": True}, Outcome.ABORTED),
    ],
)
def test_the_aim_of_a_goal_decides_its_outcome(
    aim: Aim, found: dict[str, Any], outcome: Outcome
) -> None:
    result = Result("1", "a", aim=aim, **found)
    assert result.outcome is outcome
    assert result.succeeded is (outcome in {"held", "touched", "reached", "closed"})


@pytest.mark.parametrize(
    ("asked", "aim"),
    [
        ({}, Aim.POSTURE),
        ({"opening": 0.03, "force": 2.0}, Aim.POSTURE),
        ({"opening": 0.03, "grasp": True}, Aim.OBJECT),
        ({"on_contact": {"": OnContact.SQUEEZE}}, Aim.OBJECT),
        ({"on_contact": {"thumb": OnContact.STOP}}, Aim.POSTURE),
        ({"touch": True}, Aim.CONTACT),
    ],
)
def test_what_a_goal_asks_for_is_its_aim(asked: dict[str, Any], aim: Aim) -> None:
    goal = goal_of("a", **asked)
    plan = Plan("1", "a", (), (), frozenset(), {}, 1.0, goal.to, on_contact=goal.on_contact)
    assert plan.aim is aim


def test_a_result_has_no_truth_value() -> None:
    with pytest.raises(TypeError, match="use its 'succeeded' or its 'outcome'"):
        assert Result("1", "a", reached=True)
