"""The canonical form of a hand, which does not depend on how its model is written.

Two models of one hand may list links, joints, fingers and shapes in different orders, use different
names, base frames or units of length, or be mirror images. The searches work on one common form:
elements in an order that follows from structure and geometry alone, one of the two mirror images,
and a fixed size of the hand.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, islice, permutations, product
from typing import Final

import numpy as np

from rtee.actions.types import FARTHEST_CLEARANCE, Evidence
from rtee.extract.space import rounded
from rtee.hand.kinematics import Kinematics
from rtee.hand.linalg import cross, norm, norms
from rtee.hand.model import Finger, Hand, Joint
from rtee.hand.transmission import Coupling, Linear, Transmission
from rtee.hand.urdf import Triple, Urdf, UrdfGeometry, UrdfJoint, UrdfLink
from rtee.sample import FloatArray
from rtee.types import ActuatorSpec, JointKind, readonly

SIZE: Final = 0.2
"""Size of a hand in canonical form [m]: about that of a human hand, for which the resolutions and
step sizes of the searches are tuned."""

_SAME: Final = 1e-5
"""Difference of features, as a share of the hand's size, below which they count as equal: above the
rounding errors in files, below the differences between fingers."""

_TURN: Final = 1.0
"""Motion of a continuous actuator for comparing bent fingers [rad], as it has no limits."""

_MOST_ORDERS: Final = 5040
"""Maximum number of orders of the fingers to compare: all orders of seven fingers."""

_DIGITS: Final = 9
"""Decimals of lengths in the evidence [m]."""

_ROUNDED: Final = 3e-9
"""Largest error of rounding in both units [m]."""


@dataclass(frozen=True)
class Canonical:
    """A hand in canonical form, with methods that convert results back.

    Attributes:
        source: The original hand.
        hand: Its canonical form: the same names, with canonical order, size and handedness.
        unit: Canonical length of one metre of the source [m]: canonical lengths are those of the
            source times this factor.
        mirrored: Whether the canonical hand is the source's mirror image.
    """

    source: Hand
    hand: Hand
    unit: float
    mirrored: bool

    def posture(self, u: FloatArray) -> FloatArray:
        """Return a canonical posture ``(n,)`` in the source's order and units, as stored."""
        at = {spec.name: i for i, spec in enumerate(self.hand.actuators)}
        result = np.empty(len(u))
        for i, spec in enumerate(self.source.actuators):
            value, canonical = float(u[at[spec.name]]), self.hand.actuators[at[spec.name]]
            # Keep rest exact, despite rounding errors of the factor.
            result[i] = spec.rest if value == canonical.rest else value / _factor(spec, self.unit)
        return rounded(self.source, result)

    def fingers(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return names of fingers, sorted into the source's order."""
        order = self.source.finger_names
        return tuple(sorted(names, key=order.index))

    def evidence(self, found: Evidence, names: Sequence[str]) -> Evidence:
        """Return evidence in the source's order, frame and units.

        Args:
            found: The evidence of a canonical posture.
            names: The fingers in the canonical order.
        """
        turned = self.fingers(names) != tuple(names) and len(names) == 2
        opposed = found.opposition
        if opposed is not None and turned:
            opposed = replace(opposed, angles=(opposed.angles[1], opposed.angles[0]))
        sign = -1.0 if turned else 1.0
        links = list(self.source.urdf.links)
        colliding = [tuple(sorted(pair, key=links.index)) for pair in found.colliding]
        order = self.source.finger_names
        pairs = [self.fingers((a, b)) for a, b, _ in found.pairs]
        depths = {pair: p[2] for pair, p in zip(pairs, found.pairs, strict=True)}
        pairs.sort(key=lambda pair: (order.index(pair[0]), order.index(pair[1])))
        return replace(
            found,
            depth=self._length(found.depth),
            distance=self._length(found.distance),
            frame_distance=None
            if found.frame_distance is None
            else self._length(found.frame_distance),
            point=self._vector(found.point, 1.0 / self.unit),
            normal=self._vector(found.normal, sign),
            clearance=None if found.clearance is None else self._clearance(found.clearance),
            colliding=tuple(
                sorted(
                    ((a, b) for a, b in colliding),
                    key=lambda pair: (links.index(pair[0]), links.index(pair[1])),
                )
            ),
            opposition=opposed,
            pairs=tuple((a, b, self._length(depths[a, b])) for a, b in pairs),
        )

    def _clearance(self, value: float) -> float:
        length = self._length(value)
        # Restore the largest measured clearance, despite rounding errors.
        return FARTHEST_CLEARANCE if length > FARTHEST_CLEARANCE - _ROUNDED else length

    def _length(self, value: float) -> float:
        return round(value / self.unit, _DIGITS) + 0.0

    def _vector(self, vector: Triple | None, factor: float) -> Triple | None:
        if vector is None:
            return None
        x, y, z = (round(v * factor, _DIGITS) + 0.0 for v in _mirrored(vector, self.mirrored))
        return x, y, z


def canonical(hand: Hand) -> Canonical:
    """Return the canonical form of a hand."""
    points = _Points(hand)
    unit = SIZE / points.size if points.size > 0.0 else 1.0
    order, mirrored = points.order()
    urdf = _urdf(hand, points.places(order, mirrored), unit, mirrored)
    place = {name: i for i, name in enumerate(urdf.links)}.__getitem__
    fingers = tuple(
        replace(
            hand.fingers[i],
            tip_links=tuple(sorted(hand.fingers[i].tip_links, key=place)),
            bars=tuple(sorted(hand.fingers[i].bars, key=place)),
        )
        for i in order
    )
    by_name = {joint.name: joint for joint in hand.joints}
    joints = tuple(_joint(by_name[j.name], unit) for j in urdf.joints.values() if j.moving)
    index = _actuator_order(hand, fingers, [joint.name for joint in joints])
    return Canonical(
        hand,
        replace(
            hand,
            joints=joints,
            actuators=tuple(_actuator(hand.actuators[i], unit) for i in index),
            fingers=fingers,
            transmission=_transmission(hand, joints, index, unit),
            rest=readonly([_actuator(hand.actuators[i], unit).rest for i in index]),
            urdf=urdf,
            clearance=hand.clearance * unit,
        ),
        unit,
        mirrored,
    )


class _Points:
    """Points of a hand's fingers, at rest and bent, by which the fingers can be told apart.

    Attributes:
        size: Largest distance between two of the points [m].
    """

    def __init__(self, hand: Hand) -> None:
        self._hand = hand
        self._fingers = hand.fingers
        kinematics = Kinematics(hand)
        self._rest = kinematics.placements(hand.rest)
        far = hand.rest.copy()
        for finger in hand.fingers:
            for name in finger.actuators:
                spec = hand.actuator(name)
                bounded = math.isfinite(spec.farthest)
                far[hand.actuator_index(name)] = spec.farthest if bounded else spec.rest + _TURN
        bent = kinematics.placements(far)
        shared: set[str] = set()
        if len(hand.fingers) > 1:
            shared = set.intersection(*(set(finger.links) for finger in hand.fingers))
        # First, middle and last link of the finger alone at rest, centre of the tip at rest and
        # bent, and last link bent.
        rows = []
        for finger in hand.fingers:
            links = [link for link in finger.links if link not in shared] or [finger.links[-1]]
            chosen = links[0], links[len(links) // 2], links[-1]
            places = [self._rest[link][:3, 3] for link in chosen]
            tip = finger.tip or links[-1]
            places += [_centre(hand, tip, poses[tip]) for poses in (self._rest, bent)]
            places.append(bent[links[-1]][:3, 3])
            rows.append(places)
        self.points: FloatArray = np.array(rows).reshape(len(rows), 6, 3)
        flat = self.points.reshape(-1, 3)
        self.size = max((float(norms(flat - point).max()) for point in flat), default=0.0)

    def order(self) -> tuple[tuple[int, ...], bool]:
        """Return the canonical order of the fingers, and whether the mirror image is canonical.

        Chooses the order and image with the least value of the first feature, then of the next one,
        and so on. Candidates that remain differ only in names.
        """
        if not self._fingers:
            return (), False
        candidates = [*product(self._orders(), (1.0, -1.0))]
        for feature in self._features():
            values = [feature(order, sign) for order, sign in candidates]
            most = min(values) + _SAME
            candidates = [c for c, value in zip(candidates, values, strict=True) if value <= most]
            if len(candidates) == 1:
                break
        return candidates[0][0], candidates[0][1] < 0.0

    def places(self, order: Sequence[int], mirrored: bool) -> Mapping[str, tuple[float, ...]]:
        """Return distances from the fingers' points by link; they put all links in order."""
        chosen = self.points[list(order)].reshape(-1, 3)
        size = self.size or 1.0
        if not len(chosen):
            return {}
        found = {}
        for link, pose in self._rest.items():
            distances = norms(chosen - pose[:3, 3]) / size
            found[link] = tuple((np.rint(distances / _SAME / 10.0) * _SAME * 10.0).tolist())
        return found

    def _orders(self) -> Iterable[tuple[int, ...]]:
        """Return orders of the fingers: most actuators first, most of their own, with a tip."""
        groups: dict[tuple[int, ...], list[int]] = {}
        for i, finger in enumerate(self._fingers):
            key = (-len(finger.actuators), -len(finger.own), finger.tip is None)
            groups.setdefault(key, []).append(i)
        # Limit each iterator, too, since `product` reads all of them first.
        within = [islice(permutations(groups[key]), _MOST_ORDERS) for key in sorted(groups)]
        orders = (tuple(i for part in parts for i in part) for parts in product(*within))
        return islice(orders, _MOST_ORDERS)

    def _features(self) -> Iterable[_Feature]:
        fingers, kinds = self.points.shape[:2]
        # Distances between points first: they are the same in both images.
        for (i, j), a in product(combinations(range(fingers), 2), range(kinds)):
            for b in range(kinds):
                yield _Distance(self.points, self.size, (i, a), (j, b))
        for i in range(fingers):
            for a, b in combinations(range(kinds), 2):
                yield _Distance(self.points, self.size, (i, a), (i, b))
        places = [*product(range(fingers), range(kinds))]
        for corners in islice(combinations(places, 4), _MOST_ORDERS):
            yield _Volume(self.points, self.size, corners)


@dataclass(frozen=True, slots=True)
class _Distance:
    points: FloatArray
    size: float
    first: tuple[int, int]
    second: tuple[int, int]

    def __call__(self, order: Sequence[int], sign: float) -> float:
        a, b = (self.points[order[i], k] for i, k in (self.first, self.second))
        return norm(a - b) / (self.size or 1.0)


@dataclass(frozen=True, slots=True)
class _Volume:
    points: FloatArray
    size: float
    corners: tuple[tuple[int, int], ...]

    def __call__(self, order: Sequence[int], sign: float) -> float:
        a, b, c, d = (self.points[order[i], k] for i, k in self.corners)
        volume = float(np.add.reduce((b - a) * cross(c - a, d - a)))
        return sign * volume / (self.size or 1.0) ** 3


_Feature = _Distance | _Volume


def _centre(hand: Hand, link: str, pose: FloatArray) -> FloatArray:
    """Return the mean origin of a link's shapes [m], at a pose ``(4, 4)`` of the link."""
    shapes = hand.urdf.links[link].collisions
    if not shapes:
        return pose[:3, 3]
    middle = np.add.reduce(np.array([shape.xyz for shape in shapes]), axis=0) / len(shapes)
    centre: FloatArray = np.add.reduce(pose[:3, :3] * middle, axis=1) + pose[:3, 3]
    return centre


def _urdf(hand: Hand, places: Mapping[str, tuple[float, ...]], unit: float, mirrored: bool) -> Urdf:
    """Return the URDF in canonical order, size and handedness."""
    urdf = hand.urdf
    links = {name: _link(link, unit, mirrored) for name, link in urdf.links.items()}
    below = {
        link: tuple(
            sorted(
                (_urdf_joint(joint, unit, mirrored) for joint in joints),
                key=lambda joint: (places.get(joint.child, ()), joint.kind),
            )
        )
        for link, joints in urdf.joints_below.items()
    }
    ordered: dict[str, UrdfJoint] = {}
    waiting = list(reversed(below.get(urdf.root, ())))
    while waiting:
        joint = waiting.pop()
        ordered[joint.name] = joint
        waiting += reversed(below.get(joint.child, ()))
    sequence = [urdf.root, *(joint.child for joint in ordered.values())]
    return replace(
        urdf,
        links={name: links[name] for name in sequence},
        joints=ordered,
        joint_to={joint.child: joint for joint in ordered.values()},
        joints_below=below,
    )


def _link(link: UrdfLink, unit: float, mirrored: bool) -> UrdfLink:
    shapes = [_shape(shape, unit, mirrored) for shape in link.collisions]
    # Distances and sizes are the same in both images and all frames of the link.
    shapes.sort(
        key=lambda s: (
            s.kind,
            round(s.radius, 6),
            round(s.length, 6),
            sorted(round(abs(v), 6) for v in s.size),
            round(norm(np.array(s.xyz)), 6),
            s.mesh,
        )
    )
    return replace(link, collisions=tuple(shapes), visuals=())


def _shape(shape: UrdfGeometry, unit: float, mirrored: bool) -> UrdfGeometry:
    return replace(
        shape,
        size=_scaled(shape.size, unit),
        radius=shape.radius * unit,
        length=shape.length * unit,
        scale=_mirrored(_scaled(shape.scale, unit), mirrored),
        xyz=_mirrored(_scaled(shape.xyz, unit), mirrored),
        rpy=_mirrored_turn(shape.rpy, mirrored),
    )


def _urdf_joint(joint: UrdfJoint, unit: float, mirrored: bool) -> UrdfJoint:
    slides = joint.kind == "prismatic"
    # A rotation axis is an axial vector: a mirror reverses its other components.
    axis = _mirrored(joint.axis, mirrored) if slides else _mirrored_turn(joint.axis, mirrored)
    factor = unit if slides else 1.0
    return replace(
        joint,
        xyz=_mirrored(_scaled(joint.xyz, unit), mirrored),
        rpy=_mirrored_turn(joint.rpy, mirrored),
        axis=axis,
        lower=joint.lower * factor,
        upper=joint.upper * factor,
    )


def _scaled(vector: Triple, unit: float) -> Triple:
    x, y, z = vector
    return x * unit, y * unit, z * unit


def _mirrored(vector: Triple, mirrored: bool) -> Triple:
    x, y, z = vector
    return (x, -y, z) if mirrored else vector


def _mirrored_turn(vector: Triple, mirrored: bool) -> Triple:
    x, y, z = vector
    return (-x, y, -z) if mirrored else vector


def _joint(joint: Joint, unit: float) -> Joint:
    if joint.kind is not JointKind.PRISMATIC:
        return joint
    return replace(joint, lower=joint.lower * unit, upper=joint.upper * unit)


def _factor(spec: ActuatorSpec, unit: float) -> float:
    return unit if spec.kind is JointKind.PRISMATIC else 1.0


def _actuator(spec: ActuatorSpec, unit: float) -> ActuatorSpec:
    factor = _factor(spec, unit)
    return replace(
        spec, lower=spec.lower * factor, upper=spec.upper * factor, rest=spec.rest * factor
    )


def _actuator_order(hand: Hand, fingers: Sequence[Finger], joints: Sequence[str]) -> list[int]:
    """Return the indices of the actuators, finger by finger, those nearest the palm first."""
    place: dict[str, tuple[int, int]] = {}
    for number, finger in enumerate(fingers):
        for position, name in enumerate(finger.actuators):
            place.setdefault(name, (number, position))
    names = hand.actuator_names
    return sorted(
        range(len(names)),
        key=lambda i: (*place.get(names[i], (len(fingers), 0)), joints.index(names[i])),
    )


def _transmission(
    hand: Hand, joints: Sequence[Joint], index: Sequence[int], unit: float
) -> Transmission:
    old = {joint.name: i for i, joint in enumerate(hand.joints)}
    new = {actuator: i for i, actuator in enumerate(index)}
    couplings = []
    for joint in joints:
        known = hand.transmission.couplings[old[joint.name]]
        factor = 1.0
        if known.actuator is not None:
            factor = 1.0 / _factor(hand.actuators[known.actuator], unit)
        number = None if known.actuator is None else new[known.actuator]
        coupling = Coupling(number, (Linear(factor),))
        for stage in known.stages:
            coupling = coupling.then(stage)
        if joint.kind is JointKind.PRISMATIC:
            coupling = coupling.then(Linear(unit))
        couplings.append(coupling)
    return Transmission(couplings, len(index))
