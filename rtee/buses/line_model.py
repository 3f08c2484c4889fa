"""The time that messages take on a simulated wire; sans-I/O."""

from __future__ import annotations

import heapq
import itertools
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Generic, TypeVar, cast

from rtee.buses.emulator import CanFrame, Duplex, Emulator
from rtee.buses.faults import Faults
from rtee.buses.timing import wire_time

_STANDARD_BITS, _EXTENDED_BITS = 47, 67
"""Bits of a standard and of an extended frame without data, including the interframe space (ISO
11898-1)."""

_STUFFING = 1.1
"""Bits on the wire per bit of a frame, due to bit stuffing of typical data; at worst 1.2."""

M = TypeVar("M", bytes, CanFrame)


class Schedule(ABC, Generic[M]):
    """Messages in transit between a host and emulated devices, in the order of their arrival.

    Attributes:
        emulators: The devices; each receives every message of the host.
        faults: Faults of the wire.
        busy: Total time so far in which the wire was in use [s].
    """

    def __init__(self, emulators: Sequence[Emulator] = (), faults: Faults | None = None) -> None:
        self.emulators = list(emulators)
        self.faults = faults or Faults()
        self.busy = 0.0
        # Breaks ties in the heap: messages with equal times keep their order and are not compared.
        self._number = itertools.count()
        self._events: list[tuple[float, int, bool, M]] = []
        self._stepped = 0.0

    @abstractmethod
    def receive(self, message: M, now: float) -> None:
        """Put a message of the host on the wire."""

    @abstractmethod
    def reset(self) -> None:
        """Discard all messages in transit."""

    @abstractmethod
    def _arrive(self, message: M, when: float) -> None:
        """Pass a message of the host to the devices."""

    @abstractmethod
    def _answer(self, emulator: Emulator, messages: Sequence[M], when: float) -> None:
        """Put messages of a device on the wire."""

    def step(self, now: float) -> list[M]:
        """Simulate up to ``now`` and return the messages that have reached the host."""
        out: list[M] = []
        while self._events and self._events[0][0] <= now:
            when, _, inward, message = heapq.heappop(self._events)
            # Answers that are already due are also put into the heap and found by this loop.
            if inward:
                self._arrive(message, when)
            else:
                out.append(message)
        period = self._period
        if period and now - self._stepped >= period:
            self._stepped = now
            for emulator in self.emulators:
                # An emulator of a device on this wire sends no other kind of message.
                self._answer(emulator, cast("list[M]", emulator.step(now)), now)
        return out

    def next_due(self) -> float | None:
        """Return when to call `step` next, or ``None`` if not before a message is received."""
        due = self._events[0][0] if self._events else None
        period = self._period
        if period and (due is None or self._stepped + period < due):
            due = self._stepped + period
        return due

    @property
    def _period(self) -> float:
        shortest = 0.0
        for emulator in self.emulators:
            period = emulator.period
            if period and not 0.0 < shortest <= period:
                shortest = period
        return shortest

    def _put(self, when: float, inward: bool, message: M) -> None:
        heapq.heappush(self._events, (when, next(self._number), inward, message))


