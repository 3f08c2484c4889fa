"""Options of an Ability Hand, and which motor drives which actuator."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from rtee.drivers import wiring
from rtee.drivers.ability_hand.codec import ADDRESS, MOTORS, Header
from rtee.drivers.options import DeviceOptions, Positive
from rtee.types import DeviceSpec

Motor = Literal["index", "middle", "ring", "pinky", "thumb_flexor", "thumb_rotator"]

_ROTATES = ("rot", "yaw", "oppos", "abduct")
"""Parts of names that identify the motor that rotates the thumb."""


class AbilityHandOptions(DeviceOptions):
    """Options of an Ability Hand."""

    port: str = Field("/dev/ttyUSB0", description="a tty, socket:// or rfc2217://")
    address: Annotated[int, Field(ge=1, le=255)] = Field(
        ADDRESS, description="of the hand; 80 (hexadecimal 50) from the factory"
    )
    baudrate: Literal[
        460_800, 1200, 38_400, 56_000, 57_600, 76_800, 115_200, 230_400, 250_000, 921_600, 1_000_000
    ] = Field(460_800, description="as the hand is set; above 460800 on RS-485 only")
    mode: Literal["position", "velocity", "current"] = Field(
        "position",
        description="what the hand is sent; with `velocity` it takes velocity limits, with "
        "`current` effort limits, and this computer controls the positions",
    )
    reply: Literal[1, 2, 3] | None = Field(
        None,
        description="what it answers: 1 positions, currents, touch (default); 2 positions, "
        "velocities, touch (default with `mode: current`); 3 positions, currents, velocities",
    )
    touch: bool = Field(
        True, description="whether it has touch sensors; a hand without them reports no touch"
    )
    touch_threshold: Positive = Field(
        0.15, description="force of a touch sensor above its value at rest that is a contact [N]"
    )
    motors: dict[str, Motor] = Field(
        default_factory=dict,
        description="the motor that drives each actuator; by default by its name",
    )
    reverse: frozenset[Motor] = Field(
        frozenset({"thumb_rotator"}),
        description="motors whose angles on the wire have the other sign than the actuator's",
    )
    approach: Positive = Field(
        20.0, description="with `mode: velocity`: velocity by position error [1/s]"
    )
    stiffness: Positive = Field(
        8.0, description="with `mode: current`: effort by position error [N·m/rad]"
    )
    damping: Annotated[float, Field(ge=0.0)] = Field(
        0.05, description="with `mode: current`: effort against velocity [N·m·s/rad]"
    )
    retries: Annotated[int, Field(ge=0, le=10)] = 1
    turnaround: Annotated[float, Field(ge=0.0)] = Field(
        0.0, description="time per answer that the bytes do not explain [s]"
    )

    @model_validator(mode="after")
    def _replies_fit(self) -> Self:
        if self.mode == "current" and self.reply == 1:
            raise ValueError("reply 1 has no velocities, which `mode: current` needs: 2 or 3")
        return self

    @property
    def variant(self) -> int:
        """The variant of its replies, 1 to 3."""
        return self.reply or (2 if self.mode == "current" else 1)

    @property
    def header(self) -> Header:
        """The header of its set-points, without the variant of the reply."""
        return Header[self.mode.upper()]


def motors_of(spec: DeviceSpec, options: AbilityHandOptions) -> tuple[int, ...]:
    """Return the motor of each actuator, by its index in `MOTORS`; raises `ConfigError`."""
    return wiring.motors_of(spec, "motors", options.motors, MOTORS, _motor_of)


def _motor_of(name: str) -> str:
    """Return the motor that an actuator's name suggests; empty if it suggests none."""
    lowered = name.lower()
    if "thumb" in lowered:
        turns = any(word in lowered for word in _ROTATES)
        return "thumb_rotator" if turns else "thumb_flexor"
    if "little" in lowered:
        return "pinky"
    return next((motor for motor in MOTORS[:4] if motor in lowered), "")
