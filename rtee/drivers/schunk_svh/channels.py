"""The SVH's nine channels: ranges, units, parameter sets of its controllers, and its options."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta, field

from rtee.drivers.options import Current, DeviceOptions, Moment, Pause, Positive
from rtee.drivers.schunk_svh.codec import TURNAROUND, CurrentSettings, PositionSettings
from rtee.errors import ConfigError
from rtee.hand.validation import Misfit, Section, values_given
from rtee.types import DeviceSpec


@dataclass(frozen=True, slots=True)
class Channel:
    """One channel of the hand: its homing and its gearing.

    Encoders are relative: after homing, 0 rad is the open end of the range. Homing drives a channel
    against its open stop; ``min_offset`` and ``max_offset`` place the soft limits relative to it.

    Attributes:
        index: Number on the wire, 0 to 8.
        name: Its name, with which the actuator's name ends.
        direction: Direction of homing, +1 or -1.
        min_offset: Lower soft limit relative to the stop [ticks].
        max_offset: Upper soft limit relative to the stop [ticks].
        idle_offset: Where homing leaves it, relative to the stop [ticks].
        range: Travel between the soft limits [rad].
        reset_factor: Share of the current limit at which the stop counts as reached.
        force_slope: Force at the fingertip per current [N/mA]; 0 if not known.
        force_offset: Force at zero current [N].
        lever: Distance from the joint to the fingertip [m].
    """

    index: int
    name: str
    direction: int
    min_offset: int
    max_offset: int
    idle_offset: int
    range: float
    reset_factor: float
    force_slope: float = 0.0
    force_offset: float = 0.0
    lever: float = 0.1

    @property
    def rad_per_tick(self) -> float:
        """Signed gearing [rad/tick]."""
        # Homing opens a channel and angles grow while it closes, so they have opposite signs.
        return self.range / (self.max_offset - self.min_offset) * -self.direction

    def soft_limits(self, stop: int) -> tuple[int, int]:
        """Return the lowest and highest target [ticks] for a stop met at ``stop``."""
        return stop + self.min_offset, stop + self.max_offset

    def zero(self, stop: int) -> int:
        """Return the position of 0 rad [ticks]: the soft limit at the open end."""
        return stop + (self.max_offset if self.direction > 0 else self.min_offset)

    def idle(self, stop: int) -> int:
        """Return the position after homing [ticks]: inside the limits, off the stop."""
        return stop - self.direction * abs(self.idle_offset)

    def to_rad(self, ticks: float, zero: int) -> float:
        """Return the angle [rad] of a position [ticks]."""
        return (ticks - zero) * self.rad_per_tick

    def to_ticks(self, angle: float, zero: int) -> int:
        """Return the position [ticks] of an angle [rad]."""
        return round(angle / self.rad_per_tick) + zero

    def to_rate(self, velocity: float) -> float:
        """Return the speed [ticks/s] for a velocity [rad/s]."""
        return abs(velocity / self.rad_per_tick)

    def to_effort(self, current_ma: float) -> float:
        """Return the effort [N·m] of a current [mA], positive if it closes; ``NaN``: not known."""
        if self.force_slope == 0.0:
            return math.nan
        # The offset may be negative: small currents are used up by friction.
        size = max(0.0, self.force_slope * abs(current_ma) + self.force_offset) * self.lever
        return math.copysign(size, current_ma * -self.direction)

    def to_current(self, effort: float) -> float:
        """Return the current [mA] for an effort [N·m]; ``NaN``: not known."""
        if self.force_slope == 0.0:
            return math.nan
        return max(0.0, (abs(effort) / self.lever - self.force_offset) / self.force_slope)


CHANNELS: tuple[Channel, ...] = (
    Channel(0, "Thumb_Flexion", +1, -175_000, -5_000, -15_000, 0.97, 0.75, 0.015, -1.543, 0.106),
    Channel(1, "Thumb_Opposition", +1, -150_000, -5_000, -15_000, 0.99, 0.75),
    Channel(2, "Index_Finger_Distal", +1, -47_000, -2_000, -8_000, 1.33, 0.75, 0.014, -0.07, 0.046),
    Channel(3, "Index_Finger_Proximal", -1, 2_000, 42_000, 8_000, 0.80, 0.75, 0.015, 0.282, 0.094),
    Channel(
        4, "Middle_Finger_Distal", +1, -47_000, -2_000, -8_000, 1.33, 0.75, 0.014, -0.026, 0.053
    ),
    Channel(5, "Middle_Finger_Proximal", -1, 2_000, 42_000, 8_000, 0.80, 0.75, 0.015, 0.336, 0.102),
    Channel(6, "Ring_Finger", +1, -47_000, -2_000, -8_000, 0.98, 0.75, 0.007, -0.073, 0.104),
    Channel(7, "Pinky", +1, -47_000, -2_000, -8_000, 0.98, 0.75, 0.005, 0.081, 0.089),
    Channel(8, "Finger_Spread", +1, -47_000, -2_000, -25_000, 0.58, 0.40),
)
"""The channels in the order of the wire, with the offsets built into the vendor's library."""

