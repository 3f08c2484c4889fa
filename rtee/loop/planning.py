"""From a goal to its plan, in one direction: the action, its legs, efforts, speed and timeout."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Final

from rtee.actions.naming import label
from rtee.actions.openings import MARGIN
from rtee.actions.types import Action, Timed
from rtee.errors import GoalRejected, suggestion
from rtee.hand.model import Hand
from rtee.loop.choice import OpposingTips, choose
from rtee.loop.closing import checked_share, closing_time
from rtee.loop.forces import DeviceForces, effort_limits, force_efforts
from rtee.loop.plan import Leg, Plan, targets_of
from rtee.types import Around, FirstContact, Force, Goal, Intensity, Opening, Stage, TipSpeed

if TYPE_CHECKING:
    from rtee.actions.library import ActionLibrary
    from rtee.loop.settings import LoopSettings

_PRE_GRASP_GAP: Final = 0.05
"""Intensity from the pre-grasp of a pinch to its first contact: more than the tolerance of an
actuator, and little enough to close quickly."""

_TOUCH_SPEED: Final = 0.01
"""Default speed at which the opening closes until the first contact [m/s]: a loop of 100 Hz then
stops within 0.2 mm."""

_TOUCH_SHARE: Final = 0.05
"""Share of the velocity limits at which actions without an opening close to touch: some
0.1 rad/s."""

_LONGEST: Final = 86400.0
"""Most that a low speed adds to a timeout [s]: a day, for shares of the velocity limit near 0."""

_ALL_EFFORTS: Final = DeviceForces()


def make_plan(
    goal: Goal,
    hand: Hand,
    library: ActionLibrary,
    settings: LoopSettings,
    *,
    devices: DeviceForces = _ALL_EFFORTS,
) -> Plan:
    """Make the plan of a goal.

    Args:
        goal: The goal.
        hand: The hand.
        library: Its actions.
        settings: Timeouts.
        devices: Which efforts and forces the devices can limit; by default all efforts.

    Raises:
        GoalRejected: if a value of the goal is beyond the hand.
        UnknownAction: if there is no such action.
        ActionError: if the action doesn't exist with these elements, or has no opening.
    """
    for name in goal.on_contact:
        if name and name not in hand.finger_names:
            raise GoalRejected(
                f"on_contact of an unknown finger '{name}'; {suggestion(name, hand.finger_names)}"
            )
    action, tips = choose(goal, hand, library, devices)
    legs = _legs(goal.to, action, tips, hand)
    effort = _efforts(goal, hand, tips, devices)
    speed = _speed(goal, action, tips, hand)
    timeout = goal.timeout
    if timeout is None:
        # Waiting times of the action must not use up the time for moving, nor must a low speed.
        margins = sum([leg.before + leg.after for leg in legs])
        timeout = settings.goal_timeout * len(legs) + margins + _slowness(speed, hand, legs)
        if isinstance(goal.to, Around) and tips is not None and goal.force is not None:
            timeout += closing_time(goal.to, goal.force.value, tips.grip)
    return Plan(
        goal_id=goal.goal_id,
        action=action.name,
        elements=action.elements,
        legs=legs,
        involved=frozenset().union(*[leg.targets for leg in legs]),
        effort=effort,
        timeout=timeout,
        to=goal.to,
        speed=speed,
        force=goal.force,
        on_contact=goal.on_contact,
        timed=isinstance(action, Timed),
        grip=None if tips is None else tips.grip,
    )


def _legs(
    to: Intensity | Opening | Around | FirstContact,
    action: Action,
    tips: OpposingTips | None,
    hand: Hand,
) -> tuple[Leg, ...]:
    shares: Sequence[float] = (1.0,)
    if isinstance(to, Intensity):
        shares = (_share(to, action),)
    elif isinstance(to, Opening | Around) and tips is not None:
        grip = tips.grip
        shares = (grip.intensity_at(to.width),)
        if isinstance(to, Around):
            # First around the object, then closed until the object stops the fingers.
            wider = min(to.width + MARGIN, tips.opening.widest)
            shares = (grip.intensity_at(wider), grip.intensity[-1])
    if isinstance(action, Timed):
        return tuple(
            Leg(step.alias, targets_of(step.posture, hand), step.before, step.after)
            for step in action.steps
        )
    return tuple(Leg("", targets_of(action.waypoints[-1], hand, share)) for share in shares)


def _share(to: Intensity, action: Action) -> float:
    """Return the intensity for the stage of a pinch."""
    if isinstance(action, Timed) and to.share != 1.0:
        raise GoalRejected(
            f"'{action.name}' is a timed action, which always runs at intensity 1, not {to.share:g}"
        )
    if to.stage is not Stage.PRE_GRASP:
        return to.share
    contact = action.evidence[0].contact_at if action.evidence else None
    if contact is None:
        raise GoalRejected(
            f"'{action.name}' has no pre-grasp: only pinches whose first contact is known have one"
        )
    return min(to.share, max(0.0, contact - _PRE_GRASP_GAP))


def _efforts(
    goal: Goal, hand: Hand, tips: OpposingTips | None, devices: DeviceForces
) -> Mapping[int, float]:
    """Return the effort limits by actuator index [N·m | N]."""
    if not isinstance(goal.effort, Force):
        return effort_limits(goal.effort, hand, devices.refused)
    if tips is None or not isinstance(goal.to, Opening | Around):
        return {}
    at = tips.grip.intensity_at(goal.to.width)
    efforts, *_ = [
        force_efforts(force, at, hand, tips.opening, tips.grip, devices)
        for force in (goal.effort.value, goal.effort.most)
        if force is not None
    ]
    return efforts


def _speed(goal: Goal, action: Action, tips: OpposingTips | None, hand: Hand) -> float:
    """Return the speed as a share of the velocity limits."""
    speed, to = goal.speed, goal.to
    if isinstance(to, FirstContact) and speed == 1.0:
        speed = TipSpeed(_TOUCH_SPEED)
        if tips is None:
            return _TOUCH_SHARE
    if not isinstance(speed, TipSpeed):
        return speed
    if tips is None:
        raise GoalRejected(f"{action.name} has no opening: give the speed as a share")
    grip = tips.grip
    # Where the opening falls fastest, so that it closes no faster anywhere else.
    at = max(grip.intensity, key=grip.slope_at)
    if isinstance(to, Opening | Around):
        at = grip.intensity_at(to.width)
    name = label(action.name, action.elements)
    return checked_share(speed.value, hand, grip, at, name)


def _slowness(speed: float, hand: Hand, legs: Iterable[Leg]) -> float:
    """Return the additional time of motions at a share of the velocity limits [s]."""
    at = {i: actuator.rest for i, actuator in enumerate(hand.actuators)}
    time = 0.0
    for leg in legs:
        # All actuators arrive together with the slowest one.
        time += max(
            (abs(to - at[i]) / hand.actuators[i].velocity for i, to in leg.targets.items()),
            default=0.0,
        )
        at.update(leg.targets)
    return min(time * (1.0 / speed - 1.0), _LONGEST)
