"""Effort limits from the forces in data sheets, where levers would give larger forces."""

from __future__ import annotations

import math
from typing import Final

import mujoco
import numpy as np

from rtee.drivers.mujoco.pairs import LINK
from rtee.hand.frames import tip_pose_and_jacobian
from rtee.hand.model import Finger, Hand
from rtee.sample import FloatArray

_POINTS: Final = 33
"""Number of positions at which a limit is computed: interpolation between them is off by 1 %."""

_LEAST: Final = 1e-3
"""Shorter levers do not limit the effort [m/rad | 1]: at a dead centre any effort is allowed."""


class SheetForces:
    """The effort limits of actuators whose fingers' largest force is known, by position.

    With a constant torque, fingers on levers press harder the wider they are open. A device whose
    sheet states one force for all openings controls this force itself: the effort limit follows
    from that force on every fingertip, by virtual work towards the centre of the other fingertips.

    Args:
        hand: The hand.
        model: Its model.
        actuators: The simulated actuators.
    """

    def __init__(self, hand: Hand, model: mujoco.MjModel, actuators: list[str]) -> None:
        self._tables: list[tuple[int, FloatArray, FloatArray]] = []
        for number, name in enumerate(actuators):
            known = hand.dynamics.get(name)
            if known is None or known.finger_force is None:
                continue
            index = hand.actuator_index(name)
            spec = hand.actuators[index]
            positions = np.linspace(spec.lower, spec.upper, _POINTS)
            levers = np.array([_closing(hand, model, index, q) for q in positions.tolist()])
            limits = np.where(levers > _LEAST, known.finger_force * levers, math.inf)
            self._tables.append((number, positions, limits))

    def __bool__(self) -> bool:
        """Return whether the hand has any such force."""
        return bool(self._tables)

    def lower(self, limits: FloatArray, positions: FloatArray) -> FloatArray:
        """Return lowered effort limits ``(n,)`` [N·m | N] at positions ``(n,)`` [rad | m]."""
        lowered = limits.copy()
        for number, known, most in self._tables:
            lowered[number] = min(limits[number], np.interp(positions[number], known, most))
        return lowered


def _closing(hand: Hand, model: mujoco.MjModel, index: int, position: float) -> float:
    """Return the closing distance of all tips per unit of an actuator's motion [m/rad | 1]."""
    u = hand.rest.copy()
    u[index] = position
    fingers = [f for f in hand.fingers if f.tip and f.name in hand.actuators[index].fingers]
    points, moves = [], []
    for finger in fingers:
        pose, jacobian = tip_pose_and_jacobian(hand, str(finger.tip), u)
        arm = pose[:3, :3] @ _point(model, finger)
        points.append(pose[:3, 3] + arm)
        moves.append(jacobian[:3, index] + np.cross(jacobian[3:, index], arm))
    closing = 0.0
    for k, (point, move) in enumerate(zip(points, moves, strict=True)):
        others = [p for j, p in enumerate(points) if j != k]
        if not others:
            continue
        towards = np.mean(others, axis=0) - point
        closing += abs(float(move @ towards)) / max(float(np.linalg.norm(towards)), 1e-9)
    return closing


def _point(model: mujoco.MjModel, finger: Finger) -> FloatArray:
    """Return the centre of the tip's shape that is farthest from its last joint ``(3,)`` [m]."""
    body = model.body(f"{LINK}{finger.tip}").id
    middles = model.geom_pos[model.geom_bodyid == body]
    if not len(middles):
        return np.zeros(3)
    return max(middles, key=lambda middle: float(np.linalg.norm(middle)))
