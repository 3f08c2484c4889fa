"""Reads and writes the tables of a LinkerHand: over Modbus RTU, or on CAN."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence

from rtee import monotonic
from rtee.buses.bus import Bus
from rtee.buses.can import CanBus
from rtee.buses.emulator import CanFrame
from rtee.buses.modbus import ModbusBus, ModbusRefusal
from rtee.buses.modbus_frames import READ_INPUT
from rtee.buses.timing import silence, wire_time
from rtee.drivers.deadlines import RelaxedDeadline
from rtee.drivers.linkerhand import codec
from rtee.drivers.linkerhand.codec import Fault, LinkerFrameError, Model, Table, Version
from rtee.errors import FrameError

_CAN_BITS = 130
"""Bits of a CAN frame with eight bytes, stuffing bits included."""


class _LinkerHand(RelaxedDeadline):
    """Talks to one hand.

    Args:
        bus: The line or bus.
        model: The kind of hand.
        unit: Its number.
        deadline: Longest time for one exchange, retries included [s].
        retries: How often a request is sent again within that time.
        spacing: Silence to leave between two frames [s].
    """

    PATIENCE = 1.0

    def __init__(
        self, bus: Bus, model: Model, unit: int, deadline: float, retries: int, spacing: float
    ) -> None:
        self._bus: Bus = bus
        self.model = model
        self.unit = unit
        self.deadline = deadline
        self.retries = retries
        self._spacing = spacing


class ModbusLink(_LinkerHand):
    """Modbus RTU on RS-485; several hands may share a line."""

    _bus: ModbusBus

    def __init__(
        self, bus: ModbusBus, model: Model, unit: int, deadline: float, retries: int, spacing: float
    ) -> None:
        super().__init__(bus, model, unit, deadline, retries, spacing)
        self._both = True
        # An emulated line without wire time needs no silence, either.
        if bus.gap:
            bus.gap = max(bus.gap, spacing)

    async def version(self) -> Version | None:
        """Return the hand's version block; raises `BusError`."""
        registers = await self._read(self.model.version, Version.COUNT)
        return Version.from_registers(registers, self._bus.name)

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

        Both tables are read at once: a Modbus answer does not name its registers, and only by its
        length can a late answer be distinguished from one with positions.
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
        # Other codes are not published, and more likely the late answer to another request.
        if not set(registers) <= set(Fault):
            raise FrameError(self._bus.name, f"no fault codes of a LinkerHand: {list(registers)}")
        return tuple(registers)

    async def write(self, tables: Mapping[Table, Sequence[int]]) -> None:
        """Set values of all motors, torques and speeds before positions; raises `BusError`."""
        if self.model.joint_write and len(tables) == len(Table) - 2:
            # One frame for all three: each frame costs a pause.
            values = [v for table in sorted(tables) for v in tables[table]]
            await self._write(Table.POSITION, values)
            return
        # Positions last, so that no motion begins with old limits.
        for table in sorted(tables, reverse=True):
            await self._write(table, tables[table])

    async def _write(self, table: Table, values: Sequence[int]) -> None:
        first = self.model.registers[table]
        await self._bus.write(
            self.unit, first, values, deadline=self.deadline, retries=self.retries
        )

    def cycle_time(self) -> float:
        """Return the shortest time to read the positions and to set them [s]."""
        # Frames of 8, 5 + 2n, 9 + 2n and 8 bytes for n values; pauses before both requests, and the
        # silences after them that mark their end.
        rate = self._bus.line.baudrate
        count = 30 + 2 * 2 * self.model.count
        return wire_time(count, rate) + 2 * (self._spacing + silence(rate))


class CanLink(_LinkerHand):
    """Classic CAN with 11-bit identifiers; other nodes may share the bus."""

    _bus: CanBus
    _sent = 0.0  # time of the last frame

    async def version(self) -> Version | None:
        """Return ``None``: the version block on CAN is not published."""
        return None

    async def _pause(self) -> None:
        """Wait for the pause after the previous frame."""
        wait = self._sent + self._spacing - monotonic.now()
        if wait > 0.0:
            await asyncio.sleep(wait)
        self._sent = monotonic.now()

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

    async def health(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return temperatures [°C] and fault codes of all motors; raises `BusError`."""
        return await self.read(Table.TEMPERATURE), await self.read(Table.FAULT)

    async def write(self, tables: Mapping[Table, Sequence[int]]) -> None:
        """Set values of all motors, torques and speeds before positions; raises `BusError`."""
        # Positions last, so that no motion begins with old limits.
        for table in sorted(tables, reverse=True):
            parts, at = [], 0
            for code, count in self.model.properties[table]:
                values = tables[table][at : at + count]
                parts.append(codec.property_frame(self.unit, code, values))
                at += count
            # In the order of the maker's SDK.
            for frame in reversed(parts):
                await self._pause()
                await self._bus.send(frame)

    def cycle_time(self) -> float:
        """Return the shortest time to read the positions and to set them [s]."""
        parts = len(self.model.properties[Table.POSITION])
        # A request and its answer, and a write; each waits for the pause after the previous frame.
        wire = 3 * parts * _CAN_BITS / codec.BITRATE
        return max(wire, 2 * parts * self._spacing)


LinkerLink = ModbusLink | CanLink
"""Either way to talk to a hand."""
