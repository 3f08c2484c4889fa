"""Options of a LinkerHand, and which motor drives which actuator."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from rtee.drivers import wiring
from rtee.drivers.linkerhand.codec import BITRATE, MODELS, RIGHT, Model
from rtee.drivers.options import DeviceOptions, Positive
from rtee.drivers.scale import LinearScale
from rtee.errors import ConfigError
from rtee.types import DeviceSpec

Motor = Literal[
    "thumb_bend", "thumb_yaw", "index", "middle", "ring", "little",
    "index_roll", "ring_roll", "little_roll", "thumb_roll",
]  # fmt: skip

CAN_SPACING = 0.005
"""Pause between two frames on CAN [s]; an assumption, as no source gives one."""

_YAWS = ("yaw", "rot", "oppos")
_ROLLS = ("roll", "abduct", "spread")
"""Parts of names that identify motors which do not bend a finger."""


class LinkerHandOptions(DeviceOptions):
    """Options of a LinkerHand."""

    model: Literal["o6", "l10"] = Field("o6", description="the kind of hand")
    port: str = Field(
        "/dev/ttyUSB0", description="RS-485: a tty, socket:// or rfc2217://; without `channel`"
    )
    channel: str | None = Field(None, description="CAN channel instead, for example can0")
    interface: str = Field("socketcan", description="python-can interface of the channel")
    bitrate: Annotated[int, Field(gt=0)] = Field(BITRATE, description="of CAN [bit/s]")
    unit: Annotated[int, Field(ge=1, le=247)] = Field(
        RIGHT, description="39 is a right, 40 a left hand; its identifier on CAN, too"
    )
    motors: dict[str, Motor] = Field(
        default_factory=dict,
        description="the motor that drives each actuator; by default by its name",
    )
    ranges: dict[Motor, tuple[float, float]] = Field(
        default_factory=dict,
        description="positions at 255 and at 0 of a motor [rad]; by default those of the SDK",
    )
    travel_time: Positive = Field(
        1.0, description="time for the whole way at speed 255 [s]; an assumption"
    )
    check_model: bool = Field(
        True, description="refuse a hand that tells another number of motors (RS-485)"
    )
    health_every: Annotated[int, Field(ge=1)] = Field(
        10, description="faults and temperatures are read once in so many exchanges"
    )
    spacing: Annotated[float, Field(ge=0.0)] | None = Field(
        None, description="pause between two frames [s]; by default 0.03 (O6), 0.005 (L10, CAN)"
    )
    retries: Annotated[int, Field(ge=0, le=10)] = 1

    @model_validator(mode="after")
    def _motors_exist(self) -> Self:
        known = self.kind.motors
        for name in (*self.motors.values(), *self.ranges):
            if name not in known:
                raise ValueError(f"an {self.kind.name} has no motor '{name}': {', '.join(known)}")
        return self

    @property
    def kind(self) -> Model:
        """The kind of hand."""
        return MODELS[self.model]

    @property
    def pause(self) -> float:
        """The pause between two frames [s]."""
        if self.spacing is not None:
            return self.spacing
        return self.kind.spacing if self.channel is None else CAN_SPACING

    @property
    def where(self) -> str:
        """The port or CAN channel, for messages."""
        return self.port if self.channel is None else f"CAN channel {self.channel}"


def motors_of(spec: DeviceSpec, options: LinkerHandOptions) -> tuple[int, ...]:
    """Return the motor of each actuator, by its index in the tables; raises `ConfigError`."""
    return wiring.motors_of(spec, "motors", options.motors, options.kind.motors, _motor_of)


def _motor_of(name: str) -> str:
    """Return the motor that an actuator's name suggests; empty if it suggests none."""
    lowered = name.lower().replace("pinky", "little")
    rolls = any(word in lowered for word in _ROLLS)
    if "thumb" in lowered:
        turns = any(word in lowered for word in _YAWS)
        return "thumb_yaw" if turns else "thumb_roll" if rolls else "thumb_bend"
    finger = next((f for f in ("index", "middle", "ring", "little") if f in lowered), "")
    return f"{finger}_roll" if finger and rolls else finger


def scales_of(
    spec: DeviceSpec, options: LinkerHandOptions, motors: tuple[int, ...]
) -> tuple[LinearScale, ...]:
    """Return the scale of each actuator's position.

    Raises `ConfigError` if a motor's range is empty, or does not overlap its actuator's.
    """
    scales = []
    for actuator, motor in zip(spec.actuators, motors, strict=True):
        name = options.kind.motors[motor]
        ends = options.ranges.get(name, options.kind.ranges[motor])  # type: ignore[call-overload]
        low, high = sorted(ends)
        if not max(low, actuator.lower) < min(high, actuator.upper):
            raise ConfigError(
                f"device '{spec.name}': motor '{name}' reaches {low:g} to {high:g} rad, actuator "
                f"'{actuator.name}' {actuator.lower:g} to {actuator.upper:g} rad; set 'ranges'",
                key=f"devices.{spec.name}.options.ranges",
            )
        scales.append(LinearScale((255.0, 0.0), ends))
    return tuple(scales)
