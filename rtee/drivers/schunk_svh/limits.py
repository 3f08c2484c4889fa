"""The controller settings of the SVH's channels, which include the limits of effort and speed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from rtee.drivers.schunk_svh.channels import (
    Channel,
    ChannelOptions,
    current_settings,
    position_settings,
)
from rtee.drivers.schunk_svh.codec import CurrentSettings, PositionSettings
from rtee.drivers.schunk_svh.link import SvhLink
from rtee.errors import HandshakeError
from rtee.types import Reference

_PER_CYCLE = 2
"""Largest number of limits sent in one cycle: each takes an exchange of about 2 ms."""

_TOLERANCE = 5e-3
"""Relative change of a limit that is not sent: half a percent has no noticeable effect."""


class ControllerLimits:
    """Stores the settings of each channel's controllers, and sends those that a reference changes.

    Attributes:
        position: Position controllers without the limits of a reference, by channel.
        current: Current controllers without the limits of a reference, by channel.
    """

    def __init__(self) -> None:
        self.position: dict[int, PositionSettings] = {}
        self.current: dict[int, CurrentSettings] = {}
        self._sent: dict[tuple[int, str], float] = {}
        self._settled: tuple[list[float], list[float], list[bool]] | None = None

    async def read(
        self,
        link: SvhLink,
        name: str,
        channels: Sequence[Channel],
        options: Mapping[str, ChannelOptions],
        *,
        device: bool,
    ) -> None:
        """Read the controllers' settings from the built-in table or from the device.

        The options change settings by the channel's name. Raises `HandshakeError` if the device has
        no settings, and `BusError`.
        """
        self._settled = None
        for channel in channels:
            index = channel.index
            position, current = position_settings(index), current_settings(index)
            if device:
                position = await link.position_settings(index)
                current = await link.current_settings(index)
                if not (position.max_rate > 0.0 and current.maximum > 0.0):
                    raise HandshakeError(
                        name,
                        "a hand with its own controller settings",
                        f"none in channel {channel.name}",
                        hint="'settings: library' uses the table for firmware 1.x",
                    )
            given = options.get(channel.name)
            if given is not None and given.current_limit is not None:
                limit = given.current_limit * 1000.0
                current = replace(current, minimum=-limit, maximum=limit)
            self.position[index] = position
            self.current[index] = current

    async def write(self, link: SvhLink, channels: Sequence[int]) -> None:
        """Write the settings of all channels; raises `BusError`."""
        # These settings replace all limits sent before.
        self._sent.clear()
        self._settled = None
        for channel in channels:
            await link.set_position_settings(channel, self.position[channel])
            await link.set_current_settings(channel, self.current[channel])

    def settled(self, reference: Reference) -> bool:
        """Return whether a reference has the limits that were sent last."""
        return _asked(reference) == self._settled

    async def update(
        self, link: SvhLink, channels: Sequence[Channel], reference: Reference
    ) -> set[int]:
        """Send limits that have changed, a few at a time, as each takes an exchange.

        Returns the channels whose limits are still to be sent, which must not get a new target yet;
        raises `BusError`.
        """
        # If an exchange below fails, the limits must not count as sent in the next cycle.
        self._settled = None
        waiting: set[int] = set()
        budget = _PER_CYCLE
        for i, channel in enumerate(channels):
            if not reference.mask[i]:
                continue
            wanted = {
                "current": self._current_for(channel, float(reference.max_effort[i])),
                "rate": self._rate_for(channel, float(reference.max_velocity[i])),
            }
            for what, value in wanted.items():
                # NaN is close to no value, so a limit that was never sent is sent now.
                sent = self._sent.get((channel.index, what), math.nan)
                if math.isclose(sent, value, rel_tol=_TOLERANCE):
                    continue
                if budget == 0:
                    waiting.add(channel.index)
                    continue
                budget -= 1
                await self._send(link, channel.index, what, value)
        if not waiting:
            self._settled = _asked(reference)
        return waiting

    def _current_for(self, channel: Channel, effort: float) -> float:
        most = self.current[channel.index].maximum
        wanted = channel.to_current(effort) if math.isfinite(effort) else math.nan
        # At least 1 mA: a limit of 0 would switch the controller off.
        return most if math.isnan(wanted) else min(max(wanted, 1.0), most)

    def _rate_for(self, channel: Channel, velocity: float) -> float:
        most = self.position[channel.index].max_rate
        return min(max(channel.to_rate(velocity), 1.0), most) if math.isfinite(velocity) else most

    async def _send(self, link: SvhLink, index: int, what: str, value: float) -> None:
        if what == "current":
            current = replace(self.current[index], minimum=-value, maximum=value)
            await link.set_current_settings(index, current)
        else:
            position = replace(self.position[index], max_rate=value)
            await link.set_position_settings(index, position)
        self._sent[index, what] = value


def _asked(reference: Reference) -> tuple[list[float], list[float], list[bool]]:
    return reference.max_effort.tolist(), reference.max_velocity.tolist(), reference.mask.tolist()
