"""One emulated Feetech servo: its registers, its motor, its protection."""

from __future__ import annotations

import math

from rtee.drivers.axis import Axis
from rtee.drivers.feetech import table
from rtee.drivers.feetech.codec import Status
from rtee.drivers.feetech.table import END, FULL, MODELS, RAM, Family, Register
from rtee.drivers.options import Duration, Positive
from rtee.drivers.servo_emulator import EmulatedServo
from rtee.hand.validation import Section

_COMMON = {table.ID: 1, table.RETURN_DELAY: 0, table.RESPONSE_LEVEL: 1}
_SCS = {
    table.MIN_ANGLE: 20,
    table.MAX_ANGLE: 1003,
    table.MAX_TEMPERATURE: 80,
    table.MAX_VOLTAGE: 90,
    table.MIN_VOLTAGE: 45,
    table.MAX_TORQUE: FULL,
    table.UNLOAD: 36,
    table.ALARM: 37,  # errors that light the LED
    table.P: 15,
    table.D: 15,
    Register(24, 2): 30,  # least force to start
    Register(26, 1): 1,
    Register(27, 1): 1,  # dead zones
    Register(37, 1): 20,
    Register(38, 1): 100,
    Register(39, 1): 80,  # overload protection
}
_STS = {
    table.MAX_ANGLE: 4095,
    table.MAX_TEMPERATURE: 70,
    table.MAX_VOLTAGE: 80,
    table.MIN_VOLTAGE: 40,
    table.MAX_TORQUE: FULL,
    table.PHASE: 12,
    table.UNLOAD: 44,
    table.ALARM: 47,  # errors that light the LED
    table.P: 32,
    table.D: 32,
    Register(24, 1): 16,  # least force to start
    Register(26, 1): 1,
    Register(27, 1): 1,  # dead zones
    table.PROTECTION_CURRENT: 500,
    Register(30, 1): 1,  # resolution
    Register(34, 1): 20,
    Register(35, 1): 200,
    Register(36, 1): 80,  # overload protection
    Register(37, 1): 10,
    Register(38, 1): 200,
    Register(39, 1): 10,
}
_HLS = {**_STS, table.MAX_TORQUE: 980, Register(34, 1): 0, Register(35, 1): 0, Register(36, 1): 0}
_DEFAULTS = {"scs": _SCS, "sts": _STS, "sms": _STS, "hls": _HLS}
"""Factory values on which sources agree."""


class FeetechMemory:
    """The registers of one servo.

    While it is locked, it accepts settings but does not store them; unlocked, it stores them, so
    that they survive a power cycle.

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
        """Set a register and store it; other settings do not change, stored or not."""
        self.set(register, value)
        at = slice(register.address, register.address + register.size)
        self._stored[at] = self._bytes[at]

    def power_cycle(self) -> None:
        """Restore the stored settings, set the lock, and clear all other registers."""
        self._bytes[:] = self._stored + bytes(END - RAM)
        self.set(self._family.lock, 1)

    def restore(self) -> None:
        """Restore the factory settings, except for model, id and baud rate."""
        kept = (table.MODEL, table.ID, table.BAUD_RATE)
        values = [(register, self.get(register)) for register in kept]
        fresh = FeetechMemory(self._family)
        self._bytes[:RAM] = fresh._bytes[:RAM]
        for register, value in values:
            self.set(register, value)
        self.store()

    def get(self, register: Register) -> int:
        """Return a register's value."""
        return self._family.unpack(register, self._bytes)

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


MIDDLE = 2048
"""Value of the present position after it was declared the middle [counts]."""
_MAKE_MIDDLE = 128  # value of the torque register that declares it
_FASTEST = {"scs": 1500.0, "sts": 3400.0, "sms": 3400.0, "hls": 3400.0}
"""No-load speed [counts/s]: that of published programs; no source gives a higher one."""
_FRICTION = 40.0  # load of a servo that moves freely [0.1 %]; no source gives it
_STIFFNESS = 2000.0  # load per position error [0.1 % per rad]; no source gives it
_SPEED_MODE = 1
_VOLTAGE_UNIT = 0.1  # V per count


