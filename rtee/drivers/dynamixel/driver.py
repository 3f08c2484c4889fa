"""Drives hands of Dynamixel X servos: any number on one line, one read and one write per cycle."""

from __future__ import annotations

import asyncio
import contextlib
import math
import struct
import time
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from rtee.drivers.base import Driver
from rtee.drivers.dynamixel import setup, table
from rtee.drivers.dynamixel.calibration import (
    Calibrated,
    differences,
    read_calibration,
    write_calibration,
)
from rtee.drivers.dynamixel.emulator import DynamixelEmulator
from rtee.drivers.dynamixel.link import DynamixelLink
from rtee.drivers.dynamixel.options import DynamixelOptions
from rtee.drivers.dynamixel.setup import Found
from rtee.drivers.dynamixel.table import model_of
from rtee.drivers.dynamixel.units import Scale
from rtee.drivers.emulators import emulator_of, owner_of
from rtee.drivers.options import read_options
from rtee.errors import (
    BusError,
    CalibrationError,
    ConfigError,
    DeviceFault,
    NotConnected,
    RteeError,
)
from rtee.types import ActuatorState, Capabilities, DeviceSpec, FloatArray, Reference

if TYPE_CHECKING:
    from rtee.buses.pool import BusPool

_STATE = struct.Struct("<hii")
_HEALTH = struct.Struct("<HB")
_SLOW = 5.0
_GAINS = {"p": table.POSITION_P, "i": table.POSITION_I, "d": table.POSITION_D}


