"""Convert 21 points of a human hand to actuator positions, frame by frame."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from rtee.actions.library import ActionLibrary
from rtee.errors import ConfigError
from rtee.hand.load import hand_folder, load_hand
from rtee.hand.model import Hand
from rtee.retarget.correspondence import Correspondence, Human, read_correspondence
from rtee.retarget.fit import fit
from rtee.retarget.human import (
    FINGERS,
    HumanPosture,
    Smoother,
    bones,
    in_palm,
    mirrored,
    posture_of,
)
from rtee.retarget.layouts import LAYOUTS, Layout, Side, layout_named, side_named
from rtee.retarget.tips import Row, Tips, limits_of
from rtee.sample import FloatArray
from rtee.values import number

TOUCHING: Final = 0.018
"""Distance between two tracked human tips that touch [m]: half a finger's thickness each."""

APART: Final = 0.095
"""Distance between the human tips at which a gripper is fully open [m]."""

_MEET: Final = (0.036, 0.06)
"""Distances between two human tips [m]: below the first, their gap is kept exactly; above the
second, it is ignored. In between, the weight changes smoothly."""

_FINGER: Final = 0.085
"""Length of a human finger from the knuckle [m]: gaps scale with the robot's fingers over it."""

_PRIOR: Final = 0.6
"""Weight of the human fingers' closure, which decides where tip positions leave a choice [1/range].
"""

_STAY: Final = 0.6
"""Weight of the last positions [1/range]."""

_SLIDE: Final = 3.0
"""Weight of the last positions of fingers whose tips meet [1/range]: as their surfaces are curved,
tips that slide quickly on one another would separate."""

_GAP: Final = 150.0
"""Weight of a gap between tips that meet [1/m]: ten times that of a tip's position, about 1/reach.
"""

_DRAW: Final = 0.5
"""Weight of the extracted pinch's positions while the tips meet [1/range]."""

_GRIP: Final = 50.0
"""The same weight for a gripper, which can only open and close [1/range]."""

_DRAWN: Final = 0.03
"""Gap at which the extracted pinch has half of this weight [m]."""

_APART: Final = 1000.0
"""Weight of overlapping links of different fingers [1/m]: more than that of tips that meet."""

_CURVED: Final = 1.0
"""Curvature assumed for damping a tip's path, relative to a circle around the finger's base."""

_STEPS: Final = 2
"""Number of Gauss-Newton steps per frame: from the last frame's solution, two suffice to reach the
level of noise."""

_CORRECTIONS: Final = 3
"""Maximum number of gap corrections after these steps: at the edges of tips, a step turns the
normal."""

_REACHED: Final = (0.0002, 0.008)
"""Errors of a gap below which it needs no correction, and above which none would help [m]."""

_SOFT: Final = 1e-5
"""Square of a gap's motion over an actuator's range that counts as 0 [m²]: 3 mm squared."""

_SMALL: Final = 0.05
"""Largest correction [range]."""


@dataclass(frozen=True, slots=True)
class _Pinch:
    pair: tuple[str, str]
    fingers: tuple[int, int]
    human: Human
    scale: float
    rows: NDArray[np.intp]
    contact: FloatArray
    widths: FloatArray
    positions: FloatArray

    def at(self, width: float) -> FloatArray:
        """Return a gripper's actuator positions ``(a,)`` at a distance between its tips [m]."""
        # np.interp needs increasing abscissae, but the widths decrease.
        return np.array([np.interp(-width, -self.widths, column) for column in self.positions])


@dataclass(frozen=True, slots=True)
class _Problem:
    """The targets of a frame.

    Attributes:
        last: The last positions ``(n,)`` [rad | m].
        targets: Target positions of the tips ``(k, 3)`` [m].
        follow: Weights of the tips' positions ``(k,)`` [1/m].
        stiffness: Sums of the squared weights of target positions ``(n,)``.
        pull: Sums of the squared weights times the target positions ``(n,)``.
        wanted: Pairs of fingers, the required gap between their tips [m] and its weight, 0 to 1.
        near: Links that should stay apart.
    """

    last: FloatArray
    targets: FloatArray
    follow: FloatArray
    stiffness: FloatArray
    pull: FloatArray
    wanted: list[tuple[tuple[str, str], float, float]]
    near: list[Row]


