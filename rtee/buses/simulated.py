"""Simulated ends of buses that run emulated devices: their base class, and byte lines.

Each runs in its own thread, so that a blocking client in the same process can talk to it, too. The
thread waits with microsecond resolution, to keep the modelled wire time. On simulated time
(`rtee.buses.simulated_time`), it runs in the event loop instead, and nothing waits.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import queue
import select
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Self

from rtee import monotonic
from rtee.buses.direct_end import DirectEnd
from rtee.buses.emulator import Duplex, Emulator
from rtee.buses.faults import Faults
from rtee.buses.line_model import Schedule, Wire
from rtee.buses.link import Line
from rtee.buses.simulated_ends import Pty, Tcp
from rtee.buses.simulated_time import on_simulated_time
from rtee.buses.timing import ask_for_short_slices, wake_exactly
from rtee.errors import RteeError


class Simulation(ABC):
    """One simulated bus; a context manager.

    A subclass sets the model of its wire.
    """

    _wire: Schedule[Any]

    def __init__(self, name: str) -> None:
        self.name = name
        self._thread: threading.Thread | None = None
        self._wake_out = self._wake_in = -1
        self._loop = on_simulated_time()
        self._timer: asyncio.TimerHandle | None = None
        self._tasks: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._running = False
        self._there = False

    @property
    def emulators(self) -> list[Emulator]:
        """The devices on the wire."""
        return self._wire.emulators

    @property
    def faults(self) -> Faults:
        """Faults of the wire; may be changed while it runs."""
        return self._wire.faults

    @faults.setter
    def faults(self, faults: Faults) -> None:
        self._wire.faults = faults

    @property
    @abstractmethod
    def address(self) -> str:
        """The current address for the host."""

    @property
    def plugged(self) -> bool:
        """Whether the host can connect."""
        return self._there

    @abstractmethod
    def _plug(self) -> None: ...

    @abstractmethod
    def _unplug(self) -> None: ...

    @abstractmethod
    def _turn(self, timeout: float | None) -> None:
        """Wait for traffic, the wake-up pipe or the timeout [s], and process received messages."""

    @abstractmethod
    def _step(self, now: float) -> None:
        """Carry out the events that are due at a time [s]."""

    def _next_due(self) -> float | None:
        return self._wire.next_due()

    def start(self) -> Self:
        """Open the port and start the thread."""
        self._plug()
        self._running = True
        if self._loop is not None:
            self._schedule()
            return self
        self._wake_out, self._wake_in = os.pipe()
        # A byte in the pipe ends the thread's wait (self-pipe trick).
        os.set_blocking(self._wake_out, False)
        self._thread = threading.Thread(
            target=self._run, name=f"simulated {self.name}", daemon=True
        )
        self._thread.start()
        return self

    def unplug(self) -> None:
        """Unplug the cable: the port vanishes for the host."""
        self.call(self._unplug)

    def replug(self) -> None:
        """Plug the cable in again."""
        self.call(self._plug)

    def power_cycle(self) -> None:
        """Switch the supply of the devices off and on."""
        self.call(lambda: [e.power_cycle(monotonic.now()) for e in self.emulators])

    def add(self, emulator: Emulator) -> None:
        """Connect another device to the wire."""
        self.call(lambda: self.emulators.append(emulator))

    def call(self, function: Callable[[], Any]) -> Any:
        """Run a function between two turns of the simulation's thread and return its result.

        Raises:
            RteeError: if an emulator's error has ended the thread.
        """
        if self._loop is not None:
            result = function()
            self._schedule()
            return result
        # In the simulation's own thread, a wait would never end.
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
        while not done.wait(_LOOK):
            if not (self._thread and self._thread.is_alive()) and not done.is_set():
                raise RteeError(f"'{self.name}' is no longer emulated: the emulator failed")
        if failed:
            raise failed[0]
        return box[0]

    def _wake(self) -> None:
        os.write(self._wake_in, b"\0")

    def _schedule(self) -> None:
        """On simulated time, have the event loop take the next step when it is due."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        due = self._next_due()
        if due is not None and self._loop is not None and self._running:
            self._timer = self._loop.call_at(due, self._advance)

    def _advance(self) -> None:
        self._step(monotonic.now())
        self._schedule()

    def close(self) -> None:
        """End the thread and close everything; idempotent."""
        if self._running:
            self._running = False
            if self._loop is not None:
                self._schedule()
            else:
                self._wake()
            if self._thread is not None and self._thread is not threading.current_thread():
                self._thread.join()
            self._unplug()
        if self._wake_in >= 0:
            os.close(self._wake_in)
            os.close(self._wake_out)
            self._wake_in = self._wake_out = -1

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _run(self) -> None:
        wake_exactly()
        ask_for_short_slices()
        while self._running:
            due = self._next_due()
            self._turn(None if due is None else max(0.0, due - monotonic.now()))
            with contextlib.suppress(BlockingIOError):
                os.read(self._wake_out, 4096)
            self._serve()
        self._serve()

    def _serve(self) -> None:
        """Run the functions that other threads passed to `call`."""
        while not self._tasks.empty():
            self._tasks.get()()


