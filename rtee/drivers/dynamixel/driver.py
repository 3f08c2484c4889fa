"""Drives hands of Dynamixel X servos: any number on one line, one read and one write per cycle."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path

from rtee.buses.retry import patiently
from rtee.drivers.dynamixel import setup, table
from rtee.drivers.dynamixel.calibration import (
    Calibrated,
    differences,
    read_calibration,
    write_calibration,
)
from rtee.drivers.dynamixel.cycle import STATE, DynamixelCycle
from rtee.drivers.dynamixel.emulator import DynamixelEmulator
from rtee.drivers.dynamixel.link import DynamixelLink
from rtee.drivers.dynamixel.table import model_of
from rtee.drivers.dynamixel.units import Scales
from rtee.drivers.emulators import emulator_of, owner_of
from rtee.errors import (
    BusError,
    CalibrationError,
    ConfigError,
    RteeError,
)
from rtee.types import FloatArray

_SLOW = 5.0


class DynamixelDriver(DynamixelCycle):
    """Dynamixel X servos on one line.

    A cycle is one group read of current, velocity and position, and one group write of goal
    positions. Current limits (from the effort limit) and profile velocities are written before the
    positions when they change. Hardware errors show in the alert bit of every answer.

    Servos lose their turns with their supply: a joint whose range crosses the wrap is read in the
    turn in which it lies within its limits. Servos with torque are left as they are.

    Attributes:
        scales: Units of the joints, in the order of the actuators.
    """

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
        link = self._link = DynamixelLink(
            bus, self._ids, options.deadline, options.retries, options.turnaround
        )
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
            scale.current_unit = servo.current_unit or model.current_unit
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
            refuses=(
                {}
                if "max_effort" in accepts
                else {"max_effort": "'mode: current_based_position' in its options takes one"}
            ),
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
        data, _ = await self._line.run(
            lambda: self._line.read_group(table.STATE, table.STATE_SIZE), _SLOW
        )
        for number, scale, actuator in zip(
            self._ids, self.scales, self.spec.actuators, strict=True
        ):
            pulses = STATE.unpack(data[number])[2]
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
        self._units = Scales(self._ids, self.scales)

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
        positions = {n: STATE.unpack(state[n])[2] for n in off}
        setup.prepare(link, self.options, off, positions, self._most_current())
        guard, _ = link.read_group(table.BUS_WATCHDOG.address, 1)
        setup.arm(link, self.options.watchdog)
        # What a servo does when a tripped watchdog is cleared must not depend on its old goal.
        tripped = {n: STATE.unpack(state[n])[2] for n in self._ids if guard[n][0] == 0xFF}
        link.write_group(table.GOAL_POSITION, tripped)
        self._attached.begin(
            i for i, n in enumerate(self._ids) if n not in off and n not in tripped
        )
        self._sent, self._settled = {}, None
        if off:
            self._found = setup.find(
                link, self.spec.name, dict(self.options.servos), self.options.port
            )
            link.delay = sum(found.return_delay for found in self._found.values()) * 2e-6

    async def examine(self) -> str:
        """Raise the fault that the servos report."""
        link = self._line

        def look() -> None:
            _, errors = link.read_group(table.STATE, table.STATE_SIZE)
            setup.refuse(link, self.spec.name, self._names, errors)

        await link.run(look, _SLOW)
        return ""

    async def deactivate(self) -> None:
        """Take the torque away."""
        self._active = False
        if self._link is not None:
            link = self._link
            await link.run(lambda: link.write_group(table.TORQUE, dict.fromkeys(self._ids, 0)))

    # --- stop and faults ---------------------------------------------------------------------

    async def stop(self) -> None:
        """Hold the measured pose."""
        if self._link is None:
            return
        self._attached.begin()
        link = self._link

        def hold() -> None:
            data, _ = link.read_group(table.STATE, table.STATE_SIZE)
            goals = {n: STATE.unpack(data[n])[2] for n in self._ids}
            link.write_group(table.GOAL_POSITION, goals)

        with contextlib.suppress(RteeError, OSError):
            await patiently(lambda: link.run(hold))

    async def disable(self) -> None:
        """Take the torque away; the fingers go limp."""
        with contextlib.suppress(RteeError, OSError):
            await patiently(self.deactivate)

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
        data, _ = await self._line.run(
            lambda: self._line.read_group(table.STATE, table.STATE_SIZE), _SLOW
        )
        for number, scale, angle in zip(self._ids, self.scales, rest, strict=True):
            scale.zero, scale.turn = 0.0, 0
            pulses = STATE.unpack(data[number])[2]
            scale.zero = float((pulses - scale.to_pulses(float(angle))) % table.PULSES)
        self._units = Scales(self._ids, self.scales)
        found = self._as_calibrated()
        write_calibration(path, found)
        return found
