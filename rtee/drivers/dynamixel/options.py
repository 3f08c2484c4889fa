"""Options of a line of Dynamixel servos in hand.yaml."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from rtee.drivers import servo_lines
from rtee.drivers.dynamixel.table import BAUD_RATES, MOST_GAIN, PULSES
from rtee.drivers.options import Positive
from rtee.drivers.servo_lines import LineOptions, check_line


class ServoOptions(servo_lines.ServoOptions):
    """Options of one servo.

    Attributes:
        zero: Its position at 0 rad of the joint [pulse], within one turn.
        drive_mode: Expected drive mode; a servo with another one is refused.
        current: Largest current [A]; by default that of the line.
        current_unit: Current per count [A]; by default that of the model.
    """

    id: Annotated[int, Field(ge=0, le=252)]
    zero: Annotated[float, Field(ge=0, lt=PULSES)] | None = None
    drive_mode: int = 0
    current: Positive | None = None
    current_unit: Positive | None = None


class DynamixelOptions(LineOptions):
    """Options of a line of Dynamixel servos."""

    baudrate: int = Field(4_000_000, description="rate of the line [baud]")
    servos: dict[str, ServoOptions] = Field(
        description="the servo of each actuator, by the actuator's name"
    )
    mode: Literal["current_based_position", "extended_position", "position"] = Field(
        "current_based_position", description="operating mode"
    )
    current: Positive | None = Field(
        None, description="largest current [A]; by default the servos' own limit"
    )
    fast: Literal["auto", "always", "never"] = Field(
        "auto", description="whether to read with the fast sync read; `auto` tries it"
    )
    watchdog: Annotated[float, Field(ge=0.0, le=2.54)] = Field(
        0.0, description="servos stop after a silence of this length on the line [s]; 0: they hold"
    )
    health_every: Annotated[int, Field(ge=1)] = Field(
        50, description="temperature, voltage and torque are read once in so many exchanges"
    )
    reboot_time: Positive = Field(3.0, description="longest time for a reboot [s]")
    deadline: Positive = Field(0.03, description="for one exchange, retries included [s]")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        check_line(self, self.servos, BAUD_RATES, MOST_GAIN)
        return self