class DynamixelDriver(Driver):
    """Dynamixel X servos on one line.

    A cycle is one group read of current, velocity and position, and one group write of goal
    positions. Current limits (from the effort limit) and profile velocities are written before the
    positions when they change. Hardware errors show in the alert bit of every answer.

    Servos lose their turns with their supply: a joint whose range crosses the wrap is read in the
    turn in which it lies within its limits. Servos with torque are left as they are.

    Attributes:
        scales: Units of the joints, in the order of the actuators.
    """

    Options: ClassVar[type[DynamixelOptions]] = DynamixelOptions

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        self.options = read_options(DynamixelOptions, spec)
        names = [a.name for a in spec.actuators]
        if set(names) != set(self.options.servos):
            absent = sorted(set(names) ^ set(self.options.servos))
            raise ConfigError(
                f"device '{spec.name}': option 'servos' must name the device's actuators, each "
                f"once; these do not match: {', '.join(absent)}"
            )
        self._servos = [self.options.servos[name] for name in names]
        self._ids = [servo.id for servo in self._servos]
        self._names = dict(zip(self._ids, names, strict=True))
        self.scales = [Scale(s.zero, s.direction, s.gear) for s in self._servos]
        self._link: DynamixelLink | None = None
        self._found: dict[int, Found] = {}
        self._active = False
        self._count = 0
        self._temperature = np.full(len(names), math.nan)
        self._sent: dict[str, dict[int, int]] = {}
        self.capabilities = Capabilities(
            measures=frozenset({"position", "velocity", "current", "temperature"}),
            accepts=frozenset({"position", "max_velocity"}),
            best_rate=self._best_rate(fast=self.options.fast != "never"),
            watchdog=self.options.watchdog > 0.0,
            recoverable=True,
            gains=tuple(_GAINS),
        )

    def _best_rate(self, *, fast: bool) -> float:
        n, size = len(self._ids), table.STATE_SIZE
        answer = 8 + n * (size + 4) if fast else n * (size + 11)
        count = 14 + n + answer + 14 + n * 5
        return 1.0 / (count * 10.0 / self.options.baudrate + self.options.turnaround)

    @property
    def _line(self) -> DynamixelLink:
        if self._link is None:
            raise NotConnected(self.spec.name, "is not connected")
        return self._link

    # --- life --------------------------------------------------------------------------------

    async def configure(self) -> None:
        """Open the line and find every servo; writes nothing."""
        await self.close()
        options = self.options
        bus = await self.buses.dynamixel(
            options.port,
            owner=owner_of(self.spec),
            baudrate=options.baudrate,
            emulator=emulator_of(self.spec, DynamixelEmulator),
        )
        link = self._link = DynamixelLink(bus, self._ids, options.deadline, options.retries)
        named = {name: options.servos[name] for name in self._names.values()}
        self._found = await link.run(
            lambda: setup.find(link, self.spec.name, named, options.port), _SLOW
        )
        self._calibrate()
        self._scale()
        link.delay = sum(found.return_delay for found in self._found.values()) * 2e-6
        await link.run(self._try_fast, 1.0)
        self._describe()
        await self._unwrap()

    def _try_fast(self) -> None:
        link = self._line
        link.fast = self.options.fast != "never"
        if self.options.fast == "auto":
            try:
                link.read_group(table.STATE, table.STATE_SIZE)
            except BusError:
                link.fast = False

    def _calibrate(self) -> None:
        """Take the zeros of the calibration, if its servos are these; raises `CalibrationError`."""
        path = self.options.calibration
        if path is None:
            return
        stored = read_calibration(path, self.spec.name)
        for scale, now in zip(self.scales, self._as_calibrated(), strict=True):
            then = stored.get(now.actuator)
            if then is None:
                raise CalibrationError(self.spec.name, f"'{now.actuator}' is not calibrated")
            changed = differences(then, now)
            if changed:
                raise CalibrationError(
                    self.spec.name,
                    f"'{now.actuator}' is not as it was calibrated: {'; '.join(changed)}; "
                    "calibrate again, or set it back",
                )
            scale.zero = then.zero

    def _as_calibrated(self) -> list[Calibrated]:
        return [
            Calibrated(self._names[f.id], f.id, f.model, f.drive_mode, f.homing_offset, scale.zero)
            for f, scale in zip((self._found[n] for n in self._ids), self.scales, strict=True)
        ]

    def _scale(self) -> None:
        for servo, scale in zip(self._servos, self.scales, strict=True):
            model = model_of(self._found[servo.id].model)
            scale.current_unit = model.current_unit
            scale.torque_per_ampere = servo.torque_per_ampere or model.torque_per_ampere

    def _describe(self) -> None:
        found = self._found.values()
        counted: dict[str, int] = {}
        for servo in found:
            name = model_of(servo.model).name
            counted[name] = counted.get(name, 0) + 1
        accepts, measures = {"position", "max_velocity"}, {"position", "velocity", "temperature"}
        if all(math.isfinite(s.current_unit) for s in self.scales):
            measures.add("current")
        if all(math.isfinite(s.to_effort(1.0)) for s in self.scales):
            measures.add("effort")
            if self.options.mode == "current_based_position":
                accepts.add("max_effort")
        self.capabilities = replace(
            self.capabilities,
            measures=frozenset(measures),
            accepts=frozenset(accepts),
            best_rate=self._best_rate(fast=self._line.fast),
            identity={
                "model": ", ".join(f"{n} x {name}" for name, n in counted.items()),
                "firmware": ", ".join(sorted({str(s.firmware) for s in found})),
                "read": "fast sync read" if self._line.fast else "sync read",
            },
        )

    async def _unwrap(self) -> None:
        """Find the turn each joint is in.

        Raises:
            CalibrationError: if one stands where it cannot be.
        """
        data, _ = await self._line.run(lambda: self._line.read_group(table.STATE, table.STATE_SIZE))
        for number, scale, actuator in zip(
            self._ids, self.scales, self.spec.actuators, strict=True
        ):
            pulses = _STATE.unpack(data[number])[2]
            outside = scale.unwrap(pulses, actuator.lower, actuator.upper)
            if outside > self.options.outside:
                raise CalibrationError(
                    self.spec.name,
                    f"servo {number} ({actuator.name}) reads {scale.to_rad(pulses):.2f} rad, "
                    f"{outside:.2f} rad outside its limits; its zero or direction is wrong, or "
                    "two ids are swapped",
                )
            ends = [scale.to_pulses(a) for a in (actuator.lower, actuator.upper)]
            if self.options.mode == "position" and not all(0 <= e < table.PULSES for e in ends):
                raise ConfigError(
                    f"device '{self.spec.name}': the range of '{actuator.name}' crosses the turn "
                    "of its servo; use mode 'extended_position' or 'current_based_position'"
                )

    async def activate(self) -> None:
        """Set up and power the servos that are without torque, where they stand."""
        self._line.patient = True
        await self._unwrap()
        await self._line.run(self._power, _SLOW)
        self._line.patient = False
        self._active = True

    def _power(self) -> None:
        link = self._line
        state, errors = link.read_group(table.STATE, table.STATE_SIZE)
        setup.refuse(link, self.spec.name, self._names, errors)
        torque, _ = link.read_group(table.TORQUE.address, 1)
        off = {n: replace(self._found[n], torque=False) for n in self._ids if not torque[n][0]}
        positions = {n: _STATE.unpack(state[n])[2] for n in off}
        setup.prepare(link, self.options, off, positions, self._most_current())
        guard, _ = link.read_group(table.BUS_WATCHDOG.address, 1)
        setup.arm(link, self.options.watchdog)
        # What a servo does when a tripped watchdog is cleared must not depend on its old goal.
        tripped = {n: _STATE.unpack(state[n])[2] for n in self._ids if guard[n][0] == 0xFF}
        link.write_group(table.GOAL_POSITION, tripped)
        self._sent = {}
        if off:
            self._found = setup.find(
                link, self.spec.name, dict(self.options.servos), self.options.port
            )
            link.delay = sum(found.return_delay for found in self._found.values()) * 2e-6

    def _most_current(self) -> dict[int, int]:
        most = {}
        for servo, scale in zip(self._servos, self.scales, strict=True):
            limit = self._found[servo.id].current_limit
            wanted = servo.current or self.options.current
            if wanted is not None and math.isfinite(scale.current_unit):
                limit = min(limit, round(wanted / scale.current_unit))
            most[servo.id] = limit
        return most

    async def deactivate(self) -> None:
        """Take the torque away."""
        self._active = False
        if self._link is not None:
            link = self._link
            await link.run(lambda: link.write_group(table.TORQUE, dict.fromkeys(self._ids, 0)))

    async def close(self) -> None:
        """Give the line back; servos with torque keep it."""
        link, self._link = self._link, None
        self._active = False
        if link is not None:
            await link.bus.release(owner_of(self.spec))

    def counters(self) -> Mapping[str, int]:
        """Return the counters of the line."""
        return {} if self._link is None else self._link.bus.counters.as_mapping()

    # --- every cycle -------------------------------------------------------------------------

    async def sense(self) -> ActuatorState:
        """Return current, velocity and position of all servos, read at once."""
        self._count += 1
        return await self._line.run(self._sense)

    def _sense(self) -> ActuatorState:
        link = self._line
        if self._count % self.options.health_every == 1 or self.options.health_every == 1:
            self._look_after()
        data, errors = link.read_group(table.STATE, table.STATE_SIZE)
        stamp = time.monotonic()
        if self._active:
            setup.refuse(link, self.spec.name, self._names, errors)
        n = len(self._ids)
        position, velocity = np.empty(n), np.empty(n)
        effort, current = np.empty(n), np.empty(n)
        for i, (number, scale) in enumerate(zip(self._ids, self.scales, strict=True)):
            amount, speed, pulses = _STATE.unpack(data[number])
            position[i] = scale.to_rad(pulses)
            velocity[i] = scale.to_speed(speed)
            current[i] = scale.to_current(amount)
            effort[i] = scale.to_effort(amount)
        return ActuatorState.measured(
            position,
            stamp,
            velocity=velocity,
            effort=effort,
            current=current,
            temperature=self._temperature.copy(),
        )

    def _look_after(self) -> None:
        """Read temperatures, and see that no servo has lost its torque or tripped its watchdog."""
        link = self._line
        health, _ = link.read_group(table.HEALTH, table.HEALTH_SIZE)
        self._temperature = np.array([float(_HEALTH.unpack(health[n])[1]) for n in self._ids])
        if not self._active:
            return
        # The watchdog first: a tripped one explains a servo that does not follow.
        if self.options.watchdog > 0.0:
            guard, errors = link.read_group(table.BUS_WATCHDOG.address, 1)
            tripped = [n for n in self._ids if guard[n][0] == 0xFF]
            if tripped:
                raise self._fault(setup.WATCHDOG_TRIPPED, "watchdog tripped", tripped)
        torque, errors = link.read_group(table.TORQUE.address, 1)
        setup.refuse(link, self.spec.name, self._names, errors)
        lost = [n for n in self._ids if not torque[n][0]]
        if lost:
            raise self._fault(setup.TORQUE_LOST, "torque lost", lost)

    def _fault(self, code: int, what: str, numbers: list[int]) -> DeviceFault:
        named = ", ".join(f"{n} ({self._names[n]})" for n in numbers)
        return DeviceFault(
            self.spec.name, code, f"{what}: servo {named}", hint="`rtee recover` powers it again"
        )

    async def move(self, reference: Reference) -> None:
        """Write changed limits, then the goal positions."""
        await self._line.run(lambda: self._move(reference))

    def _move(self, reference: Reference) -> None:
        link = self._line
        goals: dict[int, int] = {}
        currents: dict[int, int] = {}
        speeds: dict[int, int] = {}
        most = self._most_current()
        limited = "max_effort" in self.capabilities.accepts
        for i, (number, scale) in enumerate(zip(self._ids, self.scales, strict=True)):
            if not reference.mask[i]:
                continue
            goals[number] = scale.to_pulses(float(reference.position[i]))
            effort, velocity = float(reference.max_effort[i]), float(reference.max_velocity[i])
            if limited:
                wanted = scale.to_current_counts(effort) if math.isfinite(effort) else most[number]
                currents[number] = min(wanted, most[number])
            # A profile velocity of 0 means none at all.
            speeds[number] = scale.to_speed_counts(velocity) if math.isfinite(velocity) else 0
        if self.options.mode == "current_based_position":
            self._write_changed("current", table.GOAL_CURRENT, currents)
        if not any(f.drive_mode & 0x04 for f in self._found.values()):
            self._write_changed("speed", table.PROFILE_VELOCITY, speeds)
        link.write_group(table.GOAL_POSITION, goals)

    def _write_changed(self, what: str, register: table.Register, values: dict[int, int]) -> None:
        sent = self._sent.setdefault(what, {})
        changed = {n: v for n, v in values.items() if sent.get(n) != v}
        if changed:
            self._line.write_group(register, changed)
            sent.update(changed)

    async def set_gains(self, gains: Mapping[str, float]) -> None:
        """Write gains of the position controllers of all servos."""
        link = self._line

        def write() -> None:
            for name, value in gains.items():
                count = min(max(round(value), 0), 16383)
                link.write_group(_GAINS[name], dict.fromkeys(self._ids, count))

        await link.run(write)

    # --- stop and faults ---------------------------------------------------------------------

    async def stop(self) -> None:
        """Hold the measured pose."""
        if self._link is None:
            return
        link = self._link

        def hold() -> None:
            data, _ = link.read_group(table.STATE, table.STATE_SIZE)
            goals = {n: _STATE.unpack(data[n])[2] for n in self._ids}
            link.write_group(table.GOAL_POSITION, goals)

        with contextlib.suppress(RteeError, OSError):
            await link.run(hold)

    async def release(self) -> None:
        """Take the torque away; the fingers go limp."""
        with contextlib.suppress(RteeError, OSError):
            await self.deactivate()

    async def recover(self) -> None:
        """Reboot the servos with a hardware error; they are powered again by `activate`."""
        link = self._line
        link.patient = True
        self._active = False
        broken = await link.run(lambda: setup.hurt(link), _SLOW)
        for number in broken:
            await link.run(lambda n=number: link.reboot(n), 1.0)  # type: ignore[misc]
        end = time.monotonic() + self.options.reboot_time
        while broken:
            await asyncio.sleep(0.1)
            broken = [n for n in broken if await link.run(lambda n=n: link.ping(n), 1.0) is None]  # type: ignore[misc]
            if broken and time.monotonic() > end:
                raise self._fault(setup.TORQUE_LOST, "silent after its reboot", broken)
        named = {name: self.options.servos[name] for name in self._names.values()}
        self._found = await link.run(
            lambda: setup.find(link, self.spec.name, named, self.options.port), _SLOW
        )
        _, errors = await link.run(lambda: link.read_group(table.STATE, table.STATE_SIZE), _SLOW)
        await link.run(lambda: setup.refuse(link, self.spec.name, self._names, errors), _SLOW)

    # --- calibration -------------------------------------------------------------------------

    async def calibrate(
        self, path: Path, rest: FloatArray, ready: Callable[[str], Awaitable[None]]
    ) -> list[Calibrated]:
        """Take the pose the hand is put into by hand for its rest posture, and store the zeros.

        Args:
            path: File to write.
            rest: Angles of the rest posture [rad], in the order of the actuators.
            ready: Called with what to do; returns when it is done.

        Raises:
            BusError: if the line fails.
            ConfigError: if the file cannot be written.
        """
        await self.deactivate()
        await ready("Put every joint into the rest posture; the servos are without torque.")
        data, _ = await self._line.run(lambda: self._line.read_group(table.STATE, table.STATE_SIZE))
        for number, scale, angle in zip(self._ids, self.scales, rest, strict=True):
            scale.zero, scale.turn = 0.0, 0
            pulses = _STATE.unpack(data[number])[2]
            scale.zero = float((pulses - scale.to_pulses(float(angle))) % table.PULSES)
        found = self._as_calibrated()
        write_calibration(path, found)
        return found
