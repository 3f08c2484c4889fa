"""Emulates a LinkerHand: its registers over Modbus RTU, and its properties on CAN.

Properties set what is not published: how fast the hand moves, and its software version. The hand
keeps its last set-points when the line falls silent, and answers wrong addresses with exception 2.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

from rtee.buses.emulator import CanFrame
from rtee.buses.modbus_frames import READ_INPUT, WRITE_MANY, WRITE_ONE
from rtee.buses.modbus_slave import ILLEGAL_ADDRESS, ILLEGAL_VALUE, ModbusEmulator, Refused
from rtee.drivers.axis import Axis
from rtee.drivers.linkerhand import codec
from rtee.drivers.objects import Closing, Grasps
from rtee.drivers.options import Byte, Duration, Positive
from rtee.hand.validation import Section

_FAULTS = {fault.name.lower(): fault for fault in codec.Fault if fault}
_INDEX = 2  # index of the motor that can have these faults
_LIMITS = (codec.Table.SPEED, codec.Table.TORQUE)
_BENDING = ("thumb_bend", "index", "middle", "ring", "little")
_OPEN = {"index_roll": 128.0, "ring_roll": 128.0, "little_roll": 128.0}
"""Positions at power-up of the motors that are not open at 255."""
_RATING = 0.01
"""Heating rate of a motor at its largest torque [K/s]: it becomes warm within minutes."""


class LinkerProperties(Section, frozen=True):
    """Properties of the emulated hand.

    Attributes:
        model: ``o6`` or ``l10``.
        unit: Its number.
        travel_time: Time for the whole travel at speed 255 [s].
        software: Version of its software, major and minor in a nibble each.
        joint_reads: Whether several tables can be read in one frame.
        turnaround: Time between a request and its answer [s].
        haste: Factor by which it moves faster than a real one.
    """

    model: Literal["o6", "l10"] = "o6"
    unit: Byte = codec.RIGHT
    travel_time: Positive = 1.0
    software: Byte = 0x10
    joint_reads: bool = True
    turnaround: Duration = 0.002
    haste: Positive = 1.0


class LinkerHandEmulator(ModbusEmulator, Grasps):
    """The hand.

    Attributes:
        model: The kind of hand.
        axes: Its motors, in counts of position and of torque.
        moves: Number of position set-points received.
        begun: Torque limits when the last motion began.
    """

    PROPERTIES = LinkerProperties
    SHARED = ("model", "unit", "travel_time")
    FAULTS = ModbusEmulator.FAULTS | frozenset(_FAULTS) | {"silent"}
    BAUDRATES = frozenset({codec.BAUDRATE})
    FUNCTIONS = frozenset({READ_INPUT, WRITE_ONE, WRITE_MANY})
    EXCEPTIONS = True

    def __init__(self, properties: LinkerProperties | None = None) -> None:
        properties = properties or LinkerProperties()
        super().__init__(properties.unit, baudrate=codec.BAUDRATE)
        self.properties = properties
        self.model: codec.Model = codec.MODELS[properties.model]
        self.turnaround = max(self.turnaround, properties.turnaround)
        self.axes = []
        for name in self.model.motors:
            # Worm gears are self-locking: a squeezed object does not push a finger back.
            axis = Axis(
                _OPEN.get(name, float(codec.MOST)),
                lower=0.0,
                upper=float(codec.MOST),
                max_effort=float(codec.MOST),
                resolution=0.5,
                enabled=True,
                self_locking=True,
            )
            axis.heating = _RATING
            self.axes.append(axis)
        self.moves = 0
        self.begun = [codec.MOST] * self.model.count
        self._unlimited()

    def closings(self) -> Sequence[Closing]:
        """Return the closing motions of the motors that bend the digits."""
        pairs = zip(self.model.motors, self.axes, strict=True)
        return [
            Closing(axis, float(codec.MOST), 0.0, float(codec.MOST))
            for name, axis in pairs
            if name in _BENDING
        ]

    def power_cycle(self, now: float) -> None:
        """Restart with the largest torques and speeds; the fingers stay where they are."""
        self.advance(now)
        self.line_reset()
        self.halt()
        self._unlimited()

    def on_faults(self) -> None:
        """Stop the motor that has a fault; it continues when the fault is gone."""
        super().on_faults()
        self.axes[_INDEX].enabled = not self.faults & set(_FAULTS)

    def _unlimited(self) -> None:
        self._limits = {table: [codec.MOST] * self.model.count for table in _LIMITS}
        self._limit()

    def _limit(self) -> None:
        speeds, torques = self._limits.values()
        fastest = codec.MOST / self.properties.travel_time * self.properties.haste
        for axis, torque, speed in zip(self.axes, torques, speeds, strict=True):
            axis.max_effort = float(torque)
            axis.max_velocity = fastest * speed / codec.MOST

    # --- tables ------------------------------------------------------------------------------

    def table(self, table: codec.Table) -> list[int]:
        """Return the values of all motors."""
        if table is codec.Table.POSITION:
            return [min(max(round(axis.measured), 0), codec.MOST) for axis in self.axes]
        if table in self._limits:
            return list(self._limits[table])
        if table is codec.Table.TEMPERATURE:
            return [round(axis.temperature) for axis in self.axes]
        codes = [int(codec.Fault.NONE)] * self.model.count
        codes[_INDEX] = max(
            (code for name, code in _FAULTS.items() if name in self.faults), default=0
        )
        return codes

    def set_table(self, table: codec.Table, first: int, values: Sequence[int]) -> None:
        """Set values of consecutive motors, beginning with the index ``first``."""
        if table in self._limits:
            self._limits[table][first : first + len(values)] = values
            self._limit()
            return
        for axis, value in zip(self.axes[first:], values, strict=False):
            axis.target = float(value)
        self.moves += 1
        self.begun = list(self._limits[codec.Table.TORQUE])

    def version(self) -> codec.Version:
        """Return its version block."""
        motors = self.model.count + (1 if "wrong_device" in self.faults else 0)
        side = codec.Side.LEFT if self.unit == codec.LEFT else codec.Side.RIGHT
        return codec.Version(motors, 1, 1, side, self.properties.software, 0x10)

    # --- Modbus ------------------------------------------------------------------------------

    def feed(self, data: bytes, now: float) -> list[bytes]:
        """Receive bytes and return the answers."""
        self.advance(now)
        return [] if "silent" in self.faults else super().feed(data, now)

    def read(self, function: int, address: int, count: int, now: float) -> Sequence[int]:
        """Return input registers; those between its tables are 0."""
        if count > self.model.count and not self.properties.joint_reads:
            raise Refused(ILLEGAL_ADDRESS)
        return super().read(function, address, count, now)

    def windows(self, function: int) -> Mapping[int, Sequence[int]]:
        """Return all tables and the version, in one block."""
        registers = [0] * self.model.version
        for table, block in self.model.tables.items():
            registers[block.register : block.register + self.model.count] = self.table(table)
        return {0: [*registers, *self.version().to_registers()]}

    def write(self, address: int, values: Sequence[int], now: float) -> None:
        """Set holding registers."""
        count = self.model.count
        if address + len(values) > (len(_LIMITS) + 1) * count:
            raise Refused(ILLEGAL_ADDRESS)
        if any(value > codec.MOST for value in values):
            raise Refused(ILLEGAL_VALUE)
        # From the last table to the first, so that limits apply before the motion.
        for table in (*_LIMITS, codec.Table.POSITION):
            first = self.model.tables[table].register
            low, high = max(first, address), min(first + count, address + len(values))
            if low < high:
                self.set_table(table, low - first, values[low - address : high - address])

    # --- CAN ---------------------------------------------------------------------------------

    def on_frame(self, frame: CanFrame, now: float) -> list[CanFrame]:
        """Receive a frame and return the answer, if any."""
        self.advance(now)
        mine = frame.id == self.unit and not (frame.remote or frame.extended)
        if not mine or not frame.data or "silent" in self.faults:
            return []
        if frame.data[0] in codec.VERSION_CODES:
            version = self.version().to_registers()
            return [codec.property_frame(self.unit, frame.data[0], version)]
        for table, block in self.model.tables.items():
            first = 0
            for code, count in block.properties:
                if frame.data[0] == code:
                    return self._property(table, code, first, count, frame.data[1:])
                first += count
        return []

    def _property(
        self, table: codec.Table, code: int, first: int, count: int, data: bytes
    ) -> list[CanFrame]:
        if data:
            if table in (*_LIMITS, codec.Table.POSITION) and len(data) >= count:
                self.set_table(table, first, list(data[:count]))
            return []
        values = self.table(table)[first : first + count]
        # Another model has another number of values.
        shown = values[:2] if "wrong_device" in self.faults else values
        return [codec.property_frame(self.unit, code, shown)]
