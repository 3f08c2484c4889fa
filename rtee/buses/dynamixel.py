"""A Dynamixel line: the blocking port of dynamixel-sdk in a worker thread."""

from __future__ import annotations

import asyncio
import contextlib
import termios
from collections.abc import Callable
from typing import Any, TypeVar

import dynamixel_sdk
import serial

from rtee import monotonic
from rtee.buses.bus import Bus
from rtee.buses.direct_end import SIMULATED, DirectPort
from rtee.buses.link import Line, explained, refuse_on_simulated_time
from rtee.buses.worker import Worker
from rtee.errors import BusBroken, BusTimeout, RteeError

T = TypeVar("T")

_LATENCY = 4.0
"""Default time allowed for an answer beyond the transfer of its bytes [ms]: for the latency timer
of an adapter (1 ms) and delays of a busy computer."""

_POLL = 0.05
"""Longest wait for a first byte before the packet's timeout is checked again [s], so that an
abandoned call does not keep the thread for long."""


class DynamixelPort(dynamixel_sdk.PortHandler):  # type: ignore[misc]
    """The SDK's port with an adjustable latency, which waits for bytes instead of spinning.

    Attributes:
        latency: Time allowed for an answer beyond the transfer of its bytes [ms].
    """

    def __init__(self, bus: DynamixelBus, address: str) -> None:
        super().__init__(address)
        self.is_open: bool = False
        self.ser: Any = None
        self._bus = bus
        self.latency = _LATENCY
        self.baudrate = bus.line.baudrate
        self._sent_at = 0.0  # when the last byte written has left [ms]

    def setupPort(self, cflag_baud: int) -> bool:  # noqa: N802 - the SDK's name
        """Open the port exclusively and with low latency."""
        if self.is_open:
            self.closePort()
        if self.port_name.startswith(f"{SIMULATED}://"):
            self.ser = DirectPort(self.port_name, self.baudrate)
        else:
            self.ser = serial.Serial(
                port=self.port_name, baudrate=self.baudrate, bytesize=8, timeout=0, exclusive=True
            )
        # Only FTDI adapters have a latency timer; other adapters raise an error.
        with contextlib.suppress(Exception):
            self.ser.set_low_latency_mode(True)
        self.is_open = True
        self.ser.reset_input_buffer()
        # [ms], the SDK's unit; ten bits per byte: start, eight data, stop.
        self.tx_time_per_byte = 1000.0 / self.baudrate * 10.0
        return True

    def readPort(self, length: int) -> bytes:  # noqa: N802 - the SDK's name
        """Return up to ``length`` bytes; wait for the first until the packet's timeout."""
        # The SDK calls this in a tight loop until its packet is complete.
        waiting = self.ser.in_waiting
        if not waiting:
            left = (self.packet_timeout - self.getTimeSinceStart()) / 1000.0
            self.ser.timeout = min(max(left, 0.0), _POLL)
            # Wait only for the first byte, since the other bytes of a packet follow at once.
            data = bytes(self.ser.read(1))
            self.ser.timeout = 0
            if not data or length <= 1:
                return self._bus.note("rx", data)
            return self._bus.note("rx", data + bytes(self.ser.read(length - 1)))
        return self._bus.note("rx", bytes(self.ser.read(length)))

    def writePort(self, packet: list[int]) -> int:  # noqa: N802 - the SDK's name
        """Write a packet."""
        written = int(self.ser.write(self._bus.note("tx", bytes(packet))))
        now = self.getCurrentTime()
        self._sent_at = max(self._sent_at, now) + written * self.tx_time_per_byte
        return written

    def setPacketTimeout(self, packet_length: int) -> None:  # noqa: N802 - the SDK's name
        """Start the timeout for an answer of ``packet_length`` bytes."""
        self.packet_start_time = self.getCurrentTime()
        # Group writes are not answered: at a low baud rate, they are still on their way.
        before = max(0.0, self._sent_at - self.packet_start_time)
        self.packet_timeout = before + self.tx_time_per_byte * packet_length + self.latency

    def getCurrentTime(self) -> float:  # noqa: N802 - the SDK's name
        """Return CLOCK_MONOTONIC [ms]."""
        return monotonic.now() * 1000.0


class DynamixelBus(Bus):
    """A line of Dynamixels, used through dynamixel-sdk.

    Attributes:
        line: Settings of the line.
        port: The SDK's port handler, an argument of its packet and group handlers inside `run`.
        packets: The SDK's packet handler for protocol 2.0.
    """

    def __init__(self, name: str, line: Line, *, address: Callable[[], str] | None = None) -> None:
        super().__init__(name)
        self.line = line
        self._address = address or (lambda: name)
        self._worker = Worker(f"dynamixel {name}")
        self.port: Any = None
        self.packets: Any = dynamixel_sdk.PacketHandler(2.0)

    async def run(self, function: Callable[[], T], deadline: float) -> T:
        """Call a blocking function of the SDK in the worker thread; one at a time.

        Raises:
            BusTimeout: if it has not returned within ``deadline`` [s].
            BusBroken: if the link breaks.
            BusClosed: if the bus is closed.
        """
        self.check()
        self.counters.transactions += 1
        try:
            return await self._worker.run(function, deadline)
        except RteeError:
            raise  # before the next clauses, since several RteeErrors are OSErrors
        except TimeoutError:
            self.counters.timeouts += 1
            raise BusTimeout(self.name, f"not done within {deadline:.3f} s") from None
        except (OSError, TypeError, termios.error) as error:
            # pyserial raises a TypeError if its port is closed during the call, and a
            # termios.error, which is not an OSError, if the port vanishes.
            self._broke(str(error))
            raise BusBroken(self.name, f"the link failed: {error}") from error

    def note(self, direction: str, data: bytes) -> bytes:
        """Count, trace and return bytes, in the worker thread."""
        if data:
            self._count(direction, data, monotonic.now())
        return data

    async def _open(self) -> None:
        await self._close()
        address = self._address()
        if not address.startswith(f"{SIMULATED}://"):
            refuse_on_simulated_time(address)
        port = DynamixelPort(self, address)
        try:
            opened = await self._worker.run(lambda: port.setBaudRate(self.line.baudrate), 3.0)
        except (OSError, ValueError) as error:
            raise explained(self.name, error) from error
        if not opened:
            raise BusBroken(self.name, f"dynamixel-sdk does not support {self.line.baudrate} baud")
        self.port = port

    async def _close(self) -> None:
        await self._worker.close()
        port, self.port = self.port, None
        if port is not None and port.is_open:
            # In a thread, since closing may take the kernel some time if the adapter was unplugged.
            closing = asyncio.get_running_loop().run_in_executor(None, _close, port)
            await asyncio.shield(closing)


def _close(port: DynamixelPort) -> None:
    with contextlib.suppress(OSError):
        port.closePort()
