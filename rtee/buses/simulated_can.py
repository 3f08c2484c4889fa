"""The simulated end of a CAN bus: runs emulated nodes on a channel of python-can."""

from __future__ import annotations

import contextlib
import select
import time
from collections.abc import Callable, Sequence
from typing import Any

from rtee.buses.can_guard import frame_of, message_of, wake
from rtee.buses.emulator import CanFrame, Emulator
from rtee.buses.faults import Faults
from rtee.buses.line_model import CanWire
from rtee.buses.simulated import Simulation

_POLL = 0.02
"""Longest wait for a frame [s], for calls of other threads: only virtual buses can be woken up."""


class SimulatedCan(Simulation):
    """Nodes on a CAN channel of python-can: ``virtual``, ``udp_multicast`` or a real interface."""

    def __init__(
        self,
        emulators: Sequence[Emulator],
        *,
        name: str = "can",
        channel: str,
        interface: str = "virtual",
        bitrate: int | None = None,
        faults: Faults | None = None,
    ) -> None:
        super().__init__(name)
        self.wire = CanWire(emulators, bitrate=bitrate, faults=faults)
        self.emulators = self.wire.emulators
        self._channel, self._interface = channel, interface
        self._bus: Any = None
        self.on_unplug: Callable[[], None] | None = None

    @property
    def faults(self) -> Faults:
        """Faults of the bus."""
        return self.wire.faults

    @faults.setter
    def faults(self, faults: Faults) -> None:
        self.wire.faults = faults

    @property
    def address(self) -> str:
        """The channel."""
        return self._channel

    @property
    def plugged(self) -> bool:
        """Whether the adapter exists."""
        return self._bus is not None

    def _plug(self) -> None:
        import can

        if self._bus is None:
            self._bus = can.Bus(interface=self._interface, channel=self._channel)
            self.wire.reset()

    def _unplug(self) -> None:
        if self._bus is not None:
            self._bus.shutdown()
            self._bus = None
            if self.on_unplug is not None:
                self.on_unplug()

    def _wake(self) -> None:
        super()._wake()
        wake(self._bus)

    def _next_due(self) -> float | None:
        return self.wire.next_due()

    def _turn(self, timeout: float | None) -> None:
        if self._bus is None:
            select.select([self._wake_out], [], [], timeout)
            return
        message = self._bus.recv(_POLL if timeout is None else min(timeout, _POLL))
        now = time.monotonic()
        if message is not None and not message.is_error_frame:
            self.wire.receive(frame_of(message, now), now)
        for frame in self.wire.step(time.monotonic()):
            self._send(frame)

    def _send(self, frame: CanFrame) -> None:
        import can

        with contextlib.suppress(can.CanError):
            self._bus.send(message_of(frame))
