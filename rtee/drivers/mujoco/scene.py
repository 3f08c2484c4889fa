"""The hand and what is around it: a carrier, a table, an object."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from rtee.drivers.mujoco.model import Built, build
from rtee.drivers.mujoco.objects import add_object, parse_object
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.simulation import Simulation
from rtee.hand.geometry import HandGeometry
from rtee.hand.kinematics import Kinematics
from rtee.hand.model import Hand
from rtee.types import FloatArray


def build_hand(hand: Hand, options: SimOptions) -> Built:
    """Make the model of a hand; meshes are read only if it has any."""
    meshes = any(s.kind == "mesh" for link in hand.urdf.links.values() for s in link.collisions)
    geometry = HandGeometry(hand) if meshes else None

    def triangles(link: str) -> tuple[FloatArray, np.ndarray[tuple[int, int], np.dtype[np.int64]]]:
        if geometry is None:
            return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
        return geometry.triangles(link)

    return build(hand, options, triangles)


def grasp_centre(hand: Hand, closure: float = 0.5) -> FloatArray:
    """Return the middle of the fingertips ``(3,)`` [m] in the base frame.

    Args:
        hand: The hand.
        closure: Share of the way from rest to the far limits at which it is taken.
    """
    kinematics = Kinematics(hand)
    far = np.where(
        np.abs(hand.upper - hand.rest) >= np.abs(hand.lower - hand.rest), hand.upper, hand.lower
    )
    far = np.where(np.isfinite(far), far, hand.rest)
    u = hand.rest + closure * (far - hand.rest)
    tips = [kinematics.link_pose(u, f.tip)[:3, 3] for f in hand.fingers if f.tip is not None]
    return np.asarray(np.mean(tips, axis=0)) if tips else np.zeros(3)


def make_simulation(
    hand: Hand, options: SimOptions, actuators: Sequence[str], period: float
) -> Simulation:
    """Build, compile and start the simulation that the options describe.

    Raises:
        ModelError: if the hand cannot be simulated.
        ConfigError: if the object is none.
    """
    built = build_hand(hand, options)
    if options.object:
        add_object(
            built.spec,
            parse_object(options.object),
            mass=options.object_mass,
            position=grasp_centre(hand),
        )
    model: mujoco.MjModel = built.spec.compile()
    return Simulation(model, hand, options, actuators, period)
