"""Options of a HERI II hand on EtherCAT in hand.yaml."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from rtee.drivers.heri_ethercat.codec import MOTORS, TORQUE_PER_AMPERE
from rtee.drivers.options import DeviceOptions
from rtee.drivers.wiring import numbers_of
from rtee.types import DeviceSpec

_WIRING = {"motor_finger1": 0, "motor_finger2": 1, "motor_finger3": 2, "motor_thumb": 3}
"""The motors of the public description, counted over its two boards."""

Positive = Annotated[float, Field(gt=0.0)]
Raw = Annotated[int, Field(ge=0, le=0xFFFF)]


class HeriEthercatOptions(DeviceOptions):
    """Options of a HERI II hand on EtherCAT.

    Attributes:
        interface: Network interface the boards hang on; it is the master's alone.
        motors: Motor of each actuator, counted over the boards from 0; by default those of the
            public description (``motor_finger1`` and so on), else in the actuators' order.
        vendor: EtherCAT vendor id expected; else any.
        product: EtherCAT product code expected; else any.
        gains: Five raw gains sent to every board; their meaning is not public.
        torque_per_ampere: Torque at the shaft per current [N·m/A].
        limit_torque: Send the effort limit as the board's torque reference, which has one for both
            motors: the smaller of theirs. Else that reference stays 0.
        watchdog: Boards leave operation after so long without frames [s].
        order_timeout: Longest time for a board to acknowledge a command [s].
        deadline: Longest time for one exchange [s].
    """

    interface: str = "eth0"
    motors: dict[str, Annotated[int, Field(ge=0, lt=4 * MOTORS)]] = Field(default_factory=dict)
    vendor: int | None = None
    product: int | None = None
    gains: tuple[Raw, Raw, Raw, Raw, Raw] = (0, 0, 0, 0, 0)
    torque_per_ampere: Positive = TORQUE_PER_AMPERE
    limit_torque: bool = True
    watchdog: Annotated[float, Field(ge=0.0, le=6.5)] = 0.25
    order_timeout: Positive = 1.0
    deadline: Positive = 0.02


def motors_of(spec: DeviceSpec, options: HeriEthercatOptions) -> list[int]:
    """Return the motor of each actuator; raises `ConfigError`."""
    names = [a.name for a in spec.actuators]
    if not options.motors:
        wired = all(name in _WIRING for name in names)
        return [_WIRING[name] for name in names] if wired else list(range(len(names)))
    return numbers_of(spec, "motors", options.motors, "motor")
