"""Simulated ends of buses: a pty, a TCP port or a CAN channel that plays emulated devices.

Each runs in a thread of its own, with a selector of microsecond resolution, so that a blocking
client in the same process can talk to it too and the modelled wire time is kept.
"""

from __future__ import annotations

import contextlib
import os
import queue
import select
import shutil
import socket
import tempfile
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Self

from rtee.buses.can import wake
from rtee.buses.emulator import CanFrame, Emulator
from rtee.buses.faults import Faults
from rtee.buses.link import Line
from rtee.buses.timing import wake_exactly
from rtee.buses.wire import CanWire, Wire
from rtee.errors import BusBroken


class Simulation(ABC):
    """One simulated bus; a context manager.

    Attributes:
        faults: What goes wrong on the wire; may be changed while it runs.
        emulators: The devices on it.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.emulators: list[Emulator] = []
        self._thread: threading.Thread | None = None
        self._wake_out, self._wake_in = os.pipe()
        os.set_blocking(self._wake_out, False)
        self._tasks: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._running = False

    faults: Faults

    @property
    @abstractmethod
    def address(self) -> str:
        """Where the host finds it now."""

    @property
    @abstractmethod
    def plugged(self) -> bool:
        """Whether the host can reach it."""

    @abstractmethod
    def _plug(self) -> None: ...

    @abstractmethod
    def _unplug(self) -> None: ...

    @abstractmethod
    def _turn(self, timeout: float | None) -> None:
        """Wait for traffic, the wake-up pipe or the timeout, and serve what there is."""

    @abstractmethod
    def _next_due(self) -> float | None: ...

    def start(self) -> Self:
        """Open the port and start playing."""
        self._plug()
        self._running = True
        self._thread = threading.Thread(
            target=self._run, name=f"simulated {self.name}", daemon=True
        )
        self._thread.start()
        return self

    def unplug(self) -> None:
        """Pull the cable: the host sees the port vanish."""
        self.call(self._unplug)

    def replug(self) -> None:
        """Put the cable back."""
        self.call(self._plug)

    def power_cycle(self) -> None:
        """Cut the devices' supply and bring it back."""
        self.call(lambda: [e.power_cycle(time.monotonic()) for e in self.emulators])

    def add(self, emulator: Emulator) -> None:
        """Put one more device on the wire."""
        self.call(lambda: self.emulators.append(emulator))

    def call(self, function: Callable[[], Any]) -> Any:
        """Run a function between two turns of the simulation's thread and return its result."""
        if not self._running or threading.current_thread() is self._thread:
            return function()
        done = threading.Event()
        box: list[Any] = []
        failed: list[BaseException] = []

        def task() -> None:
            try:
                box.append(function())
            except Exception as error:
                failed.append(error)
            finally:
                done.set()

        self._tasks.put(task)
        self._wake()
        done.wait()
        if failed:
            raise failed[0]
        return box[0]

    def _wake(self) -> None:
        os.write(self._wake_in, b"\0")

    def close(self) -> None:
        """Stop playing and close everything; idempotent."""
        if self._running:
            self._running = False
            self._wake()
            if self._thread is not None and self._thread is not threading.current_thread():
                self._thread.join()
        if self._wake_in >= 0:
            self._unplug()
            os.close(self._wake_in)
            os.close(self._wake_out)
            self._wake_in = self._wake_out = -1

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _run(self) -> None:
        wake_exactly()
        while self._running:
            due = self._next_due()
            self._turn(None if due is None else max(0.0, due - time.monotonic()))
            with contextlib.suppress(BlockingIOError):
                os.read(self._wake_out, 4096)
            self._serve()
        self._serve()

    def _serve(self) -> None:
        """Do what others asked for between two turns."""
        while not self._tasks.empty():
            self._tasks.get()()


_SPIN = 1e-4
"""Longest time before something is due that is waited for without sleeping [s]."""


class SimulatedLine(Simulation):
    """A byte line over a pty or a TCP port of this machine.

    Where the wire takes its time, the thread wakes up before something is due, by as much as its
    sleeps have lately been too long, and waits for the rest: bytes arrive to some microseconds when
    the modelled wire has carried them.

    Attributes:
        wire: Its wire: emulators, baud rate, faults.
    """

    def __init__(
        self,
        emulators: Sequence[Emulator],
        *,
        name: str = "line",
        tcp: bool = False,
        host: str = "127.0.0.1",
        port: int = 0,
        link: Path | str | None = None,
        line: Line | None = None,
        wire_time: bool = True,
        faults: Faults | None = None,
        scheme: str = "socket",
    ) -> None:
        super().__init__(name)
        baudrate = float(line.baudrate) if line is not None and scheme != "tcp" else None
        bits = float(line.bits) if line is not None else 10.0
        self.wire = Wire(emulators, baudrate=baudrate, bits=bits, faults=faults, timed=wire_time)
        self.emulators = self.wire.emulators
        self._end: _Pty | _Tcp = _Tcp(host, port, scheme) if tcp else _Pty(link)
        self._late = 0.0

    @property
    def faults(self) -> Faults:
        """What goes wrong on the wire."""
        return self.wire.faults

    @faults.setter
    def faults(self, faults: Faults) -> None:
        self.wire.faults = faults

    @property
    def address(self) -> str:
        """The pty's path or the port's address."""
        return self._end.address

    @property
    def plugged(self) -> bool:
        """Whether the port is there."""
        return self._end.open

    def _plug(self) -> None:
        if not self._end.open:
            self._end.plug()
            self.wire.reset()

    def _unplug(self) -> None:
        self._end.unplug()
        self.wire.reset()

    def close(self) -> None:
        """Stop playing and close everything; idempotent."""
        super().close()
        self._end.dispose()

    def _next_due(self) -> float | None:
        return self.wire.next_due()

    def _turn(self, timeout: float | None) -> None:
        for file in self._wait(timeout):
            if file != self._wake_out:
                data = self._end.read(file)
                if data is None:
                    self.wire.reset()
                elif data:
                    self.wire.receive(data, time.monotonic())
        data = b"".join(self.wire.step(time.monotonic()))
        if data:
            self._end.write(data)

    def _wait(self, timeout: float | None) -> list[int]:
        """Return the files that can be read, at the latest when the timeout is over."""
        files = [self._wake_out, *self._end.files()]
        if timeout is None or not self.wire.timed:
            return select.select(files, [], [], timeout)[0]
        due = time.monotonic() + timeout
        readable = select.select(files, [], [], max(0.0, timeout - self._late))[0]
        if not readable and timeout > self._late:
            late = time.monotonic() - (due - self._late)
            self._late += (min(max(late, 0.0), _SPIN) - self._late) / 8
        while not readable and time.monotonic() < due:
            pass
        return readable


