"""From 21 points of a human hand to the positions of a hand's actuators, frame by frame."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Final, Self

import numpy as np

from rtee.actions.library import ActionLibrary
from rtee.errors import ConfigError
from rtee.hand.load import hand_folder, load_hand
from rtee.hand.model import Hand
from rtee.retarget.correspondence import Correspondence, read_correspondence
from rtee.retarget.fit import fit
from rtee.retarget.human import Smoother, bones, in_palm, mirrored, posture_of
from rtee.retarget.layouts import LAYOUTS, Layout, Side, layout_named, side_named
from rtee.retarget.solver import Solver
from rtee.retarget.tips import Tips
from rtee.sample import FloatArray

_LOST: Final = 0.5
"""Time without points after which the hand counts as newly found [s]."""

_FRAME: Final = 1.0 / 30.0
"""Time since the last frame that counts when there was none [s], a webcam's."""

_PALM: Final = (0.03, 0.2)
"""Shortest and longest palm of a person [m], children's and giants' included."""

_JUMP: Final = 5.0
"""Fastest motion of a tip against the palm [m/s]; a person's fastest is about 4 m/s."""

_NOISE: Final = 0.03
"""Noise of a webcam's tips that does not count as a jump, however fast [m]."""

_BONE: Final = 2.2
"""Ratio by which a finger's length may differ from what it was: a camera sees it shortened."""

_OUTLIERS: Final = 5
"""After so many outliers in a row the hand is really elsewhere."""

_LEARNING: Final = 0.03
"""Share of a frame in the person's lengths: a second's worth at a webcam's rate."""

_SPEED: Final = 4.0
"""Largest change of a position [range/s]: a person opens or closes a hand in a quarter of a second.
What the actuators can do of it is the loop's concern."""


class TrackingError(ConfigError):
    """Points that are not those of the expected hand: nothing moves by them."""


class Retargeter:
    """A person's hand as the master of a hand.

    Attributes:
        hand: The hand.
        correspondence: Which finger follows which.
        side: Which of the person's hands moves it.
        dropped: How many frames were outliers so far.
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
        """Return the retargeter of a hand: as its ``retarget.yaml`` says, else from its model.

        Args:
            hand: Its name, or the path of its folder.
            side: Which of the person's hands moves it, whichever the hand itself is.
            layout: The points, or their name in `LAYOUTS`.

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
        """Begin at positions by actuator [rad | m], such as the measured ones; else at rest."""
        for name, value in at.items():
            if math.isfinite(value):
                self._u[self.hand.actuator_index(name)] = value
        self._u = np.array(self.hand.clamp(self._u))

    def step(self, points: object, stamp: float) -> dict[str, float]:
        """Return the positions by actuator [rad | m] that answer the points of a frame.

        Args:
            points: Points of the layout, MediaPipe's ``(21, 3)`` [m] by default, in any
                right-handed frame; ``None`` when the hand was not found, which it answers by the
                last positions.
            stamp: Time of the frame [s], later than the last one.

        Raises:
            TrackingError: if the points are not as many, not finite, not in the layout's unit, of
                the other hand, or not later than the last ones. The answer stays as it was.
        """
        if not (math.isfinite(stamp) and stamp > self._stamp):
            raise TrackingError(
                f"a frame's stamp must be later than the last one's, {self._stamp:g} s, "
                f"not {stamp:g} s"
            )
        if points is not None:
            self._see(self._read(points), stamp)
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
                "knuckle: points are in metres"
            )
        return points

    def _see(self, points: FloatArray, stamp: float) -> None:
        local, lengths = in_palm(points, self.side), bones(points)
        palm = float(np.linalg.norm(points[9] - points[0]))
        dt = stamp - self._stamp
        if dt > _LOST or self._local is None:
            # Found again, perhaps of another person.
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
        """Return a person's points ``(21, 3)`` [m] beside the hand, turned and as large as it.

        In the hand's base frame, its palm's axes along the hand's own, to look at.
        """
        palm, maps = self.correspondence.palm, [*self.correspondence.fingers.values()]
        local = in_palm(points, self.side)
        reach = max(each.reach for each in maps)
        larger = reach / max(float(np.linalg.norm(local[12] - local[9])), bones(local)[6:9].sum())
        axes = np.array([palm.palmar, palm.radial, palm.distal])
        bases = np.array([each.base for each in maps]).mean(axis=0)
        # Its knuckles beside the hand's, on the little finger's side.
        found: FloatArray = larger * (local - local[9]) @ axes + bases - 1.5 * reach * axes[1]
        return found

    def gap(self, at: Mapping[str, float], first: str, second: str) -> float:
        """Return the distance between two fingertips' surfaces [m]; negative if they overlap.

        Args:
            at: Positions by actuator [rad | m]; those left out are at rest.
            first: A finger.
            second: Another one.

        Raises:
            UnknownActuator: There is no such actuator.
            UnknownFinger: There is no such finger.
            ConfigError: A finger has no tip with a shape.
        """
        u = np.array(self.hand.rest)
        for name, value in at.items():
            u[self.hand.actuator_index(name)] = value
        sides = []
        for name in (first, second):
            links = self.hand.finger(name).tip_links
            if not links:
                raise ConfigError(f"the finger '{name}' has no tip with a shape")
            sides.append(self._tips.geometry.of_links(*links))
        both, poses = (sides[0], sides[1]), self._tips.kinematics.placements(u)
        exact = self._tips.geometry.closest(both, poses, convex=False)[0]
        if exact > 0.0:
            return exact
        return min(0.0, self._tips.geometry.closest(both, poses, convex=True)[0])
