"""Find the posture in which fingertips touch the contacts that a planner asks for.

Each wanted contact is a point and a normal into the object. A damped least-squares search
(Levenberg 1944, Marquardt 1963) over the actuators brings the surface of one fingertip to each
point, its outward normal along the contact's. It starts from the hand's own actions, which is where
hands are made to grasp.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Final

import numpy as np

from rtee.actions.types import Action
from rtee.errors import ConfigError, suggestion
from rtee.hand.model import Hand
from rtee.objects.shape import vector
from rtee.planning.closing import ActionPath
from rtee.planning.collisions import GraspCollisions
from rtee.planning.frames import (
    checked_direction,
    checked_pose,
    direction_of,
    flange_rows,
    retreated,
    rows,
)
from rtee.planning.grasp_solution import GraspSolution, Residual, WantedContact
from rtee.planning.objects import GraspObject
from rtee.planning.result import Point
from rtee.planning.tips import Fingertips
from rtee.sample import FloatArray
from rtee.types import from_rest

TOLERANCE: Final = 0.003
"""Largest distance of a fingertip from its contact [m]: the give of a soft pad."""

STEEPEST: Final = math.radians(60.0)
"""Largest angle between wanted and real normal [rad]: beyond, a tip slides off its contact even
with a friction of 1.7, as of rubber."""

MARGIN: Final = 0.015
"""Room between fingertips and contacts before the grasp [m]: planners' poses are off by less."""

_PROBE: Final = 5e-3
"""A tip is probed from this far inside the object [m]: there its nearest point and the normal
change smoothly over its edges, as those of a fingertip rounded with this radius."""

_LENGTH: Final = 1e-3
"""Distance that weighs as much as the next angle [m]."""

_ANGLE: Final = math.radians(15.0)
"""Angle between normals that weighs as much as that distance [rad]."""

_POSTURE: Final = 30.0
"""A deviation from the start by an actuator's whole range counts as little as 1/30 of that
distance: it only decides between postures that are otherwise as good."""

_STARTS: Final = 6
"""Postures of actions from which each choice of fingers is searched, the nearest ones."""

_CHOICES: Final = 6
"""Choices of fingers that are searched: those whose tips come closest in the actions' postures."""

_INTENSITIES: Final = (0.25, 0.5, 0.75, 1.0)
"""Intensities at which the postures of actions are tried as starts."""

_STEPS: Final = 40
"""Most steps of one search; most end within fifteen."""

_GAIN: Final = 1e-4
"""A step that improves the sum of squares by a smaller share is the last."""

_DIFFERENCE: Final = 1e-4
"""Step of the numerical derivative, as a share of an actuator's range."""

_DAMPING: Final = (1e-3, 1e-9, 1e6)
"""First, least and largest damping, relative to the squares of the derivative's columns."""

_GOOD: Final = 0.5
"""Sum of squares of a contact that is within a millimetre and a few degrees."""

_SAME: Final = 5e-3
"""Distance below which two contacts cannot belong to two fingertips [m]."""

_MOST: Final = 10
"""Most contacts: hands have five fingers, and a mistake should not take a minute."""


@dataclass(frozen=True)
class _Contact:
    point: FloatArray
    normal: FloatArray
    finger: str


