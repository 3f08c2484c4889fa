"""The Modbus side of an emulated device: RTU or TCP, registers, exceptions or silence."""

from __future__ import annotations

import struct
from abc import abstractmethod
from collections.abc import Collection, Mapping, Sequence
from typing import Any, ClassVar, Literal

from rtee.buses.emulator import Emulator
from rtee.buses.modbus_frames import (
    READ_HOLDING,
    READ_INPUT,
    READ_WRITE,
    WRITE_MANY,
    WRITE_ONE,
    ModbusRequest,
    RtuRequests,
    TcpRequests,
)
from rtee.buses.timing import silence

ILLEGAL_FUNCTION = 1  # Modbus exception codes (application protocol 1.1b3, section 7)
ILLEGAL_ADDRESS = 2
ILLEGAL_VALUE = 3
DEVICE_FAILURE = 4
_KEPT = 64
"""Requests kept for tests."""
_MOST_REGISTERS = 125
"""Registers that one answer can carry: 250 of the 253 bytes of a PDU."""

Framing = Literal["rtu", "tcp"]


class Refused(Exception):
    """The device refuses a request, with a Modbus exception or, if it has none, with silence.

    Attributes:
        code: The Modbus exception code.
    """

    def __init__(self, code: int) -> None:
        super().__init__(f"Modbus exception {code}")
        self.code = code


class ModbusEmulator(Emulator):
    """A device of 16-bit registers.

    Attributes:
        FUNCTIONS: Supported function codes, unless the caller gives others.
        FAULTS: With ``failing``, it refuses every request.
        EXCEPTIONS: Whether it refuses a request with an exception; otherwise it stays silent.
        PORT: Default address, for drivers whose options give none.
        unit: Its number on the line.
        any_unit: Whether it answers to any number, as many devices do on TCP.
        requests: Requests received, newest last, for tests.
    """

    parser: RtuRequests | TcpRequests
    FUNCTIONS: ClassVar[frozenset[int]] = frozenset(
        {READ_HOLDING, READ_INPUT, WRITE_ONE, WRITE_MANY, READ_WRITE}
    )
    EXCEPTIONS: ClassVar[bool] = False
    FAULTS = Emulator.FAULTS | {"failing"}
    PORT: ClassVar[str] = ""

    def __init__(
        self,
        unit: int,
        framing: Framing = "rtu",
        *,
        baudrate: int = 115200,
        functions: Collection[int] | None = None,
    ) -> None:
        super().__init__()
        self.functions = frozenset(self.FUNCTIONS if functions is None else functions)
        self.unit = unit
        self.baudrate = baudrate
        self.framing = framing
        self.any_unit = framing == "tcp"
        self.turnaround = silence(baudrate) if framing == "rtu" else 0.0
        self.requests: list[bytes] = []
        self.parser = RtuRequests(unit) if framing == "rtu" else TcpRequests()

    def windows(self, function: int) -> Mapping[int, Sequence[int]]:
        """Return the registers that a function reads now: blocks by their first register."""
        return {}

    def read(self, function: int, address: int, count: int, now: float) -> Sequence[int]:
        """Return registers; raises `Refused` unless they lie in one of the `windows`."""
        self.advance(now)
        for first, values in self.windows(function).items():
            if first <= address and address + count <= first + len(values):
                return values[address - first : address - first + count]
        raise Refused(ILLEGAL_ADDRESS)

    @abstractmethod
    def write(self, address: int, values: Sequence[int], now: float) -> None:
        """Set registers; raises `Refused`."""

    @classmethod
    def fitting(cls, options: Mapping[str, Any]) -> dict[str, Any]:
        """Return the properties that follow from a driver's options, including the framing."""
        found = super().fitting(options)
        if "framing" in getattr(cls.PROPERTIES, "__struct_fields__", ()):
            tcp = str(options.get("port") or cls.PORT).startswith("tcp://")
            found["framing"] = "tcp" if tcp else "rtu"
        return found

    def feed(self, data: bytes, now: float) -> list[bytes]:
        """Receive bytes and return the answers."""
        answers = []
        for request in self.parser.feed(data):
            if not (request.unit == self.unit or self.any_unit or request.unit == 0):
                continue
            self.requests = [*self.requests[1 - _KEPT :], request.pdu]
            pdu = self._handle(request, now)
            # Broadcasts on a line are obeyed in silence; on TCP, unit 0 means the device itself.
            if pdu is not None and (request.unit or self.framing == "tcp"):
                answers.append(request.answer(pdu))
        return answers

    def _handle(self, request: ModbusRequest, now: float) -> bytes | None:
        function = request.pdu[0]
        try:
            if "failing" in self.faults:
                raise Refused(DEVICE_FAILURE)
            if function not in self.functions:
                raise Refused(ILLEGAL_FUNCTION)
            return bytes([function]) + self._done(function, request.pdu[1:], now)
        except Refused as refusal:
            return bytes([function | 0x80, refusal.code]) if self.EXCEPTIONS else None

    def _done(self, function: int, data: bytes, now: float) -> bytes:
        try:
            if function in (READ_HOLDING, READ_INPUT):
                address, count = struct.unpack(">HH", data)
                return self._read(function, address, count, now)
            if function == WRITE_ONE:
                address, value = struct.unpack(">HH", data)
                self.write(address, (value,), now)
                return data
            if function == WRITE_MANY:
                address, count, size = struct.unpack_from(">HHB", data)
                self.write(address, _values(data[5:], count, size), now)
                return data[:4]
            source, count, address, many, size = struct.unpack_from(">HHHHB", data)
        except struct.error:
            raise Refused(ILLEGAL_VALUE) from None
        # Function 23 writes before it reads (section 6.17).
        self.write(address, _values(data[9:], many, size), now)
        return self._read(function, source, count, now)

    def _read(self, function: int, address: int, count: int, now: float) -> bytes:
        if not 1 <= count <= _MOST_REGISTERS:
            raise Refused(ILLEGAL_VALUE)
        values = self.read(function, address, count, now)
        return bytes([2 * count]) + struct.pack(f">{count}H", *values)


def _values(data: bytes, count: int, size: int) -> tuple[int, ...]:
    if size != 2 * count or size != len(data) or not count:
        raise Refused(ILLEGAL_VALUE)
    return struct.unpack(f">{count}H", data)
