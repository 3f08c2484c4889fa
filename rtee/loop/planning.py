"""From a goal to its plan, in one direction: the action, its legs, efforts, speed and timeout."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from rtee.actions.naming import label
from rtee.actions.openings import MARGIN, Opening, doubtful, meeting, suitability
from rtee.actions.types import Action, Generic, Posture, Primitive, Timed
from rtee.drivers.capabilities import GripForce
from rtee.errors import ActionError, GoalRejected, UnknownAction, suggestion
from rtee.hand.model import Hand
from rtee.loop.grip import Grip
from rtee.loop.plan import Leg, Plan, targets_of
from rtee.types import Around, FirstContact, Force, Goal, Intensity, Named, Stage, TipSpeed
from rtee.types import Opening as ToOpening

if TYPE_CHECKING:
    from rtee.actions.library import ActionLibrary
    from rtee.loop.settings import LoopSettings


@dataclass(frozen=True, slots=True)
class DeviceForces:
    """Efforts and forces that the devices of a hand can limit; by default all efforts.

    Attributes:
        refused: Reason why a device takes no effort limit, in words or empty, by actuator index.
        grips: Forces by the devices' data sheets, by actuator index.
        unlimited: Actuators whose effort their device cannot limit, though it limits others.
    """

    refused: Mapping[int, str] = field(default_factory=dict)
    grips: Mapping[int, GripForce] = field(default_factory=dict)
    unlimited: frozenset[int] = frozenset()


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
        if reason := _refusal(hand, index, refused):
            raise GoalRejected(reason)
        limits[index] = float(value)
    return limits


def force_efforts(
    force: float, at: float, hand: Hand, opening: Opening, grip: Grip, devices: DeviceForces
) -> dict[int, float]:
    """Return the effort limits for a force between the tips, by actuator index [N·m | N].

    Args:
        force: The force [N].
        at: Intensity at which it is exerted.
        hand: The hand.
        opening: The action's table.
        grip: The action's grip.
        devices: Which efforts and forces its devices can limit.

    Raises:
        GoalRejected: if the force cannot be exerted, or limited; the sentence names the nearest.
    """
    low, high = grip.forces(hand, at)
    # A rounding error at the ends is not worth a refusal.
    if not low * (1.0 - 1e-9) <= force <= high * (1.0 + 1e-9):
        raise GoalRejected(_beyond(force, low, high, opening.label, grip.width_at(at)))
    if reason := unlimited(hand, opening, grip, at, devices):
        raise GoalRejected(reason)
    return grip.efforts(force, at)


def _beyond(force: float, low: float, high: float, label: str, width: float) -> str:
    nearest, reason = (high, "most") if force > high else (low, "least")
    return (
        f"{label} gives at {reason} {nearest:.3g} N at an opening of {width * 1e3:.3g} mm, "
        f"not {force:g} N; the nearest is {nearest:.3g} N"
    )


def unlimited(hand: Hand, opening: Opening, grip: Grip, at: float, devices: DeviceForces) -> str:
    """Return why no force of an action can be limited at an intensity, in words; empty if one can.

    Actuators and devices without limits refuse every force.
    """
    if math.isinf(grip.forces(hand, at)[1]):
        return (
            f"{opening.label}: the force cannot be limited: its actuators have no effort limits; "
            "give some under 'limits' in hand.yaml"
        )
    presses = grip.effort_slopes(at)
    nearest = "the nearest is the same without a force"
    for i in presses:
        if reason := _refusal(hand, i, devices.refused):
            return f"{reason}; {nearest}"
    # Two sides press equally: it is enough to limit one of them.
    if all(_loose(hand, side, presses, devices) for side in opening.sides):
        names = ", ".join(hand.actuators[i].name for i in presses if i in devices.unlimited)
        return (
            f"the force of {opening.label} cannot be limited: its device knows no effort of "
            f"{names}; {nearest}"
        )
    return ""


def _refusal(hand: Hand, index: int, refused: Mapping[int, str]) -> str:
    if index not in refused:
        return ""
    why = f": {refused[index]}" if refused[index] else ""
    return f"the device of '{hand.actuators[index].name}' takes no effort limit{why}"


def _loose(
    hand: Hand, side: Sequence[str], presses: Mapping[int, float], devices: DeviceForces
) -> bool:
    """Return whether a side presses with an actuator that cannot be limited, or with none."""
    pressing = [i for i in presses if set(side).intersection(hand.actuators[i].fingers)]
    return not pressing or any(i in devices.unlimited for i in pressing)


_CONTACT_SPEED: Final = 0.01
"""Least closing speed of the opening for a goal with a force [m/s]: that of a touch, which crosses
the margin within a second."""

_SPEED_PER_FORCE: Final = 2e-3
"""Speed of the opening at which the fingers meet an object, per requested newton [m/s/N]. In MuJoCo
a 2F-85 hits with 0.38 N per mm/s, more than any other hand: the impact stays below the force."""

_AROUND_SPEED: Final = 0.15
"""Largest speed of the opening of fingers of several actuators on their path around an object
[m/s]: servos that integrate their error overshoot by some 20 ms of their motion, less than the
margin."""

_BLOW: Final = 0.8
"""Share of the requested force that the blow of the closing fingers may have: the force itself is
built up later."""

_MOST_BLOW: Final = 1.3
"""The same where they should not meet the object yet, on the path around it: what lies askew, or
deep in the hand, is met there."""

_LEAST_BLOW: Final = 1.0
"""A blow may be as large as this in any case, or exceed the force by it on the path around [N]."""

_STOPPING: Final = 0.0013
"""Time in which an object stops what moves with the fingers [s]: in MuJoCo, an EGU that closes at
90 mm/s strikes with 140 N (1.5 ms), an SVH at 52 mm/s with 2.6 N (1.1 ms). Rubber pads take longer,
and the blow is then softer."""

_YIELDING: Final = 6.0
"""Fingers that bend, of whose mass nothing is known, go around an object, and on once they met it,
at this multiple of the speed at which they meet it: with less, light things fall before a SoftHand
presses; with more, a 3-Finger strikes harder with its middles."""

_SLOWEST: Final = 0.002
"""Least closing speed by the moving mass [m/s]: the margin around an object takes five seconds."""


def tip_speed_share(speed: float, hand: Hand, grip: Grip, at: float) -> float:
    """Return the share of the velocity limits at which the opening changes at a speed [m/s].

    Above 1 if the action is slower than that, at an intensity ``at``.
    """
    slope = grip.slope_at(at)  # of the opening [m per unit of intensity]
    # The slowest actuator sets the time; all arrive together.
    most = max(
        abs(target - rest) / hand.actuators[i].velocity
        for i, rest, target in zip(grip.indices, grip.rest, grip.target, strict=True)
    )
    return speed * most / slope


def checked_share(speed: float, hand: Hand, grip: Grip, at: float, name: str) -> float:
    """Return `tip_speed_share`, at most 1; raises `GoalRejected` if the action is slower."""
    share = tip_speed_share(speed, hand, grip, at)
    # Rounding must not refuse the very speed that the refusal suggests.
    if share > 1.0 + 1e-9:
        raise GoalRejected(
            f"{name} opens and closes at {1e3 * speed / share:.3g} mm/s at most there, "
            f"not {1e3 * speed:g} mm/s"
        )
    return min(share, 1.0)


def leg_speed(plan: Plan, leg: int, hand: Hand) -> float:
    """Return the share of the velocity limits for a leg of a plan.

    Around an object, fingers of several actuators are slower, since what is thrown past its place
    there strikes the object. On the path, they strike with no more than a grasp may.
    As they close on it, the force of the impact, before any reflex acts, comes from the inertia of
    the motors and grows with the speed: the smaller the requested force, the slower the fingers
    meet the object.
    """
    grip, force = plan.grip, plan.force
    if not isinstance(plan.to, Around) or force is None or grip is None:
        return plan.speed
    if leg + 1 == len(plan.legs):
        at = grip.intensity_at(plan.to.width)
        speed = meeting_speed(force.value, grip, at)
    else:
        at = grip.intensity_at(plan.to.width + MARGIN)
        speed = around_speed(force.value, grip, at)
    return min(plan.speed, tip_speed_share(speed, hand, grip, at))


def slowed(plan: Plan, hand: Hand) -> str:
    """Return the speed at which the fingers meet the object, in words; empty: as asked for."""
    share, grip = leg_speed(plan, len(plan.legs) - 1, hand), plan.grip
    if grip is None or plan.width is None or not share < plan.speed:
        return ""
    full = 1e3 / tip_speed_share(1.0, hand, grip, grip.intensity_at(plan.width))
    return (
        f"the fingers meet the object at {share * full:.3g} mm/s instead of "
        f"{plan.speed * full:.3g} mm/s: faster, their blow may exceed the force"
    )


def around_speed(force: float, grip: Grip, at: float) -> float:
    """Return the largest speed of the opening on the path around an object [m/s].

    Args:
        force: The requested force [N].
        grip: The grip.
        at: Intensity at which the path ends.
    """
    most = math.inf if len(grip.squeezing(at)) < 2 else _AROUND_SPEED
    if math.isnan(grip.moving_mass(at)):
        return min(most, _YIELDING * meeting_speed(force, grip, at))
    blow = _BLOW * max(_MOST_BLOW * force, force + _LEAST_BLOW)
    return max(_SLOWEST, min(most, _struck(blow, grip, at)))


def _struck(blow: float, grip: Grip, at: float) -> float:
    """Return the speed of the opening at which what moves strikes with a force [m/s].

    What moves with the fingers, of mass ``m`` at the opening, is stopped within a time ``t`` by
    ``m v / t``; infinite if the mass is not known.
    """
    mass = grip.moving_mass(at)
    return math.inf if mass != mass else blow * _STOPPING / mass


def meeting_speed(force: float, grip: Grip, at: float) -> float:
    """Return the closing speed of the opening at which the blow is not above a force [m/s].

    It is in proportion to the force, and less where the mass that moves with the fingers is known
    and would strike with more than `_BLOW` of it.

    Args:
        force: The requested force [N].
        grip: The grip.
        at: Intensity at which the fingers meet the object.
    """
    by_mass = _struck(max(_BLOW * force, _LEAST_BLOW), grip, at)
    return max(_SLOWEST, min(by_mass, max(_CONTACT_SPEED, _SPEED_PER_FORCE * force)))


def closing_time(to: Around, force: float, grip: Grip) -> float:
    """Return the additional time of a goal that closes slowly on its object [s]."""
    at = grip.intensity_at(to.width)
    # What is met on the way around is closed on from there.
    way = max(grip.width[0], to.width + MARGIN)
    return way / meeting_speed(force, grip, at) + way / around_speed(force, grip, at)


OPEN: Final = "open"
"""The action that every hand has: go to the rest posture, unless its library defines another."""

_ROUNDING: Final = 5e-5
"""An opening beyond the table by less than this counts as the one at its end [m]: people read
openings rounded to 0.1 mm."""


@dataclass(frozen=True, slots=True)
class OpposingTips:
    """The opposing fingertips of an action.

    Attributes:
        opening: The table of their opening.
        grip: Computes opening and force from measurements.
    """

    opening: Opening
    grip: Grip


def choose(
    goal: Goal, hand: Hand, library: ActionLibrary, devices: DeviceForces
) -> tuple[Action, OpposingTips | None]:
    """Return the action that a goal means, and its tips, if they oppose each other.

    Raises:
        UnknownAction: if there is no such action.
        ActionError: if it doesn't exist with these elements, or has no opening that is asked for.
        GoalRejected: if no action of the fingers suits the goal; the sentence names the nearest.
    """
    to = goal.to
    if isinstance(goal.what, Named):
        action = _named(goal.what, hand, library)
    else:
        for name in goal.what.elements:
            if name not in hand.finger_names:
                raise GoalRejected(
                    f"unknown finger '{name}'; {suggestion(name, hand.finger_names)}"
                )
        if isinstance(to, ToOpening | Around):
            return _best(goal.what.elements, to, goal.force, hand, library, devices)
        action = _touching(goal.what.elements, hand, library)
    try:
        opening = library.openings.of(action)
    except ActionError:
        if isinstance(to, Intensity | FirstContact):
            return action, None
        raise
    if isinstance(to, ToOpening | Around) and not _spans(opening, to):
        raise GoalRejected(
            f"{opening.label} opens {opening.narrowest * 1e3:.1f} to {opening.widest * 1e3:.1f} mm,"
            f" not {to.width * 1e3:.1f} mm; the nearest is {_nearest(opening, to):.1f} mm"
        )
    return action, _tips(action, opening, hand, library, devices)


def _named(what: Named, hand: Hand, library: ActionLibrary) -> Action:
    try:
        return library.find(what.action, what.elements, what.kind)
    except UnknownAction:
        # The library takes precedence: a hand may define its own "open".
        if what.action.lower() != OPEN or what.elements or what.kind:
            raise
    rest = dict(zip(hand.actuator_names, hand.rest.tolist(), strict=True))
    return Generic(OPEN, Posture(rest, hand.actuator_names), "The rest posture.")


def _tips(
    action: Action, opening: Opening, hand: Hand, library: ActionLibrary, devices: DeviceForces
) -> OpposingTips:
    targets = targets_of(action.waypoints[-1], hand)
    empty = meeting(action, opening, library)
    return OpposingTips(opening, Grip.of(hand, opening, targets, devices.grips, empty))


def _spans(opening: Opening, to: ToOpening | Around) -> bool:
    """Return whether an action has an opening, or closes on an object of a width."""
    least = opening.narrowest - (to.narrower if isinstance(to, Around) else 0.0)
    return least - _ROUNDING <= to.width <= opening.widest + _ROUNDING


def _nearest(opening: Opening, to: ToOpening | Around) -> float:
    """Return the opening of an action that is nearest to a width [mm]."""
    return 1e3 * (opening.widest if to.width > opening.widest else opening.narrowest)


def _best(
    fingers: Sequence[str],
    to: ToOpening | Around,
    force: Force | None,
    hand: Hand,
    library: ActionLibrary,
    devices: DeviceForces,
) -> tuple[Action, OpposingTips]:
    """Return the action of some fingers, or of any, that suits a width and a force best.

    Actions that can exert the force come first, then they are ordered by `suitability`.
    """
    openings = _openings(library, fingers)
    narrower = to.narrower if isinstance(to, Around) else 0.0
    candidates: list[tuple[tuple[float, ...], tuple[Action, OpposingTips]]] = []
    for order, (action, opening) in enumerate(openings):
        # At its widest opening, an action cannot get around the object.
        if not opening.narrowest - narrower <= to.width < opening.widest:
            continue
        tips = _tips(action, opening, hand, library, devices)
        weak = force is not None and not _exerts(force.value, to.width, tips, hand, devices)
        key = (weak, *suitability(hand, action, opening, to.width), order)
        candidates.append((key, (action, tips)))
    if not candidates:
        raise GoalRejected(_no_action(fingers, to, hand, [opening for _, opening in openings]))
    return min(candidates, key=lambda each: each[0])[1]


def _exerts(
    force: float, width: float, tips: OpposingTips, hand: Hand, devices: DeviceForces
) -> bool:
    """Return whether an action can exert a force at an opening, and its devices limit it."""
    at = tips.opening.intensity_at(width)
    low, high = tips.grip.forces(hand, at)
    return low <= force <= high and not unlimited(hand, tips.opening, tips.grip, at, devices)


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


def _no_action(
    fingers: Sequence[str], to: ToOpening | Around, hand: Hand, openings: Sequence[Opening]
) -> str:
    """Return the sentence that no action suits a width, with the nearest."""
    of = f" of {', '.join(fingers)}" if fingers else ""
    if not openings:
        return f"no action of '{hand.name}' has an opening between tips{of}"
    nearest = min(openings, key=lambda o: max(o.narrowest - to.width, to.width - o.widest))
    return (
        f"no action{of} of '{hand.name}' holds an object of {to.width * 1e3:.1f} mm; the nearest "
        f"is {_nearest(nearest, to):.1f} mm, by {nearest.label}"
    )


def _touching(fingers: Sequence[str], hand: Hand, library: ActionLibrary) -> Action:
    """Return the action that closes some fingers, or the whole hand, to touch something.

    Candidates move the tips of exactly these fingers, in the order: tips that close on each other,
    actions found clear of collisions, order of the library. Without fingers, all actions with an
    opening are candidates, and the one with the most fingers is chosen.
    """
    wanted = set(fingers)
    candidates: list[tuple[tuple[float, ...], Action]] = []
    for order, action in enumerate(library):
        try:
            moved = set(library.openings.of(action).fingers)
            closes = True
        except ActionError:
            if not isinstance(action, Primitive) or not wanted:
                continue
            moved, closes = set(action.fingers), False
        if not wanted or moved == wanted:
            key = (not closes, doubtful(action), -len(moved), order)
            candidates.append((key, action))
    if not candidates:
        whose = ", ".join(fingers) or f"'{hand.name}'"
        raise GoalRejected(f"no action closes the fingertips of {whose}; name one")
    return min(candidates, key=lambda each: each[0])[1]


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
    to: Intensity | ToOpening | Around | FirstContact,
    action: Action,
    tips: OpposingTips | None,
    hand: Hand,
) -> tuple[Leg, ...]:
    shares: Sequence[float] = (1.0,)
    if isinstance(to, Intensity):
        shares = (_share(to, action),)
    elif isinstance(to, ToOpening | Around) and tips is not None:
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
    if tips is None or not isinstance(goal.to, ToOpening | Around):
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
    if isinstance(to, ToOpening | Around):
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
