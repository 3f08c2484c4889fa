"""Find the places of an object at which an action grasps it, from the action's postures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from rtee.actions.types import Action
from rtee.actions.types import Primitive as PrimitiveAction
from rtee.drivers.mujoco.scene import approach, tip_geoms, tip_middles
from rtee.drivers.mujoco.simulation import Simulation
from rtee.hand.frames import homogeneous
from rtee.hand.model import Hand
from rtee.planning.closing import ActionPath, opposition
from rtee.sample import FloatArray
from rtee.types import from_rest

_STEPS = 21
"""Intensities at which the fingertips are compared with the object: a few millimetres apart."""

_TURNS = 3
"""Turns of the object at each place: its long axis across the hand, along its reach, and between
the fingers."""

_OUTWARD = (0.0, 0.01, 0.02, 0.035, 0.05, 0.065, -0.02, -0.04)
"""Distances outwards from the fingertips' middle at which places are sought [m]: hands that do not
close on their fingertips have room there; the nearest ones first."""

_ACROSS = (0.0, 0.015, 0.03, 0.045)
"""Shifts in the direction in which the fingertips curl [m]: fingers that roll up meet there."""

_TOUCH = 2e-4
"""Penetration of the object below which a link counts as clear [m]: the accuracy of models."""

_APART = 0.015
"""Places closer to each other count as one [m]: objects are varied by 10 mm along each axis."""

_AWAY = 0.12
"""Distance from which the object approaches the hand [m]: about a finger's length."""

_WAY = 9
"""Points of that approach that are checked for contact: 15 mm apart."""

_MOVES = 1e-3
"""An actuator that an action moves less stays at rest [rad | m]."""

_BACK = 2e-3
"""Step by which an object is moved back until the hand is clear of it [m]."""


@dataclass(frozen=True, slots=True)
class Place:
    """A place for an object.

    Attributes:
        pose: Pose of the object in the hand's base frame ``(4, 4)``.
        intensity: Intensity of the action at which the fingertips' spread fits the object.
        approach_from: From where the object can come, relative to the hand and free of contact: a
            vector ``(3,)`` [m] in the base frame; zero when every straight path is blocked.
        preshape: Intensity to which the hand closes before the object comes.
    """

    pose: FloatArray
    intensity: float
    approach_from: FloatArray
    preshape: float = 0.0


def fingers_of(hand: Hand, action: Action) -> tuple[str, ...]:
    """Return the fingers that an action moves."""
    if action.fingers:
        return action.fingers
    moved = np.abs(ActionPath.of(hand, action).end - hand.rest) > _MOVES
    names = {name for name, moves in zip(hand.actuator_names, moved, strict=True) if moves}
    return tuple(finger.name for finger in hand.fingers if names & set(finger.actuators))


