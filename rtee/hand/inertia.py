"""Default gain and inertia of an actuator's servo, for settings missing in hand.yaml.

Derived from the effort limit, which every data sheet has, for a servo that reaches it at a small
position error and follows with a usual bandwidth.
"""

from __future__ import annotations

import math
from typing import Final

from rtee.hand.config_schema import ActuatorDynamics
from rtee.types import ActuatorSpec, JointKind

PRISMATIC: Final = 1000.0
"""Factor from the inertia, damping and stiffness assumed of a revolute joint to those of a
prismatic one [1/m²]: the inverse square of a lever of about 30 mm."""

STIFFNESS: Final = 0.05
"""Position error at full effort [rad]."""

BANDWIDTH: Final = 15.0
"""Bandwidth of a servo [Hz]."""

ARMATURE: Final = 5e-4
"""Least inertia of motor and gear [kg·m²]."""

_LINEAR_SPAN: Final = 0.01
"""Factor from the position error at full effort in rad to that in m [m/rad]: a lever of 10 mm."""

_ROTOR_TIME: Final = 0.003
"""Mechanical time constant of a gripper's motor [s]: within it, full effort brings the motor to two
thirds of its speed. Catalogues of small brushless motors have 2 to 7 ms."""


def gain_of(spec: ActuatorSpec, limit: float, stiffness: float = STIFFNESS) -> float:
    """Return the position gain of an actuator with an effort limit [N·m/rad | N/m].

    Args:
        spec: The actuator.
        limit: Its effort limit [N·m | N].
        stiffness: Position error at full effort [rad], or a hundredth of it [m].
    """
    return limit / (stiffness * (_LINEAR_SPAN if spec.kind is JointKind.PRISMATIC else 1.0))


def inertia_of(
    spec: ActuatorSpec,
    limit: float,
    known: ActuatorDynamics,
    kp: float | None = None,
    bandwidth: float = BANDWIDTH,
    armature: float = ARMATURE,
) -> float:
    """Return the inertia of motor and gear at an actuator [kg·m² | kg]: stated or derived.

    Args:
        spec: The actuator.
        limit: Its effort limit [N·m | N]; infinite: nothing can be derived from it.
        known: Its values in hand.yaml.
        kp: Its position gain [N·m/rad | N/m]; ``None``: as known, or derived.
        bandwidth: Its bandwidth [Hz].
        armature: Least inertia [kg·m²]; for a prismatic actuator, a thousand times the number [kg].

    Returns:
        0 if it is not known.
    """
    if known.armature is not None:
        return known.armature
    if not 0.0 < limit < math.inf:
        return 0.0
    slide = spec.kind is JointKind.PRISMATIC
    least = armature * (PRISMATIC if slide else 1.0)
    if slide and spec.velocity > 0.0:
        # A spindle has no lever that the rule below could take for granted: 1000 times a finger's
        # inertia would be tens of kilograms. The jaws' own mass is that of their links.
        return max(least, _ROTOR_TIME * limit / spec.velocity)
    # The natural frequency of spring and inertia is to be the bandwidth: ω² = kp / inertia.
    gain = kp or known.kp or gain_of(spec, limit)
    return max(least, gain / (2.0 * math.pi * bandwidth) ** 2)
