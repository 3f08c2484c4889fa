"""The control table of an emulated servo, with indirect addresses ("windows") onto other bytes."""

from __future__ import annotations

from collections.abc import Iterable

from rtee.drivers.dynamixel import table
from rtee.drivers.dynamixel.table import Register


class Memory:
    """The bytes of one servo, all registers at their defaults."""

    def __init__(self) -> None:
        self._bytes = bytearray(table.END)
        self._indirect: list[int] = []
        self.reset(table.REGISTERS)
        self.reset_windows()

    def reset(self, registers: Iterable[Register]) -> None:
        """Set registers to their defaults."""
        for register in registers:
            self.set(register, register.default)

    def reset_windows(self) -> None:
        """Let every window point to itself."""
        self._indirect = list(table.INDIRECT_DATA)
        for at, target in zip(table.INDIRECT, table.INDIRECT_DATA, strict=True):
            self._bytes[at : at + 2] = target.to_bytes(2, "little")

    def get(self, register: Register) -> int:
        """Return a register's value."""
        return register.unpack(bytes(self._bytes[register.address :]))

    def set(self, register: Register, value: int) -> None:
        """Set a register without any check."""
        end = register.address + register.size
        self._bytes[register.address : end] = register.pack(value)

    def read(self, address: int, length: int) -> bytes:
        """Return bytes of the table; bytes of windows come from where they point."""
        out = self._bytes[address : address + length]
        for at in range(max(address, table.INDIRECT_DATA.start), address + length):
            out[at - address] = self._bytes[self._points_to(at)]
        return bytes(out)

    def after(self, address: int, data: bytes) -> bytes:
        """Return the whole table as if these bytes were written, without following windows."""
        return bytes(self._bytes[:address] + data + self._bytes[address + len(data) :])

    def write(self, address: int, data: bytes) -> None:
        """Write bytes; bytes to windows go where they point."""
        if address >= table.INDIRECT_DATA.start:
            for offset, byte in enumerate(data):
                self._bytes[self._points_to(address + offset)] = byte
            return
        self._bytes[address : address + len(data)] = data
        if address >= table.INDIRECT.start:
            self._point(address, len(data))

    def _points_to(self, at: int) -> int:
        source = self._indirect[at - table.INDIRECT_DATA.start]
        return source if source in table.POINTABLE else at

    def _point(self, address: int, count: int) -> None:
        for offset in range(count):
            slot = (address + offset - table.INDIRECT.start) // 2
            at = table.INDIRECT.start + 2 * slot
            self._indirect[slot] = self._bytes[at] | self._bytes[at + 1] << 8