class _Pty:
    """A pseudo-terminal, found by a symbolic link, whose host end is kept raw."""

    def __init__(self, link: Path | str | None) -> None:
        self._folder: str | None = None
        self._link = Path(link) if link is not None else None
        self._master = self._slave = -1

    @property
    def open(self) -> bool:
        return self._master >= 0

    @property
    def address(self) -> str:
        return "" if self._link is None else str(self._link)

    def plug(self) -> None:
        import pty
        import tty

        self._master, self._slave = pty.openpty()
        # The slave stays open here too: without any, the master would report a hang-up for ever.
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        if self._link is None:
            self._folder = tempfile.mkdtemp(prefix="rtee-")
            self._link = Path(self._folder) / "port"
        if self._link.is_symlink():
            self._link.unlink()
        try:
            self._link.symlink_to(os.ttyname(self._slave))
        except OSError as error:
            self.unplug()
            raise BusBroken(str(self._link), f"cannot make this link: {error.strerror}") from error

    def unplug(self) -> None:
        if self._link is not None and self._link.is_symlink() and self.open:
            self._link.unlink()
        for file in (self._slave, self._master):
            if file >= 0:
                os.close(file)
        self._master = self._slave = -1

    def dispose(self) -> None:
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = self._link = None

    def files(self) -> list[int]:
        return [self._master] if self.open else []

    def read(self, file: int) -> bytes | None:
        try:
            return os.read(self._master, 4096)
        except OSError:
            return b""

    def write(self, data: bytes) -> None:
        with contextlib.suppress(OSError):
            os.write(self._master, data)


class _Tcp:
    """A listening port that serves one connection at a time."""

    def __init__(self, host: str, port: int, scheme: str) -> None:
        self._host, self._port, self._scheme = host, port, scheme
        self._server: socket.socket | None = None
        self._peer: socket.socket | None = None

    @property
    def open(self) -> bool:
        return self._server is not None

    @property
    def address(self) -> str:
        return f"{self._scheme}://{self._host}:{self._port}"

    def plug(self) -> None:
        try:
            self._server = socket.create_server((self._host, self._port))
        except OSError as error:
            raise BusBroken(self.address, f"cannot listen there: {error.strerror}") from error
        self._port = self._server.getsockname()[1]

    def unplug(self) -> None:
        for one in (self._peer, self._server):
            if one is not None:
                # An abortive end: the host sees a reset, as when the box loses power.
                with contextlib.suppress(OSError):
                    one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
                one.close()
        self._peer = self._server = None

    def dispose(self) -> None:
        """Nothing stays behind."""

    def files(self) -> list[int]:
        return [s.fileno() for s in (self._peer, self._server) if s is not None]

    def read(self, file: int) -> bytes | None:
        if self._server is not None and file == self._server.fileno():
            return self._accept()
        if self._peer is None:
            return b""
        try:
            data = self._peer.recv(4096)
        except OSError:
            data = b""
        if not data:
            self._peer.close()
            self._peer = None
            return None
        return data

    def _accept(self) -> bytes | None:
        if self._server is None:
            return b""
        peer, _ = self._server.accept()
        if self._peer is not None:
            peer.close()
            return b""
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._peer = peer
        return None

    def write(self, data: bytes) -> None:
        if self._peer is not None:
            with contextlib.suppress(OSError):
                self._peer.sendall(data)


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
        """What goes wrong on the bus."""
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
        """Whether the adapter is there."""
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
        # Buses of other interfaces cannot be woken, so what is asked for waits this long.
        message = self._bus.recv(0.02 if timeout is None else min(timeout, 0.02))
        now = time.monotonic()
        if message is not None and not message.is_error_frame:
            frame = CanFrame(
                message.arbitration_id,
                bytes(message.data),
                message.is_extended_id,
                message.is_remote_frame,
                now,
            )
            self.wire.receive(frame, now)
        for frame in self.wire.step(time.monotonic()):
            self._send(frame)

    def _send(self, frame: CanFrame) -> None:
        import can

        with contextlib.suppress(can.CanError):
            self._bus.send(
                can.Message(
                    arbitration_id=frame.id,
                    data=frame.data,
                    is_extended_id=frame.extended,
                    is_remote_frame=frame.remote,
                )
            )