_LOOK = 0.2
"""Interval at which `call` checks that the simulation's thread is still alive [s]."""

_SPIN = 1e-4
"""Longest time to spin before a message is due [s]: the usual lateness of a sleep."""


class SimulatedLine(Simulation):
    """A byte line over a pty or a TCP port of this machine.

    With a timed wire, the thread wakes up earlier than a message is due, by the usual lateness of
    its sleeps, and spins for the rest: bytes arrive within microseconds of the modelled time.

    Attributes:
        wire: Model of the line: devices, baud rate, faults.
        strict: Whether a device receives only bytes sent at its baud rate (ptys only).
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
        strict: bool = False,
    ) -> None:
        super().__init__(name)
        self.strict = strict
        network = scheme == "tcp"
        self.wire = self._wire = Wire(
            emulators,
            baudrate=None if line is None or network else float(line.baudrate),
            bits=10.0 if line is None else float(line.bits),
            faults=faults,
            timed=wire_time,
            duplex=Duplex.FULL if network else None,
            adapter=not tcp,
        )
        self._end: Pty | Tcp | DirectEnd
        if self._loop is not None:
            self._end = DirectEnd(self._loop, self._take, self.wire.reset if tcp else None)
        else:
            self._end = Tcp(host, port, scheme) if tcp else Pty(link)
        self._late = 0.0

    @property
    def address(self) -> str:
        """The pty's path or the port's address."""
        return self._end.address

    def _plug(self) -> None:
        if not self._there:
            self._end.plug()
            self._there = True
            self.wire.reset()

    def _unplug(self) -> None:
        self._there = False
        self._end.unplug()
        self.wire.reset()

    def close(self) -> None:
        """End the thread and close everything; idempotent."""
        super().close()
        self._end.dispose()

    def _turn(self, timeout: float | None) -> None:
        if isinstance(self._end, DirectEnd):  # runs in the event loop
            return
        for file in self._wait(timeout, self._end.files()):
            if file != self._wake_out:
                data = self._end.read(file)
                if data is None:
                    self.wire.reset()
                elif data:
                    self._hear(data)
        self._step(monotonic.now())

    def _hear(self, data: bytes) -> None:
        self.wire.spoken = self._end.rate() if self.strict else None
        self.wire.receive(data, monotonic.now())

    def _take(self, data: bytes) -> None:
        """Receive bytes on simulated time; answers follow in a later turn of the loop."""
        self._hear(data)
        self._schedule()

    def _step(self, now: float) -> None:
        data = b"".join(self.wire.step(now))
        if data and self._end.heard:
            self._end.write(data)

    def _wait(self, timeout: float | None, ends: list[int]) -> list[int]:
        """Wait at most for the timeout [s]; return the file descriptors that can be read."""
        files = [self._wake_out, *ends]
        if timeout is None or not self.wire.timed:
            return select.select(files, [], [], timeout)[0]
        due = monotonic.now() + timeout
        # Earlier by the usual lateness; the loop below spins for the rest.
        readable = select.select(files, [], [], max(0.0, timeout - self._late))[0]
        if not readable and timeout > self._late:
            late = monotonic.now() - (due - self._late)
            # Exponential mean over about eight sleeps, since the lateness depends on the load.
            self._late += (min(max(late, 0.0), _SPIN) - self._late) / 8
        while not readable and monotonic.now() < due:
            pass
        return readable
