"""Enabling the SVH's channels, and the faults, lost power and heat that its controllers report."""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Iterable, Sequence

from rtee.drivers.schunk_svh.channels import HOMING_ORDER, Channel
from rtee.drivers.schunk_svh.codec import ControllerState
from rtee.drivers.schunk_svh.link import SvhLink
from rtee.errors import DeviceFault

_CLEAR = ControllerState.CLEAR
_SUPPLY = ControllerState.SUPPLY

_SETTLING = 0.002
"""Pause between two steps of enabling, as in the vendor's library [s]."""

# Codes of the driver's own faults, after `homing.HOMING_FAILED`; the hand itself has none.
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
        """Raise `DeviceFault` if a state reports one; notes the warnings."""
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
