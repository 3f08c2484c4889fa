"""Enabling, disabling and homing the SVH's channels, in the order the hand needs."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from dataclasses import replace

from rtee.drivers.schunk_svh import codec
from rtee.drivers.schunk_svh.channels import HOMING_ORDER, HOMING_RATE, Channel
from rtee.drivers.schunk_svh.codec import ControllerState
from rtee.drivers.schunk_svh.link import SvhLink
from rtee.errors import DeviceFault

_CLEAR = ControllerState.CLEAR
_SUPPLY = ControllerState.SUPPLY
_HITS = 10
_FAR = 1_000_000
_NEAR = 1_000
_POLL = 0.005
_MOVED = 50

NOT_HOMED = 1
HOMING_FAILED = 2
DRIVER_FAULT = 3
LOST_POWER = 4


async def disable(link: SvhLink) -> None:
    """Switch every channel off and clear latched faults."""
    await link.set_state(ControllerState(_CLEAR, _CLEAR))


async def enable(link: SvhLink, channels: Sequence[int], *, already: int = 0) -> ControllerState:
    """Switch channels on, one after the other, and return the hand's state.

    Args:
        link: The hand.
        channels: Which, in any order.
        already: Mask of those that are on and stay on.
    """
    if not already:
        await link.set_state(ControllerState(_CLEAR, _CLEAR))
        await asyncio.sleep(0.002)
        await link.set_state(ControllerState(_CLEAR, _CLEAR, _SUPPLY, _SUPPLY))
        await asyncio.sleep(0.002)
        await link.set_state(ControllerState(_CLEAR, _CLEAR, _SUPPLY, _SUPPLY, 1, 1))
        await asyncio.sleep(0.002)
    mask = already
    state = ControllerState()
    for channel in HOMING_ORDER:
        if channel in channels:
            mask |= 1 << channel
            on = _SUPPLY | mask
            state = await link.set_state(ControllerState(_CLEAR, _CLEAR, on, on, 1, 1))
    return state if state.enabled else await link.state()


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
        DeviceFault: if it stands still for ``timeout`` [s] without meeting a stop, or does not come
            back from it.
        BusError: if an exchange fails.
    """
    slow = replace(position, max_rate=position.max_rate * HOMING_RATE)
    await link.set_position_settings(channel.index, slow)
    here = (await link.feedback(channel.index)).position
    await link.set_target(channel.index, here)
    try:
        await enable(link, [channel.index])
        stop = await _seek(link, device, channel, current, timeout)
        await _settle(link, device, channel, channel.idle(stop), timeout)
    finally:
        ending = asyncio.ensure_future(disable(link))
        ending.add_done_callback(_ended)
        await asyncio.shield(ending)
    await link.set_position_settings(channel.index, position)
    return stop


def _ended(task: asyncio.Future[None]) -> None:
    """Take the error of switching off when nobody waits for it any more."""
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


async def _settle(link: SvhLink, device: str, channel: Channel, goal: int, timeout: float) -> None:
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
