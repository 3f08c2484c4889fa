"""Drives hands of Dynamixel X servos: any number on one line, one read and one write per cycle."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Collection, Mapping, Sequence
from enum import IntFlag
from functools import partial
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from msgspec import Meta

from rtee import monotonic
from rtee.buses.pool import BusPool
from rtee.buses.retry import heard
from rtee.drivers.dynamixel import table
from rtee.drivers.dynamixel.codec import ALERT, Hardware
from rtee.drivers.dynamixel.link import DynamixelLink
from rtee.drivers.options import Current, Moment, Positive
from rtee.drivers.servo_lines import DELAY_UNIT, LineOptions, ServoOptions, ServoScale, check_line
from rtee.drivers.servos import FoundServo, Goals, Readings, ServoCoupling, ServoDriver
from rtee.drivers.wiring import check_names
from rtee.errors import BusError, ConfigError
from rtee.sample import FloatArray
from rtee.types import ActuatorSpec, DeviceSpec


class DynamixelServo(ServoOptions, frozen=True, kw_only=True):
    """Options of one servo.

    Attributes:
        zero: Its position at 0 rad of the joint [pulse], within one turn.
        drive_mode: Expected drive mode; a servo with another one is refused.
        current: Largest current [A]; by default that of the line.
        current_unit: Current per count [A]; by default that of the model.
    """

    id: Annotated[int, Meta(ge=0, le=252)]
    zero: Annotated[float, Meta(ge=0, lt=table.PULSES)] | None = None
    drive_mode: int = 0
    current: Current | None = None
    current_unit: Positive | None = None


class DynamixelOptions(LineOptions, frozen=True, kw_only=True):
    """Options of a line of Dynamixel servos."""

    baudrate: int = 4_000_000
    """Rate of the line [baud]."""
    servos: dict[str, DynamixelServo]
    """The servo of each actuator, by the actuator's name."""
    mode: Literal["current_based_position", "extended_position", "position"] = (
        "current_based_position"
    )
    """Operating mode."""
    current: Current | None = None
    """Largest current [A]; by default the servos' own limit."""
    fast: Literal["auto", "always", "never"] = "auto"
    """Whether to read with the fast sync read; ``auto`` tries it."""
    watchdog: Annotated[float, Meta(ge=0.0, le=2.54)] = 0.0
    """Servos stop after a silence of this length on the line [s]; 0: they hold."""
    health_every: Annotated[int, Meta(ge=1)] = 50
    """Number of exchanges between readings of temperature, voltage and torque."""
    reboot_time: Positive = 3.0
    """Longest time for a reboot [s]."""
    deadline: Moment = 0.03
    """Longest time for one exchange, retries included [s]."""

    def __post_init__(self) -> None:
        """Check that the options fit each other."""
        check_line(self, self.servos, table.BAUD_RATES, table.MOST_GAIN)


WATCHDOG_TRIPPED = 0x101
"""Code of the driver's own fault, above the eight bits of the hardware error status."""

_REBOOT_POLL = 0.1
"""Pause between two pings of rebooted servos [s]; a reboot takes about 0.4 s."""

_TRIPPED = -1
"""Value of a tripped bus watchdog (address 98)."""

_TIME_BASED = 0x04
"""Bit of the drive mode (address 10): the profile velocity is a time, not a speed limit."""

_STATE = np.dtype([("current", "<i2"), ("velocity", "<i4"), ("position", "<i4")])
"""The state registers, side by side in the control table."""

_HEALTH = np.dtype([("voltage", "<u2"), ("temperature", "u1")])
"""The health registers, side by side in the control table."""