class Wire(Schedule[bytes]):
    """A line between a host and one or more emulated devices.

    A pty is infinitely fast; here a message occupies the line for the time that its bytes take, and
    the device answers after its turn-around time. On a half-duplex line messages never overlap; on
    a full-duplex one both directions are independent.

    Attributes:
        emulators: The devices on the line; each receives all bytes.
        timed: Whether bytes and the turn-around of the devices take time.
        baudrate: Bit rate [bit/s]; ``None``: bytes take no time (a network).
        spoken: Bit rate at which the host sends [bit/s]; devices with another one receive nothing.
            ``None``: all devices receive.
        bits: Bits on the line per byte.
        adapter: Whether an adapter connects the host to the line: it may damage a worn device's
            first answer, or return what the host sends. A network has none.
        faults: Faults of the line.
        busy: Total time so far in which a message or a turn-around was in progress [s]. Together
            with the silence that the host keeps, this is the shortest time for a program that waits
            for each answer.

    Args:
        duplex: Half or full duplex; by default that of the devices.
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
        adapter: bool = True,
    ) -> None:
        super().__init__(emulators, faults)
        self.timed = timed
        self.adapter = adapter
        self._duplex = duplex
        self.baudrate = baudrate if timed else None
        self.spoken: int | None = None
        self.bits = bits
        self._inward = 0.0
        self._outward = 0.0
        self._counted = 0.0

    @property
    def duplex(self) -> Duplex:
        """Full if both directions can be used at once; half if any device needs that."""
        if self._duplex is not None:
            return self._duplex
        full = self.emulators and all(e.duplex is Duplex.FULL for e in self.emulators)
        return Duplex.FULL if full else Duplex.HALF

    def receive(self, data: bytes, now: float) -> None:
        """Put bytes of the host on the line; the devices receive them when the last has passed."""
        start = max(now, self._inward)
        # Messages queue up: each begins when the previous one has left the wire.
        end = self._inward = start + wire_time(len(data), self.baudrate, self.bits)
        if self.duplex is Duplex.HALF:
            self._outward = end
        self._count(start, end)
        if self.adapter and any(emulator.echo for emulator in self.emulators):
            # A byte is received while it is sent, so the echo takes no further time.
            self._put(end, False, data)
        pieces = self.faults.apply(data) if self.faults.requests else [(0.0, data)]
        for late, piece in pieces:
            self._put(end + late, True, piece)

    def reset(self) -> None:
        """Discard all messages in transit: the line was cut."""
        self._events.clear()
        self._inward = self._outward = 0.0
        for emulator in self.emulators:
            emulator.line_reset()
            emulator.fresh = True

    def _arrive(self, message: bytes, when: float) -> None:
        for emulator in self.emulators:
            # With another bit rate, a real UART would receive only framing errors and garbage.
            if self.spoken is None or self.spoken == emulator.baudrate:
                self._answer(emulator, emulator.feed(message, when), when)

    def _answer(self, emulator: Emulator, messages: Sequence[bytes], when: float) -> None:
        turnaround = emulator.turnaround if self.timed else 0.0
        if messages and emulator.fresh:
            emulator.fresh = False
            turnaround += emulator.wear.late
            if emulator.wear.garbled and self.adapter:
                messages = [bytes([messages[0][0] ^ 0xFF]) + messages[0][1:], *messages[1:]]
        for answer in messages:
            # The turn-around counts as busy, since the host cannot use that time.
            since = max(when, self._outward)
            start = max(when + turnaround, self._outward)
            end = self._outward = start + wire_time(len(answer), self.baudrate, self.bits)
            if self.duplex is Duplex.HALF:
                self._inward = end
            self._count(since, end)
            for late, piece in self.faults.apply(answer):
                self._put(end + late, False, piece)

    def _count(self, start: float, end: float) -> None:
        """Count an interval as busy, except for the part that is already counted."""
        self.busy += max(0.0, end - max(start, self._counted))
        self._counted = max(self._counted, end)


class CanWire(Schedule[CanFrame]):
    """A CAN bus between a host and one or more emulated nodes.

    Attributes:
        emulators: The nodes; each receives every frame of the host.
        bitrate: Bit rate [bit/s]; ``None``: frames take no time.
        busy: Total time of frames and of the turn-around of the nodes so far [s].
        faults: Faults of the bus; a corrupted frame is lost, since CAN controllers discard it.
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
        """Discard all frames in transit."""
        self._events.clear()
        self._free = 0.0
        for emulator in self.emulators:
            emulator.fresh = True

    def _arrive(self, message: CanFrame, when: float) -> None:
        for emulator in self.emulators:
            self._answer(emulator, emulator.on_frame(message, when), when)

    def _answer(self, emulator: Emulator, messages: Sequence[CanFrame], when: float) -> None:
        late = emulator.wear.late if messages and emulator.fresh else 0.0
        emulator.fresh = emulator.fresh and not messages
        for frame in messages:
            since = max(when, self._free)
            start = max(when + emulator.turnaround + late, self._free)
            self._free = start + frame_time(frame, self.bitrate)
            self.busy += self._free - since
            for behind in self.faults.copies():
                self._put(self._free + behind, False, frame)


class MessageWire(Schedule[bytes]):
    """A network between a host and an emulated server, which carries whole messages.

    Messages take no time. A damaged one is lost, since TCP detects damage.
    """

    def receive(self, message: bytes, now: float) -> None:
        """Pass a message of the host on, now or late."""
        for late in self.faults.copies() if self.faults.requests else [0.0]:
            self._put(now + late, True, message)

    def reset(self) -> None:
        """Discard all messages in transit."""
        self._events.clear()

    def _arrive(self, message: bytes, when: float) -> None:
        for emulator in self.emulators:
            emulator.feed(message, when)

    def _answer(self, emulator: Emulator, messages: Sequence[bytes], when: float) -> None:
        for message in messages:
            for late in self.faults.copies():
                self._put(when + late, False, message)


def frame_time(frame: CanFrame, bitrate: float | None) -> float:
    """Return how long a frame occupies the bus [s]; 0 without a bit rate."""
    if not bitrate:
        return 0.0
    bits = (_EXTENDED_BITS if frame.extended else _STANDARD_BITS) + 8 * len(frame.data)
    return bits * _STUFFING / bitrate
