"""Emulates an RH56 on the wire: its own frames, Modbus RTU or Modbus TCP.

Properties set what differs between hands or is not known: whether registers without meaning can be
read, and how long motions and calibration take. The hand ignores frames with a wrong checksum.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any

from msgspec import structs

from rtee.buses.modbus_slave import ILLEGAL_ADDRESS, ILLEGAL_VALUE, ModbusEmulator, Refused
from rtee.buses.wear import TYPICAL, Wear
from rtee.drivers.inspire_rh56 import codec
from rtee.drivers.inspire_rh56.memory import FAULTS, Rh56Memory, Rh56Properties
from rtee.drivers.objects import Closing, Grasps

_ROTATOR = 5  # index of the motor that rotates the thumb, which does not close on an object
_SAVES = 1.0
"""Time that the hand takes to save its parameters [s]; no source gives it."""
_POLL = 0.05
"""Time between two steps while the hand saves [s]."""
_REFUSED = b"\x00"
"""Data of the reply to a refused write; sources say only that it is not 1."""


class InspireRh56Emulator(ModbusEmulator, Grasps):
    """The hand.

    Attributes:
        memory: Its registers and motors.
    """

    PROPERTIES = Rh56Properties
    SHARED = ("unit", "model", "travel_time", "turnaround", "protocol", "baudrate")
    # Recorded with real hands: 44 to 70 ms from a command to the motion, 281 to 2222 counts/s where
    # the data sheet's 0.3 s for the full travel means 3333, and idle sensors that read a few grams.
    WEAR = structs.replace(TYPICAL, lag=0.066, pace=2222.0 / 3333.0, force=(5, -12, 0, 8, -4, 0))
    FAULTS = ModbusEmulator.FAULTS | FAULTS | {"silent"}
    BAUDRATES = frozenset(codec.BAUDRATES)
    EXCEPTIONS = True

    def __init__(self, properties: Rh56Properties | None = None) -> None:
        made = properties or Rh56Properties()
        super().__init__(made.unit, made.framing, baudrate=made.baudrate)
        self.turnaround = max(self.turnaround, made.turnaround)
        self.memory = Rh56Memory(made)
        self.axes = self.memory.axes
        self._frames = codec.RequestParser() if made.protocol == "frames" else None
        self._saved: tuple[float, bytes] | None = None  # time and content of the pending save reply
        self._before = b"\0\0"

    @classmethod
    def fitting(cls, options: Mapping[str, Any]) -> dict[str, Any]:
        """Return the properties that follow from a driver's options."""
        found = super().fitting(options)
        return found | ({"protocol": "modbus"} if found["framing"] == "tcp" else {})

    def wear_down(self, wear: Wear) -> None:
        """Make the hand deviate from its data sheet; uncalibrated force sensors get offsets."""
        super().wear_down(wear)
        self.memory.bias(wear.force)

    def closings(self) -> Sequence[Closing]:
        """Return the closing motions of the motors that bend fingers and thumb."""
        most = float(self.memory.properties.most)
        return [Closing(axis, float(codec.OPEN), 0.0, most) for axis in self.memory.axes[:_ROTATOR]]

    def power_cycle(self, now: float) -> None:
        """Restart; the fingers stay where they are."""
        self.advance(now)
        self.line_reset()
        self.halt()
        self.memory.power_cycle()

    def line_reset(self) -> None:
        """Forget the bytes of an incomplete request."""
        super().line_reset()
        self._before = b"\0\0"  # a new connection counts from the beginning
        if self._frames is not None:
            self._frames.reset()

    def on_faults(self) -> None:
        """Pass the injected faults to the motors."""
        super().on_faults()
        self.memory.set_faults(self.faults)

    def advance(self, now: float) -> None:
        """Let time pass up to ``now``."""
        self.memory.advance(self._elapsed(now))

    # --- frames ------------------------------------------------------------------------------

    def feed(self, data: bytes, now: float) -> list[bytes]:
        """Receive bytes and return the replies."""
        self.advance(now)
        # Its own frames know no refusal of a reading.
        failing = self._frames is not None and "failing" in self.faults
        if failing or "silent" in self.faults:
            return []
        if self._frames is None:
            return [self._numbered(answer) for answer in super().feed(data, now)]
        replies = []
        for frame in self._frames.feed(data):
            if frame.hand == self.memory.properties.unit:
                answer = self._answer(frame)
                # The hand does not answer if there is no data, or more than a frame can carry.
                if answer and len(answer) <= codec.MOST_DATA:
                    reply = codec.Frame(frame.hand, frame.command, frame.address, answer)
                    replies.append(reply.to_bytes(codec.REPLY))
                    if (frame.command, frame.address) == (codec.Command.WRITE, codec.Register.SAVE):
                        self._saved = now + _SAVES, replies[-1]
                        self.period = _POLL
        return replies

    def step(self, now: float) -> list[bytes]:
        """Let time pass; an unsolicited second frame reports the result of saving."""
        self.advance(now)
        if self._saved is None or now < self._saved[0]:
            return []
        (_, told), self._saved, self.period = self._saved, None, 0.0
        return [told]

    def _answer(self, frame: codec.Frame) -> bytes | None:
        if frame.command == codec.Command.READ and len(frame.data) == 1:
            return self._registers(frame.address, frame.data[0])
        if frame.command == codec.Command.WRITE:
            return b"\x01" if self.memory.write(frame.address, frame.data) else _REFUSED
        return None

    def _registers(self, address: int, size: int) -> bytes | None:
        data = self.memory.read(address, size)
        if data is not None and "wrong_device" in self.faults:
            # The registers of another device: states and errors that no RH56 has.
            return b"\xee" * size if address >= codec.Register.ANGLE else data
        return data

    def _numbered(self, answer: bytes) -> bytes:
        """Return an answer, with the previous transaction's number if the hand lags behind."""
        if not self.memory.properties.behind or self.framing != "tcp":
            return answer
        before, self._before = self._before, answer[:2]
        return before + answer[2:]

    # --- Modbus ------------------------------------------------------------------------------

    def read(self, function: int, address: int, count: int, now: float) -> Sequence[int]:
        """Return registers, two bytes each."""
        data = self._registers(address, 2 * count)
        if data is None:
            raise Refused(ILLEGAL_ADDRESS)
        return struct.unpack(f"<{count}H", data)

    def write(self, address: int, values: Sequence[int], now: float) -> None:
        """Set registers, two bytes each."""
        if not self.memory.write(address, struct.pack(f"<{len(values)}H", *values)):
            raise Refused(ILLEGAL_VALUE)
