"""Emulates the touch board of an ORCA hand on the wire."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta, field

from rtee.buses.emulator import Duplex, Emulator
from rtee.buses.timing import wire_time
from rtee.drivers.options import Duration, Rate
from rtee.drivers.orca_touch import codec
from rtee.hand.validation import Section
from rtee.sample import FloatArray

_PERIOD = 1e-3
"""Time between two frames if the line is fast enough [s]."""

_SPARE = 0.9
"""Largest share of the line's capacity for frames: replies need the rest."""


_Finger = Literal["thumb", "index", "middle", "ring", "pinky"]
_Taxels = Annotated[int, Meta(ge=1, le=0xFFFF)]  # its count is a word of 16 bits


_TAXELS: dict[_Finger, _Taxels] = {"thumb": 51, "index": 87, "middle": 87, "ring": 87, "pinky": 51}


class OrcaTouchProperties(Section, frozen=True):
    """Properties of the emulated board.

    Attributes:
        taxels: Taxels of each fingertip that is connected.
        encoders: Whether joint encoders share its line.
        period: Time between two frames [s]; 0: the shortest that the line allows.
    """

    taxels: dict[_Finger, _Taxels] = field(default_factory=_TAXELS.copy)
    encoders: bool = False
    period: Duration = 0.0
    baudrate: Rate = codec.BAUDRATES[0]


class OrcaTouchEmulator(Emulator):
    """The board.

    Attributes:
        forces: Forces on the taxels of each finger ``(n, 3)`` [N].
        content: Content of its frames.
        streaming: Whether it sends them.
        angles: Counts of the joint encoders ``(17,)``.
    """

    PROPERTIES = OrcaTouchProperties
    SHARED = ("baudrate",)
    FAULTS = Emulator.FAULTS | {"error", "silent"}
    BAUDRATES = frozenset(codec.BAUDRATES)
    duplex = Duplex.FULL

    def __init__(self, properties: OrcaTouchProperties | None = None) -> None:
        super().__init__()
        made = self.properties = properties or OrcaTouchProperties()
        self.baudrate = made.baudrate
        self.fingers = tuple(finger for finger in codec.FINGERS if finger in made.taxels)
        self.forces: dict[str, FloatArray] = {
            finger: np.zeros((made.taxels[finger], 3)) for finger in self.fingers
        }
        self.angles = [0] * codec.ENCODERS
        self.parser = codec.RequestParser()
        self._due = 0.0
        self.content, self.streaming = codec.Content.RESULTANTS, False
        self._pace()

    def _pace(self) -> None:
        counts = [len(self.forces[finger]) for finger in self.fingers]
        size = codec.data_size(self.content, counts) + 7
        carried = wire_time(size, self.baudrate) / _SPARE
        self.period = self.properties.period or max(_PERIOD, carried)

    def power_cycle(self, now: float) -> None:
        """Restart; it does not stream until the stream is started."""
        self.line_reset()
        self.content, self.streaming = codec.Content.RESULTANTS, False
        self._pace()

    def step(self, now: float) -> list[bytes]:
        """Return the frames that are due, if any are; encoders send without being asked to."""
        encoders = self.properties.encoders
        if not (self.streaming or encoders) or "silent" in self.faults or now < self._due:
            return []
        # From now, not from the due time: missed frames are not sent later.
        self._due = now + self.period
        frames = [self._frame().to_bytes()] if self.streaming else []
        if encoders:
            words = [_with_parity(count) for count in self.angles]
            frames.append(codec.Encoders(0, np.array(words, dtype="<u2").tobytes()).to_bytes())
        return frames

    def _frame(self) -> codec.Stream:
        error = 1 if "error" in self.faults else 0
        return codec.Stream(error, self._forces(self.content))

    def _forces(self, content: codec.Content) -> bytes:
        taxels = [self.forces[finger] for finger in self.fingers]
        resultants = np.array([each.sum(axis=0) for each in taxels]).reshape(-1, 3)
        return codec.forces_bytes(resultants, taxels, content)

    def answers(self, frame: codec.Request, now: float) -> Iterable[bytes]:
        """Carry out a request and return the reply."""
        if frame.function == codec.Function.READ:
            data = self._register(frame.address, frame.count)
        else:
            data = b"\0" if self._set(frame.address, frame.data) else b"\x01"
        yield codec.Reply(frame.function, frame.address, frame.count, data).to_bytes()

    def _register(self, address: int, count: int) -> bytes:
        if "wrong_device" in self.faults:
            return b"\xff" * count
        tables = {
            codec.Register.CONNECTED: codec.connected_bytes(self.fingers),
            codec.Register.CONTENT: bytes([self.content]),
            codec.Register.STREAM: bytes([self.streaming]),
            codec.Register.COUNTS: codec.counts_bytes(
                {f: len(self.forces[f]) for f in self.fingers}
            ),
            codec.Register.RESULTANTS: codec.resultants_bytes(
                self.fingers, self._forces(codec.Content.RESULTANTS)
            ),
        }
        for register, data in tables.items():
            if register <= address < register + len(data):
                return (data[address - register :] + bytes(count))[:count]
        return bytes(count)

    def _set(self, address: int, data: bytes) -> bool:
        if len(data) != 1:
            return False
        if address == codec.Register.CONTENT and 1 <= data[0] <= 3:
            self.content = codec.Content(data[0])
            self._pace()
            return True
        if address == codec.Register.STREAM and data[0] <= 1:
            self.streaming = bool(data[0])
            return True
        return False


def _with_parity(count: int) -> int:
    """Return the word of an encoder's count: the highest bit makes the number of ones even."""
    word = count & 0x3FFF
    return word | (bin(word).count("1") % 2) << 15