HOMING_ORDER: tuple[int, ...] = (3, 5, 1, 0, 8, 4, 2, 6, 7)
"""Channels in the order of homing and enabling in which the fingers do not collide."""

HOMING_RATE = 0.2
"""Share of the normal speed at which a channel approaches its stop, to hit it gently."""


def channels_for(firmware: tuple[int, int]) -> tuple[Channel, ...]:
    """Return the channels with the offsets for a firmware version."""
    table = list(CHANNELS)
    # Version 0.0, which is no real version, is treated like 1.2.
    if firmware in {(0, 0), (1, 2)}:
        table[1] = replace(table[1], min_offset=-105_000)
        table[8] = replace(table[8], min_offset=-57_000)
    elif firmware[0] == 2:
        table[8] = replace(
            table[8], min_offset=-52_000, reset_factor=0.7 if firmware == (2, 3) else 0.40
        )
    return tuple(table)


# The vendor's parameter set for firmware 1.2, by channel: ticks/s, gains, and mA.
_RATES = (65e3, 50e3, 45e3, 40e3, 45e3, 40e3, 45e3, 45e3, 25e3)
_KP = (0.5, 0.5, 0.5, 0.8, 0.5, 0.8, 0.5, 0.5, 0.5)
_KI = (0.0, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
_KD = (400.0, 100.0, 40.0, 1000.0, 10.0, 1000.0, 100.0, 100.0, 100.0)
_CURRENTS = (500.0, 500.0, 300.0, 350.0, 300.0, 350.0, 300.0, 300.0, 500.0)
_CURRENT_KP = (0.6, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.7)
_CURRENT_KI = (10.0, 10.0, 10.0, 10.0, 10.0, 10.0, 25.0, 25.0, 60.0)
_CURRENT_INTEGRAL = (25.0, 25.0, 25.0, 25.0, 25.0, 25.0, 10.0, 10.0, 4.0)


def position_settings(channel: int) -> PositionSettings:
    """Return the position controller of a channel for firmware 1.x."""
    return PositionSettings(
        -1e6, 1e6, _RATES[channel], 1.0, 1e-3, -500.0, 500.0,
        _KP[channel], _KI[channel], _KD[channel],
    )  # fmt: skip


def current_settings(channel: int) -> CurrentSettings:
    """Return the current controller of a channel for firmware 1.x."""
    limit, integral = _CURRENTS[channel], _CURRENT_INTEGRAL[channel]
    return CurrentSettings(
        -limit, limit, 0.405, 4e-6, -integral, integral,
        _CURRENT_KP[channel], _CURRENT_KI[channel], -255.0, 255.0,
    )  # fmt: skip


def channel_of(actuator: str) -> int:
    """Return the channel whose name ends an actuator's name; raises `KeyError`."""
    for channel in CHANNELS:
        if actuator == channel.name or actuator.endswith(f"_{channel.name}"):
            return channel.index
    raise KeyError(actuator)


def channels_of(spec: DeviceSpec) -> tuple[int, ...]:
    """Return the channel of each actuator of a device; raises `ConfigError`."""
    found: list[int] = []
    for actuator in spec.actuators:
        try:
            channel = channel_of(actuator.name)
        except KeyError:
            names = ", ".join(c.name for c in CHANNELS)
            raise ConfigError(
                f"device '{spec.name}': actuator '{actuator.name}' is not one of the SVH's; their "
                f"names end with {names}"
            ) from None
        if channel in found:
            raise ConfigError(
                f"device '{spec.name}': two actuators drive channel '{CHANNELS[channel].name}'"
            )
        found.append(channel)
    return tuple(found)


class ChannelOptions(Section, frozen=True):
    """Changes to the built-in table for one channel.

    Attributes:
        min_offset: Lower soft limit relative to the stop [ticks].
        max_offset: Upper soft limit relative to the stop [ticks].
        idle_offset: Where homing leaves it, relative to the stop [ticks].
        reset_factor: Share of the current limit at which the stop counts as reached.
        current_limit: Largest current [A].
        effort_per_ampere: Effort per current [N·m/A], if the table has none.
    """

    min_offset: int | None = None
    max_offset: int | None = None
    idle_offset: int | None = None
    reset_factor: Annotated[float, Meta(gt=0.0, le=1.0)] | None = None
    current_limit: Current | None = None
    effort_per_ampere: Positive | None = None

    def applied_to(self, channel: Channel) -> Channel:
        """Return the changed channel; the current limit is a controller setting instead."""
        changes = values_given(self)
        changes.pop("current_limit", None)
        per_ampere = changes.pop("effort_per_ampere", None)
        if per_ampere is not None:
            # With a lever of 1 m, force and effort have the same value.
            changes |= {"force_slope": per_ampere / 1000.0, "force_offset": 0.0, "lever": 1.0}
        return replace(channel, **changes)


class SchunkSvhOptions(DeviceOptions, frozen=True):
    """Options of an SVH.

    Attributes:
        port: A tty, ``socket://host:port`` or ``rfc2217://host:port``.
        home: When it may be homed, which moves every finger: ``on_connect`` at the first
            activation, ``on_demand`` only after `recover`.
        stops_file: File to store the stops in, so that a later program can attach to a hand that
            has stayed enabled; empty: none.
        home_timeout: Longest time without motion of a channel while homing [s].
        settings: Controllers: ``library`` writes the table for firmware 1.x, ``device`` keeps the
            settings of the hand, ``auto`` decides by firmware.
        channels: Changes to the table, by channel.
        status_every: Number of exchanges after which faults are read.
        deadline: Longest time for one exchange, retries included [s].
        retries: How often a request is sent again within that time.
        turnaround: Time between a request and its answer besides that on the wire [s].
    """

    port: str = "/dev/ttyUSB0"
    home: Literal["on_demand", "on_connect"] = "on_demand"
    stops_file: Path | None = None
    home_timeout: Positive = 10.0
    settings: Literal["auto", "library", "device"] = "auto"
    channels: dict[str, ChannelOptions] = field(default_factory=dict)
    status_every: Annotated[int, Meta(ge=1)] = 50
    deadline: Moment = 0.05
    retries: Annotated[int, Meta(ge=0, le=10)] = 2
    turnaround: Pause = TURNAROUND

    def applied_to(self, table: tuple[Channel, ...]) -> tuple[Channel, ...]:
        """Return the channels of the table with these changes."""
        return tuple(
            self.channels[channel.name].applied_to(channel)
            if channel.name in self.channels
            else channel
            for channel in table
        )

    def __post_init__(self) -> None:
        """Check the names of the channels."""
        names = [channel.name for channel in CHANNELS]
        for name in self.channels:
            if name not in names:
                reason = f"unknown channel '{name}'; valid: {', '.join(names)}"
                raise Misfit(reason, "channels")
        for channel in self.applied_to(CHANNELS):
            if not channel.min_offset < channel.max_offset:
                reason = (
                    f"'min_offset' {channel.min_offset} should be below 'max_offset' "
                    f"{channel.max_offset}"
                )
                raise Misfit(reason, "channels", channel.name)
