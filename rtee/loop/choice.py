"""The action that a goal means: the one it names, or the one of its fingers that suits it best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rtee.actions.openings import Opening, doubtful, meeting, suitability
from rtee.actions.types import Action, Generic, Posture, Primitive
from rtee.errors import ActionError, GoalRejected, UnknownAction, suggestion
from rtee.hand.model import Hand
from rtee.loop.forces import DeviceForces, unlimited
from rtee.loop.grip import Grip
from rtee.loop.plan import targets_of
from rtee.types import Around, FirstContact, Force, Goal, Intensity, Named
from rtee.types import Opening as ToOpening

if TYPE_CHECKING:
    from rtee.actions.library import ActionLibrary

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
