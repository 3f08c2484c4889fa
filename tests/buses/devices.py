"""Small devices to try buses with: lines of text over bytes, and a counter on CAN."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from rtee.buses.emulator import CanFrame, Emulator
from rtee.buses.modbus_slave import ILLEGAL_ADDRESS, Framing, ModbusEmulator, Refused

in_real_time = pytest.mark.parametrize("anyio_backend", ["asyncio"])
"""For tests of what is outside of this process or of real time itself."""


class Echo(Emulator):
    """Answers ``*text#`` with ``*TEXT#``; text of digits only is answered twice, ``?`` never."""

    def __init__(self) -> None:
        super().__init__()
        self._parser = StarParser()
        self.heard: list[bytes] = []
        self.cycles = 0

    def feed(self, data: bytes, now: float) -> list[bytes]:
        answers = []
        for frame in self._parser.feed(data):
            self.heard.append(frame)
            if b"?" not in frame:
                answers += [frame_of(frame.upper())] * (2 if frame.isdigit() else 1)
        return answers

    def line_reset(self) -> None:
        self._parser.reset()

    def power_cycle(self, now: float) -> None:
        self.cycles += 1


class StarParser:
    """Cuts ``*text<sum>#`` frames; ``sum`` is one byte, the text's sum modulo 32 plus 64."""

    def __init__(self) -> None:
        self.errors = 0
        self._buffer = b""

    def feed(self, data: bytes) -> list[bytes]:
        self._buffer = (self._buffer + data)[-64:]
        frames = []
        while b"#" in self._buffer:
            frame, _, self._buffer = self._buffer.partition(b"#")
            _, star, body = frame.rpartition(b"*")
            if star and len(body) > 1 and body[-1:] == check(body[:-1]):
                frames.append(body[:-1])
            else:
                self.errors += 1
        return frames

    def reset(self) -> None:
        self._buffer = b""


def check(text: bytes) -> bytes:
    return bytes([64 + sum((i + 1) * b for i, b in enumerate(text)) % 31])


def frame_of(text: bytes) -> bytes:
    return b"*" + text + check(text) + b"#"


class CanCounter(Emulator):
    """Answers frame 0x10 by 0x11 with its data reversed; beats on 0x700 every 10 ms."""

    period = 0.01

    def __init__(self) -> None:
        super().__init__()
        self.heard = 0

    def on_frame(self, frame: CanFrame, now: float) -> list[CanFrame]:
        self.heard += 1
        return [CanFrame(0x11, frame.data[::-1])] if frame.id == 0x10 else []

    def step(self, now: float) -> list[CanFrame]:
        return [CanFrame(0x700, b"\x05")]

    def power_cycle(self, now: float) -> None:
        self.heard = 0


class Registers(ModbusEmulator):
    """A hundred registers; number 50 refuses to be written."""

    EXCEPTIONS = True

    def __init__(self, unit: int = 9, framing: Framing = "rtu") -> None:
        super().__init__(unit, framing)
        self.values = [0] * 100

    def read(self, function: int, address: int, count: int, now: float) -> Sequence[int]:
        if address + count > len(self.values):
            raise Refused(ILLEGAL_ADDRESS)
        return self.values[address : address + count]

    def write(self, address: int, values: Sequence[int], now: float) -> None:
        if address <= 50 < address + len(values):
            raise Refused(ILLEGAL_ADDRESS)
        self.values[address : address + len(values)] = values

    def advance(self, now: float) -> None:
        pass

    def power_cycle(self, now: float) -> None:
        self.values = [0] * 100
