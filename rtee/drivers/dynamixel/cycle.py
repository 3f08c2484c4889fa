"""The cycle of Dynamixel servos on one line: read all, write all, watch their health."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from rtee import monotonic
from rtee.buses.dynamixel import DynamixelBus
from rtee.drivers.dynamixel import setup, table
from rtee.drivers.dynamixel.link import DynamixelLink
from rtee.drivers.dynamixel.options import DynamixelOptions
from rtee.drivers.dynamixel.setup import Found
from rtee.drivers.dynamixel.table import model_of
from rtee.drivers.dynamixel.units import Scale, Scales
from rtee.drivers.hold_on_attach import Attached
from rtee.drivers.standstill import Standstill
from rtee.errors import CalibrationError, ConfigError, DeviceFault
from rtee.sample import ActuatorState, FloatArray
from rtee.types import DeviceSpec, Reference

_STATE = struct.Struct("<hii")
"""Present current, velocity and position, side by side in the control table."""

_HEALTH = struct.Struct("<HB")
"""Present input voltage [0.1 V] and temperature [°C], side by side in the control table."""

_TRIPPED = 0xFF
"""Value of a tripped bus watchdog (address 98): -1 as a byte."""

_TIME_BASED = 0x04
"""Bit of the drive mode (address 10): the profile velocity is a time, not a speed limit."""


class ServoCycle:
    """Reads and writes the servos of a device; every method runs in the worker thread.

    Args:
        spec: The device.
        bus: The line.

    Attributes:
        link: Group reads and writes on the line.
        names: The actuator of each servo, by id, in the order of the actuators.
        scales: Units of the joints, in the order of the actuators.
        found: The registers of the servos as found, by id.
        active: Whether the servos must have torque.
    """

    def __init__(self, spec: DeviceSpec, options: DynamixelOptions, bus: DynamixelBus) -> None:
        ids = [options.servos[a.name].id for a in spec.actuators]
        self.link = DynamixelLink(bus, ids, options.deadline, options.retries, options.turnaround)
        self._device = spec.name
        self._options = options
        self._actuators = spec.actuators
        self._servos = [options.servos[a.name] for a in spec.actuators]
        self.names = dict(zip(ids, (a.name for a in spec.actuators), strict=True))
        self.scales = [Scale(s.zero, s.direction, s.gear) for s in self._servos]
        self.found: dict[int, Found] = {}
        self.active = False
        self._units = Scales(ids, self.scales)
        self._count = 0
        self._temperature = np.full(len(self._servos), math.nan)
        self._extras: Mapping[str, FloatArray] = {}
        self._sent: dict[table.Register, dict[int, int]] = {}
        self._limits: tuple[list[float], list[float], list[bool]] | None = None
        self._attached = Attached(spec.actuators)
        self._measured: FloatArray = np.full(len(self._servos), math.nan)

    # --- set-up ------------------------------------------------------------------------------

    def find(self) -> None:
        """Find all servos and adopt the units of their models; raises as `setup.find`."""
        named = {name: self._options.servos[name] for name in self.names.values()}
        self.found = setup.find(self.link, self._device, named, self._options.port)
        # In a group read the servos answer one after the other, so their delays add up; the
        # register counts in units of 2 µs.
        self.link.delay = sum(found.return_delay for found in self.found.values()) * 2e-6
        for servo, scale in zip(self._servos, self.scales, strict=True):
            model = model_of(self.found[servo.id].model)
            scale.current_unit = servo.current_unit or model.current_unit
            scale.torque_per_ampere = servo.torque_per_ampere or model.torque_per_ampere

    def unwrap(self) -> None:
        """Determine the turn of each joint; see `Scale.unwrap`.

        Raises:
            CalibrationError: if a joint is far outside its limits.
            ConfigError: if its range crosses a turn, which the operating mode excludes.
            BusError: if the line fails.
        """
        positions = self.positions()
        for number, scale, actuator in zip(
            self.link.ids, self.scales, self._actuators, strict=True
        ):
            pulses = positions[number]
            outside = scale.unwrap(pulses, actuator.lower, actuator.upper)
            if outside > self._options.outside:
                raise CalibrationError(
                    self._device,
                    f"servo {number} ({actuator.name}) reads {scale.to_rad(pulses):.2f} rad, "
                    f"{outside:.2f} rad outside its limits; its zero or direction is wrong, or "
                    "two ids are swapped",
                )
            ends = [scale.to_pulses(a) for a in (actuator.lower, actuator.upper)]
            if self._options.mode == "position" and not all(0 <= e < table.PULSES for e in ends):
                raise ConfigError(
                    f"device '{self._device}': the range of '{actuator.name}' crosses the turn "
                    "of its servo; use mode 'extended_position' or 'current_based_position'"
                )
        # `Scales` has copies of the zeros and turns, so it is made again when they change.
        self._units = Scales(self.link.ids, self.scales)

    def set_zeros(self, angles: FloatArray) -> None:
        """Set the zeros so that the joints are at these angles [rad]; raises `BusError`."""
        positions = self.positions()
        for number, scale, angle in zip(self.link.ids, self.scales, angles, strict=True):
            # Without zero and turn, `to_pulses` converts the joint's angle alone.
            scale.zero, scale.turn = 0.0, 0
            pulses = positions[number]
            scale.zero = float((pulses - scale.to_pulses(float(angle))) % table.PULSES)
        self._units = Scales(self.link.ids, self.scales)

    def positions(self) -> dict[int, int]:
        """Return the servos' present positions [pulse], by id; raises `BusError`."""
        data, _ = self.link.read_group(table.STATE, table.STATE_SIZE)
        return {number: _STATE.unpack(data[number])[2] for number in self.link.ids}

    def power(self) -> None:
        """Set up the servos without torque and power them at their positions.

        Raises `DeviceFault` if one has a hardware error, and `BusError`.
        """
        link = self.link
        self.check()
        positions = self.positions()
        torque, _ = link.read_group(table.TORQUE.address, 1)
        # Servos with torque are not set up: writing some registers needs the torque off, which
        # would end a grip.
        off = {n: replace(self.found[n], torque=False) for n in link.ids if not torque[n][0]}
        at_rest = {n: positions[n] for n in off}
        setup.prepare(link, self._options, off, self._as_goals(at_rest), self._current_limits())
        guard, _ = link.read_group(table.BUS_WATCHDOG.address, 1)
        setup.arm(link, self._options.watchdog)
        # After clearing a tripped watchdog, a servo must not move to its old goal.
        tripped = {n: positions[n] for n in link.ids if guard[n][0] == _TRIPPED}
        link.write_confirmed(table.GOAL_POSITION, self._as_goals(tripped), within=setup.NEAR)
        # All others have got their own positions as goals, so they grip nothing.
        self._attached.begin(i for i, n in enumerate(link.ids) if n not in off and n not in tripped)
        # Limits written before a power cycle are lost.
        self._sent, self._limits = {}, None
        if off:
            # `prepare` may have changed return delays, and with them the time to wait for answers.
            self.find()

    # --- every cycle -------------------------------------------------------------------------

    def sense(self) -> ActuatorState:
        """Read current, velocity and position of all servos in one exchange.

        Raises:
            DeviceFault: if a servo that must have torque has none, or a hardware error.
            BusError: if the line fails.
        """
        count, self._count = self._count, self._count + 1
        # Seldom, since temperatures change slowly and each read takes a good part of a cycle.
        if count % self._options.health_every == 0:
            self._read_health()
        data, errors = self.link.read_group(table.STATE, table.STATE_SIZE)
        stamp = monotonic.now()
        if self.active:
            setup.refuse(self.link, self._device, self.names, errors)
        position, velocity, effort, current = self._units.measured(data)
        self._measured = position
        return ActuatorState.measured(
            position,
            stamp,
            velocity=velocity,
            effort=effort,
            current=current,
            # A copy, since each state needs new arrays and this one is read only now and then.
            temperature=self._temperature.copy(),
            extras=self._extras,
        )

    def _read_health(self) -> None:
        """Read voltages and temperatures; check that torque is on and no watchdog has tripped."""
        link = self.link
        health, _ = link.read_group(table.HEALTH, table.HEALTH_SIZE)
        read = np.array([_HEALTH.unpack(health[n]) for n in link.ids], dtype=np.float64)
        self._extras = {"voltage": read[:, 0] * 0.1}
        self._temperature = read[:, 1]
        if not self.active:
            return
        # Servos do not answer a group write, so limits are written again now and then.
        self._sent, self._limits = {}, None
        # The watchdog first, as it explains why a servo does not follow.
        if self._options.watchdog > 0.0:
            guard, _ = link.read_group(table.BUS_WATCHDOG.address, 1)
            tripped = [n for n in link.ids if guard[n][0] == _TRIPPED]
            if tripped:
                raise self.fault(setup.WATCHDOG_TRIPPED, "watchdog tripped", tripped)
        torque, errors = link.read_group(table.TORQUE.address, 1)
        setup.refuse(link, self._device, self.names, errors)
        lost = [n for n in link.ids if not torque[n][0]]
        if lost:
            raise self.fault(setup.TORQUE_LOST, "torque lost", lost)

    def check(self) -> None:
        """Raise the `DeviceFault` that the servos report, if any."""
        _, errors = self.link.read_group(table.STATE, table.STATE_SIZE)
        setup.refuse(self.link, self._device, self.names, errors)

    def fault(self, code: int, what: str, numbers: Iterable[int]) -> DeviceFault:
        """Return a fault of these servos."""
        named = ", ".join(f"{n} ({self.names[n]})" for n in numbers)
        return DeviceFault(
            self._device, code, f"{what}: servo {named}", hint="`rtee recover` powers it again"
        )

    def move(self, reference: Reference) -> None:
        """Write changed limits, then the goal positions; raises `BusError`."""
        mask = reference.mask.tolist()
        # Before the limits, since the limits of an actuator that holds an object are its grip.
        if self._attached:
            left = self._attached.left(reference, self._measured)
            mask = [commanded and i not in left for i, commanded in enumerate(mask)]
        limits = reference.max_effort.tolist(), reference.max_velocity.tolist(), mask
        if limits != self._limits:
            # Forgotten first, so that a failed write is repeated in the next cycle.
            self._limits = None
            self._write_limits(*limits)
            self._limits = limits
        pulses = self._units.pulses(reference.position)
        columns = zip(self.link.ids, pulses, mask, strict=True)
        self.link.write_group(table.GOAL_POSITION, {n: p for n, p, given in columns if given})

    def release(self) -> None:
        """Disable the torque, and check that it is off; raises `BusError`."""
        self.link.write_confirmed(table.TORQUE, dict.fromkeys(self.link.ids, 0))

    def hold(self, standstill: Standstill) -> None:
        """Make the present positions the goals; raises `BusError`."""
        # The new goals end every grip, so no actuator is left alone any more.
        self._attached.begin()
        goals = self.positions()
        joints = tuple(zip(self.link.ids, self.scales, strict=True))
        here = [scale.to_rad(goals[number]) for number, scale in joints]
        for i, position in standstill.instead(here).items():
            number, scale = joints[i]
            goals[number] = scale.to_pulses(position)
        self.link.write_confirmed(table.GOAL_POSITION, self._as_goals(goals))

    def _as_goals(self, positions: Mapping[int, int]) -> dict[int, int]:
        """Return positions [pulse] limited to the goals that the servos accept."""
        if self._options.mode != "position":
            return dict(positions)
        # A joint may rest a little outside the limits, where the servo would refuse the goal.
        return {
            n: min(max(at, self.found[n].lowest), self.found[n].highest)
            for n, at in positions.items()
        }

    @property
    def limits_effort(self) -> bool:
        """Whether effort limits can be sent as current limits, in this operating mode."""
        known = all(math.isfinite(scale.to_effort(1.0)) for scale in self.scales)
        return known and self._options.mode == "current_based_position"

    def _write_limits(
        self, efforts: list[float], velocities: list[float], mask: list[bool]
    ) -> None:
        """Write the current and speed limits that have changed."""
        currents: dict[int, int] = {}
        speeds: dict[int, int] = {}
        most, limited = self._current_limits(), self.limits_effort
        for number, scale, commanded, effort, velocity in zip(
            self.link.ids, self.scales, mask, efforts, velocities, strict=True
        ):
            if not commanded:
                continue
            if limited:
                wanted = scale.to_current_counts(effort) if math.isfinite(effort) else most[number]
                currents[number] = min(wanted, most[number])
            # A profile velocity of 0 means no limit.
            speeds[number] = scale.to_speed_counts(velocity) if math.isfinite(velocity) else 0
        self._write_changed(table.GOAL_CURRENT, currents)
        if not any(found.drive_mode & _TIME_BASED for found in self.found.values()):
            self._write_changed(table.PROFILE_VELOCITY, speeds)

    def _write_changed(self, register: table.Register, values: dict[int, int]) -> None:
        sent = self._sent.setdefault(register, {})
        changed = {n: v for n, v in values.items() if sent.get(n) != v}
        if changed:
            self.link.write_group(register, changed)
            # Not before the write, so that a failed one is repeated.
            sent.update(changed)

    def _current_limits(self) -> dict[int, int]:
        """Return the largest current of each servo [counts]: its limit, or a smaller option."""
        limits = {}
        for servo, scale in zip(self._servos, self.scales, strict=True):
            limit = self.found[servo.id].current_limit
            wanted = servo.current or self._options.current
            if wanted is not None and math.isfinite(scale.current_unit):
                limit = min(limit, round(wanted / scale.current_unit))
            limits[servo.id] = limit
        return limits