class DynamixelDriver(ServoDriver[DynamixelLink]):
    """Dynamixel X servos on one line.

    A cycle is one group read of current, velocity and position, and one group write of goal
    positions. Current limits (from the effort limit) and profile velocities are written before the
    positions when they change. Hardware errors set the alert bit of every answer.

    Servos lose their turn count when their supply is cut: a joint whose range crosses the wrap is
    assumed to be in the turn that lies within its limits.
    """

    Options = DynamixelOptions
    options: DynamixelOptions
    TORQUE = table.TORQUE
    GOAL = table.GOAL_POSITION
    GAINS: ClassVar[Mapping[str, Any]] = {
        "p": table.POSITION_P,
        "i": table.POSITION_I,
        "d": table.POSITION_D,
    }
    MOST_GAIN = table.MOST_GAIN
    STORED = table.RAM
    # No source says whether the goal of a servo without torque follows the shaft. 16 pulses are
    # 1.4°, too little for a harmful jump.
    NEAR = 16
    FOLLOWS = (table.Mode.POSITION, table.Mode.EXTENDED_POSITION, table.Mode.CURRENT_BASED_POSITION)
    GOAL_POWERS = False
    HINT = "`rtee recover` reboots the servo"

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        options = self.options
        self.mode = table.Mode[options.mode.upper()]
        self._health: FloatArray = np.full((2, len(self.ids)), math.nan)
        self._sent: dict[table.Register, dict[int, int]] = {}
        self._limits_sent: tuple[list[int], list[float], list[float]] | None = None
        self.refine(
            best_rate=self._best_rate(fast=options.fast != "never"),
            watchdog=options.watchdog > 0.0,
        )

    def _wired(
        self,
    ) -> tuple[Mapping[str, ServoOptions], tuple[float, float], ServoCoupling | None]:
        check_names(self.spec, "servos", self.options.servos)
        servos = {a.name: self.options.servos[a.name] for a in self.spec.actuators}
        return servos, (table.RAD_PER_PULSE, float(table.CENTER)), None

    def _best_rate(self, *, fast: bool) -> float:
        """Return the highest cycle rate that the line allows [Hz]."""
        n, size = len(self.spec.actuators), table.STATE_SIZE
        # Bytes of the read request, the answers (one packet, or one per servo), the write request.
        answer = 8 + n * (size + 4) if fast else n * (size + 11)
        count = 14 + n + answer + 14 + n * 5
        # A byte takes ten bits on the line: eight of data between a start and a stop bit.
        return 1.0 / (count * 10.0 / self.options.baudrate + self.options.turnaround)

    async def _connect(self) -> DynamixelLink:
        options = self.options
        self._sent, self._limits_sent = {}, None
        return await self.open(
            self.buses.dynamixel,
            options.port,
            lambda bus: DynamixelLink(
                bus, self.ids, options.deadline, options.retries, options.turnaround
            ),
            baudrate=options.baudrate,
        )

    # --- set-up ------------------------------------------------------------------------------

    def _model(self, number: int | None) -> str:
        return "unknown" if number is None else table.model_of(number).name

    def _check_model(self, name: str, servo: ServoOptions, model: int) -> None:
        if servo.model is None and model not in table.MODELS:
            raise self.stranger(
                f"an X-series servo as {servo.id} ({name})",
                f"model {model}",
                hint="if it has the same control table, configure 'model'",
            )

    def _as_found(self, number: int, stored: bytes, powered: bool) -> FoundServo:
        def get(register: table.Register) -> int:
            return register.unpack(stored[register.address :])

        # Only in this mode does a servo refuse goals beyond its limits. A stop may meet servos that
        # another program has powered in another one, where a goal at the limits would move them.
        has = get(table.OPERATING_MODE)
        limited = table.Mode.POSITION in ((has,) if powered else (self.mode, has))
        return FoundServo(
            number,
            get(table.MODEL),
            str(get(table.FIRMWARE)),
            get(table.DRIVE_MODE),
            get(table.HOMING_OFFSET),
            get(table.OPERATING_MODE),
            get(table.RETURN_DELAY),
            (get(table.MIN_POSITION), get(table.MAX_POSITION)) if limited else (0, 0),
            get(table.CURRENT_LIMIT),
            powered,
        )

    def _check_found(self, name: str, found: FoundServo) -> None:
        expected = self.options.servos[name].drive_mode
        if found.drive_mode & table.REVERSE != expected & table.REVERSE:
            raise self.stranger(
                f"servo {found.id} ({name}) with drive mode {expected}",
                f"drive mode {found.drive_mode}",
                hint="its sense of rotation is reversed; set it back, or configure 'drive_mode'",
            )

    def _adopt(self, servo: ServoOptions, found: FoundServo, scale: ServoScale) -> None:
        # In a group read the servos answer one after the other, so their delays add up.
        self.link.delay = DELAY_UNIT * sum(s.return_delay for s in self.found.values())
        model = table.model_of(found.model)
        given = self.options.servos[self.names[servo.id]].current_unit
        scale.current_unit = given or model.current_unit
        scale.speed_unit = table.VELOCITY_UNIT
        per_ampere = servo.torque_per_ampere or model.torque_per_ampere
        scale.effort_unit = scale.limit_unit = scale.current_unit * per_ampere * scale.gear

    async def _place(self) -> None:
        link = self.link
        if link.fast is None:
            link.fast = self.options.fast != "never"
            try:
                await self._readings()
            except BusError:
                if self.options.fast != "auto":
                    raise
                # Older firmware does not support it and does not answer.
                link.fast = False
        readings = await self._readings()
        for scale, actuator, position in zip(
            self.scales, self.spec.actuators, readings.columns[0].tolist(), strict=True
        ):
            lower, upper = self._turn(actuator, scale)
            scale.unwrap(position, lower, upper)
        self._use_scales()
        # Already here, since the turn was derived from the limits.
        self._check_places(readings)

    def _turn(self, actuator: ActuatorSpec, scale: ServoScale) -> tuple[float, float]:
        """Return the positions between which a measured one must lie [rad]."""
        ends = self.spec.mechanism(actuator)
        # A mechanism of more than a turn of the servo has two places with one reading: there,
        # hand.yaml says in which turn the joint is.
        if ends.upper - ends.lower >= table.PULSES * abs(scale.rad):
            return actuator.lower, actuator.upper
        return ends.lower, ends.upper

    def _check_range(self, number: int, ends: Sequence[float]) -> None:
        if self.mode is table.Mode.POSITION and not all(0 <= end < table.PULSES for end in ends):
            raise ConfigError(
                f"device '{self.spec.name}': the range of '{self.names[number]}' crosses the turn "
                "of its servo; use mode 'extended_position' or 'current_based_position'"
            )

    def _described(self) -> tuple[float, str]:
        fast = bool(self.link.fast)
        return self._best_rate(fast=fast), "fast sync read" if fast else "sync read"

    def _refuses_effort(self) -> str:
        known = all(math.isfinite(scale.limit_unit) for scale in self.scales)
        if known and self.mode is table.Mode.CURRENT_BASED_POSITION:
            return ""
        return "'mode: current_based_position' in its options takes one"

    async def _prepare(self, off: Sequence[int]) -> None:
        link, delay = self.link, self.options.return_delay
        found = [self.found[number] for number in off]
        # By group writes that are read back: a servo may be set to answer nothing but reads. Only
        # where they differ, since EEPROM wears out. The mode before gains and goals: a servo that
        # changes its mode resets its goals.
        await self._set(
            table.OPERATING_MODE, {s.id: int(self.mode) for s in found if s.mode != self.mode}
        )
        if delay is not None:
            # The factory setting is 0.5 ms, with which 16 servos delay every read by 8 ms.
            slow = {s.id: delay for s in found if s.return_delay != delay}
            await self._set(table.RETURN_DELAY, slow)
        # Until it is cleared, a watchdog that has tripped refuses all of the following.
        await self._set(table.BUS_WATCHDOG, dict.fromkeys(off, 0))
        # Another program may have left the motors weak, or slow. Not an error if a servo keeps
        # other values, or does not return these: it can be driven.
        await link.set_all(table.GOAL_PWM, await link.values(table.PWM_LIMIT, off))
        for register in (table.PROFILE_ACCELERATION, table.PROFILE_VELOCITY):
            await link.set_all(register, dict.fromkeys(off, 0))
        await self._set_gains(off)
        if self.mode is table.Mode.CURRENT_BASED_POSITION:
            most = {n: self._most(i) for i, n in enumerate(self.ids) if n in off}
            await self._set(table.GOAL_CURRENT, most)

    async def _arm(self) -> Collection[int]:
        """Set all bus watchdogs; return the servos whose tripped watchdog was cleared."""
        guards = await self.link.values(table.BUS_WATCHDOG, self.ids)
        # 0 clears a watchdog that has tripped; any other value is refused until then.
        await self._set(table.BUS_WATCHDOG, dict.fromkeys(self.ids, 0))
        if self.options.watchdog > 0.0:
            count = min(max(round(self.options.watchdog / table.WATCHDOG_UNIT), 1), 127)
            await self._set(table.BUS_WATCHDOG, dict.fromkeys(self.ids, count))
        # Limits written before a power cycle are lost.
        self._sent, self._limits_sent = {}, None
        # After clearing a tripped watchdog, a servo must not move to its old goal.
        return {n for n, guard in guards.items() if guard == _TRIPPED}

    # --- every cycle -------------------------------------------------------------------------

    async def _readings(self) -> Readings:
        link = self.link
        data, errors = await link.run(partial(link.read_group, table.STATE, table.STATE_SIZE, None))
        state = np.frombuffer(b"".join([data[number] for number in self.ids]), _STATE)
        columns = np.empty((6, len(self.ids)))
        columns[0], columns[1] = state["position"], state["velocity"]
        columns[2] = columns[3] = state["current"]
        columns[4:] = self._health
        return Readings(columns, errors)

    async def _errors(self, errors: Mapping[int, int]) -> Mapping[int, IntFlag]:
        # The alert bit shows that there is an error; this register shows which.
        alerted = [number for number, error in errors.items() if error & ALERT]
        link = self.link
        return {
            number: Hardware((await link.values(table.HARDWARE_ERROR, [number]))[number])
            for number in alerted
        }

    async def _watch(self) -> None:
        """Read voltages and temperatures at intervals, since they change slowly; check the torque.

        Raises `DeviceFault` if torque is off, or a watchdog has tripped.
        """
        if self._count % self.options.health_every:
            return
        link = self.link
        data, _ = await link.run(partial(link.read_group, table.HEALTH, table.HEALTH_SIZE, None))
        health = np.frombuffer(b"".join([data[number] for number in self.ids]), _HEALTH)
        self._health = np.array([health["temperature"], health["voltage"]], dtype=np.float64)
        if not self.active:
            return
        # Servos do not answer a group write, so limits are written again from time to time.
        self._sent, self._limits_sent = {}, None
        # The watchdog first, as it explains why a servo does not follow.
        if self.options.watchdog > 0.0:
            guards = await link.values(table.BUS_WATCHDOG, self.ids)
            tripped = [n for n, guard in guards.items() if guard == _TRIPPED]
            if tripped:
                raise self._lost(tripped, "watchdog tripped", WATCHDOG_TRIPPED)
        torque = await link.values(table.TORQUE, self.ids)
        lost = [n for n, powered in torque.items() if not powered]
        if lost:
            await self._refuse(await self._readings())
            raise self._lost(lost)

    def _most(self, i: int) -> int:
        """Return the largest current of a servo [counts]: its limit, or a smaller option."""
        number, unit = self.ids[i], self.scales[i].current_unit
        limit = self.found[number].most
        wanted = self.options.servos[self.names[number]].current or self.options.current
        if wanted is None or not math.isfinite(unit):
            return limit
        return min(limit, round(wanted / unit))

    async def _write(self, goals: Goals) -> None:
        link = self.link
        limits = goals.chosen, goals.rates, goals.efforts
        changed = {} if limits == self._limits_sent else self._changed_limits(goals)
        positions = {self.ids[i]: goals.positions[i] for i in goals.chosen}

        def write() -> None:
            for register, values in changed.items():
                link.write_group(register, values)
                # Stored after the write, so that a failed write is repeated.
                self._sent.setdefault(register, {}).update(values)
            link.write_group(table.GOAL_POSITION, positions)

        self._limits_sent = None
        await link.run(write)
        self._limits_sent = limits

    def _changed_limits(self, goals: Goals) -> dict[table.Register, dict[int, int]]:
        """Return the current and speed limits that differ from those sent last."""
        wanted: dict[table.Register, dict[int, int]] = {}
        if not self._refuses_effort():
            wanted[table.GOAL_CURRENT] = {
                self.ids[i]: min(
                    self.scales[i].to_limit(goals.efforts[i])
                    if math.isfinite(goals.efforts[i])
                    else self._most(i),
                    self._most(i),
                )
                for i in goals.chosen
            }
        if not any(found.drive_mode & _TIME_BASED for found in self.found.values()):
            wanted[table.PROFILE_VELOCITY] = {
                # A profile velocity of 0 means no limit.
                self.ids[i]: self.scales[i].to_speed(goals.rates[i])
                if math.isfinite(goals.rates[i])
                else 0
                for i in goals.chosen
            }
        changed = {
            register: {n: v for n, v in values.items() if self._sent.get(register, {}).get(n) != v}
            for register, values in wanted.items()
        }
        return {register: values for register, values in changed.items() if values}

    # --- faults ------------------------------------------------------------------------------

    async def recover(self) -> None:
        """Reboot the servos with a hardware error; they are powered again by `activate`.

        Powered servos in a mode that does not stop at a goal lose their torque.
        """
        link, self.active = self.link, False
        with link.relaxed_deadline():
            broken = []
            for number in self.ids:
                there = await heard(link.values(table.HARDWARE_ERROR, [number]))
                if there is None or there[number]:
                    broken.append(number)
                    await link.run(partial(link.reboot, number))
            # A servo is silent until its reboot is done.
            end = monotonic.now() + self.options.reboot_time
            while broken:
                await asyncio.sleep(_REBOOT_POLL)
                broken = [n for n in broken if await link.model(n) is None]
                if broken and monotonic.now() > end:
                    raise self._lost(broken, "silent after its reboot")
            await self.find()
            await self._refuse(await self._readings())
            powered = (n for n, servo in self.found.items() if servo.powered)
            await self._release(self._misled(powered))

    def _zero(self, position: float) -> float:
        return position % table.PULSES