def reach_contacts(
    hand: Hand,
    actions: Iterable[Action],
    contacts: Sequence[WantedContact],
    *,
    palm_pose: FloatArray | None = None,
    approach: Sequence[float] | None = None,
    retreat: float = 0.1,
    tolerance: float = TOLERANCE,
    tips: Fingertips | None = None,
    obj: GraspObject | None = None,
    object_pose: FloatArray | None = None,
) -> GraspSolution:
    """Return the posture in which fingertips touch the wanted contacts.

    Args:
        hand: The hand.
        actions: Its actions, in whose postures the search starts.
        contacts: The contacts: two or more.
        palm_pose: Pose of the hand's base link ``(4, 4)`` in the frame of the contacts; that frame
            is the base link's unless given.
        approach: Direction in which the palm approaches, in the frame of the contacts; from the
            palm to the middle of the contacts unless given.
        retreat: Distance of the palm along it before the approach [m].
        tolerance: Farthest that a fingertip may be from its contact [m].
        tips: The fingertips, where their geometry was read already.
        obj: The object, or another obstacle, to check for collisions; without one, only those of
            the hand with itself are checked.
        object_pose: Its pose ``(4, 4)`` in the frame of the contacts; that frame's unless given.

    Raises:
        ConfigError: if a value is invalid, or no posture reaches the contacts; with the reason.
        ModelError: if a mesh of the hand is missing or cannot be read.
    """
    base = checked_pose(palm_pose, "the palm's pose")
    tips = tips or Fingertips(hand)
    wanted = _checked(hand, tips, contacts, base)
    if not (math.isfinite(tolerance) and tolerance > 0.0):
        raise ConfigError(f"a tolerance must be above 0 m, not {tolerance:g}")
    given = None if approach is None else checked_direction(approach)
    if not (math.isfinite(retreat) and retreat >= 0.0):
        raise ConfigError(f"a retreat must be 0 m or more, not {retreat:g}")
    there = np.linalg.inv(base) @ checked_pose(object_pose, "the object's pose")
    collisions = GraspCollisions(hand, tips.geometry, obj, there)
    search = _PostureSearch(hand, tips, _starts(hand, actions), collisions)
    u, fingers = search.best(wanted)
    residuals = [search.residual(u, c, f) for c, f in zip(wanted, fingers, strict=True)]
    _refuse(residuals, wanted, tolerance)
    before = search.before(u, wanted, fingers)
    involved = [hand.actuator_names[i] for i in search.involved(fingers)]
    # The wanted points are in the palm's frame here: their middle is the vector from its origin.
    middle = base[:3, :3] @ np.mean([c.point for c in wanted], axis=0)
    unknown = "the palm is in the middle of the contacts: give the direction of its approach"
    direction = direction_of(middle, unknown) if given is None else given
    return GraspSolution(
        hand=hand.name,
        fingers=fingers,
        posture=_by_name(hand, u, involved),
        pre_grasp=_by_name(hand, before, involved),
        palm_pose=rows(base),
        pre_palm_pose=rows(retreated(base, direction, retreat)),
        flange_pose=flange_rows(hand, base),
        pre_flange_pose=flange_rows(hand, retreated(base, direction, retreat)),
        residuals=tuple(
            Residual(r.finger, _point(base[:3, :3] @ r.point + base[:3, 3]), r.distance, r.angle)
            for r in residuals
        ),
        collisions=collisions.at(u, fingers) + collisions.at(before, (), "pre_grasp"),
    )


def _checked(
    hand: Hand, tips: Fingertips, contacts: Sequence[WantedContact], base: FloatArray
) -> list[_Contact]:
    """Return the contacts in the base link's frame, each with a normal."""
    if not 2 <= len(contacts) <= _MOST:
        raise ConfigError(f"a grasp must have 2 to {_MOST} contacts, not {len(contacts)}")
    if len(contacts) > len(tips.fingers):
        raise ConfigError(
            f"{len(contacts)} contacts for {len(tips.fingers)} fingertips: '{hand.name}' has "
            f"{', '.join(tips.fingers) or 'none'}"
        )
    names = [c.finger for c in contacts if c.finger]
    for name in names:
        if name not in tips.fingers:
            raise ConfigError(f"unknown finger '{name}'; {suggestion(name, tips.fingers)}")
        if names.count(name) > 1:
            raise ConfigError(f"the finger '{name}' has two contacts")
    points = np.array([vector(c.point, "a contact's point") for c in contacts])
    for i, j in zip(*np.triu_indices(len(points), 1), strict=True):
        if np.linalg.norm(points[i] - points[j]) < _SAME:
            raise ConfigError(f"the contacts {i + 1} and {j + 1} are at the same place")
    turn, origin = base[:3, :3], base[:3, 3]
    middle = points.mean(axis=0)
    made = []
    for point, contact in zip(points, contacts, strict=True):
        given = contact.normal
        normal = middle - point if given is None else np.array(vector(given, "a contact's normal"))
        length = float(np.linalg.norm(normal))
        if length < 1e-9:
            raise ConfigError("a contact's normal must not be 0")
        made.append(_Contact(turn.T @ (point - origin), turn.T @ normal / length, contact.finger))
    return made


def _starts(hand: Hand, actions: Iterable[Action]) -> list[FloatArray]:
    """Return rest, and postures along the paths of actions."""
    rest = np.array(hand.rest)
    found = [rest]
    for action in actions:
        goal = ActionPath.of(hand, action).end
        found += [from_rest(rest, goal, s) for s in _INTENSITIES]
    # A posture that several actions share would take up several of the `_STARTS`.
    return list({u.round(6).tobytes(): u for u in found}.values())


