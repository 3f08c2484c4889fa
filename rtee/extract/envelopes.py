"""Lower bounds on the distances of many links at many postures at once.

A capsule, a box and a ball enclose each link. The bounds only select links that need no exact
measurement, so that results do not depend on the bounds' last digits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtee.extract.pairs import LinkPair
from rtee.extract.scene import Scene
from rtee.hand.linalg import applied, composed, cross, inner, matmul, matvec, norm, norms, rotated
from rtee.sample import FloatArray
from rtee.types import JointKind

_SLACK: Final = 2e-6
"""Margin subtracted from every bound [m]: more than the rounding errors of the computation."""

_WORTH: Final = 40
"""Number of distances above which the bounds of capsules and boxes cost less than measuring."""

_ALONG: Final = 1e-10
"""Squared sine of the angle between two axes below which they count as parallel; the error is less
than a micrometre for links of 10 cm."""

_TINY: Final = 1e-30
"""Substitute for a zero divisor [m²]."""

_SIDES: Final = 16
"""Number of points around an end of a cylinder; their hull, slightly widened, encloses the end."""


@dataclass(frozen=True, slots=True)
class _Envelope:
    """A capsule, a box and a ball around a link, in the frame of its body.

    Attributes:
        ends: Ends of the capsule's axis ``(2, 3)`` [m].
        radius: Radius of the capsule [m].
        centre: Centre of the box ``(3,)`` [m].
        axes: Directions of the box's edges, in rows ``(3, 3)``.
        halves: Half the lengths of the box's edges ``(3,)`` [m].
        middle: Centre of the ball ``(3,)`` [m].
        reach: Radius of the ball [m].
    """

    ends: FloatArray
    radius: float
    centre: FloatArray
    axes: FloatArray
    halves: FloatArray
    middle: FloatArray
    reach: float


@dataclass(frozen=True, slots=True)
class _Level:
    """Joints at the same depth of the kinematic tree.

    Attributes:
        bodies: Numbers of the joints, and of the bodies that they move.
        parents: Numbers of the parent bodies.
        rotations: Orientations of the joints in the parent bodies ``(3, 3, 1, b)``.
        positions: Positions of the joints in the parent bodies ``(3, 1, b)`` [m].
        axes: Axes of the joints ``(3, 1, b)``.
        across: Cross-product matrices of the axes ``(3, 3, 1, b)``.
        along: Projection matrices onto the axes ``(3, 3, 1, b)``.
        slides: Whether the joints are prismatic ``(b,)``.
    """

    bodies: list[int]
    parents: list[int]
    rotations: FloatArray
    positions: FloatArray
    axes: FloatArray
    across: FloatArray
    along: FloatArray
    slides: NDArray[np.bool_]


def _levels(scene: Scene) -> list[_Level]:
    model, hand = scene.kinematics.model, scene.hand
    parents, depth = list(model.parents), [0] * model.njoints
    for body in range(1, model.njoints):
        depth[body] = depth[parents[body]] + 1
    levels = []
    for level in range(1, max(depth) + 1):
        bodies = [body for body in range(1, model.njoints) if depth[body] == level]
        placed = [model.jointPlacements[body] for body in bodies]
        joints = [hand.joints[body - 1] for body in bodies]
        axes = np.array([hand.urdf.joints[joint.name].axis for joint in joints])
        axes /= norms(axes)[:, None]
        slides = np.array([joint.kind is JointKind.PRISMATIC for joint in joints])
        levels.append(
            _Level(
                bodies,
                [parents[body] for body in bodies],
                np.array([p.rotation for p in placed]).transpose(1, 2, 0)[:, :, None],
                np.array([p.translation for p in placed]).T[:, None],
                axes.T[:, None],
                # The columns of a cross-product matrix are the products with the unit vectors.
                cross(axes[:, None, :], np.eye(3)).transpose(2, 1, 0)[:, :, None],
                (axes.T[:, None] * axes.T)[:, :, None],
                slides,
            )
        )
    return levels


Ends = NDArray[np.intp]
"""The numbers of the first and of the second links of pairs ``(2, p)``."""


class Envelopes:
    """Lower bounds on the distances of pairs of links, at many postures at once."""

    def __init__(self, scene: Scene) -> None:
        """Enclose all links."""
        self._scene = scene
        links = dict.fromkeys(shapes for pair in scene.pairs.values() for shapes in pair.shapes)
        self._number = {shapes: i for i, shapes in enumerate(links)}
        self._links = [_enclosed(scene, shapes) for shapes in links]
        self._bodies = [scene.shapes[shapes[0]].body for shapes in links]
        self._levels = _levels(scene)

    def ends(self, pairs: Sequence[LinkPair]) -> Ends:
        """Return the numbers of the links of each pair, for `gaps`."""
        numbers = [[self._number[shapes] for shapes in pair.shapes] for pair in pairs]
        return np.array(numbers, dtype=np.intp).reshape(-1, 2).T

    def gaps(
        self, postures: Sequence[FloatArray], pairs: Ends, within: FloatArray | float
    ) -> FloatArray:
        """Return a lower bound on the distance of every pair at every posture ``(t, p)`` [m].

        Args:
            postures: Actuator positions ``(n,)`` [rad | m].
            pairs: The pairs, as returned by `ends`.
            within: Distance ``(p,)`` [m] beyond which a coarse bound is good enough.
        """
        if not pairs.size:
            return np.zeros((len(postures), 0))
        rotations, positions = self._placed(postures)
        least = self._between_balls(rotations, positions, pairs)
        near = np.flatnonzero(least.min(axis=0) < within)
        if len(near) * len(postures) > _WORTH:
            closer = self._between_rods(rotations, positions, pairs[:, near])
            least[:, near] = np.maximum(least[:, near], closer)
        return least - _SLACK

    def _placed(self, postures: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Return rotations ``(3, 3, t, l)`` and positions ``(3, t, l)`` of the links' bodies."""
        rotations, positions = self._bodies_at(postures)
        return rotations[..., self._bodies], positions[..., self._bodies]

    def _bodies_at(self, postures: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Return rotations ``(3, 3, t, b)`` and positions ``(3, t, b)`` of all bodies."""
        if len(postures) == 1:
            self._scene.place(postures[0])
            turns, places = self._scene.bodies()
            return turns.transpose(1, 2, 0)[:, :, None], places.T[:, None]
        joints = np.array([self._scene.couplings.joints(u) for u in postures])
        cosines, sines = _each(math.cos, joints), _each(math.sin, joints)
        count = joints.shape[1] + 1
        rotations = np.empty((3, 3, len(joints), count))
        positions = np.zeros((3, len(joints), count))
        unit = np.eye(3)[:, :, None, None]
        rotations[..., :1] = unit
        # Place all joints of one depth at once.
        for level in self._levels:
            columns = [body - 1 for body in level.bodies]
            q, cosine, sine = (a[:, columns] for a in (joints, cosines, sines))
            above = rotations[..., level.parents]
            frames = composed(above, level.rotations)
            there = positions[..., level.parents] + applied(above, level.positions)
            if level.slides.any():
                there += applied(frames, level.axes * np.where(level.slides, q, 0.0))
                cosine = np.where(level.slides, 1.0, cosine)
                sine = np.where(level.slides, 0.0, sine)
            # Rodrigues' formula.
            turn = cosine * unit + sine * level.across + (1.0 - cosine) * level.along
            positions[..., level.bodies] = there
            rotations[..., level.bodies] = composed(frames, turn)
        return rotations, positions

    def _between_balls(
        self, rotations: FloatArray, positions: FloatArray, pairs: Ends
    ) -> FloatArray:
        centres, radii = self._balls
        there = applied(rotations, centres[:, None, :]) + positions
        between = there[..., pairs[1]] - there[..., pairs[0]]
        result: FloatArray = np.sqrt(inner(between, between)) - (radii[pairs[0]] + radii[pairs[1]])
        return result

    def _between_rods(
        self, rotations: FloatArray, positions: FloatArray, pairs: Ends
    ) -> FloatArray:
        """Return the largest of the distances of two capsules, and of either box from a capsule."""
        ends, radii, centres, axes, halves = self._stacked
        first, second = pairs
        tips = [applied(rotations, end[:, None, :]) + positions for end in ends]
        least = _between_segments(
            (tips[0][..., first], tips[1][..., first]),
            (tips[0][..., second], tips[1][..., second]),
        )
        least -= radii[first] + radii[second]
        middles = applied(rotations, centres[:, None, :]) + positions
        edges = composed(rotations, axes[:, :, None, :])
        for box, rod in ((first, second), (second, first)):
            beside = np.zeros(least.shape)
            starts, stops = (tip[..., rod] - middles[..., box] for tip in tips)
            for k in range(3):
                edge, half = edges[:, k][..., box], halves[k][box]
                a, b = inner(starts, edge), inner(stops, edge)
                out = np.maximum(np.minimum(a, b) - half, -np.maximum(a, b) - half)
                out = np.maximum(out, 0.0)
                beside += out * out
            least = np.maximum(least, np.sqrt(beside) - radii[rod])
        return least

    @cached_property
    def _balls(self) -> tuple[FloatArray, FloatArray]:
        """Centres ``(3, l)`` and radii ``(l,)`` of the balls [m]."""
        links = self._links
        return np.array([e.middle for e in links]).T, np.array([e.reach for e in links])

    @cached_property
    def _stacked(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Arrays of all envelopes, with the vector components first."""
        links = self._links
        return (
            np.array([e.ends for e in links]).transpose(1, 2, 0),
            np.array([e.radius for e in links]),
            np.array([e.centre for e in links]).T,
            # The directions of the edges in columns, as in a rotation matrix.
            np.array([e.axes.T for e in links]).transpose(1, 2, 0),
            np.array([e.halves for e in links]).T,
        )


def _enclosed(scene: Scene, shapes: tuple[int, ...]) -> _Envelope:
    """Return a capsule, a box and a ball around shapes of one body."""
    parts = [_balls(scene, i) for i in shapes]
    points = np.concatenate([points for points, _ in parts])
    radii = np.concatenate([np.full(len(points), radius) for points, radius in parts])
    middle: FloatArray = (points.min(axis=0) + points.max(axis=0)) / 2.0
    away = norms(points - middle) + radii
    far = points[int(np.argmax(away))]
    long = points[int(np.argmax(norms(points - far)))] - far
    frames = [np.eye(3), scene.shapes[shapes[0]].placement.rotation.T]
    if norm(long) > 0.0:
        # Align one axis with the longest diagonal, and the others across it.
        x = long / norm(long)
        y = cross(np.eye(3)[int(np.argmin(np.abs(x)))], x)
        y /= norm(y)
        frames.append(np.array([x, y, cross(x, y)]))
    boxes, capsules = [], []
    for axes in frames:
        local = rotated(points, axes)
        lower = (local - radii[:, None]).min(axis=0)
        upper = (local + radii[:, None]).max(axis=0)
        halves = (upper - lower) / 2.0
        boxes.append((float(np.prod(halves)), axes, (lower + upper) / 2.0, halves))
        capsules += [_capsule(local, radii, axes, k, (lower + upper) / 2.0) for k in range(3)]
    _, axes, centre, halves = min(boxes, key=lambda box: box[0])
    _, ends, radius = min(capsules, key=lambda capsule: capsule[0])
    centre = matvec(axes.T, centre)
    return _Envelope(ends, radius, centre, axes, halves, middle, float(away.max()))


def _capsule(
    local: FloatArray, radii: FloatArray, axes: FloatArray, k: int, middle: FloatArray
) -> tuple[float, FloatArray, float]:
    """Return a capsule along axis ``k`` around balls: its volume / π [m³], ends and radius [m]."""
    across = [i for i in range(3) if i != k]
    away = norms(local[:, across] - middle[across])
    radius = float((away + radii).max())
    cap = np.sqrt(np.maximum(0.0, (radius - radii) ** 2 - away * away))
    start, stop = float((local[:, k] + cap).min()), float((local[:, k] - cap).max())
    if start > stop:  # a sphere
        start = stop = (start + stop) / 2.0
    ends = np.array([middle, middle])
    ends[:, k] = start, stop
    volume = radius * radius * (stop - start + 4.0 / 3.0 * radius)
    return volume, matmul(ends, axes), radius


def _balls(scene: Scene, i: int) -> tuple[FloatArray, float]:
    """Return points ``(k, 3)`` in the body's frame, and the radius [m] of balls around them.

    The hull of these balls contains the shape.
    """
    shape = scene.shapes[i]
    kind, source = shape.source.kind, shape.source
    if kind == "sphere":
        points, radius = np.zeros((1, 3)), source.radius
    elif kind == "cylinder":
        turns = [2.0 * math.pi * k / _SIDES for k in range(_SIDES)]
        wide = source.radius / math.cos(math.pi / _SIDES)
        ring = np.array([(wide * math.cos(a), wide * math.sin(a), 0.0) for a in turns])
        up = np.array([0.0, 0.0, source.length / 2.0])
        points, radius = np.concatenate([ring - up, ring + up]), 0.0
    else:
        points, radius = shape.points, 0.0
    placed = rotated(points, shape.placement.rotation) + shape.placement.translation
    return placed, radius


def _each(function: Callable[[float], float], values: FloatArray) -> FloatArray:
    """Return a function of each value; NumPy's functions would depend on the processor."""
    return np.array([function(v) for v in values.ravel().tolist()]).reshape(values.shape)


def _between_segments(
    one: tuple[FloatArray, FloatArray], other: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """Return the distances ``(...)`` [m] of segments with ends ``(3, ...)``.

    Source: Ericson, Real-Time Collision Detection, 2005, section 5.1.9.
    """
    along, across, apart = one[1] - one[0], other[1] - other[0], one[0] - other[0]
    a, e = inner(along, along), inner(across, across)
    b, c, f = inner(along, across), inner(along, apart), inner(across, apart)
    both = a * e
    skew = both - b * b
    s = np.where(skew > _ALONG * both, (b * f - c * e) / np.maximum(skew, _TINY), 0.0)
    s = np.minimum(np.maximum(s, 0.0), 1.0)
    t = np.minimum(np.maximum((b * s + f) / np.maximum(e, _TINY), 0.0), 1.0)
    s = np.minimum(np.maximum((b * t - c) / np.maximum(a, _TINY), 0.0), 1.0)
    between = apart + s * along - t * across
    return np.sqrt(inner(between, between))
