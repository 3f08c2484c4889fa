"""Options of an SVH in hand.yaml."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta, field

from rtee.drivers.options import DeviceOptions, NotNegative, Positive
from rtee.drivers.schunk_svh.channels import CHANNELS, Channel
from rtee.drivers.schunk_svh.codec import TURNAROUND
from rtee.hand.validation import Misfit, Section, values_given


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
    current_limit: Positive | None = None
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
        turnaround: Time between a request and its answer beside that on the wire [s].
    """

    port: str = "/dev/ttyUSB0"
    home: Literal["on_demand", "on_connect"] = "on_demand"
    stops_file: Path | None = None
    home_timeout: Positive = 10.0
    settings: Literal["auto", "library", "device"] = "auto"
    channels: dict[str, ChannelOptions] = field(default_factory=dict)
    status_every: Annotated[int, Meta(ge=1)] = 50
    deadline: Positive = 0.05
    retries: Annotated[int, Meta(ge=0, le=10)] = 2
    turnaround: NotNegative = TURNAROUND

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
                reason = f"there is no channel '{name}'; there are: {', '.join(names)}"
                raise Misfit(reason, "channels")
