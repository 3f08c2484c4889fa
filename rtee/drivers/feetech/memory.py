"""The registers of an emulated Feetech servo: stored and active values."""

from __future__ import annotations

from rtee.drivers.feetech import table
from rtee.drivers.feetech.table import END, FULL, RAM, Family, Register

_COMMON = {table.ID: 1, table.RETURN_DELAY: 0, table.RESPONSE_LEVEL: 1}
_SCS = {
    table.MIN_ANGLE: 20,
    table.MAX_ANGLE: 1003,
    table.MAX_TEMPERATURE: 80,
    table.MAX_VOLTAGE: 90,
    table.MIN_VOLTAGE: 45,
    table.MAX_TORQUE: FULL,
    table.UNLOAD: 36,
    table.ALARM: 37,  # errors that the LED shows
    table.P: 15,
    table.D: 15,
    Register(24, 2): 30,  # least force to start
    Register(26, 1): 1,
    Register(27, 1): 1,  # dead zones
    Register(37, 1): 20,
    Register(38, 1): 100,
    Register(39, 1): 80,  # the overload's protection
}
_STS = {
    table.MAX_ANGLE: 4095,
    table.MAX_TEMPERATURE: 70,
    table.MAX_VOLTAGE: 80,
    table.MIN_VOLTAGE: 40,
    table.MAX_TORQUE: FULL,
    table.PHASE: 12,
    table.UNLOAD: 44,
    table.ALARM: 47,  # errors that the LED shows
    table.P: 32,
    table.D: 32,
    Register(24, 1): 16,  # least force to start
    Register(26, 1): 1,
    Register(27, 1): 1,  # dead zones
    table.PROTECTION_CURRENT: 500,
    Register(30, 1): 1,  # resolution
    Register(34, 1): 20,
    Register(35, 1): 200,
    Register(36, 1): 80,  # the overload's protection
    Register(37, 1): 10,
    Register(38, 1): 200,
    Register(39, 1): 10,
}
_HLS = {**_STS, table.MAX_TORQUE: 980, Register(34, 1): 0, Register(35, 1): 0, Register(36, 1): 0}
_DEFAULTS = {"scs": _SCS, "sts": _STS, "sms": _STS, "hls": _HLS}
"""Values from the factory, as far as sources agree."""


class Memory:
    """The registers of one servo.

    Locked, it accepts settings but does not store them; unlocked, they survive a power cycle.

    Args:
        family: The servo's family.
    """

    def __init__(self, family: Family) -> None:
        self._family = family
        self._bytes = bytearray(END)
        self._stored = bytearray(RAM)
        for register, value in (_COMMON | _DEFAULTS[family.name]).items():
            self.set(register, value)
        self.store()
        self.power_cycle()

    def store(self) -> None:
        """Store all settings."""
        self._stored[:] = self._bytes[:RAM]

    def keep(self, register: Register, value: int) -> None:
        """Set a register and store it; other settings stay as they are, stored or not."""
        self.set(register, value)
        at = slice(register.address, register.address + register.size)
        self._stored[at] = self._bytes[at]

    def power_cycle(self) -> None:
        """Restore the stored settings, locked and with the other registers at 0."""
        self._bytes[:] = self._stored + bytes(END - RAM)
        self.set(self._family.lock, 1)

    def restore(self) -> None:
        """Restore the values from the factory, except for the identity."""
        kept = (table.MODEL, table.ID, table.BAUD_RATE)
        values = [(register, self.get(register)) for register in kept]
        fresh = Memory(self._family)
        self._bytes[:RAM] = fresh._bytes[:RAM]
        for register, value in values:
            self.set(register, value)
        self.store()

    def get(self, register: Register) -> int:
        """Return a register's value."""
        return self._family.unpack(register, bytes(self._bytes))

    def set(self, register: Register, value: int) -> None:
        """Set a register without any check; the value is not stored."""
        data = self._family.pack(register, value)
        self._bytes[register.address : register.address + register.size] = data

    def read(self, address: int, size: int) -> bytes | None:
        """Return bytes of the table, or ``None`` beyond its end."""
        return bytes(self._bytes[address : address + size]) if address + size <= END else None

    def write(self, address: int, data: bytes) -> None:
        """Write bytes as a host may; read-only bytes are not changed."""
        stored = not self.get(self._family.lock)
        for at, byte in enumerate(data, address):
            if at < table.ID.address or table.PRESENT_POSITION.address <= at:
                continue
            self._bytes[at] = byte
            if at < RAM and stored:
                self._stored[at] = byte
