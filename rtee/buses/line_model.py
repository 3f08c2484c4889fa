"""The time that messages take on a simulated wire; sans-I/O."""

from __future__ import annotations

import heapq
import itertools
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Generic, TypeVar

from rtee.buses.emulator import CanFrame, Duplex, Emulator
from rtee.buses.faults import Faults
from rtee.buses.timing import wire_time

_STANDARD_BITS, _EXTENDED_BITS = 47, 67
"""Bits of a frame beside its data, the pause between frames included (ISO 11898-1)."""

_STUFFING = 1.1
"""Bits sent per bit of a frame, as stuffing makes of usual data; at worst it is 1.2."""

M = TypeVar("M", bytes, CanFrame)


class _Schedule(ABC, Generic[M]):
    """Messages under way between a host and emulated devices, in the order of their arrival."""

    def __init__(self, emulators: Sequence[Emulator], faults: Faults | None) -> None:
        self.emulators = list(emulators)
        self.faults = faults or Faults()
        self.busy = 0.0
        # Breaks ties in the heap: equal times keep their order, and messages are never compared.
        self._number = itertools.count()
        self._events: list[tuple[float, int, bool, M]] = []
        self._stepped = 0.0

    @abstractmethod
    def _arrive(self, message: M, when: float) -> None:
        """Let the devices receive a message of the host."""

    @abstractmethod
    def _sent_unasked(self, emulator: Emulator, now: float) -> list[M]:
        """Return what a device sends by itself."""

    @abstractmethod
    def _answer(self, emulator: Emulator, messages: Sequence[M], when: float) -> None:
        """Put what a device sends on the wire."""

    def step(self, now: float) -> list[M]:
        """Let time pass up to ``now``; return what has reached the host."""
        out: list[M] = []
        while self._events and self._events[0][0] <= now:
            when, _, inward, message = heapq.heappop(self._events)
            # It may put answers into the heap that are due by now, too: the loop finds them.
            if inward:
                self._arrive(message, when)
            else:
                out.append(message)
        period = self._period
        if period and now - self._stepped >= period:
            self._stepped = now
            for emulator in self.emulators:
                self._answer(emulator, self._sent_unasked(emulator, now), now)
        return out

    def next_due(self) -> float | None:
        """Return when `step` is to be called next, or ``None``: only when a message comes."""
        due = [self._events[0][0]] if self._events else []
        period = self._period
        if period:
            due.append(self._stepped + period)
        return min(due) if due else None

    @property
    def _period(self) -> float:
        return min((e.period for e in self.emulators if e.period), default=0.0)

    def _put(self, when: float, inward: bool, message: M) -> None:
        heapq.heappush(self._events, (when, next(self._number), inward, message))


