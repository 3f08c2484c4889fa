"""What a line of Dynamixels does every cycle: read all, write all, look after their health."""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from rtee.drivers.base import Driver
from rtee.drivers.dynamixel import setup, table
from rtee.drivers.dynamixel.link import DynamixelLink
from rtee.drivers.dynamixel.options import DynamixelOptions
from rtee.drivers.dynamixel.setup import Found
from rtee.drivers.dynamixel.units import Scale, Scales
from rtee.drivers.emulators import owner_of
from rtee.drivers.hold_on_attach import Attached
from rtee.drivers.options import read_options
from rtee.errors import ConfigError, DeviceFault, NotConnected
from rtee.types import ActuatorState, Capabilities, DeviceSpec, FloatArray, Reference

if TYPE_CHECKING:
    from rtee.buses.pool import BusPool

STATE = struct.Struct("<hii")
"""Current, velocity and position, side by side in the control table."""
_HEALTH = struct.Struct("<HB")
GAINS = {"p": table.POSITION_P, "i": table.POSITION_I, "d": table.POSITION_D}
"""Registers of the gains that can be tuned."""


class DynamixelCycle(Driver):
    """What happens every cycle: one group read, one group write.

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
        self._units = Scales(self._ids, self.scales)
        self._link: DynamixelLink | None = None
        self._found: dict[int, Found] = {}
        self._active = False
        self._count = 0
        self._temperature = np.full(len(names), math.nan)
        self._extras: Mapping[str, FloatArray] = {}
        self._sent: dict[str, dict[int, int]] = {}
        self._settled: tuple[list[float], list[float], list[bool]] | None = None
        self._attached = Attached(spec.actuators)
        self._here: FloatArray = np.full(len(names), math.nan)
        self.capabilities = Capabilities(
            measures=frozenset({"position", "velocity", "current", "temperature"}),
            accepts=frozenset({"position", "max_velocity"}),
            best_rate=self._best_rate(fast=self.options.fast != "never"),
            watchdog=self.options.watchdog > 0.0,
            recoverable=True,
            gains=tuple(GAINS),
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
        position, velocity, effort, current = self._units.measured(data)
        self._here = position
        return ActuatorState.measured(
            position,
            stamp,
            velocity=velocity,
            effort=effort,
            current=current,
            temperature=self._temperature.copy(),
            extras=self._extras,
        )

    def _look_after(self) -> None:
        """Read voltages and temperatures; see that torque is on and no watchdog has tripped."""
        link = self._line
        health, _ = link.read_group(table.HEALTH, table.HEALTH_SIZE)
        read = np.array([_HEALTH.unpack(health[n]) for n in self._ids], dtype=np.float64)
        self._extras = {"voltage": read[:, 0] * 0.1}
        self._temperature = read[:, 1]
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
        mask = reference.mask.tolist()
        asked = reference.max_effort.tolist(), reference.max_velocity.tolist(), mask
        if asked != self._settled:
            self._settled = None
            self._write_limits(*asked)
            self._settled = asked
        if self._attached:
            left = self._attached.left(reference, self._here)
            mask = [asked_for and i not in left for i, asked_for in enumerate(mask)]
        pulses = self._units.pulses(reference.position)
        goals = {n: p for n, p, asked_for in zip(self._ids, pulses, mask, strict=True) if asked_for}
        self._line.write_group(table.GOAL_POSITION, goals)

    def _write_limits(
        self, efforts: list[float], velocities: list[float], mask: list[bool]
    ) -> None:
        """Write limits of current and speed that have changed."""
        currents: dict[int, int] = {}
        speeds: dict[int, int] = {}
        most = self._most_current()
        limited = "max_effort" in self.capabilities.accepts
        for number, scale, commanded, effort, velocity in zip(
            self._ids, self.scales, mask, efforts, velocities, strict=True
        ):
            if not commanded:
                continue
            if limited:
                wanted = scale.to_current_counts(effort) if math.isfinite(effort) else most[number]
                currents[number] = min(wanted, most[number])
            # A profile velocity of 0 means none at all.
            speeds[number] = scale.to_speed_counts(velocity) if math.isfinite(velocity) else 0
        if self.options.mode == "current_based_position":
            self._write_changed("current", table.GOAL_CURRENT, currents)
        if not any(f.drive_mode & 0x04 for f in self._found.values()):
            self._write_changed("speed", table.PROFILE_VELOCITY, speeds)

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
                link.write_group(GAINS[name], dict.fromkeys(self._ids, count))

        await link.run(write)

    def _most_current(self) -> dict[int, int]:
        most = {}
        for servo, scale in zip(self._servos, self.scales, strict=True):
            limit = self._found[servo.id].current_limit
            wanted = servo.current or self.options.current
            if wanted is not None and math.isfinite(scale.current_unit):
                limit = min(limit, round(wanted / scale.current_unit))
            most[servo.id] = limit
        return most

    async def close(self) -> None:
        """Give the line back; servos with torque keep it."""
        link, self._link = self._link, None
        self._active = False
        if link is not None:
            await link.bus.detach(owner_of(self.spec))

    def counters(self) -> Mapping[str, int]:
        """Return the counters of the line."""
        return {} if self._link is None else self._link.bus.counters.as_mapping()
