"""One emulated X-series servo: its instructions, its motor, its faults."""

from __future__ import annotations

import math
from collections.abc import Iterable

from rtee.drivers.axis import Axis
from rtee.drivers.dynamixel import table
from rtee.drivers.dynamixel.codec import Error, Hardware
from rtee.drivers.dynamixel.table import Mode, Register
from rtee.drivers.servo_emulator import EmulatedServo
from rtee.hand.validation import Section


class DynamixelMemory:
    """The control table of one servo; it begins with all registers at their defaults."""

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
        """Let every indirect address point to its own byte of the indirect data."""
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
        """Return bytes of the table; for indirect data, those that indirect addresses point to."""
        out = self._bytes[address : address + length]
        for at in range(max(address, table.INDIRECT_DATA.start), address + length):
            out[at - address] = self._bytes[self._points_to(at)]
        return bytes(out)

    def after(self, address: int, data: bytes) -> bytes:
        """Return the table as if these bytes were written, without following indirect addresses."""
        return bytes(self._bytes[:address] + data + self._bytes[address + len(data) :])

    def write(self, address: int, data: bytes) -> None:
        """Write bytes; those for indirect data go where the indirect addresses point."""
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


QUARTER_TURN = table.PULSES / 4.0  # [pulse]
_PULSES_PER_COUNT = 0.229 / 60.0 * table.PULSES
"""Speed per velocity count [pulse/s]."""
_FRICTION = 25.0  # current to move the free shaft [mA]; no datasheet gives it
_GAIN = 4.0  # current per position error at standstill [mA/pulse], an assumption
_POSITION_MODES = (Mode.POSITION, Mode.EXTENDED_POSITION, Mode.CURRENT_BASED_POSITION)
_BOUNDS = {
    table.GOAL_CURRENT: table.CURRENT_LIMIT,
    table.GOAL_VELOCITY: table.VELOCITY_LIMIT,
    table.GOAL_PWM: table.PWM_LIMIT,
}
"""For each goal, the register that limits its magnitude."""


class DynamixelServoProperties(Section, frozen=True):
    """Properties of an emulated servo.

    Attributes:
        model: Its model number.
        start: Shaft position at power-up [pulse]; whole turns are lost, as in a real servo.
        homing_offset: Homing offset in the EEPROM [pulse].
        drive_mode: Drive mode in the EEPROM.
        return_delay: Return delay in the EEPROM [2 µs].
        reboot_time: Silence after a reboot [s].
        overload_time: Time at the current limit after which the overload error trips [s]; 0: never.
        lower: Lower mechanical stop [pulse].
        upper: Upper mechanical stop [pulse].
        closing: Signed travel from `start` to closed, for objects [pulse].
    """

    model: int = 1200
    start: float = float(table.CENTER)
    homing_offset: int = 0
    drive_mode: int = 0
    return_delay: int = 250
    reboot_time: float = 0.4
    overload_time: float = 0.0
    lower: float = -math.inf
    upper: float = math.inf
    closing: float = QUARTER_TURN


