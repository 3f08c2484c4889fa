"""Power and homing of the SVH's channels, their faults, and the file with the stops found."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from rtee import monotonic
from rtee.drivers.json_files import write_json
from rtee.drivers.schunk_svh import codec
from rtee.drivers.schunk_svh.channels import HOMING_ORDER, HOMING_RATE, Channel
from rtee.drivers.schunk_svh.codec import ControllerState
from rtee.drivers.schunk_svh.link import SvhLink
from rtee.errors import DeviceFault

_CLEAR = ControllerState.CLEAR
_SUPPLY = ControllerState.SUPPLY

_SETTLING = 0.002
"""Pause between two steps of enabling, as in the vendor's library [s]."""

# Codes of the driver's own faults, besides `HOMING_FAILED`; the hand itself has none.
NOT_HOMED = 1
DRIVER_FAULT = 3
LOST_POWER = 4

HOMING = (
    "`rtee recover`, or `rtee run --home`, homes it: every finger moves to its open stop, so "
    "nothing may be in the way"
)
"""Hint for a hand that is not homed."""


async def disable(link: SvhLink) -> None:
    """Disable every channel and clear latched faults."""
    await link.set_state(ControllerState(_CLEAR, _CLEAR))


async def enable(link: SvhLink, channels: Collection[int]) -> ControllerState:
    """Enable channels one after the other, and return the hand's state."""
    # The vendor's steps: clear the latches, switch the 12 V on, start the controllers.
    for step in ((), (_SUPPLY, _SUPPLY), (_SUPPLY, _SUPPLY, 1, 1)):
        await link.set_state(ControllerState(_CLEAR, _CLEAR, *step))
        await asyncio.sleep(_SETTLING)
    on, state = _SUPPLY, ControllerState()
    for channel in HOMING_ORDER:
        if channel in channels:
            # One at a time, in the order that keeps fingers from colliding.
            on |= 1 << channel
            state = await link.set_state(ControllerState(_CLEAR, _CLEAR, on, on, 1, 1))
    return state if state.enabled else await link.state()


class Health:
    """Compares the controllers' states with the state in which the hand was enabled.

    Attributes:
        enabled: Mask of the channels that must be on.
        warnings: Conditions that are not faults.
    """

    def __init__(self, device: str) -> None:
        self.enabled = 0
        self.warnings: tuple[str, ...] = ()
        self._device = device
        self._baseline = ControllerState()

    def found(self, state: ControllerState) -> None:
        """Start with a hand as found: channels that are enabled must stay so."""
        self.enabled = state.enabled
        self._baseline = _latched(state)

    def begin(self, state: ControllerState, channels: Iterable[int]) -> None:
        """Ignore the fault bits that are set now; the channels must stay enabled from now on."""
        self.enabled = sum(1 << channel for channel in channels)
        self._baseline = state

    def off(self) -> None:
        """Expect no channel to be enabled."""
        self.enabled = 0

    def cleared(self, state: ControllerState) -> None:
        """Start again after latched faults have been cleared."""
        self.enabled = 0
        self.warnings = ()
        self._baseline = _latched(state)

    def check(self, state: ControllerState, table: Sequence[Channel]) -> None:
        """Raise `DeviceFault` if a state reports a fault; store its warnings."""
        faults = state.pwm_fault & ~self._baseline.pwm_fault
        lost = self.enabled & ~state.enabled
        hot = state.pwm_otw & ~self._baseline.pwm_otw
        self.warnings = (f"over-temperature warning {hot:#04x}",) if hot else ()
        if faults:
            raise DeviceFault(
                self._device,
                DRIVER_FAULT,
                f"driver fault {faults:#04x}",
                hint="let it cool down, then `rtee recover`",
            )
        if lost:
            names = ", ".join(c.name for c in table if lost >> c.index & 1)
            raise DeviceFault(
                self._device,
                LOST_POWER,
                f"switched off: {names}",
                hint=f"was the 24 V supply cut? {HOMING}",
            )


