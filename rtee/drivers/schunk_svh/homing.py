"""Homing of the SVH's channels, and the file that keeps the stops found."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from rtee.drivers.schunk_svh import codec
from rtee.drivers.schunk_svh.channels import HOMING_RATE, Channel
from rtee.drivers.schunk_svh.link import SvhLink
from rtee.drivers.schunk_svh.power import disable, enable
from rtee.errors import DeviceFault
from rtee.hand.files import make_folder, write_atomically

HOMING_FAILED = 2
"""Code of the fault that a channel does not find its stop, the driver's own."""

_HITS = 10
"""Times that the current must reach its threshold at the stop, as in the vendor's library."""

_FAR = 1_000_000
"""Target beyond every stop [ticks]: the largest reference of the position controllers."""

_NEAR = 1_000
"""Distance at which a channel has come back from its stop, as in the vendor's library [ticks]."""

_MOVED = 50
"""Change of the position that is motion and not noise [ticks]: some 0.1 % of a channel's range."""

_POLL = 0.005
"""Pause between two exchanges with a channel that homes [s]."""


async def home(
    link: SvhLink,
    device: str,
    channel: Channel,
    position: codec.PositionSettings,
    current: codec.CurrentSettings,
    *,
    timeout: float,
) -> int:
    """Look for a channel's stop, slowly; leave it off the stop, switched off.

    Returns:
        The position of the stop [ticks].

    Raises:
        DeviceFault: if it does not move for ``timeout`` [s] without meeting a stop, or does not
            come back from it.
        BusError: if an exchange fails.
    """
    slow = replace(position, max_rate=position.max_rate * HOMING_RATE)
    await link.set_position_settings(channel.index, slow)
    here = (await link.feedback(channel.index)).position
    # Before the power comes: with an old target the channel would run off at once.
    await link.set_target(channel.index, here)
    try:
        await enable(link, [channel.index])
        stop = await _seek(link, device, channel, current, timeout)
        await _leave_stop(link, device, channel, channel.idle(stop), timeout)
    finally:
        # Shielded: also when homing is cancelled, the channel must be switched off.
        ending = asyncio.ensure_future(disable(link))
        ending.add_done_callback(_ended)
        await asyncio.shield(ending)
    await link.set_position_settings(channel.index, position)
    return stop


def _ended(task: asyncio.Future[None]) -> None:
    """Retrieve the error of switching off after the caller was cancelled."""
    if not task.cancelled():
        task.exception()


async def _seek(
    link: SvhLink,
    device: str,
    channel: Channel,
    current: codec.CurrentSettings,
    timeout: float,
) -> int:
    threshold = channel.reset_factor * current.maximum
    far = channel.direction * _FAR
    hits, last, since = 0, None, time.monotonic()
    while True:
        feedback = await link.set_target(channel.index, far)
        pressing = abs(feedback.current_ma) >= threshold
        # One peak of the current is friction; only a lasting one is the stop.
        hits = hits + 1 if pressing else max(0, hits - 1)
        if hits >= _HITS:
            return feedback.position
        now = time.monotonic()
        if last is None or abs(feedback.position - last) > _MOVED:
            last, since = feedback.position, now
        elif now - since > timeout:
            raise DeviceFault(
                device,
                HOMING_FAILED,
                f"homing failed: {channel.name} does not move",
                hint="switch the 24 V supply on, clear its way; `rtee recover` homes again",
            )
        await asyncio.sleep(_POLL)


async def _leave_stop(
    link: SvhLink, device: str, channel: Channel, goal: int, timeout: float
) -> None:
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        feedback = await link.set_target(channel.index, goal)
        if abs(feedback.position - goal) < _NEAR:
            return
        await asyncio.sleep(_POLL)
    raise DeviceFault(
        device,
        HOMING_FAILED,
        f"homing failed: {channel.name} does not come back from its stop",
        hint="free the finger; `rtee recover` homes again",
    )


def read_stops(path: Path | None) -> dict[int, int]:
    """Return the stops [ticks] by channel, or nothing without a file that makes sense."""
    if path is None:
        return {}
    try:
        stored = json.loads(path.read_text("utf-8"))
        found = {int(channel): int(ticks) for channel, ticks in stored["stops"].items()}
    # Not an error: without a file that can be used, homing finds the stops.
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return {}
    return found if all(0 <= channel < codec.CHANNELS for channel in found) else {}


def write_stops(path: Path | None, stops: dict[int, int]) -> None:
    """Keep the stops [ticks] by channel; raises `ConfigError` if the file cannot be written."""
    if path is not None:
        make_folder(path.parent)
        text = json.dumps({"stops": {str(c): stops[c] for c in sorted(stops)}}, indent=2)
        write_atomically(path, text + "\n")


def plausible(
    stops: Mapping[int, int], table: Sequence[Channel], feedback: codec.FeedbackAll
) -> bool:
    """Return whether every finger is where its stop allows."""
    for index, stop in stops.items():
        low, high = table[index].soft_limits(stop)
        # A finger may rest a little beyond its soft limits; a tenth of the range is not another
        # zero.
        slack = (high - low) // 10
        if not low - slack <= feedback.positions[index] <= high + slack:
            return False
    return True
