"""Offline: derive which finger follows which human finger, from a hand's model and pinches."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from rtee.actions.library import ActionLibrary
from rtee.actions.openings import model_of
from rtee.actions.types import Primitive, PrimitiveKind
from rtee.errors import ActionError, ConfigError
from rtee.hand.halton import halton
from rtee.hand.model import Finger
from rtee.retarget.correspondence import (
    FORMAT,
    Correspondence,
    FingerMap,
    Human,
    Palm,
    Pinch,
    Vector,
)
from rtee.retarget.tips import Tips, limits_of
from rtee.sample import FloatArray

_NAMES: Final = {str(human): human for human in Human} | {"pinky": Human.LITTLE}

_IN_ORDER: Final = (Human.INDEX, Human.MIDDLE, Human.RING, Human.LITTLE)

_WIDTHS: Final = 17
"""Number of openings stored for a gripper: enough for the curve of a linkage."""

_POSTURES: Final = 128
"""Number of postures that determine the reach of a finger: enough for its few joints."""

_BEGIN: Final = 0.3
"""Share of the path to the closed posture over which a finger's motion shows where the palm faces.
"""

_PINCHING: Final = 0.5
"""Closure of the fingers in a typical pinch, 0 to 1; of several pinches, the nearest is used."""


def fit(library: ActionLibrary) -> Correspondence:
    """Derive the correspondence of a hand to a human hand from its model and primitives alone.

    Raises:
        ConfigError: if the hand has fewer than two fingertips.
        ModelError: if one of its meshes cannot be read.
    """
    return _Fit(library, Tips(library.hand)).found()


class _Fit:
    def __init__(self, library: ActionLibrary, tips: Tips) -> None:
        self._hand, self._tips, self._openings = library.hand, tips, library.openings
        self._primitives = [action for action in library if isinstance(action, Primitive)]
        hand = library.hand
        self._fingers = [finger for finger in hand.fingers if finger.tip_links]
        if len(self._fingers) < 2:
            raise ConfigError(
                f"retargeting needs a hand with at least two fingertips; {hand.name} has "
                f"{len(self._fingers)}"
            )
        self._rest = np.array(hand.rest)
        self._closed = self._closing()
        self._bases = {finger.name: self._base(finger) for finger in self._fingers}
        self._ends = {finger.name: self._end(finger) for finger in self._fingers}

    def found(self) -> Correspondence:
        hand = self._hand
        humans = self._humans()
        grips = Human.NEAREST in humans.values()
        thumb = next(name for name, human in humans.items() if human is Human.THUMB)
        pairs = [(thumb, name) for name in humans if name != thumb]
        return Correspondence(
            FORMAT,
            model_of(hand),
            self._palm(humans, thumb),
            {
                name: FingerMap(
                    human,
                    _vector(self._bases[name]),
                    _vector(self._ends[name][1]),
                    round(self._reach(name), 4),
                    # A gripper only opens and closes: the human tip's position does not matter.
                    follow=0.0 if grips else 1.0,
                )
                for name, human in humans.items()
            },
            {name: round(value, 4) for name, value in self._closed.items()},
            tuple(self._pinch(pair, grips=grips) for pair in pairs),
        )

    # --- fingers -----------------------------------------------------------------------------

    def _base(self, finger: Finger) -> FloatArray:
        """Return the base of a finger at rest ``(3,)`` [m]: its first actuated joint."""
        hand, path = self._hand, self._hand.urdf.path_to(str(finger.tip))
        rows = {joint.name: row for row, joint in enumerate(hand.joints)}
        own = {hand.actuator_index(name) for name in finger.own or finger.actuators}
        moved = [j.child for j in path if j.moving and hand.transmission.moves(rows[j.name]) in own]
        link = moved[0] if moved else finger.base
        return np.array(self._tips.kinematics.link_pose(link, self._rest)[:3, 3])

    def _end(self, finger: Finger) -> tuple[int, FloatArray]:
        """Return the body of a fingertip, and its farthest point in the tip link's frame [m]."""
        geometry, kinematics = self._tips.geometry, self._tips.kinematics
        body, placement = kinematics.bodies[str(finger.tip)]
        shapes = [geometry.shapes[i] for i in geometry.of_links(*finger.tip_links)]
        points = np.concatenate(
            [s.points @ s.placement.rotation.T + s.placement.translation for s in shapes]
        )
        # Measured from the finger's base at rest, where most hands are open.
        self._tips.go(self._rest)
        base = kinematics.data.oMi[body].actInv(self._bases[finger.name])
        far = points[np.argmax(np.linalg.norm(points - base, axis=1))]
        # Take the mean near the end, which lies in the middle of the tip instead of on its edge.
        ends = points[points @ _unit(far - base) > far @ _unit(far - base) - 0.004]
        return body, np.array(placement.actInv(ends.mean(axis=0)))

    def _tip(self, name: str, u: FloatArray) -> FloatArray:
        """Return the position of a tip ``(3,)`` [m] at actuator positions ``(n,)``."""
        link = str(self._hand.finger(name).tip)
        pose = self._tips.kinematics.link_pose(link, u)
        return pose[:3, :3] @ self._ends[name][1] + pose[:3, 3]

    def _reach(self, name: str) -> float:
        hand = self._hand
        own = [hand.actuator_index(a) for a in self._hand.finger(name).actuators]
        lower, upper = limits_of(hand)
        far = [float(np.linalg.norm(self._tip(name, self._rest) - self._bases[name]))]
        for shares in halton(len(own), _POSTURES) if own else ():
            u = self._rest.copy()
            u[own] = lower[own] + shares * (upper - lower)[own]
            far.append(float(np.linalg.norm(self._tip(name, u) - self._bases[name])))
        return max(far)

    # --- closing -----------------------------------------------------------------------------

    def _closing(self) -> dict[str, float]:
        """Return the closed positions of the actuators that close fingers."""
        kinds = (PrimitiveKind.TRIG, PrimitiveKind.SINGLE_JOINT_MULTIPLE_TIPS)
        closed: dict[str, float] = {}
        for kind in kinds:
            for primitive in self._primitives:
                if primitive.kind is kind:
                    posture = primitive.posture
                    for name in posture.involved:
                        closed.setdefault(name, posture.position[name])
        return closed

    def _at(self, closed: float) -> FloatArray:
        """Return the actuator positions ``(n,)`` with all fingers closed by a share, 0 to 1."""
        u = self._rest.copy()
        for name, value in self._closed.items():
            i = self._hand.actuator_index(name)
            u[i] += closed * (value - u[i])
        return u

    def _motion(self, name: str) -> FloatArray:
        return self._tip(name, self._at(_BEGIN)) - self._tip(name, self._rest)

    # --- correspondence ----------------------------------------------------------------------

    def _humans(self) -> dict[str, Human]:
        """Return the human finger of each finger that has one."""
        names = [finger.name for finger in self._fingers]
        known = {name: _NAMES[name] for name in names if name in _NAMES}
        if Human.THUMB not in known.values():
            motions = {name: self._motion(name) for name in names}
            total = sum(motions.values(), np.zeros(3))
            thumb = min(names, key=lambda name: float(motions[name] @ (total - motions[name])))
            # Without a named thumb, the hand only opens and closes, like a gripper.
            return {name: Human.THUMB if name == thumb else Human.NEAREST for name in names}
        if len(names) == 2:
            return {name: known.get(name, Human.NEAREST) for name in names}
        free = [human for human in _IN_ORDER if human not in known.values()]
        thumb = next(name for name, human in known.items() if human is Human.THUMB)
        others = [name for name in names if name not in known]
        # In the order of their bases' distances from the thumb's.
        others.sort(key=lambda n: float(np.linalg.norm(self._bases[n] - self._bases[thumb])))
        return known | dict(zip(others, free, strict=False))

    def _palm(self, humans: Mapping[str, Human], thumb: str) -> Palm:
        names = sorted(
            (name for name in humans if name != thumb),
            key=lambda name: list(Human).index(humans[name]),
        )
        bases = [self._bases[name] for name in names]
        vectors = [self._tip(name, self._rest) - self._bases[name] for name in names]
        distal = _unit(np.sum([_unit(vector) for vector in vectors], axis=0))
        palmar = np.sum([self._motion(name) for name in names], axis=0)
        across = bases[0] - bases[-1]
        if len(names) < 2 or not np.linalg.norm(across) > 1e-3:
            across = np.cross(distal, palmar)
        radial = _unit(across - (across @ distal) * distal)
        normal = np.cross(radial, distal)
        palmar = normal if normal @ palmar >= 0.0 else -normal
        return Palm(_vector(palmar), _vector(radial), _vector(distal))

    # --- pinches -----------------------------------------------------------------------------

    def _pinch(self, pair: tuple[str, str], *, grips: bool) -> Pinch:
        contact = self._contact(pair)
        if not (grips and contact):
            return Pinch(pair, contact)
        shares = np.linspace(0.0, 1.0, _WIDTHS)
        positions = {
            name: tuple(np.round(rest + shares * (value - rest), 4).tolist())
            for name, value in contact.items()
            for rest in [self._hand.actuator(name).rest]
        }
        widths = np.minimum.accumulate([self._width(pair, contact, share) for share in shares])
        return Pinch(pair, contact, tuple(np.round(widths, 5).tolist()), positions)

    def _width(self, pair: tuple[str, str], contact: Mapping[str, float], share: float) -> float:
        """Return the opening between two fingers on the path from rest to their contact [m]."""
        for primitive in self._pinches(pair):
            try:
                opening = self._openings.of(primitive)
            except ActionError:
                continue  # it has no table
            touching = primitive.evidence[0].contact_at if primitive.evidence else None
            return opening.at(share * (touching or 1.0))
        u = self._rest.copy()
        for name, value in contact.items():
            u[self._hand.actuator_index(name)] += share * (value - self._hand.actuator(name).rest)
        self._tips.go(u)
        return max(0.0, self._tips.gap(pair)[0])

    def _pinches(self, pair: tuple[str, str]) -> list[Primitive]:
        kinds = (PrimitiveKind.PINCH_TIGHT, PrimitiveKind.PINCH_LOOSE)
        found = (each for each in self._primitives if each.kind in kinds)
        return [each for each in found if {*each.elements} == {*pair}]

    def _contact(self, pair: tuple[str, str]) -> dict[str, float]:
        """Return the positions at which two fingertips first touch on the path to their pinch."""
        hand, usual = self._hand, self._at(_PINCHING)
        lower, upper = limits_of(hand)
        best: tuple[float, dict[str, float]] = (np.inf, {})
        for primitive in self._pinches(pair):
            for posture, evidence in zip(primitive.postures, primitive.evidence, strict=True):
                share = 1.0 if evidence.contact_at is None else evidence.contact_at
                contact = {
                    name: rest + share * (posture.position[name] - rest)
                    for name in posture.involved
                    for rest in [hand.actuator(name).rest]
                }
                rows = [hand.actuator_index(name) for name in contact]
                off = (np.array([*contact.values()]) - usual[rows]) / (upper - lower)[rows]
                best = min(best, (float(np.linalg.norm(off)), contact), key=lambda each: each[0])
        return {name: round(value, 4) for name, value in best[1].items()}


def _unit(vector: FloatArray) -> FloatArray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def _vector(values: FloatArray) -> Vector:
    x, y, z = (round(float(value), 5) for value in values)
    return x, y, z
