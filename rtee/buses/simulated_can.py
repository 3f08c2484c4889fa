"""The simulated end of a CAN bus: runs emulated nodes on a channel of python-can."""

from __future__ import annotations

import contextlib
import select
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from rtee import monotonic
from rtee.buses.can_guard import frame_of, message_of, open_bus, wake
from rtee.buses.emulator import CanFrame, Emulator
from rtee.buses.faults import Faults
from rtee.buses.line_model import CanWire
from rtee.buses.simulated import Simulation
from rtee.buses.simulated_time import SimulatedTimeLoop, on_simulated_time

_POLL = 0.02
"""Longest wait for a frame before calls of other threads are served [s]: only the wait on a virtual
bus can be interrupted."""


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
        self.wire = self._wire = CanWire(emulators, bitrate=bitrate, faults=faults)
        self._channel, self._interface = channel, interface
        self._bus: Any = None
        self._hosts: list[DirectCan] = []
        self.on_unplug: Callable[[], None] | None = None

    @property
    def address(self) -> str:
        """The channel."""
        return self._channel

    def connect(self, receive: Callable[[CanFrame], None]) -> DirectCan | None:
        """Connect a host that receives frames on simulated time; ``None`` in real time."""
        if self._loop is None:
            return None
        host = DirectCan(self, self._loop, receive)
        self._hosts.append(host)
        return host

    def _plug(self) -> None:
        if self._there:
            return
        if self._loop is None:
            self._bus = open_bus(self._interface, self._channel)
        self._there = True
        self.wire.reset()

    def _unplug(self) -> None:
        if not self._there:
            return
        self._there = False
        if self._bus is not None:
            self._bus.shutdown()
            self._bus = None
        self._hosts.clear()
        if self.on_unplug is not None:
            self.on_unplug()

    def _wake(self) -> None:
        super()._wake()
        wake(self._bus)

    def _turn(self, timeout: float | None) -> None:
        if self._bus is None:
            select.select([self._wake_out], [], [], timeout)
        else:
            message = self._bus.recv(_POLL if timeout is None else min(timeout, _POLL))
            now = monotonic.now()
            if message is not None and not message.is_error_frame:
                self.wire.receive(frame_of(message, now), now)
        self._step(monotonic.now())

    def hear(self, host: DirectCan, frame: CanFrame) -> None:
        """Receive a frame from a host on simulated time; drop it if the host has left."""
        if host in self._hosts:
            self.wire.receive(frame, monotonic.now())
            self._schedule()

    def leave(self, host: DirectCan) -> None:
        """Disconnect a host; idempotent."""
        if host in self._hosts:
            self._hosts.remove(host)

    def _step(self, now: float) -> None:
        for frame in self.wire.step(now):
            self._send(frame)

    def _send(self, frame: CanFrame) -> None:
        import can

        for host in tuple(self._hosts):
            host.receive(replace(frame, stamp=monotonic.now()))
        if self._bus is None:
            return
        with contextlib.suppress(can.CanError):
            self._bus.send(message_of(frame))


class DirectCan:
    """A host on a simulated CAN bus on simulated time, in place of a bus of python-can.

    Args:
        simulation: The bus.
        loop: The event loop of both.
        receive: Called with every frame of the nodes.
    """

    def __init__(
        self, simulation: SimulatedCan, loop: SimulatedTimeLoop, receive: Callable[[CanFrame], None]
    ) -> None:
        self._simulation = simulation
        self._loop = loop
        self.receive = receive

    def send(self, frame: CanFrame) -> None:
        """Send a frame; may be called from any thread."""
        if on_simulated_time() is None:  # another thread
            self._loop.call_soon_threadsafe(self._simulation.hear, self, frame)
        else:
            self._simulation.hear(self, frame)

    def shutdown(self) -> None:
        """Leave the bus; idempotent."""
        self._simulation.leave(self)
