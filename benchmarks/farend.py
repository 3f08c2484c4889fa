"""The device's end of a serial line in a process of its own, so that it costs the driver nothing.

Played in a thread, as everywhere else, an emulated device shares the interpreter's lock with the
driver, and its thread is woken some tens of microseconds late at every message: that is counted
against the driver, although no real device takes the driver's processor. Here the device is played
by a forked process that never sleeps. It hands bytes over when the modelled wire has carried them,
never before, and notes by how much later it did.
"""

from __future__ import annotations

import contextlib
import gc
import mmap
import os
import select
import signal
import struct
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from rtee.buses.emulator import EmulatorFactory
from rtee.buses.link import Line
from rtee.buses.played import PlayedEnds
from rtee.buses.pool import BusPool
from rtee.buses.simulated_ends import Pty
from rtee.buses.wire import Wire

_NOTES = struct.Struct("@dddd")
"""Ready, time the wire was taken [s], requests answered, lateness of their last answers [s]."""


class FarEnd:
    """A forked process that plays one device at a pseudo-terminal."""

    def __init__(self, factory: EmulatorFactory, line: Line) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="rtee-")
        self.address = str(Path(self._folder.name) / "port")
        self._notes = mmap.mmap(-1, _NOTES.size)
        self._process = os.fork()
        if not self._process:
            try:
                self._play(factory, line)
            finally:
                os._exit(1)
        while not self._read()[0]:
            time.sleep(0.001)

    @property
    def busy(self) -> float:
        """Time that messages and the device's turn-around have taken so far [s]."""
        return self._read()[1]

    def late(self) -> tuple[float, float]:
        """Return how many requests were answered, and by how much too late in all [s]."""
        _, _, answers, late = self._read()
        return answers, late

    def close(self) -> None:
        """End the process."""
        os.kill(self._process, signal.SIGKILL)
        os.waitpid(self._process, 0)
        self._folder.cleanup()

    def _read(self) -> tuple[float, float, float, float]:
        return _NOTES.unpack_from(self._notes)  # type: ignore[return-value]

    def _play(self, factory: EmulatorFactory, line: Line) -> None:
        gc.disable()
        processors = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, processors[-1:])
        wire = Wire([factory()], baudrate=float(line.baudrate), bits=float(line.bits))
        end = Pty(self.address)
        end.plug()
        (file,) = end.files()
        poll = select.poll()
        poll.register(file, select.POLLIN)
        answers = late = last = 0.0
        parent = os.getppid()
        while os.getppid() == parent:
            if poll.poll(0):
                wire.receive(end.read(file) or b"", time.monotonic())
                answers += last > 0.0
                late += last
                last = 0.0
            due = wire.next_due()
            now = time.monotonic()
            if due is not None and due <= now:
                data = b"".join(wire.step(now))
                if data:
                    end.write(data)
                    last = time.monotonic() - due
            _NOTES.pack_into(self._notes, 0, 1.0, wire.busy, answers, late)


class ApartEnds(PlayedEnds):
    """Far ends of which those of serial lines are processes of their own."""

    def __init__(self) -> None:
        super().__init__(wire_time=True)
        self.apart: dict[str, FarEnd] = {}

    def line(self, url: str, owner: str, line: Line, factory: EmulatorFactory) -> Callable[[], str]:
        """Play a device on a line, and return what tells where the host finds it now."""
        if "://" in url:
            return super().line(url, owner, line, factory)
        end = self.apart.get(url)
        if end is None:
            end = self.apart[url] = FarEnd(factory, line)
        return lambda: end.address

    def close(self) -> None:
        """End every simulation and every process; idempotent."""
        super().close()
        for end in self.apart.values():
            end.close()
        self.apart.clear()


class ApartPool(BusPool):
    """A pool that plays the devices of serial lines in processes of their own."""

    def __init__(self) -> None:
        super().__init__(wire_time=True)
        self._ends: ApartEnds = ApartEnds()

    def busy(self) -> float:
        """Return the time that all wires were taken so far [s]."""
        wires = [getattr(simulation, "wire", None) for simulation in self.simulations.values()]
        played = sum(float(getattr(wire, "busy", 0.0)) for wire in wires)
        return played + sum(end.busy for end in self._ends.apart.values())

    def late(self) -> tuple[float, float]:
        """Return the far ends' answered requests and lateness in all; see `FarEnd.late`."""
        said = [end.late() for end in self._ends.apart.values()]
        return sum(answers for answers, _ in said), sum(late for _, late in said)

    @contextlib.contextmanager
    def processors(self) -> Iterator[None]:
        """Leave the last processor to the far ends."""
        every = os.sched_getaffinity(0)
        if self._ends.apart and len(every) > 1:
            os.sched_setaffinity(0, every - {max(every)})
        try:
            yield
        finally:
            os.sched_setaffinity(0, every)
