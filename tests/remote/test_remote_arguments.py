"""Arguments of another type in the methods of a running hand: a sentence, and nothing moves."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

import pytest

import rtee
from rtee.actions.library import ActionLibrary
from rtee.errors import ConfigError, NoHand, UserError
from rtee.hand.model import Hand

from .serving import serving

pytestmark = pytest.mark.anyio

CALLS: list[tuple[Callable[[rtee.RemoteHand], Awaitable[Any]], str]] = [
    (lambda hand: hand.actions(elements=3), "the elements must be a list of names, .*, not 3"),
    (lambda hand: hand.effort_limits(0.5, 3), "the actuators must be a list of names, .*, not 3"),
    (lambda hand: hand.effort_limits(0.5, "near"), "the actuators must be a list of names"),
    (lambda hand: hand.effort_limits(0.5, besides=3), "the actuators to leave out must be a list"),
    (lambda hand: hand.add_composed("x", 3), "the parts of a composed action must be a list"),
    (lambda hand: hand.add_timed("x", 3), "must be a StepPlan, such as .*, not 3"),
    (lambda hand: hand.add_action("fist"), "an action is what a library returns, not 'fist'"),
    (lambda hand: hand.grasp_plan(3), "an object is a shape, such as sphere:0.03, not 3"),
    (lambda hand: hand.grasp_plan("drill", weight_axis=3), "must be three finite numbers, not 3"),
    (lambda hand: hand.grasp_plan("drill", mass="heavy"), "must be finite and above 0"),
    (lambda hand: hand.grasp_plan("drill", top=0), "at least one grasp must be wanted, not 0"),
    (lambda hand: hand.grasp_plan("drill", top="all"), "at least one grasp must be wanted, not"),
    (lambda hand: hand.grasp_plan("drill", table="yes"), r"a table is a Table\(…\), not 'yes'"),
    (lambda hand: hand.reach(approach=3), "an approach must be three finite numbers, not 3"),
    (lambda hand: hand.reach(fingers=3), "give contacts, or a gripper's pose and a width"),
    (lambda hand: hand.grasp_at(stage="half"), "unknown stage 'half'"),
    (lambda hand: anext(hand.states(rate="100")), "rate of states must be a finite number, not"),
    (lambda hand: hand.do("fist", on_contact={3: "stop"}), "by the name of a finger, not 3"),
]


@pytest.mark.parametrize(("call", "said"), CALLS)
async def test_a_method_says_what_it_needs(
    hand: Hand,
    library: ActionLibrary,
    call: Callable[[rtee.RemoteHand], Awaitable[Any]],
    said: str,
) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        with pytest.raises(UserError, match=said):
            await call(remote)
        assert served.watcher.goals == []


async def _later(feedback: object) -> None:
    """Do nothing with feedback."""


@pytest.mark.parametrize("given", [3, _later])
async def test_feedback_needs_a_function(hand: Hand, library: ActionLibrary, given: Any) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        for call in (
            remote.do("fist", on_feedback=given),
            remote.open(on_feedback=given),
            remote.grasp("5mm", on_feedback=given),
            remote.move_opening("5mm", on_feedback=given),
            remote.touch(on_feedback=given),
        ):
            with pytest.raises(UserError, match="on_feedback must be a function, without async"):
                await call
        assert served.watcher.goals == [], "nothing has moved"


async def test_a_client_that_has_left_is_told_so(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library):
        connection = rtee.connect("small")
        async with connection as remote:
            pass
        for call in (remote.state, remote.status, remote.open):
            with pytest.raises(NoHand, match="this client has left the hand 'small'"):
                await call()
        with pytest.raises(ConfigError, match=r"was opened before; call rtee\.connect again"):
            async with connection:
                pass
