"""Check goals whose fingers react to contacts, and plan goals that close until they touch."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from rtee.actions.openings import doubtful, meeting
from rtee.actions.types import Action, Primitive
from rtee.errors import ActionError, GoalRejected, suggestion
from rtee.hand.model import Hand
from rtee.loop.grip import Grip
from rtee.loop.opening_plan import DeviceForces, check_tip_speed, tip_speed_share
from rtee.types import Goal, Stage

if TYPE_CHECKING:
    from rtee.actions.library import ActionLibrary

TOUCH_SPEED: Final = 0.01
"""Default speed at which the opening closes until the first contact [m/s]: a loop of 100 Hz then
stops within 0.2 mm."""

TOUCH_SHARE: Final = 0.05
"""Share of the velocity limits at which actions without an opening close to touch: some
0.1 rad/s."""


def check_reflexes(goal: Goal, hand: Hand) -> None:
    """Refuse a goal with impossible reactions to contacts.

    Raises:
        GoalRejected: if a finger is unknown or a value cannot be used.
    """
    for name in goal.on_contact:
        if name and name not in hand.finger_names:
            raise GoalRejected(
                f"on_contact of an unknown finger '{name}'; {suggestion(name, hand.finger_names)}"
            )
    if goal.max_force is not None:
        if goal.force is None:
            raise GoalRejected("a largest force needs the force to begin with")
        if not goal.force <= goal.max_force < math.inf:
            raise GoalRejected(
                f"the largest force must be at least the force, {goal.force:g} N, "
                f"not {goal.max_force:g}"
            )
    if goal.touch:
        given = (goal.opening, goal.force)
        if goal.grasp or any(value is not None for value in given) or goal.on_contact:
            raise GoalRejected("a touch takes no opening, force or on_contact: it stops by itself")
        if goal.stage is not Stage.BOTH:
            raise GoalRejected("a touch has no stages")
        check_tip_speed(goal)


def grip_of(
    hand: Hand,
    library: ActionLibrary,
    action: Action,
    devices: DeviceForces,
    targets: Callable[[Action], Mapping[int, float]],
) -> Grip | None:
    """Return the grip of an action, ``None`` if the action has no opening."""
    try:
        opening = library.openings.of(action)
    except ActionError:
        return None
    empty = meeting(action, opening, library)
    return Grip.of(hand, opening, targets(action), devices.grips, empty)


def touching_action(goal: Goal, hand: Hand, library: ActionLibrary) -> Action:
    """Return the action that closes some fingers, or the whole hand, to touch something.

    Candidates move the tips of exactly these fingers, in the order: tips that close on each other,
    actions found clear of collisions, order of the library. Without fingers, all actions with an
    opening are candidates, and the one with the most fingers is chosen.

    Raises:
        GoalRejected: if there is none.
    """
    for name in goal.elements:
        if name not in hand.finger_names:
            raise GoalRejected(f"unknown finger '{name}'; {suggestion(name, hand.finger_names)}")
    wanted = set(goal.elements)
    candidates: list[tuple[tuple[float, ...], Action]] = []
    for order, action in enumerate(library):
        try:
            fingers = set(library.openings.of(action).fingers)
            closes = True
        except ActionError:
            if not isinstance(action, Primitive) or not wanted:
                continue
            fingers, closes = set(action.fingers), False
        if not wanted or fingers == wanted:
            key = (not closes, doubtful(action), -len(fingers), order)
            candidates.append((key, action))
    if not candidates:
        whose = ", ".join(goal.elements) or f"'{hand.name}'"
        raise GoalRejected(f"no action closes the fingertips of {whose}; name one")
    return min(candidates, key=lambda each: each[0])[1]


def slowly(goal: Goal, hand: Hand, grip: Grip | None, name: str) -> Goal:
    """Return a goal to touch with the speed at which its fingers close filled in."""
    if goal.speed != 1.0:
        return goal
    if grip is None:
        if goal.tip_speed is not None:
            raise GoalRejected(f"{name} has no opening: give the speed as a share")
        return replace(goal, speed=TOUCH_SHARE)
    speed = TOUCH_SPEED if goal.tip_speed is None else goal.tip_speed
    # Where the opening falls fastest, so that it closes no faster anywhere else.
    steepest = max(grip.intensity, key=grip.slope_at)
    return replace(goal, speed=tip_speed_share(speed, hand, grip, steepest, name))