def _latched(state: ControllerState) -> ControllerState:
    """Return the bits to ignore: those written to clear latches, if the hand echoes them."""
    echoed = state.pwm_fault == ControllerState.CLEAR
    return state if echoed else ControllerState()


HOMING_FAILED = 2
"""Code of the fault that a channel does not find its stop; a code of the driver's own."""

_HITS = 10
"""Number of times that the current must reach its threshold at the stop, as in the vendor's
library."""

_FAR = 1_000_000
"""Target beyond every stop [ticks]: the largest reference of the position controllers."""

_NEAR = 1_000
"""Distance to its goal at which a channel has left its stop, as in the vendor's library [ticks]."""

_MOVED = 50
"""Smallest change of the position that is not noise [ticks]: about 0.1 % of a channel's range."""

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
    """Move a channel slowly to its stop, then off the stop; leave it disabled.

    Returns the position of the stop [ticks]. Raises `DeviceFault` if the channel does not move for
    ``timeout`` [s] without reaching its stop, or does not come back from it; and `BusError`.
    """
    slow = replace(position, max_rate=position.max_rate * HOMING_RATE)
    # Slowed down before it is enabled, so that it never meets the stop at full speed.
    await link.set_position_settings(channel.index, slow)
    here = (await link.feedback(channel.index)).position
    # Before it is enabled, since it would move to an old target at once.
    await link.set_target(channel.index, here)
    try:
        await enable(link, [channel.index])
        stop = await _seek(link, device, channel, current, timeout)
        await _leave_stop(link, device, channel, channel.idle(stop), timeout)
    finally:
        # Shielded, since the channel must be disabled even when homing is cancelled.
        disabling = asyncio.ensure_future(disable(link))
        disabling.add_done_callback(_retrieve_error)
        await asyncio.shield(disabling)
    await link.set_position_settings(channel.index, position)
    return stop


def _retrieve_error(task: asyncio.Future[None]) -> None:
    """Retrieve the error of disabling, which nobody awaits after the caller was cancelled."""
    if not task.cancelled():
        task.exception()


async def _seek(
    link: SvhLink, device: str, channel: Channel, current: codec.CurrentSettings, timeout: float
) -> int:
    threshold = channel.reset_factor * current.maximum
    far = channel.direction * _FAR
    hits, last, since = 0, None, monotonic.now()
    while True:
        feedback = await link.set_target(channel.index, far)
        pressing = abs(feedback.current_ma) >= threshold
        # A short peak of the current is friction; only a lasting one is the stop.
        hits = hits + 1 if pressing else max(0, hits - 1)
        if hits >= _HITS:
            return feedback.position
        now = monotonic.now()
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
    end = monotonic.now() + timeout
    while monotonic.now() < end:
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
    """Return the stops [ticks] by channel; empty without a usable file."""
    if path is None:
        return {}
    try:
        stored = json.loads(path.read_text("utf-8"))
        stops = {int(channel): int(ticks) for channel, ticks in stored["stops"].items()}
    # Not an error, since homing finds the stops without the file.
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return {}
    return stops if all(0 <= channel < codec.CHANNELS for channel in stops) else {}


def write_stops(path: Path | None, stops: dict[int, int]) -> None:
    """Store the stops [ticks] by channel; raises `ConfigError` if the file cannot be written."""
    if path is not None:
        write_json(path, {"stops": {str(c): stops[c] for c in sorted(stops)}})


def plausible(
    stops: Mapping[int, int], table: Sequence[Channel], feedback: codec.FeedbackAll
) -> bool:
    """Return whether every finger is within the range that its stop allows."""
    for index, stop in stops.items():
        low, high = table[index].soft_limits(stop)
        # A finger may rest a little beyond its soft limits; a wrong zero is off by more than this.
        slack = (high - low) // 10
        if not low - slack <= feedback.positions[index] <= high + slack:
            return False
    return True