class Wire(_Schedule[bytes]):
    """A line between a host and one or more emulated devices.

    A pty is infinitely fast; here a message occupies the line for as long as its bytes would, and
    the device answers after its turn-around. On a half-duplex line two messages never overlap; on
    a full-duplex one the host's and the devices' pass each other.

    Attributes:
        emulators: The devices on the line; each receives everything.
        timed: Whether bytes and the devices' turn-around take their time.
        baudrate: Bits per second; ``None`` takes no time (a network).
        spoken: Rate at which the host sends [baud]; devices of another one then receive nothing.
        bits: Bits on the line per byte.
        faults: What goes wrong.
        bytes_in: Bytes that came from the host.
        bytes_out: Bytes that went to the host.
        busy: Time during which a message or a device's turn-around was under way so far [s]. With
            the silence that the host keeps, no program that waits for each answer needs less.
    """

    def __init__(
        self,
        emulators: Sequence[Emulator],
        *,
        baudrate: float | None = None,
        bits: float = 10.0,
        faults: Faults | None = None,
        timed: bool = True,
        duplex: Duplex | None = None,
    ) -> None:
        """Make an idle line.

        Args:
            emulators: The devices on it.
            baudrate: Bits per second; ``None`` takes no time (a network).
            bits: Bits on the line per byte.
            faults: What goes wrong.
            timed: Whether bytes and the devices' turn-around take their time.
            duplex: Its duplex; by default that of the devices on it.
        """
        super().__init__(emulators, faults)
        self.timed = timed
        self._duplex = duplex
        self.baudrate = baudrate if timed else None
        self.spoken: int | None = None
        self.bits = bits
        self.bytes_in = 0
        self.bytes_out = 0
        self._inward = 0.0
        self._outward = 0.0
        self._counted = 0.0

    @property
    def duplex(self) -> Duplex:
        """Whether both directions can be used at once; half where one of the devices needs it."""
        if self._duplex is not None:
            return self._duplex
        full = self.emulators and all(e.duplex is Duplex.FULL for e in self.emulators)
        return Duplex.FULL if full else Duplex.HALF

    def receive(self, data: bytes, now: float) -> None:
        """Put bytes of the host on the line; the devices receive them with the last one."""
        self.bytes_in += len(data)
        start = max(now, self._inward)
        # Messages queue up: one begins when the one before has left the wire.
        end = self._inward = start + wire_time(len(data), self.baudrate, self.bits)
        if self.duplex is Duplex.HALF:
            self._outward = end
        self._count(start, end)
        pieces = self.faults.apply(data) if self.faults.requests else [(0.0, data)]
        for late, piece in pieces:
            self._put(end + late, True, piece)

    def step(self, now: float) -> list[bytes]:
        """Let time pass up to ``now``; return what has reached the host."""
        out = super().step(now)
        self.bytes_out += sum(len(data) for data in out)
        return out

    def reset(self) -> None:
        """Forget everything that is under way: the line was cut."""
        self._events.clear()
        self._inward = self._outward = 0.0
        for emulator in self.emulators:
            emulator.line_reset()

    def _arrive(self, message: bytes, when: float) -> None:
        for emulator in self.emulators:
            # At another rate a real UART would see framing errors, and nothing that makes sense.
            if self.spoken is None or self.spoken == emulator.baudrate:
                self._answer(emulator, emulator.feed(message, when), when)

    def _sent_unasked(self, emulator: Emulator, now: float) -> list[bytes]:
        return [data for data in emulator.step(now) if isinstance(data, bytes)]

    def _answer(self, emulator: Emulator, messages: Sequence[bytes], when: float) -> None:
        turnaround = emulator.turnaround if self.timed else 0.0
        for answer in messages:
            # The turn-around counts as busy as well: no host can use it.
            since = max(when, self._outward)
            start = max(when + turnaround, self._outward)
            end = self._outward = start + wire_time(len(answer), self.baudrate, self.bits)
            if self.duplex is Duplex.HALF:
                self._inward = end
            self._count(since, end)
            for late, piece in self.faults.apply(answer):
                self._put(end + late, False, piece)

    def _count(self, start: float, end: float) -> None:
        """Count a time as busy, as far as it is not counted yet."""
        self.busy += max(0.0, end - max(start, self._counted))
        self._counted = max(self._counted, end)


class CanWire(_Schedule[CanFrame]):
    """A CAN bus between a host and one or more emulated nodes.

    Attributes:
        emulators: The nodes; each receives every frame of the host.
        bitrate: Bits per second; ``None`` takes no time.
        busy: Time that frames and the nodes' turn-around have taken so far [s].
        faults: What goes wrong; a corrupted frame is a lost one, as the controllers drop it.
    """

    def __init__(
        self,
        emulators: Sequence[Emulator],
        *,
        bitrate: float | None = None,
        faults: Faults | None = None,
    ) -> None:
        super().__init__(emulators, faults)
        self.bitrate = bitrate
        self._free = 0.0

    def receive(self, frame: CanFrame, now: float) -> None:
        """Put a frame of the host on the bus."""
        taken = frame_time(frame, self.bitrate)
        self.busy += taken
        self._free = max(now, self._free) + taken
        for late in self.faults.copies() if self.faults.requests else [0.0]:
            self._put(self._free + late, True, frame)

    def reset(self) -> None:
        """Forget everything that is under way."""
        self._events.clear()
        self._free = 0.0

    def _arrive(self, message: CanFrame, when: float) -> None:
        for emulator in self.emulators:
            self._answer(emulator, emulator.on_frame(message, when), when)

    def _sent_unasked(self, emulator: Emulator, now: float) -> list[CanFrame]:
        return [frame for frame in emulator.step(now) if isinstance(frame, CanFrame)]

    def _answer(self, emulator: Emulator, messages: Sequence[CanFrame], when: float) -> None:
        for frame in messages:
            since = max(when, self._free)
            start = max(when + emulator.turnaround, self._free)
            self._free = start + frame_time(frame, self.bitrate)
            self.busy += self._free - since
            for late in self.faults.copies():
                self._put(self._free + late, False, frame)


def frame_time(frame: CanFrame, bitrate: float | None) -> float:
    """Return how long a frame occupies the bus [s]; 0 where there is no bit rate."""
    if not bitrate:
        return 0.0
    bits = (_EXTENDED_BITS if frame.extended else _STANDARD_BITS) + 8 * len(frame.data)
    return bits * _STUFFING / bitrate
