"""Contact and friction: one set of numbers for everything that touches.

`docs/concepts/simulation.md` describes the study behind them; `benchmarks/contacts.py` repeats it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import mujoco

from rtee.hand.model import Hand
from rtee.types import JointKind

TIME_STEP: Final = 0.002
"""Step of the simulation [s]; half of that for hands whose fingertips are fast."""

TIME_CONSTANT: Final = 0.004
"""Time constant of a contact [s]: twice the time step, the least that MuJoCo integrates stably."""

IMPEDANCE: Final = (0.95, 0.99, 0.001, 0.5, 2.0)
"""Impedance of a contact: at the surface, inside, the depth [m] over which it grows, and the shape
of that growth. With MuJoCo's 0.9 to 0.95, 240 N press the pads of a 2F-85 2.6 mm into a sphere,
with these 0.8 mm; stiffer ones chatter."""

SKIN: Final = 0.0008
"""Depth of an object's skin, in which its contact forces grow [m]. A fast fingertip moves 1 mm in a
time step; without the skin it would be inside the object before there is any force. The skin lies
inside of the object's surface, where the forces begin."""

_SKIN_SHARE: Final = 0.75
"""Depth of the skin of a thin object, as a share of half its least extent."""

IMPRATIO: Final = 100.0
"""Ratio of the stiffness of friction to that of the normal force: a held object creeps in inverse
proportion to it, and a high ratio costs no time."""

DIMENSIONS: Final = 4
"""Dimensions of a contact: normal force, friction in two directions, torsion about the normal."""

PAD_FRICTION: Final = 1.0
"""Default friction of a fingertip with an object: rubber on plastic or metal."""

LINK_FRICTION: Final = 0.8
"""Default friction of all other links with an object."""

TABLE_FRICTION: Final = 0.8
"""Friction of a table with an object on it."""

_LEVER = 0.15
"""Distance from the first joint of a finger to its tip in large hands [m]."""

_TORSION = 0.01
"""Torsional friction at a sliding friction of 1 [m]: the diameter of the contact patch."""

_ROLLING = 1e-3
"""Rolling friction at a sliding friction of 1 [m]; contacts of four dimensions have none."""


def time_step(hand: Hand) -> float:
    """Return a time step [s] in which no fingertip passes the skin of an object."""
    fastest = max(
        a.velocity * (1.0 if a.kind is JointKind.PRISMATIC else _LEVER) for a in hand.actuators
    )
    return TIME_STEP if fastest * TIME_STEP <= SKIN else 0.5 * TIME_STEP


def configure(option: mujoco.MjOption) -> None:
    """Set how the solver treats contacts: exact friction cones with hardly any creep."""
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = IMPRATIO


def make_hard(geom: mujoco.MjsGeom, friction: float) -> None:
    """Give a shape the common contact parameters, with a coefficient of sliding friction."""
    geom.solref = [TIME_CONSTANT, 1.0]
    geom.solimp = IMPEDANCE
    geom.condim = DIMENSIONS
    geom.friction = [friction, _TORSION * friction, _ROLLING * friction]


def make_object(geom: mujoco.MjsGeom, half_extents: Sequence[float]) -> float:
    """Give a shape of an object its contact parameters: hard, with a skin, and frictionless.

    MuJoCo takes the larger friction of two shapes, so a pair has the coefficient of the shape that
    touches the object. The forces begin at a distance, the margin; the caller shrinks the shape by
    the margin, so that they begin at the surface.

    Args:
        geom: The shape.
        half_extents: Half of its extents [m].

    Returns:
        The depth of the skin [m].
    """
    make_hard(geom, friction=0.0)
    # Only the object has a skin, so two links of the hand do not feel each other at a distance.
    geom.margin = min(SKIN, _SKIN_SHARE * min(half_extents))
    return float(geom.margin)


def make_pair_hard(pair: mujoco.MjsPair, friction: float) -> None:
    """Give an explicit pair of shapes the common contact parameters."""
    pair.solref = [TIME_CONSTANT, 1.0]
    pair.solimp = IMPEDANCE
    pair.condim = DIMENSIONS
    torsion, rolling = _TORSION * friction, _ROLLING * friction
    pair.friction = [friction, friction, torsion, rolling, rolling]


def hand_friction(asked: float | None, *, tip: bool) -> float:
    """Return the friction of a link of the hand: the given one, or the usual one."""
    if asked is not None:
        return asked
    return PAD_FRICTION if tip else LINK_FRICTION
