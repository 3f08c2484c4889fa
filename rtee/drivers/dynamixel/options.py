"""Options of a line of Dynamixel servos in hand.yaml."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from rtee.drivers import servo_lines
from rtee.drivers.dynamixel.table import BAUD_RATES, CENTER, LATENCY, PULSES
from rtee.drivers.options import DeviceOptions, Positive
from rtee.drivers.servo_lines import check_line

Gain = Annotated[int, Field(ge=0, le=16383)]


class ServoOptions(servo_lines.ServoOptions):
    """Options of one servo.

    Attributes:
        id: Its id on the line.
        zero: Its position at 0 rad of the joint [pulse], within one turn.
        drive_mode: Expected drive mode; a servo with another one is refused.
        p: Proportional gain; by default that of the line.
        i: Integral gain.
        d: Derivative gain.
        current: Largest current [A]; by default that of the line.
        current_unit: Current per count [A]; by default that of the model.
    """

    id: Annotated[int, Field(ge=0, le=252)]
    zero: Annotated[float, Field(ge=0, lt=PULSES)] = CENTER
    drive_mode: int = 0
    p: Gain | None = None
    i: Gain | None = None
    d: Gain | None = None
    current: Positive | None = None
    current_unit: Positive | None = None


class DynamixelOptions(DeviceOptions):
    """Options of a line of Dynamixel servos.

    Attributes:
        port: The adapter's tty.
        baudrate: Rate of the line [baud].
        servos: The servo of each actuator, by the actuator's name.
        mode: Operating mode.
        p: Proportional gain; by default as stored in the servos.
        i: Integral gain.
        d: Derivative gain.
        current: Largest current [A]; by default the servos' own limit.
        calibration: File of a calibration (`rtee calibrate`); its zeros replace those above.
        fast: Whether to read with the fast sync read: ``auto`` tries it.
        return_delay: Return delay to write to servos with another one [2 µs]; ``null``: unchanged.
        watchdog: Servos stop after a silence of this length on the line [s]; 0: they hold.
        health_every: Number of exchanges after which temperature, voltage and torque are read.
        outside: Distance from its limits at which a joint's zero counts as wrong [rad].
        reboot_time: Longest time for a reboot [s].
        deadline: Longest time for one exchange, retries included [s].
        retries: How often a request is sent again within that time.
        turnaround: Time per read beside that on the wire: the adapter's latency [s].
    """

    port: str = "/dev/ttyUSB0"
    baudrate: int = 4_000_000
    servos: dict[str, ServoOptions]
    mode: Literal["current_based_position", "extended_position", "position"] = (
        "current_based_position"
    )
    p: Gain | None = None
    i: Gain | None = None
    d: Gain | None = None
    current: Positive | None = None
    calibration: Path | None = None
    fast: Literal["auto", "always", "never"] = "auto"
    return_delay: Annotated[int, Field(ge=0, le=254)] | None = 0
    watchdog: Annotated[float, Field(ge=0.0, le=2.54)] = 0.0
    health_every: Annotated[int, Field(ge=1)] = 50
    outside: Positive = 0.35
    reboot_time: Positive = 3.0
    deadline: Positive = 0.03
    retries: Annotated[int, Field(ge=0, le=10)] = 2
    turnaround: Annotated[float, Field(ge=0.0)] = LATENCY

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        check_line(self.baudrate, BAUD_RATES, [servo.id for servo in self.servos.values()])
        return self
