"""What fingers do to an object that they press on: each actuator is a spring, its servo.

Fingers that grasp with a force keep their posture, and their references go on along the action
together, into the object. The forces at their contacts are those of the springs, not the best ones
that the fingers could exert: while the object stands on a table, the table bears the difference.
Afterwards the object moves with the fingers until the forces balance, or it is lost.

- *Pressing* is the energy that the springs give to the contacts. By the principle of least
    complementary energy, forces ``f`` within the cones of friction minimise ``f C f / 2 - f d``,
    with the compliance ``C`` of the fingers at the contacts and the displacement ``d`` of their
    references there. Solved again under the condition that forces and torques add up to zero, this
    gives the forces that balance. - The stiffness with which the springs hold the object is that of
    Nguyen (1989), with soft contacts
  in series, less the effect of the forces themselves: two tips that press on an object tilt it,
      once their force exceeds their transverse stiffness times half of its width (Cutkosky and Kao,
      1989).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtee.hand.inertia import gain_of
from rtee.hand.linalg import cross
from rtee.hand.model import Hand
from rtee.planning.wrench import EDGES, PATCH, least_squares
from rtee.sample import BoolArray, FloatArray

_ADD_UP: Final = 100.0
"""Weight of the condition that forces add up to zero, relative to the largest spring's."""

_CONTACT: Final = 5e3
"""Stiffness of a contact [N/m]: a rubber fingertip yields by 1 mm to 5 N."""

_TAKES_PART: Final = 0.02
"""Contacts with less than this share of the largest force do not hold the object."""


def gains(hand: Hand) -> FloatArray:
    """Return the position gains of the actuators ``(n,)`` [N·m/rad | N/m]: known or usual.

    They are 0 for those whose effort limit is not known.
    """
    found = []
    for actuator in hand.actuators:
        known = hand.dynamics.get(actuator.name)
        kp = None if known is None else known.kp
        if kp is None:
            kp = gain_of(actuator, actuator.effort) if math.isfinite(actuator.effort) else 0.0
        found.append(kp)
    return np.array(found)


@dataclass(frozen=True)
class PressingForces:
    """Fingers that press on an object.

    Attributes:
        share: The share of their pressing that balances on the object alone, 0 to 1.
        forces: The forces that balance ``(k, 3)``, of any scale.
        normal: Their parts along the normals ``(k,)``.
    """

    share: float
    forces: FloatArray
    normal: FloatArray


def pressing(
    found: FloatArray, maps: FloatArray, stiffness: FloatArray, way: FloatArray
) -> PressingForces:
    """Return how fingers press.

    Args:
        found: Wrenches of their contacts of unit normal force ``(k (EDGES + 2), 6)``; see
            `wrench.wrenches`.
        maps: Maps from forces at the contacts to efforts ``(k, n, 3)``.
        stiffness: Gains of the actuators ``(n,)``; see `gains`.
        way: Direction in which their references go on ``(n,)``.
    """
    count = len(maps)
    springs: BoolArray = stiffness > 0.0
    roots = np.sqrt(stiffness[springs])
    each = EDGES + 2
    efforts = np.einsum("kaj,kej->kea", maps[:, springs], found.reshape(count, each, 6)[:, :, :3])
    matrix, wanted = (efforts.reshape(-1, len(roots)) / roots).T, roots * way[springs]
    scale = _ADD_UP * float(np.abs(matrix).max(initial=0.0))
    whole = float(wanted @ wanted)

    def given(forces: FloatArray) -> float:
        left = matrix @ forces - wanted
        return whole - float(left @ left)

    most = given(least_squares(matrix, wanted)[0])
    if most <= 1e-9 * whole:
        return PressingForces(0.0, np.zeros((count, 3)), np.zeros(count))
    system = np.vstack([matrix, scale * found.T])
    shares, _ = least_squares(system, np.concatenate([wanted, np.zeros(6)]))
    by_contact = shares.reshape(count, each)
    forces = np.einsum("ke,kej->kj", by_contact, found.reshape(count, each, 6)[:, :, :3])
    share = min(1.0, max(0.0, given(shares) / most))
    return PressingForces(share, forces, by_contact.sum(axis=1))


def sunk(
    pressed: PressingForces,
    maps: FloatArray,
    stiffness: FloatArray,
    arms: FloatArray,
    normals: FloatArray,
    weight: float,
) -> float:
    """Return how far a force moves an object that fingers hold [m]; infinite: they don't hold it.

    Fingers of unequal strength and an accelerating arm may push it in any direction: the one in
    which the springs yield most counts.

    Args:
        pressed: The forces that hold it ``(k, 3)`` [N].
        maps: Maps from forces at the contacts to efforts ``(k, n, 3)``.
        stiffness: Gains of the actuators ``(n,)``.
        arms: The contacts relative to the object's centre of mass ``(k, 3)`` [m].
        normals: Their unit normals ``(k, 3)``.
        weight: The size of the force [N].
    """
    part: BoolArray = pressed.normal > _TAKES_PART * pressed.normal.max(initial=0.0)
    springs: BoolArray = stiffness > 0.0
    if np.count_nonzero(part) < 2:
        return math.inf
    arms, forces, normals = arms[part], pressed.forces[part], normals[part]
    # Torques are divided by a length, so that all terms are of one size.
    length = float(np.linalg.norm(arms, axis=1).max())
    grasp = np.concatenate([np.hstack([np.eye(3), -_crossed(arm) / length]) for arm in arms])
    fingers = maps[part][:, springs].swapaxes(1, 2).reshape(-1, int(np.count_nonzero(springs)))
    # Contacts and servos in series: the fingers move to where both are in balance.
    servos = _CONTACT * fingers.T @ fingers + np.diag(stiffness[springs])
    carried = fingers.T @ grasp
    held = _CONTACT * grasp.T @ grasp - _CONTACT**2 * carried.T @ np.linalg.solve(servos, carried)
    # When the object turns, the contacts move with it, but the forces keep their directions.
    geometric = np.zeros((3, 3))
    for arm, force, normal in zip(arms, forces, normals, strict=True):
        outer = np.outer(force, arm)
        geometric += (force @ arm) * np.eye(3) - 0.5 * (outer + outer.T)
        geometric += _CONTACT * PATCH**2 * np.outer(normal, normal)
    held[3:, 3:] += geometric / length**2
    if np.linalg.eigvalsh(held)[0] <= 0.0:
        return math.inf
    yielding = np.linalg.inv(held)[:3, :3]
    return weight * float(np.linalg.eigvalsh(yielding)[-1])


def _crossed(arm: FloatArray) -> FloatArray:
    """Return the matrix ``(3, 3)`` of the cross product with a vector from the left."""
    return np.asarray(cross(arm[None], np.eye(3)).T)


def scaled(pressed: PressingForces, normal: float) -> PressingForces:
    """Return the same pressing fingers, scaled to a total normal force [N]."""
    whole = float(pressed.normal.sum())
    factor = normal / whole if whole > 0.0 else 0.0
    return PressingForces(pressed.share, factor * pressed.forces, factor * pressed.normal)