class Solver:
    """Solves for a hand's actuator positions, starting from the last ones."""

    def __init__(self, hand: Hand, found: Correspondence, tips: Tips) -> None:
        self._tips = tips
        self._lower, self._upper = limits_of(hand)
        self.range = np.maximum(self._upper - self._lower, 1e-6)
        self._turned = self.range**2
        self._rest, n = np.array(hand.rest), len(hand.actuators)
        names = list(found.fingers)
        maps = list(found.fingers.values())
        self._humans = [each.human for each in maps]
        self._axes = np.array([found.palm.palmar, found.palm.radial, found.palm.distal])
        self._bases = np.array([each.base for each in maps])
        self._reach = np.array([max(each.reach * each.scale, 1e-6) for each in maps])
        self._follow = np.array([each.follow for each in maps])
        self._bodies, self._points = [], []
        for name, each in found.fingers.items():
            body, placement = tips.kinematics.bodies[str(hand.finger(name).tip)]
            self._bodies.append(body)
            self._points.append(np.array(placement * np.array(each.tip)))
        # Not for a gripper: the hulls of its moving jaws may overlap.
        if self._follow.any():
            tips.watch()
        # The fingers that each actuator closes; it follows the mean of their closures.
        self._closed = self._rest.copy()
        self._closes = np.zeros((n, len(names)))
        self._moves = np.array(
            [[float(a in hand.finger(f).actuators) for f in names] for a in hand.actuator_names]
        )
        for name, value in found.closed.items():
            i = hand.actuator_index(name)
            self._closed[i] = value
            for k, finger in enumerate(names):
                spec = hand.finger(finger)
                self._closes[i, k] = float(name in (spec.own or spec.actuators))
        self._closes /= np.maximum(self._closes.sum(axis=1, keepdims=True), 1.0)
        self._pinches: list[_Pinch] = []
        self._drawing = np.full(n, _DRAW**2)
        for pinch in found.pinches:
            fingers = names.index(pinch.fingers[0]), names.index(pinch.fingers[1])
            reach = float(np.mean([self._reach[k] for k in fingers]))
            rows = np.array(
                [hand.actuator_index(a) for a in pinch.positions or pinch.contact], dtype=np.intp
            )
            contact = np.array([*pinch.contact.values()])
            if pinch.widths:
                self._drawing[rows] = _GRIP**2
            human = self._humans[fingers[1]]
            widths, positions = np.array(pinch.widths), np.array([*pinch.positions.values()])
            scale = reach / _FINGER
            self._pinches.append(
                _Pinch(pinch.fingers, fingers, human, scale, rows, contact, widths, positions)
            )

    def solve(self, human: HumanPosture, last: FloatArray) -> FloatArray:
        """Return the positions ``(n,)`` [rad | m] for a human posture, starting from the last."""
        nearest = 1 + int(np.argmin(human.gaps[1:]))
        of = [nearest if h is Human.NEAREST else FINGERS.index(h) for h in self._humans]
        curls = human.curls[of]
        targets = self._bases + self._reach[:, None] * (human.tips[of] @ self._axes)
        prior = self._rest + (self._closes @ curls) * (self._closed - self._rest)
        wanted, bound = [], np.zeros(len(of))
        draw, drawn = np.zeros(len(last)), np.zeros(len(last))
        for pinch in self._pinches:
            distance = float(human.gaps[of[pinch.fingers[1]]])
            if len(pinch.widths):
                draw[pinch.rows] += pinch.at(_opened(distance) * float(pinch.widths[0]))
                drawn[pinch.rows] += 1.0
                continue
            weight, gap = self._intent(pinch, distance)
            if weight <= 0.0:
                continue
            wanted.append((pinch.pair, gap, weight))
            for k in pinch.fingers:
                bound[k] = max(bound[k], weight)
            share = (weight * _DRAWN / (_DRAWN + gap)) ** 2
            draw[pinch.rows] += share * pinch.contact
            drawn[pinch.rows] += share
        # Several pinches of one actuator share its weight.
        draw = np.divide(draw, drawn, out=prior.copy(), where=drawn > 0.0)
        drawn = self._drawing * np.minimum(drawn, 1.0)
        stay = _STAY**2 + _SLIDE**2 * (self._moves * bound).max(axis=1)
        self._tips.go(last)
        problem = _Problem(
            last,
            targets,
            self._follow * (1.0 - 0.9 * bound) / self._reach,
            _PRIOR**2 + stay + drawn,
            _PRIOR**2 * prior + stay * last + drawn * draw,
            wanted,
            self._tips.near(pair for pair, _, _ in wanted),
        )
        u = last
        for _ in range(_STEPS):
            u = self._step(u, problem)
        return self._met(u, [(pair, gap) for pair, gap, weight in wanted if weight == 1.0])

    def _met(self, u: FloatArray, wanted: list[tuple[tuple[str, str], float]]) -> FloatArray:
        """Return the nearest positions with the required gaps."""
        for _ in range(_CORRECTIONS if wanted else 0):
            self._tips.go(u)
            found = [self._tips.gap(pair) for pair, _ in wanted]
            off = np.array([gap - row[0] for (_, gap), row in zip(wanted, found, strict=True)])
            # Distant targets are out of reach; while some tips overlap, correct only these.
            over = np.array([row[0] < -_REACHED[0] for row in found])
            mended = (np.abs(off) < _REACHED[1]) & (over | ~over.any())
            rows, off = np.array([row[1] for row in found])[mended] * self.range, off[mended]
            if not len(off) or np.abs(off).max() < _REACHED[0]:
                break
            square = rows @ rows.T + _SOFT * np.eye(len(off))
            step = np.clip(rows.T @ np.linalg.solve(square, off), -_SMALL, _SMALL)
            u = np.clip(u + step * self.range, self._lower, self._upper)
        return u

    def _intent(self, pinch: _Pinch, distance: float) -> tuple[float, float]:
        """Return the weight of a pinch's gap, and its required width [m]."""
        beyond = max(0.0, distance - TOUCHING)
        share = min(1.0, max(0.0, (_MEET[1] - distance) / (_MEET[1] - _MEET[0])))
        # Squared, so that a fist, whose tips are also near one another, still closes.
        return (share * share * (3.0 - 2.0 * share)) ** 2, pinch.scale * beyond

    def _step(self, u: FloatArray, problem: _Problem) -> FloatArray:
        """Return the positions after one Gauss-Newton step."""
        tips, unit, follow = self._tips, self.range, problem.follow
        tips.go(u)
        # In units of the ranges, so that radians and metres are comparable.
        rows, off = np.zeros((0, len(u))), np.zeros(0)
        damping = problem.stiffness
        if follow.any():
            places = np.array(
                [tips.place(b, p) for b, p in zip(self._bodies, self._points, strict=True)]
            )
            rows = (tips.moves(self._bodies, places) * (follow[:, None, None] * unit)).reshape(
                -1, len(u)
            )
            off = (follow[:, None] * (problem.targets - places)).ravel()
            # Damp by the term that Gauss-Newton drops, or unreachable targets cause oscillation.
            damping = damping + _CURVED * float(np.abs(off).max()) * self._turned
        added = []
        for pair, gap, weight in problem.wanted:
            distance, row = tips.gap(pair)
            weight *= _GAP if distance > 0.0 else _APART
            added.append((weight * row * unit, weight * (gap - distance)))
            damping = damping + np.abs(added[-1][0] * added[-1][1])
        for begun, row in problem.near:
            # These links move little in a frame, so one measurement suffices.
            distance = begun + float(row @ (u - problem.last))
            if distance < 0.0:
                added.append((_APART * row * unit, -_APART * distance))
        if added:
            rows = np.vstack([rows, [row for row, _ in added]])
            off = np.append(off, [each for _, each in added])
        hessian = rows.T @ rows
        hessian.flat[:: len(u) + 1] += damping
        return self._within(
            u, hessian, rows.T @ off + (problem.pull - problem.stiffness * u) / unit
        )

    def _within(self, u: FloatArray, hessian: FloatArray, slope: FloatArray) -> FloatArray:
        """Return the minimum of a quadratic function within the limits.

        Coordinates that would leave the limits are frozen there one after another.
        """
        low, high = (self._lower - u) / self.range, (self._upper - u) / self.range
        step = np.zeros_like(u)
        free = ~((low >= 0.0) & (slope < 0.0) | (high <= 0.0) & (slope > 0.0))
        while free.any():
            rows = hessian[free]
            given = slope[free] - rows[:, ~free] @ step[~free]
            step[free] = np.linalg.solve(rows[:, free], given)
            beyond = free & ((step < low) | (step > high))
            if not beyond.any():
                break
            step[beyond] = np.clip(step[beyond], low[beyond], high[beyond])
            free &= ~beyond
        return np.clip(u + step * self.range, self._lower, self._upper)


