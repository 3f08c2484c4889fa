"""Reads and writes the tables of a LinkerHand: over Modbus RTU, or on CAN."""

from __future__ import annotations

import asyncio
from abc import abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rtee import monotonic
from rtee.buses.can import CanBus
from rtee.buses.emulator import CanFrame
from rtee.buses.modbus import ModbusBus, ModbusRefusal
from rtee.buses.modbus_frames import READ_INPUT
from rtee.buses.parser import CodecError
from rtee.buses.timing import silence, wire_time
from rtee.drivers.deadlines import RelaxedDeadline
from rtee.drivers.linkerhand import codec
from rtee.drivers.linkerhand.codec import Model, Table, Version
from rtee.errors import FrameError

_CAN_BITS = 130
"""Bits of a CAN frame with eight bytes, stuffing bits included."""


@dataclass
class _LinkerHand(RelaxedDeadline):
    """Talks to one hand.

    Attributes:
        bus: The line or bus.
        model: The kind of hand.
        unit: Its number.
        deadline: Longest time for one exchange, retries included [s].
        retries: How often a request is sent again within that time.
        spacing: Silence to leave between two frames [s].
    """

    PATIENCE = 1.0

    bus: Any
    model: Model
    unit: int
    deadline: float
    retries: int
    spacing: float

    async def version(self) -> Version | None:
        """Return the version block, ``None`` where it is not published; raises `BusError`."""
        return None

    @abstractmethod
    async def read(self, table: Table) -> tuple[int, ...]:
        """Return the values of all motors; raises `BusError`."""

    @abstractmethod
    async def _write(self, table: Table, values: Sequence[int]) -> None:
        """Set the values of all motors; raises `BusError`."""

    async def health(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return temperatures [°C] and fault codes of all motors; raises `BusError`."""
        return await self.read(Table.TEMPERATURE), await self.read(Table.FAULT)

    async def write(self, tables: Mapping[Table, Sequence[int]]) -> None:
        """Set values of all motors, torques and speeds before positions; raises `BusError`."""
        # Positions last, so that no motion begins with old limits.
        for table in sorted(tables, reverse=True):
            await self._write(table, tables[table])


@dataclass
class ModbusLink(_LinkerHand):
    """Modbus RTU on RS-485; several hands may share a line."""

    bus: ModbusBus
    _both = True

    def __post_init__(self) -> None:
        # An emulated line without wire time needs no silence.
        if self.bus.gap:
            self.bus.gap = max(self.bus.gap, self.spacing)

    async def version(self) -> Version | None:
        """Return the hand's version block; raises `BusError`."""
        registers = await self._read(self.model.version, Version.COUNT)
        return Version.from_registers(registers, self.bus.name)

    async def _read(self, address: int, count: int) -> tuple[int, ...]:
        return await self.bus.read(
            self.unit,
            address,
            count,
            deadline=self.deadline,
            retries=self.retries,
            function=READ_INPUT,
        )

    async def read(self, table: Table) -> tuple[int, ...]:
        """Return the values of all motors; raises `BusError`."""
        first = self.model.tables[table].register
        # Among answers of the same length, an unpublished fault code is more likely to be a late
        # answer to another request.
        known = codec.FAULTS if table is Table.FAULT else codec.VALUES
        return self._checked(await self._read(first, self.model.count), known)

    async def health(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return temperatures [°C] and fault codes of all motors; raises `BusError`.

        One request reads both tables: a Modbus answer does not name its registers, and only its
        length distinguishes a late answer from one with positions.
        """
        count, both = self.model.count, (Table.TEMPERATURE, Table.FAULT)
        if self._both:
            try:
                registers = await self._read(self.model.tables[both[0]].register, 2 * count)
            except ModbusRefusal as refusal:
                if refusal.passing:
                    raise
                self._both = False
            else:
                return self._checked(registers[:count]), self._checked(registers[count:])
        return await super().health()

    def _checked(
        self, registers: Sequence[int], known: Collection[int] = codec.VALUES
    ) -> tuple[int, ...]:
        try:
            return codec.checked(registers, self.model.count, known)
        except CodecError as error:
            raise FrameError(self.bus.name, str(error)) from error

    async def write(self, tables: Mapping[Table, Sequence[int]]) -> None:
        """Set values of all motors, torques and speeds before positions; raises `BusError`."""
        if self.model.joint_write and len(tables) == len(Table) - 2:
            # One frame for all three: each frame costs a pause.
            values = [v for table in sorted(tables) for v in tables[table]]
            await self._write(Table.POSITION, values)
        else:
            await super().write(tables)

    async def _write(self, table: Table, values: Sequence[int]) -> None:
        first = self.model.tables[table].register
        await self.bus.write(self.unit, first, values, deadline=self.deadline, retries=self.retries)

    def cycle_time(self) -> float:
        """Return the shortest time to read the positions and to set them [s]."""
        # Frames of 8, 5 + 2n, 9 + 2n and 8 bytes for n values; a pause before each request, and a
        # silence after it that marks its end.
        rate = self.bus.line.baudrate
        count = 30 + 2 * 2 * self.model.count
        return wire_time(count, rate) + 2 * (self.spacing + silence(rate))


@dataclass
class CanLink(_LinkerHand):
    """Classic CAN with 11-bit identifiers; other nodes may share the bus."""

    bus: CanBus
    _sent = 0.0  # time of the last frame

    async def _pause(self) -> None:
        """Wait for the pause after the previous frame."""
        wait = self._sent + self.spacing - monotonic.now()
        if wait > 0.0:
            await asyncio.sleep(wait)
        self._sent = monotonic.now()

    async def read(self, table: Table) -> tuple[int, ...]:
        """Return the values of all motors; raises `BusError`."""
        values: list[int] = []
        for code, count in self.model.tables[table].properties:
            await self._pause()

            def fits(frame: CanFrame, code: int = code, count: int = count) -> bool:
                return codec.answers(frame, self.unit, code, count)

            answer = await self.bus.request(
                codec.query(self.unit, code), fits, self.deadline, retries=self.retries
            )
            values += answer.data[1 : 1 + count]
        return tuple(values)

    async def _write(self, table: Table, values: Sequence[int]) -> None:
        parts, at = [], 0
        for code, count in self.model.tables[table].properties:
            parts.append(codec.property_frame(self.unit, code, values[at : at + count]))
            at += count
        # In the order of the maker's SDK.
        for frame in reversed(parts):
            await self._pause()
            self.bus.send_now(frame)

    def cycle_time(self) -> float:
        """Return the shortest time to read the positions and to set them [s]."""
        parts = len(self.model.tables[Table.POSITION].properties)
        # A request, its answer and a write; the pause precedes the request and the write.
        wire = 3 * parts * _CAN_BITS / codec.BITRATE
        return max(wire, 2 * parts * self.spacing)


LinkerLink = ModbusLink | CanLink
"""Either kind of link to a hand."""
