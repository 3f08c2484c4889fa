"""From a goal to its plan, in one direction: the action, its legs, efforts, speed and timeout."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from typing import TYPE_CHECKING, Final

from rtee.actions.naming import label
from rtee.actions.openings import MARGIN, Openings, OpeningTable, best_for, doubtful, meeting
from rtee.actions.types import Action, Generic, Posture, Primitive, Timed
from rtee.errors import GoalRejected, UnknownAction, suggestion
from rtee.hand.model import Hand
from rtee.loop.closing import checked_share, closing_time
from rtee.loop.forces import DeviceForces, effort_limits, force_efforts, unlimited
from rtee.loop.grip import Grip
from rtee.loop.plan import Leg, Plan, targets_of
from rtee.types import (
    Around,
    FirstContact,
    Force,
    Goal,
    Intensity,
    Named,
    Opening,
    Stage,
    TipSpeed,
    from_rest,
)

if TYPE_CHECKING:
    from rtee.actions.library import ActionLibrary
    from rtee.loop.settings import LoopSettings

OPEN: Final = "open"
"""The action that every hand has: go to the rest posture, unless its library defines another."""

_ROUNDING: Final = 5e-5
"""An opening outside the table by less than this is clamped to its end [m]: people read openings
rounded to 0.1 mm."""


@dataclass(frozen=True, slots=True)
class OpposingTips:
    """The opposing fingertips of an action.

    Attributes:
        opening: The table of their opening.
        grip: Computes opening and force from measurements.
    """

    opening: OpeningTable
    grip: Grip


@dataclass(frozen=True, slots=True)
class FoundAction:
    """An action, with the data that every goal for it needs.

    Attributes:
        action: The action.
        tips: Its tips, if they oppose each other and its opening is known.
        meets: Positions beyond which the empty hand may touch itself, by index [rad | m].
    """

    action: Action
    tips: OpposingTips | None
    meets: Mapping[int, float]


Words = tuple[str, tuple[str, ...], str | None]
"""Name, elements and kind of an action, as a goal gives them."""

_MOST_FOUND: Final = 64
"""Most words that are remembered: a program names fewer actions, but clients may spell one in many
ways."""


class FoundActions:
    """The actions of earlier goals, until actions, openings or the devices' forces change.

    Any thread may use it.
    """

    def __init__(self) -> None:
        self._found: tuple[int, object, object, dict[Words, FoundAction]] = (-1, None, None, {})

    def since(
        self, version: int, openings: Openings, devices: DeviceForces
    ) -> dict[Words, FoundAction]:
        """Return the actions found with this version of the library, these openings and forces."""
        before = self._found
        same = before[0] == version and before[1] is openings and before[2] is devices
        if not same or len(before[3]) >= _MOST_FOUND:
            # Replaced in one step, for other threads.
            self._found = before = version, openings, devices, {}
        return before[3]


def choose(
    goal: Goal,
    hand: Hand,
    library: ActionLibrary,
    openings: Openings,
    devices: DeviceForces,
    known: dict[Words, FoundAction],
) -> FoundAction:
    """Return the action that a goal asks for; ``known`` caches those found, by the goal's words.

    Raises:
        UnknownAction: if there is no such action.
        ActionError: if it doesn't exist with these elements, or lacks the requested opening.
        GoalRejected: if no action of the fingers suits the goal; the sentence names the nearest.
    """
    what, to = goal.what, goal.to
    if isinstance(what, Named):
        words = what.action, tuple(what.elements), what.kind
        found = known.get(words)
        if found is None:
            action = _named(what, hand, library)
            found = known[words] = _found(action, openings, hand, library, devices)
    else:
        for name in what.elements:
            if name not in hand.finger_names:
                raise GoalRejected(
                    f"unknown finger '{name}'; {suggestion(name, hand.finger_names)}"
                )
        if isinstance(to, Opening | Around):
            action = _best(what.elements, to, goal.force, hand, library, devices)
        else:
            action = _touching(what.elements, hand, library)
        found = _found(action, openings, hand, library, devices)
    if found.tips is None:
        if not isinstance(to, Intensity | FirstContact):
            openings.of(found.action)  # raises the reason
    elif isinstance(to, Opening | Around) and not _spans(opening := found.tips.opening, to):
        raise GoalRejected(
            f"{opening.label} opens {opening.narrowest * 1e3:.1f} to {opening.widest * 1e3:.1f} mm,"
            f" not {to.width * 1e3:.1f} mm; the nearest is {_nearest(opening, to):.1f} mm"
        )
    return found


def _found(
    action: Action, openings: Openings, hand: Hand, library: ActionLibrary, devices: DeviceForces
) -> FoundAction:
    opening = openings.find(action)
    tips = None if opening is None else _tips(action, opening, hand, library, devices)
    return FoundAction(action, tips, _meets(action, hand, openings))


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
    action: Action, opening: OpeningTable, hand: Hand, library: ActionLibrary, devices: DeviceForces
) -> OpposingTips:
    targets = targets_of(action.waypoints[-1], hand)
    empty = meeting(action, opening, library, library.openings)
    return OpposingTips(opening, Grip.of(hand, opening, targets, devices.grips, empty))


def _spans(opening: OpeningTable, to: Opening | Around) -> bool:
    """Return whether an action can open to a width, or close on an object that wide."""
    least = opening.narrowest - (to.narrower if isinstance(to, Around) else 0.0)
    return least - _ROUNDING <= to.width <= opening.widest + _ROUNDING


def _nearest(opening: OpeningTable, to: Opening | Around) -> float:
    """Return the opening of an action that is nearest to a width [mm]."""
    return 1e3 * (opening.widest if to.width > opening.widest else opening.narrowest)


def _best(
    fingers: Sequence[str],
    to: Opening | Around,
    force: Force | None,
    hand: Hand,
    library: ActionLibrary,
    devices: DeviceForces,
) -> Action:
    """Return the action of some fingers, or of any, that suits a width and a force best.

    Actions that can exert the force come first, then `best_for` decides.
    """
    known = library.openings.known(library)
    openings = [each for each in known if not fingers or set(fingers) == set(each[1].fingers)]
    narrower = to.narrower if isinstance(to, Around) else 0.0
    # At its widest opening, an action cannot get around the object.
    able = [each for each in openings if each[1].narrowest - narrower <= to.width < each[1].widest]
    if not able:
        raise GoalRejected(_no_action(fingers, to, hand, [opening for _, opening in openings]))
    if force is not None:
        tips = [_tips(*each, hand, library, devices) for each in able]
        strong = [_exerts(force.value, to.width, each, hand, devices) for each in tips]
        able = list(compress(able, strong)) or able
    return best_for(hand, able, to.width)[0]


def _exerts(
    force: float, width: float, tips: OpposingTips, hand: Hand, devices: DeviceForces
) -> bool:
    """Return whether an action can exert a force at an opening, and its devices can limit it."""
    at = tips.opening.intensity_at(width)
    low, high = tips.grip.forces(hand, at)
    return low <= force <= high and not unlimited(hand, tips.opening, tips.grip, at, devices)


def _no_action(
    fingers: Sequence[str], to: Opening | Around, hand: Hand, openings: Sequence[OpeningTable]
) -> str:
    """Return an error message that no action suits a width, and which width is nearest."""
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

    Candidates move the tips of exactly these fingers. Preferred are tips that close on each other,
    then actions found free of collisions, then those first in the library. Without fingers, all
    actions with an opening are candidates, and the one with the most fingers is chosen.
    """
    wanted = set(fingers)
    candidates: list[tuple[tuple[float, ...], Action]] = []
    openings = library.openings
    for order, action in enumerate(library):
        opening = openings.find(action)
        if opening is not None:
            moved = set(opening.fingers)
        elif isinstance(action, Primitive) and wanted:
            moved = set(action.fingers)
        else:
            continue
        if not wanted or moved == wanted:
            key = (opening is None, doubtful(action), -len(moved), order)
            candidates.append((key, action))
    if not candidates:
        whose = ", ".join(fingers) or f"'{hand.name}'"
        raise GoalRejected(f"no action closes the fingertips of {whose}; give an action")
    return min(candidates, key=lambda each: each[0])[1]


