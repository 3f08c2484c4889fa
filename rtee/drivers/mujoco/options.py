"""Options of the simulation that users may change; the defaults suit most hands."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from rtee.hand.inertia import ARMATURE, BANDWIDTH, STIFFNESS
from rtee.hand.validation import Section

DENSITY = 1000.0
"""Density of links without mass [kg/m³]: that of water, near that of plastics and hollow metal."""

JOINT_DAMPING = 5e-3
"""Damping of every joint [N·m·s/rad]: enough to end the swing of a light link within a moment."""

JOINT_FRICTION = 0.01
"""Dry friction of every actuator's joint [effort limit]: less than the gears of hands have."""

PASSIVE_STIFFNESS = 0.05
"""Least stiffness of passive joints [N·m/rad]: a return spring; more where the weight of the links
needs it."""

MISSING_EFFORT = 10.0
"""Effort limit of actuators that have none [N·m | 0.01 N]: more than any finger needs."""


class SimOptions(Section, frozen=True):
    """Options of the `mujoco` driver in hand.yaml.

    Attributes:
        timestep: Step of the simulation [s]; several steps make one exchange. By default 2 ms,
            or 1 ms for hands whose fingertips are fast.
        gravity: Gravity along the world's z axis [m/s²].
        friction: Friction of every contact of the hand, mainly with objects; by default 1.0 at
            fingertips and 0.8 elsewhere.
        stiffness: Position error at which an actuator of unknown gain exerts its full effort [rad],
            or, for a prismatic one, a hundredth of it [m].
        bandwidth: Bandwidth of a servo [Hz], where its inertia is not known.
        armature: Least inertia of motor and gear seen at a joint [kg·m²]; a thousand times as many
            kg at a prismatic one.
        object: An object to grasp: ``box:0.05x0.05x0.1``, ``cylinder:0.03x0.1``, ``sphere:0.03``,
            ``capsule:0.02x0.1`` (length with its caps), ``drill``, or the path of a mesh; empty
            for none.
        object_mass: Mass of the object [kg].
        object_scale: Factor of all lengths of the object.
        support: What carries the object before the grasp: ``held``: a yielding hand, which lets go
            when two links have touched it for a while; ``table``; ``floating``: it has no
            weight while it is supported.
        carrier: What carries the hand: a fixed mount, a vertical lift, or an arm with six
            degrees of freedom that follows a script. A hand that is carried reaches down, otherwise
            the base frame is the world's.
        touch: Touch sensors: ``hand``: where hand.yaml places some; ``off``: none; a grid such as
            ``4x4`` (rows along the pad, columns): on each fingertip. With them, the fingers feel
            what these measure instead of all contacts.
        touch_rate: Rate at which they measure [Hz].
    """

    timestep: Annotated[float, Meta(gt=0, le=0.01)] | None = None
    gravity: Annotated[float, Meta(ge=-100, le=100)] = -9.81
    friction: Annotated[float, Meta(ge=0, le=10)] | None = None
    stiffness: Annotated[float, Meta(gt=0, le=1)] = STIFFNESS
    bandwidth: Annotated[float, Meta(gt=0, le=100)] = BANDWIDTH
    armature: Annotated[float, Meta(gt=0, le=1)] = ARMATURE
    object: str = ""
    object_mass: Annotated[float, Meta(gt=0, le=100)] = 0.1
    object_scale: Annotated[float, Meta(ge=0.1, le=10)] = 1.0
    support: Literal["held", "table", "floating"] = "held"
    carrier: Literal["fixed", "lift", "arm"] = "fixed"
    touch: Annotated[str, Meta(pattern=r"^(hand|off|[1-9]\d?x[1-9]\d?)$")] = "hand"
    touch_rate: Annotated[float, Meta(gt=0, le=2000)] = 100.0