class FeetechServoProperties(Section, frozen=True):
    """Properties of an emulated servo.

    Attributes:
        model: Its model number; 0: the first known of its family.
        start: Position at power-up [counts]; negative: in the middle.
        closing: Signed travel from `start` to closed, for objects [counts]; 0: a quarter turn.
        lower: Lower mechanical stop [counts].
        upper: Upper mechanical stop [counts].
        return_delay: Stored return delay [2 µs].
        level: Stored response level; at 0 it answers only reads.
        limits: Stored smallest and largest position [counts]; ``None``: from the factory.
        phase: Stored phase bits; ``None``: from the factory.
        offset: Stored position offset [counts].
        unload: Stored errors that disable the torque; ``None``: from the factory.
        voltage: Its supply voltage [V].
        reboot_time: Silence after a reboot [s].
        haste: Factor by which it moves faster than a real one.
    """

    model: int = 0
    start: float = -1.0
    closing: float = 0.0
    lower: float = -math.inf
    upper: float = math.inf
    return_delay: int = 0
    level: int = 1
    limits: tuple[int, int] | None = None
    phase: int | None = None
    offset: int = 0
    unload: int | None = None
    voltage: Positive = 6.0
    reboot_time: Duration = 0.8
    haste: Positive = 1.0


class EmulatedFeetech(EmulatedServo):
    """A servo's registers and its motor.

    Args:
        number: Its id.

    Attributes:
        axis: Its shaft, in counts of its encoder and 0.1 % of its largest torque.
    """

    ID = table.ID
    PENDING = table.PENDING
    MODEL = table.MODEL
    BAUD_RATE = table.BAUD_RATE
    RETURN_DELAY = table.RETURN_DELAY

    def __init__(self, family: Family, number: int, properties: FeetechServoProperties) -> None:
        self.properties = properties
        self._family = family
        self.memory = FeetechMemory(family)
        self.get, self.set, self.keep = self.memory.get, self.memory.set, self.memory.keep
        known = next(model for model, one in MODELS.items() if one.family == family.name)
        self.model = properties.model or known
        stored: dict[Register, int | None] = {
            table.FIRMWARE: int.from_bytes(b"\x03\x0a", family.order),
            table.MODEL: self.model,
            table.ID: number,
            table.RETURN_DELAY: properties.return_delay,
            table.RESPONSE_LEVEL: properties.level,
            table.PHASE: properties.phase,
            table.UNLOAD: properties.unload,
        }
        if properties.limits is not None:
            stored[table.MIN_ANGLE], stored[table.MAX_ANGLE] = properties.limits
        if family.offset is not None:
            stored[family.offset] = properties.offset
        for register, value in stored.items():
            if value is not None:
                self.set(register, value)
        self.memory.store()
        start = family.center if properties.start < 0.0 else properties.start
        opened = start + properties.offset
        quarter = 1.57 / family.rad_per_count
        self.travel = opened, opened + (properties.closing or quarter)
        self.axis = Axis(
            opened,
            lower=properties.lower,
            upper=properties.upper,
            max_effort=float(FULL),
            gain=_STIFFNESS * family.rad_per_count,
            friction=_FRICTION,
            resolution=0.5,
        )
        self._latched = Status(0)
        self._start()

    # --- registers -----------------------------------------------------------------------------

    @property
    def delay(self) -> float:
        """Time that it waits before it answers [s]; 0 for HLS, whose register is a second id."""
        return 0.0 if self._family.name == "hls" else super().delay

    @property
    def status(self) -> Status:
        """The errors in the status of every reply."""
        return Status(self.cause) | self._latched

    @property
    def position(self) -> int:
        """Reported present position [counts]."""
        position = round(self.axis.measured) - self._offset
        if self._turns:
            return position
        return min(max(position, 0), self._family.counts - 1)

    @property
    def _offset(self) -> int:
        return 0 if self._family.offset is None else self.get(self._family.offset)

    @property
    def _turns(self) -> bool:
        """Whether the servo counts turns and has no position limits."""
        return self.get(table.MIN_ANGLE) == self.get(table.MAX_ANGLE) == 0

    def read(self, address: int, size: int) -> bytes | None:
        """Return bytes of the table, or ``None`` beyond its end."""
        self._report()
        return self.memory.read(address, size)

    def write(self, address: int, data: bytes) -> None:
        """Write bytes as a host may, and act on them."""
        touched = range(address, address + len(data))
        self.memory.write(address, data)
        # Published clients reset an overload by writing the torque register.
        if table.TORQUE.address in touched:
            self._latched = Status(0)
            if self.get(table.TORQUE) == _MAKE_MIDDLE and self._family.offset is not None:
                self.make_present(MIDDLE)
        if table.GOAL_POSITION.address in touched and not self.get(table.TORQUE):
            # A goal enables the torque, which published programs never do separately.
            self.set(table.TORQUE, int(not self.status & self.get(table.UNLOAD)))
        self._act()

    def make_present(self, position: int) -> None:
        """Set the offset so that the present position becomes ``position``; disable the torque."""
        if self._family.offset is not None:
            self.memory.keep(self._family.offset, round(self.axis.position) - position)
        self.set(table.TORQUE, 0)
        self._act()

    # --- life ----------------------------------------------------------------------------------

    def reboot(self, now: float) -> None:
        """Restart without torque; values that are not stored are lost."""
        self.silent_until = now + self.properties.reboot_time
        self._pending = None
        self.memory.power_cycle()
        self._start()

    def _start(self) -> None:
        self._latched, self._strained = Status(0), None
        self.set(table.GOAL_POSITION, self.position)
        if self._family.limits_torque == "share":
            self.set(table.TORQUE_LIMIT, self.get(table.MAX_TORQUE))
        elif self._family.limits_torque == "current":
            self.set(table.GOAL_TIME, self.get(table.PROTECTION_CURRENT))
        self._act()

    def fail(self, error: Status) -> None:
        """Disable the torque if the unload mask contains the error."""
        if error & self.get(table.UNLOAD):
            self.set(table.TORQUE, 0)
        self._act()

    # --- motion --------------------------------------------------------------------------------

    def step(self, now: float) -> None:
        """Let time pass up to ``now`` [s]."""
        self.axis.step(now)
        if self.axis.temperature > self.get(table.MAX_TEMPERATURE):
            self._latched |= Status.OVERHEATING
            self.fail(Status.OVERHEATING)
        self._watch_load(now)

    def _watch_load(self, now: float) -> None:
        if self._family.protection is None or Status.OVERLOAD in self._latched:
            return
        _, lasting, most = map(self.get, self._family.protection)
        # Torques are in percent, the time in the register's unit.
        strained = abs(self.axis.effort) > most * FULL / 100 > 0
        if self.strained_for(strained, now) > lasting * self._family.torque_time:
            self._strained = None
            self._latched |= Status.OVERLOAD
            self.fail(Status.OVERLOAD)

    def _act(self) -> None:
        """Apply the registers to the shaft."""
        axis = self.axis
        axis.rating, axis.max_effort = float(FULL), float(self._strongest())
        axis.enabled = self.get(table.TORQUE) == 1 and axis.max_effort > _FRICTION
        unit = self._family.speed_unit(self.get(table.PHASE)) / self._family.rad_per_count
        asked = self.get(table.GOAL_SPEED)
        fastest = _FASTEST[self._family.name] * self.properties.haste
        axis.max_velocity = min(abs(asked) * unit, fastest) if asked else fastest
        if self._family.offset is not None and self.get(table.MODE) == _SPEED_MODE:
            # A target too far away to be reached, since only the speed counts.
            axis.target = math.copysign(1e9, asked) if asked else axis.position
        elif self._turns and self._family.offset is None:
            axis.target = axis.position  # a wheel without a target stands still
        else:
            goal = self.get(table.GOAL_POSITION)
            low, high = self.get(table.MIN_ANGLE), self.get(table.MAX_ANGLE)
            axis.target = float((min(max(goal, low), high) if low < high else goal) + self._offset)

    def _strongest(self) -> float:
        """Return the largest torque [0.1 %] that limits and protection allow."""
        most = float(self.get(table.MAX_TORQUE))
        if self._family.limits_torque == "share":
            most = min(most, float(self.get(table.TORQUE_LIMIT)))
        elif self._family.limits_torque == "current":
            current, full = self.get(table.GOAL_TIME), self.get(table.PROTECTION_CURRENT)
            most = min(current / full, 1.0) * FULL if full else 0.0
        if Status.OVERLOAD in self._latched and self._family.protection is not None:
            protective = self.get(self._family.protection[0])
            most = min(most, protective * FULL / 100)
        return most

    def _report(self) -> None:
        """Update the registers that report the state."""
        axis, family = self.axis, self._family
        unit = family.speed_unit(self.get(table.PHASE)) / family.rad_per_count
        self.set(table.PRESENT_POSITION, self.position)
        self.set(table.PRESENT_SPEED, round(axis.velocity / unit))
        self.set(table.PRESENT_LOAD, round(axis.effort))
        self.set(table.PRESENT_VOLTAGE, round(self.properties.voltage / _VOLTAGE_UNIT))
        self.set(table.PRESENT_TEMPERATURE, min(round(axis.temperature), 255))
        self.set(table.STATUS, self.status)
        self.set(table.MOVING, int(axis.moving))
        if family.has_current:
            full = self.get(table.PROTECTION_CURRENT)
            self.set(table.PRESENT_CURRENT, round(axis.effort / FULL * full))