def _opened(distance: float) -> float:
    """Return the opening of a person's tips, from 0 (touching) to 1 (fully apart)."""
    return min(1.0, max(0.0, (distance - TOUCHING) / (APART - TOUCHING)))


_LOST: Final = 0.5
"""Time without points after which the hand counts as newly found [s]."""

_FRAME: Final = 1.0 / 30.0
"""Time since the last frame to assume if there was none [s]: that of a webcam."""

_PALM: Final = (0.03, 0.2)
"""Shortest and longest palm of a person [m], from children to giants."""

_JUMP: Final = 5.0
"""Fastest motion of a tip relative to the palm [m/s]; people reach about 4 m/s."""

_NOISE: Final = 0.03
"""Motion of a tip that never counts as a jump [m]: the noise of a webcam."""

_BONE: Final = 2.2
"""Largest ratio between a finger's lengths over time: a camera foreshortens fingers."""

_OUTLIERS: Final = 5
"""Number of consecutive outliers after which the hand really is elsewhere."""

_LEARNING: Final = 0.03
"""Weight of a frame in the moving average of the person's lengths: about a second at a webcam's
rate."""

_SPEED: Final = 4.0
"""Largest change of a position [range/s]: a person opens or closes a hand in a quarter of a second.
The loop limits it to what the actuators can do."""


