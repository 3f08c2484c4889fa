"""The device's end of a serial line in a separate process, so that it costs the driver nothing.

In a thread, as everywhere else, an emulated device shares the interpreter's lock with the
driver, and its thread is woken some tens of microseconds late at every message: that would count
against the driver, although no real device takes the driver's processor. Here a forked process that
never sleeps emulates the device. It hands bytes over when the modelled wire has carried them,
never before, and notes by how much later it did.

Bytes are on the wire from the moment the driver writes them, as on a real one. The kernel passes
the bytes of a pseudo-terminal on in a thread of its own, some tens of microseconds later; so the
driver's process records when it wrote how many bytes, and the far end counts from there. The
device's computation costs only its turn-around, since it is done while the modelled wire is busy.
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
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path

from rtee.buses.emulated_endpoints import EmulatedEndpoints
from rtee.buses.emulator import EmulatorFactory
from rtee.buses.line_model import Wire
from rtee.buses.link import Line
from rtee.buses.pool import BusPool
from rtee.buses.simulated_ends import Pty
from rtee.drivers.ability_hand.emulator import AbilityHandEmulator

_NOTES = struct.Struct("@dddd")
"""Ready, time the wire was taken [s], requests answered, lateness of their last answers [s]."""
_COUNT = struct.Struct("@Q")
"""Writes of the driver so far."""
_WRITE = struct.Struct("@dQ")
"""When the driver wrote, CLOCK_MONOTONIC [s], and how many bytes."""
_WRITES = 256
"""Newest writes that are kept: far more than are ever on the wire at once."""
_AT_ONCE = 2e-5
"""Actions due within this time are awaited without checking for new bytes [s]."""

PASSIVE = (AbilityHandEmulator,)
"""Devices that act by themselves without traffic, but send nothing unasked: while requests arrive,
they need no steps of their own."""


class FarEnd:
    """A forked process that plays one device at a pseudo-terminal."""

    def __init__(self, factory: EmulatorFactory, line: Line) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="rtee-")
        self.address = str(Path(self._folder.name) / "port")
        self._notes = mmap.mmap(-1, _NOTES.size)
        self._writes = mmap.mmap(-1, _COUNT.size + _WRITES * _WRITE.size)
        self._written = 0
        self._process = os.fork()
        if not self._process:
            try:
                self._play(factory, line)
            except Exception:
                traceback.print_exc()
            finally:
                # Not sys.exit: the child must not run the parent's clean-up.
                os._exit(1)
        while not self._read()[0]:
            ended, status = os.waitpid(self._process, os.WNOHANG)
            if ended:
                self._folder.cleanup()
                raise RuntimeError(
                    f"the far end ended with status {os.waitstatus_to_exitcode(status)}"
                )
            time.sleep(0.001)

    @property
    def busy(self) -> float:
        """Time that messages and the device's turn-around have taken so far [s]."""
        return self._read()[1]

    def late(self) -> tuple[float, float]:
        """Return how many requests were answered, and by how much too late in all [s]."""
        _, _, answers, late = self._read()
        return answers, late

    def wrote(self, count: int, now: float) -> None:
        """Note that the driver writes so many bytes now; called before it does."""
        at = _COUNT.size + self._written % _WRITES * _WRITE.size
        _WRITE.pack_into(self._writes, at, now, count)
        self._written += 1
        # Last: the other process reads an entry only when the count says that it is there.
        _COUNT.pack_into(self._writes, 0, self._written)

    def _heard(self, data: bytes) -> Iterator[tuple[bytes, float]]:
        """Return what came in, in pieces as they were written, and when that was."""
        while data:
            if self._written == _COUNT.unpack_from(self._writes)[0]:
                yield data, time.monotonic()  # written by the way
                return
            at = _COUNT.size + self._written % _WRITES * _WRITE.size
            when, count = _WRITE.unpack_from(self._writes, at)
            if count > len(data):  # the rest is still on its way
                _WRITE.pack_into(self._writes, at, when, count - len(data))
            else:
                self._written += 1
            yield data[:count], when
            data = data[count:]

    def close(self) -> None:
        """End the process."""
        os.kill(self._process, signal.SIGKILL)
        os.waitpid(self._process, 0)
        self._folder.cleanup()

    def _read(self) -> tuple[float, float, float, float]:
        return _NOTES.unpack_from(self._notes)  # type: ignore[return-value]

    def _play(self, factory: EmulatorFactory, line: Line) -> None:
        # A collection would be a late answer.
        gc.disable()
        processors = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, processors[-1:])
        device = factory()
        if isinstance(device, PASSIVE):
            device.period = 0.0
        # Its answers depend on the time at which they are computed, not on requests alone.
        if device.period:
            raise ValueError("a device that sends by itself cannot think ahead")
        wire = Wire([device], baudrate=float(line.baudrate), bits=float(line.bits))
        end = Pty(self.address)
        end.plug()
        (file,) = end.files()
        poll = select.poll()
        poll.register(file, select.POLLIN)
        answers = late = last = 0.0
        due: deque[tuple[float, bytes]] = deque()
        parent = os.getppid()
        _NOTES.pack_into(self._notes, 0, 1.0, wire.busy, answers, late)
        while os.getppid() == parent:
            if poll.poll(0):
                for data, when in self._heard(end.read(file) or b""):
                    wire.receive(data, when)
                answers += last > 0.0
                late += last
                last = 0.0
                while (when := wire.next_due()) is not None:
                    due.append((when, b"".join(wire.step(when))))
                _NOTES.pack_into(self._notes, 0, 1.0, wire.busy, answers, late)
            while due and due[0][0] - time.monotonic() < _AT_ONCE:
                when, data = due.popleft()
                while time.monotonic() < when:
                    pass
                if data:
                    end.write(data)
                    last = time.monotonic() - when


class ApartEnds(EmulatedEndpoints):
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
        super().__init__(wire_time=True, trace=self._traced)
        self._ends: ApartEnds = ApartEnds()

    def _traced(self, bus: str, direction: str, data: bytes, stamp: float) -> None:
        if direction == "tx" and bus in self._ends.apart:
            self._ends.apart[bus].wrote(len(data), stamp)

    def busy(self) -> float:
        """Return the time that all wires were taken so far [s]."""
        wires = [getattr(simulation, "wire", None) for simulation in self.simulations.values()]
        played = sum(float(getattr(wire, "busy", 0.0)) for wire in wires)
        return played + sum(end.busy for end in self._ends.apart.values())

    def late(self) -> tuple[float, float]:
        """Return the far ends' answered requests and lateness in all; see `FarEnd.late`."""
        ends = [end.late() for end in self._ends.apart.values()]
        return sum(answers for answers, _ in ends), sum(late for _, late in ends)

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
