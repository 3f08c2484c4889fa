"""What the SVH's controllers tell of faults, lost power and heat since they were enabled."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rtee.drivers.schunk_svh import power
from rtee.drivers.schunk_svh.channels import Channel
from rtee.drivers.schunk_svh.codec import ControllerState
from rtee.errors import DeviceFault

HOMING = (
    "`rtee recover`, or `rtee run --home`, homes it: every finger moves to its open stop, so "
    "nothing may be in the way"
)


class Health:
    """Compares the controllers' states with what was so when the hand was enabled.

    Attributes:
        enabled: Mask of the channels that must be on.
        warnings: Conditions that are no faults.
    """

    def __init__(self, device: str) -> None:
        self.enabled = 0
        self.warnings: tuple[str, ...] = ()
        self._device = device
        self._baseline = ControllerState()

    def found(self, state: ControllerState) -> None:
        """Take a hand as it is found: what is on must stay on."""
        self.enabled = state.enabled
        self._baseline = _latched(state)

    def begin(self, state: ControllerState, channels: Iterable[int]) -> None:
        """Take bits set now for ones that tell nothing; these channels must stay on."""
        self.enabled = sum(1 << channel for channel in channels)
        self._baseline = state

    def off(self) -> None:
        """Expect no channel to be on."""
        self.enabled = 0

    def cleared(self, state: ControllerState) -> None:
        """Begin anew after latched faults have been cleared."""
        self.enabled = 0
        self.warnings = ()
        self._baseline = _latched(state)

    def check(self, state: ControllerState, table: Sequence[Channel]) -> None:
        """Raise `DeviceFault` if a state tells of one; notes the warnings."""
        faults = state.pwm_fault & ~self._baseline.pwm_fault
        lost = self.enabled & ~state.enabled
        hot = state.pwm_otw & ~self._baseline.pwm_otw
        self.warnings = (f"over-temperature warning {hot:#04x}",) if hot else ()
        if faults:
            raise DeviceFault(
                self._device,
                power.DRIVER_FAULT,
                f"driver fault {faults:#04x}",
                hint="let it cool down, then `rtee recover`",
            )
        if lost:
            names = ", ".join(c.name for c in table if lost >> c.index & 1)
            raise DeviceFault(
                self._device,
                power.LOST_POWER,
                f"switched off: {names}",
                hint=f"was the 24 V supply cut? {HOMING}",
            )


def _latched(state: ControllerState) -> ControllerState:
    """Return the bits that tell nothing: those written to clear latches, if they come back."""
    echoed = state.pwm_fault == ControllerState.CLEAR
    return state if echoed else ControllerState()