class TrackingError(ConfigError):
    """Raised if a frame does not fit the expected hand; the robot does not follow it."""


class Retargeter:
    """Moves a robot's hand as a person's hand moves.

    Attributes:
        hand: The hand.
        correspondence: Mapping from human fingers to the hand's.
        side: The person's hand that moves it.
        dropped: Number of frames dropped as outliers so far.
    """

    def __init__(
        self,
        hand: Hand,
        correspondence: Correspondence,
        *,
        side: Side = Side.RIGHT,
        layout: Layout = LAYOUTS["mediapipe"],
    ) -> None:
        """Prepare to retarget; see `of`."""
        self.hand, self.correspondence, self.side = hand, correspondence, side
        self.dropped = 0
        self._layout = layout
        self._tips = Tips(hand)
        self._solver = Solver(hand, correspondence, self._tips)
        self._smoother = Smoother()
        self._u = np.array(hand.rest)
        self._fastest = _SPEED * self._solver.range
        self._stamp = -math.inf
        self._local: FloatArray | None = None
        self._bones: FloatArray = np.zeros(0)
        self._palm = 0.0
        self._odd = self._backwards = 0

    @classmethod
    def of(
        cls,
        hand: str | Path,
        *,
        side: Side | str = Side.RIGHT,
        layout: Layout | str = "mediapipe",
    ) -> Self:
        """Return the retargeter of a hand: as its ``retarget.yaml`` says, otherwise from its model.

        Args:
            hand: Name of the hand, or path of its folder.
            side: The person's hand that moves it, which need not be on the robot hand's side.
            layout: Layout of the tracker's points, or its name in `LAYOUTS`.

        Raises:
            UserError: if the hand, its actions or an argument can't be used.
        """
        folder = hand_folder(hand)[0]
        model = load_hand(folder)
        found = read_correspondence(folder, model)
        if found is None:
            found = fit(ActionLibrary.load(model, folder / "actions"))
        known = layout_named(layout) if isinstance(layout, str) else layout
        return cls(model, found, side=side_named(side), layout=known)

    def begin(self, at: Mapping[str, float]) -> None:
        """Start from positions by actuator [rad | m], such as measured ones, instead of rest."""
        for name, value in at.items():
            if math.isfinite(value):
                self._u[self.hand.actuator_index(name)] = value
        self._u = np.array(self.hand.clamp(self._u))

    def step(self, points: object, stamp: float) -> dict[str, float]:
        """Return the positions by actuator [rad | m] for the points of a frame.

        Args:
            points: Points of the layout, MediaPipe's ``(21, 3)`` [m] by default, in any
                right-handed frame; ``None`` if no hand was found, for which it returns the last
                positions.
            stamp: Time of the frame [s], later than that of the last one.

        Raises:
            TrackingError: if the number of points is wrong, or they are not finite, not in the
                layout's unit, of the other hand, or not later than the last frame. The positions
                then stay as they were.
        """
        time = number(stamp)
        if time is None or not (math.isfinite(time) and time > self._stamp):
            said = repr(stamp)[:100] if time is None else f"{time:g} s"
            raise TrackingError(
                f"a frame's stamp must be later than the last one's, {self._stamp:g} s, not {said}"
            )
        if points is not None:
            self._see(self._read(points), time)
        return dict(zip(self.hand.actuator_names, self._u.tolist(), strict=True))

    def _read(self, given: object) -> FloatArray:
        try:
            points = self._layout.points(given)
        except ConfigError as error:
            raise TrackingError(error.message) from None
        palm = float(np.linalg.norm(points[9] - points[0]))
        if not _PALM[0] < palm < _PALM[1]:
            raise TrackingError(
                f"the palm would be {palm:.3g} m long, from the wrist to the middle finger's "
                "knuckle; points must be in metres"
            )
        return points

    def _see(self, points: FloatArray, stamp: float) -> None:
        local, lengths = in_palm(points, self.side), bones(points)
        palm = float(np.linalg.norm(points[9] - points[0]))
        dt = stamp - self._stamp
        if dt > _LOST or self._local is None:
            # Found again; it may be another person's hand.
            if self._local is None or self._odd > _OUTLIERS:
                self._bones, self._palm = lengths, palm
            self._smoother.restart()
            dt = _FRAME
        elif self._outlier(local - self._local, lengths, dt):
            self._odd += 1
            if self._odd <= _OUTLIERS:
                self.dropped += 1
                return
            self._bones, self._palm = lengths, palm
            self._smoother.restart()
        self._check_side(mirrored(local))
        self._odd = 0
        self._stamp, self._local = stamp, local
        self._bones = self._bones + _LEARNING * (lengths - self._bones)
        self._palm += _LEARNING * (palm - self._palm)
        smooth = self._smoother.step(local, dt)
        wanted = self._solver.solve(posture_of(smooth, self._bones, self._palm), self._u)
        most = self._fastest * dt
        self._u = self._u + np.clip(wanted - self._u, -most, most)

    def _outlier(self, moved: FloatArray, lengths: FloatArray, dt: float) -> bool:
        ratio = lengths.reshape(5, 3).sum(axis=1) / self._bones.reshape(5, 3).sum(axis=1)
        if (ratio > _BONE).any() or (ratio < 1.0 / _BONE).any():
            return True
        farthest = float(np.linalg.norm(moved[4::4], axis=1).max())
        return farthest > max(_JUMP * dt, _NOISE)

    def _check_side(self, backwards: bool) -> None:
        self._backwards = self._backwards + 1 if backwards else 0
        if backwards and (self._local is None or self._backwards >= _OUTLIERS):
            other = Side.LEFT if self.side is Side.RIGHT else Side.RIGHT
            raise TrackingError(
                f"the fingers bend backwards, as if the points were of a {other} hand; "
                f"the side given is {self.side}"
            )

    def beside(self, points: FloatArray) -> FloatArray:
        """Return a person's points ``(21, 3)`` [m], placed, turned and scaled beside the hand.

        For display: the points are in the hand's base frame, with the palm's axes along the hand's.
        """
        palm, maps = self.correspondence.palm, [*self.correspondence.fingers.values()]
        local = in_palm(points, self.side)
        reach = max(each.reach for each in maps)
        larger = reach / max(float(np.linalg.norm(local[12] - local[9])), bones(local)[6:9].sum())
        axes = np.array([palm.palmar, palm.radial, palm.distal])
        bases = np.array([each.base for each in maps]).mean(axis=0)
        # Put the knuckles beside the hand's, on the little finger's side.
        found: FloatArray = larger * (local - local[9]) @ axes + bases - 1.5 * reach * axes[1]
        return found

    def gap(self, at: Mapping[str, float], first: str, second: str) -> float:
        """Return the distance between two fingertips' surfaces [m]; negative if they overlap.

        Args:
            at: Positions by actuator [rad | m]; those left out are at rest.
            first: A finger.
            second: Another finger.

        Raises:
            UnknownActuator: if there is no such actuator.
            UnknownFinger: if there is no such finger.
            ConfigError: if a finger has no tip with geometry.
        """
        u = np.array(self.hand.rest)
        for name, value in at.items():
            u[self.hand.actuator_index(name)] = value
        sides = []
        for name in (first, second):
            links = self.hand.finger(name).tip_links
            if not links:
                raise ConfigError(f"the finger '{name}' has no tip with geometry")
            sides.append(self._tips.geometry.of_links(*links))
        both, poses = (sides[0], sides[1]), self._tips.kinematics.placements(u)
        exact = self._tips.geometry.closest(both, poses, convex=False)[0]
        if exact > 0.0:
            return exact
        return min(0.0, self._tips.geometry.closest(both, poses, convex=True)[0])