class _PostureSearch:
    """Searches for postures of one hand."""

    def __init__(
        self,
        hand: Hand,
        tips: Fingertips,
        starts: Sequence[FloatArray],
        collisions: GraspCollisions,
    ) -> None:
        self._hand, self._tips, self._starts = hand, tips, starts
        self._collisions = collisions
        lower, upper = np.array(hand.lower), np.array(hand.upper)
        # One turn holds every angle of a continuous actuator, and a search needs finite bounds.
        self._lower = np.where(np.isfinite(lower), lower, -np.pi)
        self._upper = np.where(np.isfinite(upper), upper, np.pi)
        self._range = np.maximum(self._upper - self._lower, 1e-9)

    def involved(self, fingers: Iterable[str]) -> list[int]:
        """Return the actuators that move some fingers' tips."""
        names = {name for finger in fingers for name in self._hand.finger(finger).actuators}
        return [i for i, name in enumerate(self._hand.actuator_names) if name in names]

    def best(self, wanted: Sequence[_Contact]) -> tuple[FloatArray, tuple[str, ...]]:
        """Return the best posture found, and which finger touches where.

        Of postures that are within a millimetre and a few degrees of all contacts, the first
        without collisions is the best. One with collisions is taken only if all have some.
        """
        good = _GOOD * len(wanted)
        colliding: list[tuple[float, FloatArray, tuple[str, ...]]] = []
        costs = self._costs(wanted)
        ranked = sorted(
            self._choices(wanted), key=lambda choice: float(self._cost(costs, choice).min())
        )
        found: list[tuple[float, FloatArray, tuple[str, ...]]] = []
        for choice in ranked[:_CHOICES]:
            order = np.argsort(self._cost(costs, choice), kind="stable")
            for k in order[:_STARTS].tolist():
                cost, u = self._descend(self._starts[k], wanted, choice)
                # Looking for collisions is slow: postures that miss the contacts are not worth it.
                clear = cost >= good or not self._collisions.at(u, choice)
                (found if clear else colliding).append((cost, u, choice))
            # By the cost alone: a tie between tuples would compare arrays, which raises.
            if found and min(found, key=lambda each: each[0])[0] < good:
                break
        least = min((each[0] for each in found), default=math.inf)
        _, u, choice = min(found if least < good else found + colliding, key=lambda each: each[0])
        return u, choice

    def _choices(self, wanted: Sequence[_Contact]) -> list[tuple[str, ...]]:
        """Return all assignments of fingers to contacts."""
        named = {c.finger for c in wanted if c.finger}
        free = [name for name in self._tips.fingers if name not in named]
        count = sum(not c.finger for c in wanted)
        found = []
        for order in permutations(free, count):
            rest = iter(order)
            found.append(tuple(c.finger or next(rest) for c in wanted))
        return found

    def _costs(self, wanted: Sequence[_Contact]) -> FloatArray:
        """Return the squares of all tips' residuals ``(starts, contacts, tips)``."""
        fingers = self._tips.fingers
        found = np.zeros((len(self._starts), len(wanted), len(fingers)))
        for row, u in enumerate(self._starts):
            self._tips.go(u)
            for column, contact in enumerate(wanted):
                for k, finger in enumerate(fingers):
                    part = self._part(contact, finger)
                    found[row, column, k] = part @ part
        return found

    def _cost(self, costs: FloatArray, choice: Sequence[str]) -> FloatArray:
        """Return the sums over the contacts ``(starts,)`` for a choice of fingers."""
        columns = [self._tips.fingers.index(finger) for finger in choice]
        found: FloatArray = costs[:, np.arange(len(columns)), columns].sum(axis=1)
        return found

    def _part(self, contact: _Contact, finger: str) -> FloatArray:
        """Return the residual of one contact for the hand as placed ``(4,)``."""
        distance, _, normal = self._probed(contact, finger)
        return np.append((normal - contact.normal) / _ANGLE, distance / _LENGTH)

    def _probed(self, contact: _Contact, finger: str) -> tuple[float, FloatArray, FloatArray]:
        """Return the distance of a tip from a contact, its nearest point and its normal there."""
        inside = contact.point + _PROBE * contact.normal
        distance, point, normal = self._tips.near(finger, inside)
        return distance - _PROBE, point, normal

    def residual(self, u: FloatArray, contact: _Contact, finger: str) -> Residual:
        """Return the residual at a contact, in the base link's frame."""
        self._tips.go(u)
        distance, point, normal = self._probed(contact, finger)
        # By rounding, the product of unit vectors may exceed 1, which acos refuses.
        angle = math.acos(min(max(float(normal @ contact.normal), -1.0), 1.0))
        return Residual(finger, _point(point), distance, angle)

    def _descend(
        self, start: FloatArray, wanted: Sequence[_Contact], fingers: Sequence[str]
    ) -> tuple[float, FloatArray]:
        """Return the sum of squares and the posture at the end of one search."""
        moving = self.involved(fingers)
        # The other fingers are not part of the grasp: they stay at rest.
        u = np.array(self._hand.rest)
        u[moving] = start[moving]
        home = u[moving].copy()
        span = self._range[moving]

        def residuals(x: FloatArray) -> FloatArray:
            placed = u.copy()
            placed[moving] = x
            self._tips.go(placed)
            parts = [self._part(c, f) for c, f in zip(wanted, fingers, strict=True)]
            return np.concatenate([*parts, (x - home) / span / _POSTURE])

        x, damping = home.copy(), _DAMPING[0]
        r = residuals(x)
        for _ in range(_STEPS):
            slope = self._slope(residuals, x, r, moving)
            square, descent = slope.T @ slope, slope.T @ r
            before = float(r @ r)
            while damping <= _DAMPING[2]:
                # Marquardt's scaling: actuators in radians and in metres are damped alike.
                damped = square + damping * np.diag(np.diag(square) + 1e-12)
                tried = x - np.linalg.solve(damped, descent)
                tried = np.clip(tried, self._lower[moving], self._upper[moving])
                after = residuals(tried)
                if after @ after < before:
                    break
                damping *= 4.0
            else:
                # No damping improves it: this is the minimum, up to rounding.
                break
            x, r, damping = tried, after, max(damping / 4.0, _DAMPING[1])
            if before - float(r @ r) < _GAIN * before:
                break
        u[moving] = x
        return float(r @ r), u

    def _slope(
        self,
        residuals: Callable[[FloatArray], FloatArray],
        x: FloatArray,
        r: FloatArray,
        moving: Sequence[int],
    ) -> FloatArray:
        """Return the derivative of the residuals by forward differences ``(len(r), len(x))``."""
        columns = []
        for k, i in enumerate(moving):
            step = _DIFFERENCE * self._range[i]
            # Backwards at the upper limit: no posture is outside the limits.
            if x[k] + step > self._upper[i]:
                step = -step
            there = x.copy()
            there[k] += step
            columns.append((residuals(there) - r) / step)
        return np.array(columns).T

    def before(
        self, u: FloatArray, wanted: Sequence[_Contact], fingers: Sequence[str]
    ) -> FloatArray:
        """Return the posture on the path from rest in which every tip leaves room at its contact.

        The rest posture, if there is none.
        """
        rest = np.array(self._hand.rest)
        # From the grasp backwards, so that the fingers open no farther than they need to.
        for share in np.linspace(1.0, 0.0, 51).tolist():
            posture = from_rest(rest, u, share)
            self._tips.go(posture)
            room = (self._tips.near(f, c.point)[0] for c, f in zip(wanted, fingers, strict=True))
            if min(room) >= MARGIN:
                return posture
        return rest


def _refuse(residuals: Sequence[Residual], wanted: Sequence[_Contact], tolerance: float) -> None:
    """Raise `ConfigError` for contacts that are not reached."""
    far = []
    for residual, contact in zip(residuals, wanted, strict=True):
        at = ", ".join(f"{1e3 * v:.0f}" for v in contact.point)
        if abs(residual.distance) > tolerance:
            far.append(
                f"{residual.finger} stays {abs(residual.distance) * 1e3:.0f} mm from its contact "
                f"at ({at}) mm"
            )
        elif residual.angle > STEEPEST:
            far.append(
                f"{residual.finger} meets its contact at ({at}) mm "
                f"{math.degrees(residual.angle):.0f} degrees off the normal"
            )
    if far:
        raise ConfigError(f"the contacts cannot be reached: {'; '.join(far)}, in the palm's frame")


def _by_name(hand: Hand, u: FloatArray, names: Iterable[str]) -> Mapping[str, float]:
    return {name: float(u[hand.actuator_index(name)]) for name in names}


def _point(values: FloatArray) -> Point:
    x, y, z = (float(value) for value in values)
    return x, y, z
