"""Reads and writes the tables of a LinkerHand: over Modbus RTU, or on CAN."""

from __future__ import annotations

import asyncio
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager

from rtee.buses.can import CanBus
from rtee.buses.emulator import CanFrame
from rtee.buses.modbus import ModbusBus, ModbusRefusal
from rtee.buses.modbus_frames import READ_INPUT
from rtee.buses.timing import silence, wire_time
from rtee.drivers.connection import longer_deadline
from rtee.drivers.linkerhand import codec
from rtee.drivers.linkerhand.codec import Fault, LinkerFrameError, Model, Table, Version
from rtee.errors import FrameError

PATIENCE = 1.0
"""Longest time for an exchange that belongs to no cycle [s]."""
_CAN_BITS = 130
"""Bits of a CAN frame with eight bytes and its share of stuffing."""


class LinkerLink(ABC):
    """Talks to one hand.

    Attributes:
        deadline: Longest time for one exchange, retries included [s].
        retries: How often a request is sent again within that time.
    """

    def __init__(self, model: Model, unit: int, deadline: float, retries: int) -> None:
        self.model = model
        self.unit = unit
        self.deadline = deadline
        self.retries = retries

    def unhurried(self) -> AbstractContextManager[None]:
        """Allow exchanges outside the cycle the time they may need on a busy computer."""
        return longer_deadline(self, PATIENCE)

    @abstractmethod
    async def version(self) -> Version | None:
        """Return what the hand says about itself, if that is known; raises `BusError`."""

    @abstractmethod
    async def read(self, table: Table) -> tuple[int, ...]:
        """Return the values of all motors; raises `BusError`."""

    async def health(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return temperatures [°C] and fault codes of all motors; raises `BusError`."""
        return await self.read(Table.TEMPERATURE), await self.read(Table.FAULT)

    @abstractmethod
    async def write(self, tables: Mapping[Table, Sequence[int]]) -> None:
        """Set values of all motors, torques and speeds before positions; raises `BusError`."""

    @abstractmethod
    def cycle_time(self) -> float:
        """Return the shortest time to read the positions and to set them [s]."""


class ModbusLink(LinkerLink):
    """Modbus RTU on RS-485; several hands may share a line.

    Args:
        bus: The line.
        model: The kind of hand.
        unit: Its number.
        deadline: Longest time for one exchange, retries included [s].
        retries: How often a request is sent again within that time.
        spacing: Silence to leave between two frames [s].
    """

    def __init__(
        self,
        bus: ModbusBus,
        model: Model,
        unit: int,
        deadline: float,
        retries: int,
        spacing: float,
    ) -> None:
        super().__init__(model, unit, deadline, retries)
        self._bus = bus
        self._spacing = spacing
        self._both = True
        # A played line that takes no time needs no silence, either.
        if bus.gap:
            bus.gap = max(bus.gap, spacing)

    async def version(self) -> Version | None:
        """Return what the hand says about itself; raises `BusError`."""
        registers = await self._read(self.model.version, codec.VERSION_COUNT)
        try:
            return Version.from_registers(registers)
        except LinkerFrameError as error:
            raise FrameError(self._bus.name, str(error)) from error

    async def _read(self, address: int, count: int) -> tuple[int, ...]:
        return await self._bus.read(
            self.unit,
            address,
            count,
            deadline=self.deadline,
            retries=self.retries,
            function=READ_INPUT,
        )

    async def read(self, table: Table) -> tuple[int, ...]:
        """Return the values of all motors; raises `BusError`."""
        return self._checked(await self._read(self.model.registers[table], self.model.count))

    async def health(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return temperatures [°C] and fault codes of all motors; raises `BusError`.

        An answer does not name the registers that it tells. Of another length than that for the
        positions, a late one cannot be taken for it; so both tables are asked for at once.
        """
        count = self.model.count
        if self._both:
            try:
                registers = await self._read(self.model.registers[Table.TEMPERATURE], 2 * count)
            except ModbusRefusal:
                self._both = False
            else:
                return self._checked(registers[:count]), self._codes(registers[count:])
        temperatures = await self.read(Table.TEMPERATURE)
        return temperatures, self._codes(await self.read(Table.FAULT))

    def _checked(self, registers: Sequence[int]) -> tuple[int, ...]:
        try:
            return codec.checked(registers, self.model.count)
        except LinkerFrameError as error:
            raise FrameError(self._bus.name, str(error)) from error

    def _codes(self, registers: Sequence[int]) -> tuple[int, ...]:
        # Other codes are not published, and more likely the late answer to another question.
        if not set(registers) <= set(Fault):
            raise FrameError(self._bus.name, f"no fault codes of a LinkerHand: {list(registers)}")
        return tuple(registers)

    async def write(self, tables: Mapping[Table, Sequence[int]]) -> None:
        """Set values of all motors, torques and speeds before positions; raises `BusError`."""
        if self.model.joint_write and len(tables) == len(Table) - 2:
            # One frame for all three: each costs the hand's pause.
            await self._write(
                Table.POSITION, [v for table in sorted(tables) for v in tables[table]]
            )
            return
        for table in sorted(tables, reverse=True):
            await self._write(table, tables[table])

    async def _write(self, table: Table, values: Sequence[int]) -> None:
        await self._bus.write(
            self.unit,
            self.model.registers[table],
            values,
            deadline=self.deadline,
            retries=self.retries,
        )

    def cycle_time(self) -> float:
        """Return the shortest time to read the positions and to set them [s]."""
        # Frames of 8, 5 + n, 9 + n and 8 bytes, n of them values; pauses before both requests, and
        # the silences after them by which the hand knows their end.
        rate = self._bus.line.baudrate
        count = 30 + 2 * 2 * self.model.count
        return wire_time(count, rate) + 2 * (self._spacing + silence(rate))


class CanLink(LinkerLink):
    """Classic CAN, identifiers of 11 bits; other nodes may share the bus.

    Arguments are those of `ModbusLink`, with a CAN bus.
    """

    def __init__(
        self, bus: CanBus, model: Model, unit: int, deadline: float, retries: int, spacing: float
    ) -> None:
        super().__init__(model, unit, deadline, retries)
        self._bus = bus
        self._spacing = spacing
        self._sent = 0.0

    async def version(self) -> Version | None:
        """Return ``None``: what a hand answers to the question on CAN is not published."""
        return None

    async def _pause(self) -> None:
        """Leave the hand its time since the frame before."""
        wait = self._sent + self._spacing - time.monotonic()
        if wait > 0.0:
            await asyncio.sleep(wait)
        self._sent = time.monotonic()

    async def read(self, table: Table) -> tuple[int, ...]:
        """Return the values of all motors; raises `BusError`."""
        values: list[int] = []
        for code, count in self.model.properties[table]:
            await self._pause()

            def fits(frame: CanFrame, code: int = code, count: int = count) -> bool:
                return codec.answers(frame, self.unit, code, count)

            answer = await self._bus.request(
                codec.query(self.unit, code), fits, self.deadline, retries=self.retries
            )
            values += answer.data[1 : 1 + count]
        return tuple(values)

    async def write(self, tables: Mapping[Table, Sequence[int]]) -> None:
        """Set values of all motors, torques and speeds before positions; raises `BusError`."""
        for table in sorted(tables, reverse=True):
            parts, at = [], 0
            for code, count in self.model.properties[table]:
                parts.append(codec.told(self.unit, code, tables[table][at : at + count]))
                at += count
            for frame in reversed(parts):
                await self._pause()
                await self._bus.send(frame)

    def cycle_time(self) -> float:
        """Return the shortest time to read the positions and to set them [s]."""
        parts = len(self.model.properties[Table.POSITION])
        # A question and its answer, or a setting; each waits for the pause after the one before.
        wire = 3 * parts * _CAN_BITS / codec.BITRATE
        return max(wire, 2 * parts * self._spacing)