class Places:
    """Finds places for the object of a simulation; moves only a copy of its state."""

    def __init__(self, simulation: Simulation, hand: Hand, action: Action) -> None:
        """Prepare for an action."""
        self._simulation, self._hand = simulation, hand
        self._model = simulation.model
        self._data = mujoco.MjData(self._model)
        self._goal = ActionPath.of(hand, action).end
        self._geoms = tip_geoms(self._model, hand, fingers_of(hand, action))
        self._shift = self._contact_point(action)

    def find(self, most: int) -> list[Place]:
        """Return up to ``most`` places, the tightest first, each well apart from the others."""
        found: list[Place] = []
        for place in self._candidates():  # nearest to the fingertips first
            if all(self._differ(place, other) for other in found):
                found.append(Place(place.pose, place.intensity, self._approach_offset(place.pose)))
                if len(found) == most:
                    break
        return found

    def freed(self, place: Place) -> FloatArray:
        """Return a place's pose ``(4, 4)``, moved back until the open hand is clear."""
        pose = np.array(place.pose)
        length = float(np.linalg.norm(place.approach_from))
        # Without an approach there are no steps, so that nothing is divided by its length of 0.
        steps = round(length / _BACK)
        for _ in range(steps):
            if self._clear(pose, 0.0):
                break
            pose[:3, 3] += _BACK * place.approach_from / length
        return pose

    @staticmethod
    def _differ(one: Place, other: Place) -> bool:
        near = float(np.linalg.norm(one.pose[:3, 3] - other.pose[:3, 3])) < _APART
        # Entries of two turns that differ by less than 0.2 are within some 12 degrees.
        return not (near and np.allclose(one.pose[:3, :3], other.pose[:3, :3], atol=0.2))

    def _candidates(self) -> Iterator[Place]:
        outward = approach(self._hand)
        across = self._curl(outward)
        axis, weights = self._opposition(outward)
        ways = sorted(
            ((o, a) for o in _OUTWARD for a in _ACROSS), key=lambda way: abs(way[0]) + way[1]
        )
        for along, aside in ways:
            missing = set(range(_TURNS))
            # From closed to open: the first place that is clear is the tightest.
            for intensity in np.linspace(1.0, 0.0, _STEPS):
                centres = self._tips(float(intensity))
                middle = weights @ centres + self._shift
                middle = middle + along * outward + aside * across
                poses = self._poses(middle, centres, axis, outward)
                for turn in sorted(missing):
                    pose = poses[turn]
                    # The open hand has to be clear of it, too: from there it closes.
                    if self._clear(pose, float(intensity)) and self._clear(pose, 0.0):
                        missing.discard(turn)
                        yield Place(pose, float(intensity), np.zeros(3))
                if not missing:
                    break

    def _curl(self, outward: FloatArray) -> FloatArray:
        """Return the unit vector ``(3,)`` across the reach in which the fingertips close."""
        # Not at the end: fingertips that have rolled up move back again.
        curl = self._tips(0.4).mean(axis=0) - self._tips(0.0).mean(axis=0)
        curl = curl - (curl @ outward) * outward
        length = float(np.linalg.norm(curl))
        # Without a direction, places to the side coincide and count as one.
        return curl / length if length > 1e-3 else np.zeros(3)

    def _opposition(self, outward: FloatArray) -> tuple[FloatArray | None, FloatArray]:
        """Return the axis along which three or more fingertips close, and their weights.

        Fingertips that come from the two sides of the axis weigh the same together, however many
        there are on each, so that the object is between them. There is no axis when the fingertips
        close from all around, or when they are fewer than three; then all weigh the same.
        """
        tips = self._tips(0.0)
        axis, sides = opposition(self._tips(1.0) - tips, outward)
        both = [sides < 0.0, sides > 0.0]
        # Where all move the same way, there are no two sides to balance.
        if axis is None or not all(side.any() for side in both):
            return axis, np.full(len(tips), 1.0 / len(tips))
        weights: FloatArray = sum((0.5 * side / side.sum() for side in both), np.zeros(len(tips)))
        return axis, weights

    @staticmethod
    def _poses(
        middle: FloatArray, centres: FloatArray, axis: FloatArray | None, outward: FloatArray
    ) -> list[FloatArray]:
        """Return poses whose x axis is the axis of closing, with three directions for z."""
        closing = centres[-1] - centres[0] if axis is None else axis
        closing = closing - (closing @ outward) * outward
        if float(np.linalg.norm(closing)) < 1e-3:
            # With one fingertip, or several in line with the reach, any axis across will do.
            closing = np.eye(3)[int(np.argmin(np.abs(outward)))]
        closing = closing / np.linalg.norm(closing)
        side = np.cross(outward, closing)
        return [
            homogeneous(np.stack([x, np.cross(z, x), z], axis=1), middle)
            for z, x in ((side, closing), (outward, closing), (closing, side))
        ]

    def _tips(self, intensity: float) -> FloatArray:
        """Return the middles ``(k, 3)`` of the fingertips' geometry in the base frame."""
        self._pose_hand(intensity)
        # Positions are all that is needed; finding contacts would cost far more.
        mujoco.mj_kinematics(self._model, self._data)
        inverse: FloatArray = np.asarray(np.linalg.inv(self._base()), dtype=np.float64)
        points = tip_middles(self._model, self._data, self._geoms)
        if not len(points):
            points = np.zeros((1, 3))
        return points @ inverse[:3, :3].T + inverse[:3, 3]

    def _contact_point(self, action: Action) -> FloatArray:
        """Return the vector from the middle of the tips to the contact of a pinch ``(3,)`` [m]."""
        if (
            isinstance(action, PrimitiveAction)
            and action.evidence
            and action.kind.pinch
            and action.evidence[0].point is not None
        ):
            shift: FloatArray = np.array(action.evidence[0].point) - self._tips(1.0).mean(axis=0)
            return shift
        return np.zeros(3)

    def _base(self) -> FloatArray:
        return self._simulation.surroundings.base_pose

    def _pose_hand(self, intensity: float) -> None:
        u = from_rest(self._hand.rest, self._goal, intensity)
        joints = self._hand.transmission.joints(u)
        for name, value in zip(self._hand.joint_names, joints, strict=True):
            self._data.qpos[self._model.joint(name).qposadr[0]] = value

    def _clear(self, pose: FloatArray, intensity: float) -> bool:
        """Return whether nothing of the hand is inside the object."""
        self._pose_hand(intensity)
        depth = self._simulation.surroundings.depth_at(self._data, self._base() @ pose)
        return bool(depth < _TOUCH)

    def _approach_offset(self, pose: FloatArray) -> FloatArray:
        """Return the offset from which the object can come to the hand at rest."""
        axis = approach(self._hand)
        others = [v for v in (*np.eye(3), *-np.eye(3)) if abs(float(v @ axis)) < 0.5]
        for direction in (axis, *others):
            moved = np.array(pose)
            for distance in np.linspace(0.0, _AWAY, _WAY):
                moved[:3, 3] = pose[:3, 3] + distance * direction
                if not self._clear(moved, 0.0):
                    break
            else:
                return np.asarray(_AWAY * direction, dtype=np.float64)
        return np.zeros(3)
