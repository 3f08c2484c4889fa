"""Options of an Allegro Hand in hand.yaml."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from rtee.drivers.allegro.codec import JOINTS, NAMES
from rtee.drivers.options import DeviceOptions, Positive
from rtee.drivers.wiring import numbers_of
from rtee.errors import ConfigError
from rtee.types import DeviceSpec

NotNegative = Annotated[float, Field(ge=0.0)]


class AllegroOptions(DeviceOptions):
    """Options of an Allegro Hand.

    Attributes:
        channel: CAN channel, for example ``can0``.
        interface: python-can interface.
        hand: The hand's number on the bus.
        version: 4 or 5; by default as the hand reports.
        side: ``left`` or ``right``; a hand of the other side is refused.
        joints: Joint on the wire, 0 to 15, of each actuator; by default in their order.
        period: Period of the hand's position frames [ms]; by default 3 (version 4) or 2 (5).
        kp: Stiffness of the joints [N·m/rad].
        kd: Damping of the joints [N·m·s/rad].
        ki: Integral gain of the joints [N·m/(rad·s)], against friction and weight; 0: none.
        max_integral: Largest torque of the integral [N·m].
        max_torque: Largest torque [N·m], besides the hand's own limits.
        smoothing: Time constant of the velocity filter [s].
        info_every: Number of exchanges after which temperature and faults are read.
        deadline: Longest time to wait for an answer [s].
    """

    channel: str = "can0"
    interface: str = "socketcan"
    hand: Annotated[int, Field(ge=0, le=3)] = 0
    version: Literal[4, 5] | None = None
    side: Literal["left", "right"] | None = None
    joints: dict[str, Annotated[int, Field(ge=0, lt=JOINTS)]] = Field(default_factory=dict)
    period: Annotated[int, Field(ge=1, le=50)] | None = None
    kp: NotNegative = 1.0
    kd: NotNegative = 0.04
    ki: NotNegative = 8.0
    max_integral: NotNegative = 0.05
    max_torque: Positive = 0.5
    smoothing: Positive = 0.006
    info_every: Annotated[int, Field(ge=1)] = 100
    deadline: Positive = 0.1


def wire_order(spec: DeviceSpec, options: AllegroOptions) -> list[int]:
    """Return the joint on the wire of each actuator; raises `ConfigError`."""
    names = [a.name for a in spec.actuators]
    if not options.joints:
        if len(names) != JOINTS:
            raise ConfigError(
                f"device '{spec.name}': an Allegro Hand has {JOINTS} actuators "
                f"({', '.join(NAMES)}, four each), not {len(names)}; name those there are by the "
                "option 'joints'"
            )
        return list(range(JOINTS))
    return numbers_of(spec, "joints", options.joints, "joint")
