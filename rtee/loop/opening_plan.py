"""Plan goals in millimetres and newtons: the action, its intensity and the effort limits."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

from rtee.actions.naming import label
from rtee.actions.openings import MARGIN, Opening, meeting, suitability
from rtee.actions.types import Action
from rtee.drivers.capabilities import GripForce
from rtee.errors import ActionError, GoalRejected, suggestion
from rtee.hand.model import Hand
from rtee.loop.grip import Grip, check_force
from rtee.types import Goal, Stage

if TYPE_CHECKING:
    from rtee.actions.library import ActionLibrary

_ROUNDING: Final = 5e-5
"""An opening beyond the table by less than this counts as the one at its end [m]: people read
openings rounded to 0.1 mm."""

_CONTACT_SPEED: Final = 0.01
"""Least closing speed of the opening for a goal with a force [m/s]: that of a touch, which crosses
the margin within a second."""

_SPEED_PER_FORCE: Final = 2e-3
"""Speed of the opening at which the fingers meet an object, per requested newton [m/s/N]. In MuJoCo
a 2F-85 hits with 0.38 N per mm/s, more than any other hand: the impact stays below the force."""

_AROUND_SPEED: Final = 0.15
"""Largest speed of the opening of fingers of several actuators on their way around an object [m/s]:
servos that integrate their error overshoot by some 20 ms of their way, less than the margin."""

_BLOW: Final = 0.8
"""Share of the requested force that the blow of the closing fingers may have: the force itself is
built up later."""

_LEAST_BLOW: Final = 1.0
"""A blow may be as large as this in any case [N]: the force may be exceeded by as much."""

_STOPPING: Final = 0.0015
"""Time in which an object stops what moves with the fingers [s]: in MuJoCo, an EGU that closes at
90 mm/s strikes with 140 N. Rubber pads take longer, and the blow is then softer."""

_SLOWEST: Final = 0.002
"""Least closing speed by the moving mass [m/s]: the margin around an object takes five seconds."""

_SAMPLES: Final = 8
"""Openings at which the range of the force is sampled, besides the first: the range varies
smoothly."""


@dataclass(frozen=True, slots=True)
class DeviceForces:
    """Which efforts and forces the devices of a hand can limit.

    Attributes:
        refused: Reason why a device takes no effort limit, in words or empty, by actuator index.
        grips: Forces by the devices' data sheets, by actuator index.
        unlimited: Actuators whose effort their device cannot limit, though it limits others.
    """

    refused: Mapping[int, str] = field(default_factory=dict)
    grips: Mapping[int, GripForce] = field(default_factory=dict)
    unlimited: frozenset[int] = frozenset()


@dataclass(frozen=True, slots=True)
class OpeningPlan:
    """The result of planning a goal in millimetres and newtons.

    Attributes:
        goal: The goal, with its speed as a share of the velocity limits.
        action: The action.
        intensities: The intensities to go to, one after the other.
        effort: Effort limits by actuator index [N·m | N].
        grip: Computes opening and force from measurements.
    """

    goal: Goal
    action: Action
    intensities: tuple[float, ...]
    effort: Mapping[int, float]
    grip: Grip


def wants_opening(goal: Goal) -> bool:
    """Return whether a goal is given in millimetres or newtons."""
    given = (goal.opening, goal.force, goal.tip_speed)
    return not goal.touch and (goal.grasp or any(value is not None for value in given))


def check_opening(goal: Goal) -> None:
    """Refuse a goal in millimetres and newtons with unusable values.

    Raises:
        GoalRejected: if a value cannot be used.
    """
    if goal.opening is None:
        request = (
            "a grasp" if goal.grasp else "a force" if goal.force is not None else "a speed in m/s"
        )
        raise GoalRejected(f"{request} needs the opening, or the width of the object, in metres")
    name = "width" if goal.grasp else "opening"
    if not 0.0 <= goal.opening < math.inf:
        raise GoalRejected(f"the {name} must be 0 m or more, not {goal.opening:g}")
    if goal.force is not None and not 0.0 < goal.force < math.inf:
        raise GoalRejected(f"the force must be above 0 N, not {goal.force:g}")
    check_tip_speed(goal)
    for side, value in (("narrower", goal.narrower), ("wider", goal.wider)):
        if not 0.0 <= value < math.inf:
            raise GoalRejected(f"the tolerance '{side}' must be 0 m or more, not {value:g}")
    if goal.intensity != 1.0:
        raise GoalRejected("give an intensity or an opening, not both")
    if goal.stage is not Stage.BOTH:
        raise GoalRejected("give a stage or an opening, not both")
    if goal.force is not None and goal.effort:
        raise GoalRejected("give efforts or a force, not both")


def check_tip_speed(goal: Goal) -> None:
    """Refuse a goal with an unusable speed of the opening.

    Raises:
        GoalRejected: if it cannot be used.
    """
    if goal.tip_speed is None:
        return
    if not 0.0 < goal.tip_speed < math.inf:
        raise GoalRejected(f"the speed must be above 0 m/s, not {goal.tip_speed:g}")
    if goal.speed != 1.0:
        raise GoalRejected("give the speed as a share or in m/s, not both")


def plan_opening(
    goal: Goal,
    hand: Hand,
    library: ActionLibrary,
    devices: DeviceForces,
    find: Callable[[], Action],
    targets: Callable[[Action], Mapping[int, float]],
) -> OpeningPlan:
    """Plan a goal in millimetres and newtons.

    Args:
        goal: The goal; `check_opening` has passed it.
        hand: The hand.
        library: Its actions.
        devices: Which efforts and forces its devices can limit.
        find: Returns the action of a goal that names one.
        targets: Returns the actuators' positions of an action at intensity 1, by index [rad | m].

    Raises:
        GoalRejected: if the opening, the force or the speed is beyond the hand.
        UnknownAction: if there is no such action.
        ActionError: if it has no opening.
    """
    assert goal.opening is not None  # noqa: S101 - `check_opening` has seen to that
    width = goal.opening

    def grip_of(action: Action, opening: Opening) -> Grip:
        empty = meeting(action, opening, library)
        return Grip.of(hand, opening, targets(action), devices.grips, empty)

    if goal.action:
        action = find()
        opening = library.openings.of(action)
        _check_width(opening, goal)
    else:
        action, opening = _best(goal, hand, library, devices, grip_of)
    grip = grip_of(action, opening)
    at = grip.intensity_at(width)
    effort: dict[int, float] = {}
    if goal.force is not None:
        check_force(grip, hand, opening.label, goal.force, at)
        effort = grip.efforts(goal.force, at)
        _check_devices(hand, opening, effort, devices)
    if goal.max_force is not None:
        check_force(grip, hand, opening.label, goal.max_force, at)
    intensities: tuple[float, ...] = (at,)
    if goal.grasp:
        # First around the object, then closed until the object stops the fingers.
        wider = min(width + MARGIN, opening.widest)
        intensities = (grip.intensity_at(wider), grip.intensity[-1])
    if goal.tip_speed is not None:
        goal = replace(goal, speed=tip_speed_share(goal.tip_speed, hand, grip, at, opening.label))
    return OpeningPlan(goal, action, intensities, effort, grip)


def _check_width(opening: Opening, goal: Goal) -> None:
    """Refuse an opening that an action does not have, naming the nearest that it has."""
    width = goal.opening or 0.0
    least = opening.narrowest - (goal.narrower if goal.grasp else 0.0)
    if least - _ROUNDING <= width <= opening.widest + _ROUNDING:
        return
    nearest = opening.widest if width > opening.widest else opening.narrowest
    raise GoalRejected(
        f"{opening.label} opens {opening.narrowest * 1e3:.1f} to {opening.widest * 1e3:.1f} mm, "
        f"not {width * 1e3:.1f} mm; the nearest is {nearest * 1e3:.1f} mm"
    )


def _check_devices(
    hand: Hand, opening: Opening, effort: Mapping[int, float], devices: DeviceForces
) -> None:
    """Refuse a force if a device takes no effort limit, or cannot limit what the force needs."""
    nearest = "the nearest is the same without a force"
    for i in effort:
        if i in devices.refused:
            why = f": {devices.refused[i]}" if devices.refused[i] else ""
            raise GoalRejected(
                f"the device of '{hand.actuators[i].name}' takes no effort limit{why}; {nearest}"
            )
    # Two sides press equally: it is enough to limit one of them.
    if all(_unlimited(hand, side, effort, devices) for side in opening.sides):
        names = ", ".join(hand.actuators[i].name for i in effort if i in devices.unlimited)
        raise GoalRejected(
            f"the force of {opening.label} cannot be limited: its device knows no effort of "
            f"{names}; {nearest}"
        )


def force_refused(hand: Hand, opening: Opening, grip: Grip, devices: DeviceForces) -> str:
    """Return why no force can be requested of an action, in words; empty if one can."""
    # Actuators and devices without limits refuse any force, so one force in range is enough.
    at = grip.intensity[0]
    high = grip.forces(hand, at)[1]
    try:
        check_force(grip, hand, opening.label, high, at)
        _check_devices(hand, opening, grip.efforts(high, at), devices)
    except GoalRejected as error:
        return str(error)
    return ""


def _can(hand: Hand, opening: Opening, effort: Mapping[int, float], devices: DeviceForces) -> bool:
    """Return whether the devices can limit a force."""
    try:
        _check_devices(hand, opening, effort, devices)
    except GoalRejected:
        return False
    return True


def _unlimited(
    hand: Hand, side: Sequence[str], effort: Mapping[int, float], devices: DeviceForces
) -> bool:
    """Return whether a side presses with an actuator that cannot be limited, or with none."""
    presses = [i for i in effort if set(side).intersection(hand.actuators[i].fingers)]
    return not presses or any(i in devices.unlimited for i in presses)


def tip_speed_share(speed: float, hand: Hand, grip: Grip, at: float, name: str) -> float:
    """Return the share of the velocity limits at which the opening changes at a speed [m/s]."""
    slope = grip.slope_at(at)  # of the opening [m per unit of intensity]
    # The slowest actuator sets the time; all arrive together.
    most = max(
        abs(target - rest) / hand.actuators[i].velocity
        for i, rest, target in zip(grip.indices, grip.rest, grip.target, strict=True)
    )
    share = speed * most / slope
    # Rounding must not refuse the very speed that the refusal suggests.
    if share > 1.0 + 1e-9:
        raise GoalRejected(
            f"{name} opens and closes at {1e3 * speed / share:.3g} mm/s at most there, "
            f"not {1e3 * speed:g} mm/s"
        )
    return min(share, 1.0)


def around_speed(goal: Goal, hand: Hand, grip: Grip | None) -> float:
    """Return the share of the velocity limits at which a goal opens, or closes, around its object.

    What is thrown past its place there strikes the object.
    """
    if not goal.grasp or goal.force is None or goal.opening is None or grip is None:
        return goal.speed
    at = grip.intensity_at(goal.opening + MARGIN)
    if len(grip.squeezing(at)) < 2:
        return goal.speed
    try:
        return min(goal.speed, tip_speed_share(_AROUND_SPEED, hand, grip, at, ""))
    except GoalRejected:  # faster than the action can close
        return goal.speed


def closing_speed(goal: Goal, hand: Hand, grip: Grip | None) -> float:
    """Return the share of the velocity limits at which a goal closes on its object.

    The force of the impact, before any reflex acts, comes from the inertia of the motors and grows
    with the speed: the smaller the requested force, the slower the fingers meet the object.
    """
    if not goal.grasp or goal.force is None or goal.opening is None or grip is None:
        return goal.speed
    at = grip.intensity_at(goal.opening)
    speed = meeting_speed(goal.force, grip, at)
    try:
        return min(goal.speed, tip_speed_share(speed, hand, grip, at, ""))
    except GoalRejected:  # faster than the action can close
        return goal.speed


def meeting_speed(force: float, grip: Grip, at: float) -> float:
    """Return the closing speed of the opening at which the blow is not above a force [m/s].

    What moves with the fingers, of mass ``m`` at the opening, is stopped within a time ``t`` by
    ``m v / t``, which may be `_BLOW` of the force. Where the mass is not stated in hand.yaml, the
    speed is in proportion to the force.

    Args:
        force: The requested force [N].
        grip: The grip.
        at: Intensity at which the fingers meet the object.
    """
    mass = grip.moving_mass(at)
    if mass != mass:
        return max(_CONTACT_SPEED, _SPEED_PER_FORCE * force)
    return max(_SLOWEST, max(_BLOW * force, _LEAST_BLOW) * _STOPPING / mass)


def closing_time(goal: Goal, grip: Grip) -> float:
    """Return the additional time of a goal that closes slowly on its object [s]."""
    if not goal.grasp or goal.force is None or goal.opening is None:
        return 0.0
    speed = meeting_speed(goal.force, grip, grip.intensity_at(goal.opening))
    return (goal.opening + MARGIN) / speed


def _best(
    goal: Goal,
    hand: Hand,
    library: ActionLibrary,
    devices: DeviceForces,
    grip_of: Callable[[Action, Opening], Grip],
) -> tuple[Action, Opening]:
    """Return the action that suits an object's width, the force and the fingers best.

    Actions that can exert the force come first, then they are ordered by `suitability`.

    Raises:
        GoalRejected: if there is none; the sentence names the nearest.
    """
    for name in goal.elements:
        if name not in hand.finger_names:
            raise GoalRejected(f"unknown finger '{name}'; {suggestion(name, hand.finger_names)}")
    width = goal.opening or 0.0
    openings = _openings(library, goal.elements)
    candidates: list[tuple[tuple[float, ...], Action, Opening]] = []
    for order, (action, opening) in enumerate(openings):
        # At its widest opening, an action cannot get around the object.
        if not opening.narrowest - goal.narrower <= width < opening.widest:
            continue
        at = opening.intensity_at(width)
        grip = grip_of(action, opening)
        weak = False
        if goal.force is not None:
            low, high = grip.forces(hand, at)
            efforts = grip.efforts(goal.force, at)
            weak = not low <= goal.force <= high or not _can(hand, opening, efforts, devices)
        key = (weak, *suitability(hand, action, opening, width), order)
        candidates.append((key, action, opening))
    if not candidates:
        raise GoalRejected(_no_action(goal, hand, [opening for _, opening in openings]))
    _, action, opening = min(candidates, key=lambda each: each[0])
    return action, opening


def _openings(library: ActionLibrary, fingers: Sequence[str]) -> list[tuple[Action, Opening]]:
    """Return the actions with an opening; with fingers given, only those of just these fingers."""
    found, reason = [], ""
    for action in library:
        try:
            opening = library.openings.of(action)
        except ActionError as error:
            # All actions give the same reason, such as a missing file.
            reason = reason or str(error)
            continue
        if not fingers or set(fingers) == set(opening.fingers):
            found.append((action, opening))
    if not found and not library.openings.tables:
        raise GoalRejected(reason or "the hand has no actions")
    return found


def _no_action(goal: Goal, hand: Hand, openings: Sequence[Opening]) -> str:
    """Return the sentence that no action suits a goal, with the nearest width."""
    width = goal.opening or 0.0
    fingers = f" of {', '.join(goal.elements)}" if goal.elements else ""
    if not openings:
        return f"no action of '{hand.name}' has an opening between tips{fingers}"

    def off(opening: Opening) -> float:
        return max(opening.narrowest - width, width - opening.widest)

    nearest = min(openings, key=off)
    at = nearest.widest if width > nearest.widest else nearest.narrowest
    return (
        f"no action{fingers} of '{hand.name}' holds an object of {width * 1e3:.1f} mm; the nearest "
        f"is {at * 1e3:.1f} mm, by {label(nearest.action, nearest.elements)}"
    )
