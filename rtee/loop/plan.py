"""Turn a goal into a plan: the legs of the motion, checked before anything moves."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from rtee.actions.types import Action, Generic, Posture, Timed
from rtee.errors import GoalRejected, UnknownAction, suggestion
from rtee.hand.model import Hand
from rtee.loop.grip import Grip
from rtee.loop.opening_plan import (
    DeviceForces,
    check_opening,
    closing_time,
    plan_opening,
    wants_opening,
)
from rtee.loop.reflex_plan import check_reflexes, grip_of, slowly, touching_action
from rtee.types import Goal, Stage, from_rest

if TYPE_CHECKING:
    from rtee.actions.library import ActionLibrary
    from rtee.loop.settings import LoopSettings

OPEN = "open"
"""The action that every hand has: go to the rest posture, unless its library defines another."""

NO_DEVICES = DeviceForces()
"""Devices that take all effort limits, and whose forces are unknown."""

PRE_GRASP_GAP = 0.05
"""Intensity from the pre-grasp of a pinch to its first contact: more than the tolerance of an
actuator, and little enough to close quickly."""


@dataclass(frozen=True, slots=True)
class Leg:
    """One motion to a set of set-points.

    Attributes:
        name: Alias of the inner action of a timed action, else empty.
        targets: Position by actuator index [rad | m], inside the limits.
        before: Time to wait before [s].
        after: Time to wait after the motion [s].
    """

    name: str
    targets: Mapping[int, float]
    before: float = 0.0
    after: float = 0.0


@dataclass(frozen=True, slots=True)
class Plan:
    """A goal that was checked and can be executed.

    Attributes:
        goal: The goal.
        action: Name of the action, as the library writes it.
        legs: The motions, one after the other.
        involved: Indices of the actuators that move.
        effort: Effort limits of the goal by actuator index [N·m | N].
        timeout: Longest time [s].
        timed: Whether the legs are inner actions.
        elements: Elements of the action, for a goal with an opening or a force.
        grip: Computes opening and force of the fingertips, for such a goal.
    """

    goal: Goal
    action: str
    legs: tuple[Leg, ...]
    involved: frozenset[int]
    effort: Mapping[int, float]
    timeout: float
    timed: bool = False
    elements: tuple[str, ...] = ()
    grip: Grip | None = None

    def only(self, indices: Collection[int]) -> Plan:
        """Return the plan for some of its actuators only; legs without any are left out."""
        legs = [
            replace(leg, targets={i: t for i, t in leg.targets.items() if i in indices})
            for leg in self.legs
        ]
        left = tuple(leg for leg in legs if leg.targets)
        return replace(self, legs=left, involved=self.involved.intersection(indices))


_LONGEST = 86400.0
"""Most that a low speed adds to a timeout [s]: a day, for shares of the velocity limit near 0."""


def make_plan(
    goal: Goal,
    hand: Hand,
    library: ActionLibrary,
    settings: LoopSettings,
    *,
    devices: DeviceForces = NO_DEVICES,
) -> Plan:
    """Check a goal and make the plan for it.

    Args:
        goal: The goal.
        hand: The hand.
        library: Its actions.
        settings: Timeouts.
        devices: Which efforts and forces the devices can limit.

    Raises:
        GoalRejected: if a value of the goal cannot be used.
        UnknownAction: if there is no such action.
        ActionError: if the action doesn't exist with these elements.
    """
    _check_numbers(goal)
    check_reflexes(goal, hand)
    effort = effort_limits(goal.effort, hand, devices.refused)
    if wants_opening(goal):
        return _opening_plan(goal, hand, library, settings, devices, effort)
    if goal.touch and not goal.action:
        action = touching_action(goal, hand, library)
    else:
        action = _find(goal, hand, library)
    if isinstance(action, Timed):
        legs = _timed_legs(goal, action, hand)
        timed = True
    else:
        intensity = _intensity(goal, action)
        legs = (Leg("", _targets(action.posture, hand, intensity)),)
        timed = False
    # By its opening, what is held is told from fingertips that press on one another.
    grip = grip_of(
        hand,
        library,
        action,
        devices,
        lambda action: _targets(action.waypoints[-1], hand, 1.0),
    )
    if goal.touch:
        goal = slowly(goal, hand, grip, action.name)
    plan = _plan_of(goal, hand, action, legs, effort, settings, timed)
    if grip is None and not goal.touch:
        return plan
    return replace(plan, elements=action.elements, grip=grip)


def _plan_of(
    goal: Goal,
    hand: Hand,
    action: Action,
    legs: tuple[Leg, ...],
    effort: Mapping[int, float],
    settings: LoopSettings,
    timed: bool,
) -> Plan:
    involved = frozenset().union(*[leg.targets for leg in legs])
    timeout = goal.timeout
    if timeout is None:
        # Waiting times of the action must not use up the time for moving.
        margins = sum([leg.before + leg.after for leg in legs])
        timeout = settings.goal_timeout * len(legs) + margins
        # Nor must the low speed of the goal.
        timeout += slowness(goal.speed, hand, [leg.targets for leg in legs])
    return Plan(goal, action.name, legs, involved, effort, timeout, timed)


def slowness(speed: float, hand: Hand, legs: Iterable[Mapping[int, float]]) -> float:
    """Return the additional time of motions at a share of the velocity limits [s].

    Args:
        speed: The share, above 0 up to 1.
        hand: The hand.
        legs: Targets of its actuators, by index [rad | m], for one motion after the other.
    """
    at = {i: actuator.rest for i, actuator in enumerate(hand.actuators)}
    time = 0.0
    for targets in legs:
        # All actuators arrive together with the slowest one.
        time += max(
            (abs(to - at[i]) / hand.actuators[i].velocity for i, to in targets.items()), default=0.0
        )
        at.update(targets)
    return min(time * (1.0 / speed - 1.0), _LONGEST)


def _opening_plan(
    goal: Goal,
    hand: Hand,
    library: ActionLibrary,
    settings: LoopSettings,
    devices: DeviceForces,
    effort: Mapping[int, float],
) -> Plan:
    """Make the plan for a goal in millimetres and newtons."""
    check_opening(goal)
    opening = plan_opening(
        goal,
        hand,
        library,
        devices,
        lambda: _find(goal, hand, library),
        lambda action: _targets(action.waypoints[-1], hand, 1.0),
    )
    action = opening.action
    legs = tuple(Leg("", _targets(action.waypoints[-1], hand, at)) for at in opening.intensities)
    effort = {**effort, **opening.effort}
    plan = _plan_of(opening.goal, hand, action, legs, effort, settings, False)
    timeout = (
        plan.timeout
        if goal.timeout is not None
        else plan.timeout + closing_time(goal, opening.grip)
    )
    return replace(plan, timeout=timeout, elements=action.elements, grip=opening.grip)


def _check_numbers(goal: Goal) -> None:
    if not 0.0 <= goal.intensity <= 1.0:
        raise GoalRejected(f"the intensity must be 0 to 1, not {goal.intensity:g}")
    if not 0.0 < goal.speed <= 1.0:
        raise GoalRejected(f"the speed must be above 0 and at most 1, not {goal.speed:g}")
    if not 0.0 < goal.tolerance < math.inf:
        raise GoalRejected(f"the tolerance must be above 0, not {goal.tolerance:g}")
    if goal.timeout is not None and not 0.0 < goal.timeout < math.inf:
        raise GoalRejected(f"the timeout must be above 0 s, not {goal.timeout:g}")


def effort_limits(
    efforts: Mapping[str, float], hand: Hand, refused: Mapping[int, str]
) -> dict[int, float]:
    """Return the effort limits of a goal or a stream, by actuator index [N·m | N].

    Args:
        efforts: The limits by name [N·m | N].
        hand: The hand.
        refused: Reason why a device takes no effort limit, in words or empty, by actuator index.

    Raises:
        GoalRejected: if a limit cannot be used.
    """
    limits: dict[int, float] = {}
    for name, value in efforts.items():
        if name not in hand.actuator_names:
            raise GoalRejected(
                f"effort for an unknown actuator '{name}'; {suggestion(name, hand.actuator_names)}"
            )
        index = hand.actuator_index(name)
        most = hand.actuators[index].effort
        if not 0.0 < value <= most:
            raise GoalRejected(
                f"the effort limit of '{name}' must be above 0 and at most {most:g}, not {value:g}"
            )
        if index in refused:
            why = f": {refused[index]}" if refused[index] else ""
            raise GoalRejected(f"the device of '{name}' takes no effort limit{why}")
        limits[index] = float(value)
    return limits


def _find(goal: Goal, hand: Hand, library: ActionLibrary) -> Action:
    try:
        return library.find(goal.action, goal.elements, goal.kind)
    except UnknownAction:
        # The library takes precedence: a hand may define its own "open".
        if goal.action.lower() != OPEN or goal.elements or goal.kind:
            raise
    rest = dict(zip(hand.actuator_names, hand.rest.tolist(), strict=True))
    return Generic(OPEN, Posture(rest, hand.actuator_names), "The rest posture.")


def _intensity(goal: Goal, action: Action) -> float:
    if goal.stage is not Stage.PRE_GRASP:
        return goal.intensity
    contact = action.evidence[0].contact_at if action.evidence else None
    if contact is None:
        raise GoalRejected(
            f"'{action.name}' has no pre-grasp: only pinches whose first contact is known have one"
        )
    return min(goal.intensity, max(0.0, contact - PRE_GRASP_GAP))


def _timed_legs(goal: Goal, action: Timed, hand: Hand) -> tuple[Leg, ...]:
    if goal.intensity != 1.0:
        raise GoalRejected(
            f"'{action.name}' is a timed action, which always runs at intensity 1,"
            f" not {goal.intensity:g}"
        )
    if goal.stage is Stage.PRE_GRASP:
        raise GoalRejected(f"'{action.name}' is a timed action and has no pre-grasp")
    return tuple(
        Leg(step.alias, _targets(step.posture, hand, 1.0), step.before, step.after)
        for step in action.steps
    )


def _targets(posture: Posture, hand: Hand, intensity: float) -> dict[int, float]:
    targets: dict[int, float] = {}
    for name in posture.involved:
        index = hand.actuator_index(name)
        spec = hand.actuators[index]
        wanted = from_rest(spec.rest, posture.position[name], intensity)
        # Calibration may have narrowed the limits since the action was made.
        targets[index] = min(max(wanted, spec.lower), spec.upper)
    return targets