class EmulatedDynamixel(EmulatedServo):
    """A servo's control table and its motor; the axis counts pulses over all turns.

    Attributes:
        cause: Hardware errors whose cause persists: they come back after a reboot.
    """

    ID = table.ID
    PENDING = table.REGISTERED
    MODEL = table.MODEL
    BAUD_RATE = table.BAUD_RATE
    RETURN_DELAY = table.RETURN_DELAY

    def __init__(self, number: int, properties: DynamixelServoProperties) -> None:
        self.properties = properties
        self.axis = Axis(
            properties.start,
            lower=properties.lower,
            upper=properties.upper,
            max_effort=float(table.CURRENT_LIMIT.default),
            gain=_GAIN,
            friction=_FRICTION,
            resolution=0.5,
        )
        self.model = properties.model
        self.travel = properties.start, properties.start + properties.closing
        self._memory = DynamixelMemory()
        self.get, self.set = self._memory.get, self._memory.set
        self.keep = self.set
        self._heard = -math.inf
        self._turn = 0
        self.set(table.ID, number)
        self.set(table.MODEL, properties.model)
        self.set(table.HOMING_OFFSET, properties.homing_offset)
        self.set(table.DRIVE_MODE, properties.drive_mode)
        self.set(table.RETURN_DELAY, properties.return_delay)
        self._start()

    # --- memory ----------------------------------------------------------------------------

    @property
    def alert(self) -> bool:
        """Whether the servo has a hardware error."""
        return self.get(table.HARDWARE_ERROR) != 0

    def read(self, address: int, length: int) -> bytes | None:
        """Return bytes of the table, or ``None`` beyond its end."""
        if length == 0 or address + length > table.END:
            return None
        self._report()
        return self._memory.read(address, length)

    def write(self, address: int, data: bytes) -> Error:
        """Write bytes as a host may, and return the error of the servo's answer."""
        if address + len(data) > table.END or not data:
            return Error.DATA_RANGE
        if address >= table.INDIRECT_DATA.start:
            self._memory.write(address, data)
            self._act()
            return Error.NONE
        touched = [
            r
            for r in table.REGISTERS
            if r.address < address + len(data) and address < r.address + r.size
        ]
        end = address + len(data)
        error = self._objection(touched, self._memory.after(address, data), address, end)
        if error is not Error.NONE:
            return error
        mode = self.get(table.OPERATING_MODE)
        powered = self.get(table.TORQUE)
        self._memory.write(address, data)
        if self.get(table.OPERATING_MODE) != mode:
            self._enter_mode()
        # A servo whose torque is switched on stays where it is.
        begins = self.get(table.TORQUE) and not powered
        if begins and self.get(table.OPERATING_MODE) in _POSITION_MODES:
            self.set(table.GOAL_POSITION, self.position)
        self._act()
        return Error.NONE

    def _objection(self, touched: list[Register], after: bytes, address: int, end: int) -> Error:
        torque = self.get(table.TORQUE)
        tripped = self.get(table.BUS_WATCHDOG) < 0
        for register in touched:
            if not register.writable or (register.eeprom and torque):
                return Error.ACCESS
            if not address <= register.address <= end - register.size:
                return Error.DATA_LENGTH  # only a part of a register
            value = register.unpack(after[register.address :])
            low, high = register.minimum, register.maximum
            if (low is not None and value < low) or (high is not None and value > high):
                return Error.DATA_RANGE
            goal = table.GOAL_PWM.address <= register.address <= table.GOAL_POSITION.address
            if tripped and goal:
                return Error.DATA_RANGE
            if register == table.OPERATING_MODE and value not in set(Mode):
                return Error.DATA_RANGE  # some numbers between the modes have no meaning
            if self._beyond(register, value):
                return Error.DATA_LIMIT
        return self._windows(after, address, end)

    @staticmethod
    def _windows(after: bytes, address: int, end: int) -> Error:
        """Return the error of a write to indirect addresses."""
        for at in table.INDIRECT:
            if at + 2 <= address or end <= at:
                continue
            if not address <= at <= end - 2:
                return Error.DATA_LENGTH
            if not table.POINTABLE.start <= after[at] | after[at + 1] << 8 < table.POINTABLE.stop:
                return Error.DATA_RANGE
        return Error.NONE

    def _beyond(self, register: Register, value: int) -> bool:
        if register in _BOUNDS:
            return abs(value) > self.get(_BOUNDS[register])
        if register == table.GOAL_POSITION and self.get(table.OPERATING_MODE) == Mode.POSITION:
            return not self.get(table.MIN_POSITION) <= value <= self.get(table.MAX_POSITION)
        return False

    # --- life ------------------------------------------------------------------------------

    def reboot(self, now: float) -> None:
        """Restart with RAM at its defaults, without torque, turns and errors."""
        self.silent_until = now + self.properties.reboot_time
        self._memory.reset(register for register in table.REGISTERS if not register.eeprom)
        self._memory.reset_windows()
        self._pending = None
        self._start()

    def factory_reset(self, now: float, option: int) -> None:
        """Reset the EEPROM, too; option 1 keeps the id, 2 also the baud rate."""
        kept = {0x01: (table.ID,), 0x02: (table.ID, table.BAUD_RATE)}.get(option, ())
        # The model number is the servo's identity, not a setting.
        values = [(register, self.get(register)) for register in (*kept, table.MODEL)]
        self._memory.reset(table.REGISTERS)
        for register, value in values:
            self.set(register, value)
        self.reboot(now)

    def clear_turns(self) -> None:
        """Reset the turn count."""
        self._lose_turns()
        self.set(table.GOAL_POSITION, self.position)
        self._act()

    def _start(self) -> None:
        self.set(table.HARDWARE_ERROR, self.cause)
        self._strained = None
        self._lose_turns()
        self._enter_mode()

    def _lose_turns(self) -> None:
        self._turn = math.floor(self._sign * self.axis.position / table.PULSES)

    def _enter_mode(self) -> None:
        if self.get(table.OPERATING_MODE) == Mode.POSITION:
            self._lose_turns()
        self.set(table.GOAL_POSITION, self.position)
        self.set(table.GOAL_CURRENT, self.get(table.CURRENT_LIMIT))
        self._act()

    def fail(self, error: Hardware) -> None:
        """Set a hardware error; if the shutdown mask contains it, disable the torque."""
        self.set(table.HARDWARE_ERROR, self.get(table.HARDWARE_ERROR) | error)
        if error & self.get(table.SHUTDOWN):
            self.set(table.TORQUE, 0)
            self._act()

    # --- motion ----------------------------------------------------------------------------

    @property
    def _sign(self) -> int:
        return -1 if self.get(table.DRIVE_MODE) & table.REVERSE else 1

    @property
    def _offset(self) -> int:
        return self.get(table.HOMING_OFFSET) - table.PULSES * self._turn

    @property
    def position(self) -> int:
        """Reported present position [pulse]."""
        return round(self._sign * self.axis.measured) + self._offset

    def heard(self, now: float) -> None:
        """Note the time of an instruction on the bus, for any servo."""
        self._heard = now

    def step(self, now: float) -> None:
        """Let time pass up to ``now`` [s]."""
        self.axis.step(now)
        torque = self.get(table.TORQUE)
        period = self.get(table.BUS_WATCHDOG) * table.WATCHDOG_UNIT
        if torque and period > 0.0 and now - self._heard > period:
            # As in the manual: the servo stops, and its profile registers become 0.
            self.set(table.BUS_WATCHDOG, -1)
            self.set(table.PROFILE_VELOCITY, 0)
            self.set(table.PROFILE_ACCELERATION, 0)
            self.set(table.GOAL_POSITION, self.position)
            self._act()
        if self.axis.temperature > self.get(table.TEMPERATURE_LIMIT):
            self.fail(Hardware.OVERHEATING)
        self._watch_load(now)

    def _watch_load(self, now: float) -> None:
        allowed = self.properties.overload_time
        strained = allowed and abs(self.axis.effort) >= 0.9 * self.get(table.CURRENT_LIMIT)
        if self.strained_for(bool(strained), now) > allowed:
            self.fail(Hardware.OVERLOAD)

    def _act(self) -> None:
        """Apply the registers to the shaft."""
        axis, mode = self.axis, self.get(table.OPERATING_MODE)
        limit = self.get(table.CURRENT_LIMIT)
        current = self.get(table.GOAL_CURRENT)
        axis.rating = float(table.CURRENT_LIMIT.default)
        axis.max_effort = float(limit)
        speed = self.get(table.PROFILE_VELOCITY) or self.get(table.VELOCITY_LIMIT)
        axis.max_velocity = min(speed, self.get(table.VELOCITY_LIMIT)) * _PULSES_PER_COUNT
        if mode in _POSITION_MODES:
            if mode == Mode.CURRENT_BASED_POSITION:
                axis.max_effort = float(min(abs(current), limit))
            # The voltage that a host allows limits effort and speed.
            pwm = min(abs(self.get(table.GOAL_PWM)) / table.PWM_LIMIT.default, 1.0)
            axis.max_effort *= pwm
            axis.max_velocity *= pwm
            axis.target = self._sign * (self.get(table.GOAL_POSITION) - self._offset)
        else:
            push = {Mode.CURRENT: current, Mode.VELOCITY: self.get(table.GOAL_VELOCITY)}.get(
                Mode(mode), self.get(table.GOAL_PWM)
            )
            # Without a goal position, the shaft moves up to the stops.
            axis.target = axis.position if push == 0 else math.copysign(1e9, push * self._sign)
            if mode == Mode.CURRENT:
                axis.max_effort = float(min(abs(current), limit))
            elif mode == Mode.VELOCITY:
                axis.max_velocity = abs(push) * _PULSES_PER_COUNT
        axis.enabled = bool(self.get(table.TORQUE)) and self.get(table.BUS_WATCHDOG) >= 0

    def _report(self) -> None:
        """Update the registers that report the state."""
        axis = self.axis
        self.set(table.PRESENT_POSITION, self.position)
        self.set(table.PRESENT_VELOCITY, round(self._sign * axis.velocity / _PULSES_PER_COUNT))
        self.set(table.PRESENT_CURRENT, round(self._sign * axis.effort))
        self.set(table.PRESENT_TEMPERATURE, min(round(axis.temperature), 255))
        self.set(table.MOVING, int(abs(axis.velocity) > 10 * _PULSES_PER_COUNT))
