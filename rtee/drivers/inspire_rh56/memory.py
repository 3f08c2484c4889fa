"""The registers and motors of an emulated RH56, without the wire."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Literal

from rtee.buses.modbus_slave import Framing
from rtee.drivers.axis import Axis
from rtee.drivers.inspire_rh56 import codec, tactile
from rtee.drivers.inspire_rh56.options import TURNAROUND
from rtee.drivers.options import Byte, Duration, Positive, Rate
from rtee.hand.validation import Section

FIRST, LAST = codec.Register.HAND_ID, codec.Register.TEMPERATURE + codec.COUNT
_BLOCK_FAULTS = {
    "locked_rotor": codec.Error.LOCKED,
    "too_hot": codec.Error.TOO_HOT,
    "over_current": codec.Error.CURRENT,
    "abnormal": codec.Error.ABNORMAL,
    "no_motor": codec.Error.COMMUNICATION,
}
_SETTABLE = (
    codec.Register.CURRENT_LIMIT,
    codec.Register.INITIAL_SPEED,
    codec.Register.INITIAL_FORCE,
    codec.Register.ANGLE_SET,
    codec.Register.FORCE_SET,
    codec.Register.SPEED_SET,
)
"""Tables that can be written, as a whole or for consecutive motors."""
FAULTS = frozenset(_BLOCK_FAULTS)
"""Faults of the index finger that can be injected."""

_INDEX = 3
_STALL_MA = 900.0
"""Current of a motor that exerts the largest force [mA]; no source gives it."""
_VOLTAGE = 560
"""Value of the supply register; real hands returned 557 to 562, in a unit that no source gives."""
_RUNNING_MA = 150.0
"""Current of a motor that moves freely [mA]; no source gives it."""


class Rh56Properties(Section, frozen=True):
    """Properties of the emulated hand.

    Attributes:
        unit: Its number.
        protocol: Its own frames, or Modbus.
        framing: Modbus framing: ``rtu`` or ``tcp``.
        baudrate: Rate that its line is set to [baud].
        model: With tactile sensors (``dftp``) its force limits go up to 3000 g.
        unknown: Whether it returns registers without meaning as 0, or refuses to.
        behind: Whether answers over Modbus TCP carry the number of the previous transaction.
        travel_time: Time for the whole travel at speed 1000 [s].
        force_bias: Readings of the force sensors of an idle hand until they are calibrated [g].
        calibration_time: Duration of its force calibration [s].
        turnaround: Time between a request and its answer [s].
        haste: Factor by which it calibrates and moves faster than a real one.
    """

    unit: Byte = 1
    protocol: Literal["frames", "modbus"] = "frames"
    framing: Framing = "rtu"
    baudrate: Rate = codec.BAUDRATES[0]
    model: Literal["dfx", "dfq", "bfx", "dftp"] = "dfx"
    unknown: Literal["zeros", "refused"] = "zeros"
    behind: bool = False
    travel_time: Positive = 0.3
    force_bias: tuple[int, int, int, int, int, int] = (0, 0, 0, 0, 0, 0)
    calibration_time: Duration = 6.0
    turnaround: Duration = TURNAROUND
    haste: Positive = 1.0

    @property
    def most(self) -> int:
        """Largest force limit [g]."""
        return codec.MOST_TACTILE if self.model == "dftp" else codec.MOST


class Rh56Memory:
    """The registers, and the six motors behind them.

    Attributes:
        axes: The motors, in counts of their angles and in grams.
        moves: Number of angle set-points received.
        begun: Force limits when the last motion began [g].
        errors: Error bits of the motors.
        taxels: Bytes of the taxels' registers; empty in a hand without tactile sensors.
    """

    def __init__(self, properties: Rh56Properties) -> None:
        self.properties = properties
        fastest = codec.OPEN / properties.travel_time * properties.haste
        self.axes = [
            Axis(
                float(codec.OPEN),
                lower=0.0,
                upper=float(codec.OPEN),
                max_velocity=fastest,
                max_effort=float(properties.most),
                resolution=0.5,
                enabled=True,
                # Spindles are self-locking: a squeezed object does not push a finger back.
                self_locking=True,
            )
            for _ in range(codec.COUNT)
        ]
        self.moves = 0
        self.begun = [properties.most] * codec.COUNT
        self.errors = [codec.Error(0)] * codec.COUNT
        self._fastest = fastest
        self._faults: frozenset[str] = frozenset()
        self._bytes = bytearray(LAST - FIRST)
        self.taxels = bytearray(tactile.LAST - tactile.FIRST if properties.model == "dftp" else 0)
        self._bias = list(properties.force_bias)
        self._calibrating = 0.0
        self._put(codec.Register.HAND_ID, bytes([properties.unit]))
        self._put(codec.Register.VOLTAGE, struct.pack("<H", _VOLTAGE))
        self._put(codec.Register.CURRENT_LIMIT, codec.table([1500] * codec.COUNT))
        self._put(codec.Register.INITIAL_SPEED, codec.table([codec.MOST] * codec.COUNT))
        self._put(codec.Register.INITIAL_FORCE, codec.table([properties.most] * codec.COUNT))
        self.power_cycle()

    def power_cycle(self) -> None:
        """Restore the initial speeds and force limits.

        Until its first command, a motor then has no set-point and no state.
        """
        self.errors = [codec.Error(0)] * codec.COUNT
        self._put(codec.Register.SPEED_SET, self._get(codec.Register.INITIAL_SPEED, codec.WORDS))
        self._put(codec.Register.FORCE_SET, self._get(codec.Register.INITIAL_FORCE, codec.WORDS))
        self._put(codec.Register.ANGLE_SET, codec.table([codec.KEEP] * codec.COUNT))
        self._limit()

    def bias(self, grams: Sequence[int]) -> None:
        """Add offsets [g] to the force sensors, until they are calibrated."""
        self._bias = [a + b for a, b in zip(self._bias, grams or (0,) * codec.COUNT, strict=True)]

    def set_faults(self, faults: set[str]) -> None:
        """Set the injected faults; errors stay until they are cleared."""
        self._faults = frozenset(faults & FAULTS)
        self._latch()

    def _latch(self) -> None:
        for fault in self._faults:
            self.errors[_INDEX] |= _BLOCK_FAULTS[fault]
        if "too_hot" not in self._faults:
            # The only error that ends with its cause and cannot be cleared.
            self.errors[_INDEX] &= ~codec.Error.TOO_HOT
        for axis, errors in zip(self.axes, self.errors, strict=True):
            axis.enabled = not errors
            if errors:
                axis.target = axis.position

    def advance(self, dt: float) -> None:
        """Let a time ``dt`` [s] pass."""
        for axis in self.axes:
            axis.advance(dt)
        if self._calibrating > 0.0:
            self._calibrating -= dt * self.properties.haste
            if self._calibrating <= 0.0:
                self._bias = [0] * codec.COUNT

    # --- registers -------------------------------------------------------------------------------

    def _put(self, address: int, data: bytes) -> None:
        self._bytes[address - FIRST : address - FIRST + len(data)] = data

    def _get(self, address: int, size: int) -> bytes:
        return bytes(self._bytes[address - FIRST : address - FIRST + size])

    def _table(self, register: codec.Register) -> tuple[int, ...]:
        return codec.words(self._get(register, codec.WORDS))

    def read(self, address: int, size: int) -> bytes | None:
        """Return registers, or ``None`` if the hand refuses to."""
        at = address - tactile.FIRST
        if at >= 0 and at + size <= len(self.taxels):
            return bytes(self.taxels[at : at + size])
        # The registers between angles and forces have no meaning.
        hole = range(codec.Register.ANGLE + codec.WORDS, codec.Register.FORCE)
        known = address >= FIRST and address + size <= LAST
        if self.properties.unknown == "refused" and (
            not known or (address < hole.stop and address + size > hole.start)
        ):
            return None
        if not known:
            return bytes(size)
        report = self.report()
        self._put(codec.Register.ANGLE, report.to_bytes())
        stroke = [round((codec.OPEN - angle) * 2) for angle in report.angles]  # 0 to 2000, closed
        self._put(codec.Register.STROKE, codec.table(stroke))
        return self._get(address, size)

    def report(self) -> codec.Report:
        """Return its measurements."""
        angles = self._table(codec.Register.ANGLE_SET)
        return codec.Report(
            tuple(round(axis.measured) for axis in self.axes),
            tuple(round(self._force(i)) for i in range(codec.COUNT)),
            tuple(round(self._current(axis)) for axis in self.axes),
            tuple(self.errors),
            tuple(self._state(i, angle) for i, angle in enumerate(angles)),
            tuple(round(axis.temperature) for axis in self.axes),
        )

    def _force(self, i: int) -> float:
        # The sensors measure contact forces, not forces inside the hand.
        axis = self.axes[i]
        felt = -axis.effort if axis.obstacle is not None and axis.velocity == 0.0 else 0.0
        return felt + self._bias[i]

    def _current(self, axis: Axis) -> float:
        if axis.velocity != 0.0:
            return _RUNNING_MA
        return _STALL_MA * abs(axis.effort) / self.properties.most if axis.blocked else 0.0

    def _state(self, i: int, angle: int) -> codec.State:
        axis, errors = self.axes[i], self.errors[i]
        if errors:
            if errors & codec.Error.LOCKED:
                return codec.State.LOCKED
            return (
                codec.State.CURRENT_PROTECTION
                if errors & codec.Error.CURRENT
                else codec.State.FAULT
            )
        if angle == codec.KEEP:
            return codec.State.UNSET
        if axis.blocked and axis.obstacle is not None and abs(axis.effort) >= axis.max_effort:
            return codec.State.AT_FORCE
        if axis.position == axis.target:
            return codec.State.AT_TARGET
        return codec.State.CLOSING if axis.target < axis.position else codec.State.OPENING

    def write(self, address: int, data: bytes) -> bool:
        """Set registers and act on them; return whether the write was accepted."""
        for register in _SETTABLE:
            first, odd = divmod(address - register, 2)
            if 0 <= first < codec.COUNT and not odd:
                return self._part(register, first, data)
        flag = data[:1] == b"\x01"
        if address == codec.Register.CLEAR_ERROR and flag:
            self.errors = [error & codec.Error.TOO_HOT for error in self.errors]
            self._latch()
        elif address == codec.Register.FORCE_CALIBRATION and flag:
            self._calibrating = self.properties.calibration_time
        elif address in (codec.Register.HAND_ID, codec.Register.BAUD) and data[0] < 255:
            if address == codec.Register.BAUD and data[0] >= len(codec.BAUDRATES):
                return False
            self._put(address, data[:1])
        else:
            return address in (codec.Register.SAVE, codec.Register.RESET)
        return True

    def _part(self, register: codec.Register, first: int, data: bytes) -> bool:
        """Set a table's values of consecutive motors, from ``first`` on."""
        count, odd = divmod(len(data), 2)
        if odd or not 0 < count <= codec.COUNT - first:
            return False
        given = struct.unpack(f"<{count}h", data)
        # The others keep their values: KEEP commands nothing, and a limit is set to its own value.
        others = [codec.KEEP] * codec.COUNT
        if register is not codec.Register.ANGLE_SET:
            others = list(self._table(register))
        others[first : first + count] = given
        return self._set(register, tuple(others))

    def _set(self, register: codec.Register, values: tuple[int, ...]) -> bool:
        most = self.properties.most if "FORCE" in register.name else codec.MOST
        least = 0
        if register is codec.Register.ANGLE_SET:
            # An example frame of the manual writes 2000, which is assumed to mean fully open.
            least, most = codec.KEEP, 2 * codec.OPEN
        # Current limits are in mA and have another range.
        if register is not codec.Register.CURRENT_LIMIT and not all(
            least <= v <= most for v in values
        ):
            return False
        before = self._table(register)
        kept = [b if v == codec.KEEP else v for v, b in zip(values, before, strict=True)]
        self._put(register, codec.table(kept))
        if register is codec.Register.ANGLE_SET:
            self._aim(values)
        self._limit()
        return True

    def _aim(self, values: tuple[int, ...]) -> None:
        if any(value != codec.KEEP for value in values):
            self.moves += 1
            self.begun = list(self._table(codec.Register.FORCE_SET))
        for axis, value in zip(self.axes, values, strict=True):
            if value != codec.KEEP and axis.enabled:
                axis.target = float(min(value, codec.OPEN))

    def _limit(self) -> None:
        forces = self._table(codec.Register.FORCE_SET)
        speeds = self._table(codec.Register.SPEED_SET)
        for axis, force, speed in zip(self.axes, forces, speeds, strict=True):
            axis.max_effort = float(force)
            axis.max_velocity = self._fastest * speed / codec.MOST