_PRE_GRASP_GAP: Final = 0.05
"""Intensity between the pre-grasp of a pinch and its first contact: more than the tolerance of an
actuator, yet little enough to close quickly."""

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
    found: FoundActions | None = None,
) -> Plan:
    """Make the plan of a goal.

    Args:
        goal: The goal.
        hand: The hand.
        library: Its actions.
        settings: Timeouts.
        devices: Which efforts and forces the devices can limit; by default all efforts.
        found: Actions of earlier goals of this hand; ``None``: find the action again.

    Raises:
        GoalRejected: if the hand cannot reach a value of the goal.
        UnknownAction: if there is no such action.
        ActionError: if the action doesn't exist with these elements, or has no opening.
    """
    for name in goal.on_contact:
        if name and name not in hand.finger_names:
            raise GoalRejected(
                f"on_contact of an unknown finger '{name}'; {suggestion(name, hand.finger_names)}"
            )
    # Before the action is found: it may change meanwhile.
    version, openings = library.version, library.openings
    known = {} if found is None else found.since(version, openings, devices)
    chosen = choose(goal, hand, library, openings, devices, known)
    action, tips = chosen.action, chosen.tips
    legs = _legs(goal.to, action, tips, hand)
    effort = _efforts(goal, hand, tips, devices)
    speed = _speed(goal, action, tips, hand)
    timeout = goal.timeout
    if timeout is None:
        # Waits within the action, or a low speed, must not use up the time allowed for moving.
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
        meets=chosen.meets,
    )


def _meets(action: Action, hand: Hand, openings: Openings) -> Mapping[int, float]:
    """Return the positions beyond which the empty hand may touch itself, by index [rad | m]."""
    known = None if isinstance(action, Timed) else openings.meeting(action)
    if known is None:
        return {}
    rest, names = hand.rest, hand.actuator_names
    return {
        i: from_rest(float(rest[i]), target, known.get(names[i], 1.0))
        for i, target in targets_of(action.waypoints[-1], hand).items()
    }


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
    end = action.waypoints[-1]
    return tuple([Leg("", targets_of(end, hand, share)) for share in shares])


def _share(to: Intensity, action: Action) -> float:
    """Return the intensity at which a goal's motion ends, given its stage."""
    if isinstance(action, Timed) and to.share != 1.0:
        raise GoalRejected(
            f"'{action.name}' is a timed action, which always runs at intensity 1, not {to.share:g}"
        )
    if to.stage is Stage.BOTH:
        return to.share
    contact = action.evidence[0].contact_at if action.evidence else None
    if contact is None:
        raise GoalRejected(
            f"'{action.name}' has no stages: only pinches whose first contact is known have them;"
            f" leave '{to.stage}' out"
        )
    if to.stage is Stage.GRASP:
        return to.share
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
    if speed == 1.0:
        return 0.0
    at = {i: actuator.rest for i, actuator in enumerate(hand.actuators)}
    time = 0.0
    for leg in legs:
        # All actuators arrive together with the slowest one.
        time += max(
            (abs(to - at[i]) / hand.actuators[i].velocity for i, to in leg.targets.items()),
            default=0.0,
        )
        at.update(leg.targets)
    return min(time / speed - time, _LONGEST)
