"""The cycle of Feetech servos on one line: read all, set all."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from rtee import monotonic
from rtee.drivers.feetech import setup, table
from rtee.drivers.feetech.joints import Joints
from rtee.drivers.feetech.link import FeetechLink
from rtee.drivers.feetech.options import FeetechOptions
from rtee.drivers.feetech.setup import POWERED, Found
from rtee.drivers.feetech.table import DELAY_UNIT, FAMILIES, FULL, MODELS, State
from rtee.drivers.feetech.units import Measured, Scale, Scales
from rtee.drivers.hold_on_attach import Attached
from rtee.drivers.servo_lines import Calibrated
from rtee.errors import BusTimeout, CalibrationError, ConfigError, FrameError
from rtee.sample import ActuatorState, FloatArray
from rtee.types import DeviceSpec, Reference

_FASTER = 1.5
"""Speed limit of references without one [velocity limit of the actuators]: a servo that lags behind
its set-points has to be faster than they are."""

_QUICK = 30.0
"""Largest plausible speed of a servo [rad/s]: several times that of a free one."""
_ATTEMPTS = 4
"""Attempts to write goals to servos that are about to be powered."""

_JUMP = 0.1
"""Change of a servo's angle that is plausible at any speed [rad]: backlash, and a push."""


class ServoCycle:
    """Reads and sets the servos of a device.

    Args:
        spec: The device.

    Attributes:
        link: The line.
        family: The servos' family.
        joints: The map between servos and actuators.
        ids: Their ids, in the order of the actuators.
        names: Their names by id.
        together: Whether they are read by one request for all.
        found: Their registers as found, by id.
        scales: Their units, in the order of the actuators.
        attached: The actuators that keep what they held when the driver attached.
        active: Whether the servos must have torque.
    """

    def __init__(
        self, spec: DeviceSpec, options: FeetechOptions, joints: Joints, link: FeetechLink
    ) -> None:
        self.link = link
        self._device = spec.name
        self._options = options
        self._actuators = spec.actuators
        self.family = FAMILIES[options.family]
        self.joints = joints
        self._servos = [options.servos[name] for name in self.joints.names]
        self.ids = [servo.id for servo in self._servos]
        self.names = dict(zip(self.ids, self.joints.names, strict=True))
        self.together = len(self.ids) > 1 and (
            self.family.sync_read if options.read == "auto" else options.read == "sync"
        )
        self.found: dict[int, Found] = {}
        self.scales = [
            Scale(
                self.family,
                float(self.family.center if servo.zero is None else servo.zero),
                servo.direction,
                servo.gear,
            )
            for servo in self._servos
        ]
        self.attached = Attached(spec.actuators)
        self.active = False
        self._count = 0
        self._silent = False
        n = len(spec.actuators)
        self._angles: FloatArray = np.full(n, math.nan)
        self._goal: FloatArray = np.full(n, math.nan)
        self._fastest = np.array([_FASTER * a.velocity for a in spec.actuators])
        self._warnings: tuple[str, ...] = ()
        self._seen: tuple[float, list[int]] | None = None
        self._doubted: list[int] = []

    # --- set-up ------------------------------------------------------------------------------

    async def find(self) -> None:
        """Find all servos and adopt the units of their models; raises as `setup.find`."""
        options = self._options
        named = dict(zip(self.joints.names, self._servos, strict=True))
        self.found = await setup.find(self.link, self.family, self._device, named, options.port)
        # That of the slowest servo, since the deadline is the same for all.
        self.link.delay = max(servo.return_delay for servo in self.found.values()) * DELAY_UNIT
        for servo, scale in zip(self._servos, self.scales, strict=True):
            found = self.found[servo.id]
            model = MODELS.get(found.model)
            known = math.nan if model is None else model.stall_torque
            scale.stall_torque = servo.stall_torque or options.stall_torque or known
            by_current = servo.torque_per_ampere or options.torque_per_ampere
            scale.torque_per_ampere = by_current or math.nan
            scale.speed_unit = self.family.speed_unit(found.phase)
        self.use_scales()

    def use_scales(self) -> None:
        """Apply changes of the servos' units."""
        self._units = Scales(self.scales)

    def check(self, states: Sequence[State]) -> None:
        """Check that the servos' limits include their actuators' ranges, and their positions.

        Raises:
            CalibrationError: if an actuator is far outside its limits.
            ConfigError: if a servo's limits do not include the actuator's range.
            DeviceFault: if one reports a fault.
        """
        self.refuse(states)
        ends = self.joints.ends(self._actuators)
        for i, (number, name) in enumerate(self.names.items()):
            low, high = self.found[number].limits
            # A servo with the opposite sign swaps the ends.
            wanted = sorted(self.scales[i].to_counts(angle) for angle in ends[i])
            # A servo that counts turns has limits of 0 and goes anywhere.
            if low < high and not low <= wanted[0] <= wanted[1] <= high:
                raise ConfigError(
                    f"device '{self._device}': servo {number} ({name}) would have to go from "
                    f"{wanted[0]} to {wanted[1]}, but takes {low} to {high}; set its 'zero', or "
                    "tighten the limits of its actuator"
                )
        positions = self.joints.positions(self._units.measured(states).angle)
        for actuator, position in zip(self._actuators, positions.tolist(), strict=True):
            outside = max(actuator.lower - position, position - actuator.upper)
            if outside > self._options.outside:
                raise CalibrationError(
                    self._device,
                    f"'{actuator.name}' is at {position:.2f} rad, {outside:.2f} rad outside its "
                    "limits; a zero or direction is wrong, or two ids are swapped; `rtee "
                    "calibrate` finds the zeros",
                )

    async def power(self) -> None:
        """Set up the servos without torque and power them at their positions; see `check`.

        Raises `DriverError` if one does not accept a setting, and `BusError`.
        """
        # Again, since a power cycle in the meantime has reset the settings.
        await self.find()
        self.check(await self.states())
        off = {n: servo for n, servo in self.found.items() if not servo.powered}
        if off:
            await setup.prepare(self.link, self.family, self._device, self._options, off)
            # The settings have changed the registers, which limit the goals.
            await self.find()
            # Before the torque, since the servo would jump to an old goal.
            await self._aim_here(list(off))
            refused = await self.link.set_all(table.TORQUE, dict.fromkeys(off, POWERED))
            if refused:
                self.refuse(await self.states())
                # Only if no other fault explains it.
                raise setup.lost(self._device, self.names, list(refused))
        self._goal = self.joints.positions(self._take(await self.states()).angle)
        held = {i for i, number in enumerate(self.ids) if number not in off}
        for i, j in self.joints.pairs:
            # Both servos drive both actuators, so a pair holds only if both servos do.
            if not {i, j} <= held:
                held -= {i, j}
        self.attached.begin(held)
        # At the end: until here, missing torque is no fault.
        self.active = True

    # --- every cycle -------------------------------------------------------------------------

    async def states(self) -> list[State]:
        """Read the states of the servos, in the order of the actuators; raises `BusError`."""
        first, size = table.PRESENT_POSITION.address, self.family.state
        answers = await self.link.read_all(first, size, self.ids, together=self.together)
        return [State.from_bytes(self.family, answers[n].params, answers[n].code) for n in self.ids]

    def refuse(self, states: Sequence[State]) -> None:
        """Raise a `DeviceFault` if states report errors."""
        pairs = zip(self.ids, states, strict=True)
        setup.refuse(self._device, self.names, {number: state.status for number, state in pairs})

    def _take(self, states: Sequence[State]) -> Measured:
        measured = self._units.measured(states)
        self._angles = measured.angle
        return measured

    async def sense(self) -> ActuatorState:
        """Return the servos' measurements.

        Raises:
            DeviceFault: if one that must have torque has none or has restarted, or reports a fault.
            FrameError: if one reports an impossible position.
            BusError: if the line fails.
        """
        self._count += 1
        if self.active:
            await self._check_servos()
        try:
            states = await self.states()
        except BusTimeout:
            # Remembered for the next cycle, which looks for a power cycle.
            self._silent = True
            raise
        stamp = monotonic.now()
        self._believe(states, stamp)
        if self.active and any(state.status for state in states):
            # Read again, since a sum of bytes misses one damaged answer in fifty.
            self.refuse(await self.states())
        measured = self._take(states)
        velocity, effort = measured.rate, measured.torque
        current, temperature = measured.current, measured.temperature
        if self.joints.pairs:
            jacobian = self.joints.jacobian(measured.angle)
            # Power is the same on both sides, so efforts follow by the transpose.
            velocity = np.linalg.inv(jacobian) @ velocity
            effort = jacobian.T @ effort
            for i, j in self.joints.pairs:
                # Both servos drive both actuators, so the worse of the two counts for both.
                temperature[[i, j]] = max(temperature[i], temperature[j])
                current[[i, j]] = np.abs(current[[i, j]]).max()
        return ActuatorState.measured(
            self.joints.positions(measured.angle),
            stamp,
            velocity=velocity,
            effort=effort,
            current=current,
            temperature=temperature,
            extras={"voltage": measured.voltage},
            warnings=self._warnings,
        )

    async def _check_servos(self) -> None:
        """Check one servo in turn, or all after a silence; raises as `_check_servo`."""
        turn, rest = divmod(self._count, self._options.check_every)
        # One servo at a time: all together would take as long as a whole cycle.
        due = [self.ids[turn % len(self.ids)]] if rest == 0 else []
        # All after a silence, which may have been a power cycle.
        for number in self.ids if self._silent else due:
            await self._check_servo(number)
        self._silent = False

    async def _check_servo(self, number: int) -> None:
        """Check that a servo has its torque and its settings; raises `DeviceFault`, `BusError`."""
        # Twice, so that a damaged answer is not taken for a servo without torque.
        torque, marked = POWERED, True
        for _ in range(2):
            torque, marked = await setup.condition(self.link, self.family, number)
            # A servo that had no mark when it was found cannot lose it.
            marked = marked or not self.found[number].marked
            if torque == POWERED and marked:
                return
        if not torque:
            self.refuse(await self.states())
            raise setup.lost(self._device, self.names, [number])
        if not marked:
            raise setup.restarted(self._device, self.names, number)
        # Any other value comes from a frame that was damaged on its way.
        await self.link.set_all(table.TORQUE, {number: POWERED})

    async def restarted(self) -> list[int]:
        """Return the servos that have lost their settings by a power cycle; raises `BusError`."""
        expected = [number for number, servo in self.found.items() if servo.marked]
        return [
            number
            for number in expected
            if not (await setup.condition(self.link, self.family, number))[1]
        ]

    def _believe(self, states: Sequence[State], stamp: float) -> None:
        """Refuse positions that servos cannot have reached, unless they are reported twice.

        Raises `FrameError`: an answer must have been damaged in spite of its checksum.
        """
        reported, doubted = [state.position for state in states], self._doubted
        self._doubted = []
        if self._seen is not None:
            when, last = self._seen
            reach = (_JUMP + _QUICK * (stamp - when)) / self.family.rad_per_count
            pairs = zip(self.ids, reported, last, strict=True)
            jumped = [n for n, p, q in pairs if abs(p - q) > reach]
            again = bool(doubted) and all(
                abs(p - q) <= reach for p, q in zip(reported, doubted, strict=True)
            )
            if jumped and not again:
                self._doubted = reported
                numbers = ", ".join(str(n) for n in jumped)
                raise FrameError(
                    self._options.port,
                    f"servo {numbers} cannot have reached the position it reports",
                )
        # A jump that was reported twice is real.
        self._seen = stamp, reported

    async def move(self, reference: Reference) -> None:
        """Set positions, speeds and torque limits of the servos that a reference commands."""
        # A copy, since the reference belongs to the caller.
        mask = reference.mask.copy()
        if self.attached:
            here = self.joints.positions(self._angles)
            mask[list(self.attached.left(reference, here))] = False
        # Before the pairs are joined: an actuator without a reference keeps its goal.
        self._goal = np.where(mask, reference.position, self._goal)
        for i, j in self.joints.pairs:
            mask[[i, j]] = mask[i] or mask[j]
        if not mask.any():
            return
        angles = self.joints.servos(self._goal)
        self._warnings = self.joints.gave_way(self._goal, angles)
        # Absolute values, since in the worst case both actuators' motions add up in one servo.
        jacobian = np.abs(self.joints.jacobian(self._angles))
        limited = np.isfinite(reference.max_velocity)
        speeds = self._speeds(jacobian, np.where(limited, reference.max_velocity, self._fastest))
        torques = self._torques(reference.max_effort, jacobian)
        counts = self._units.counts(angles)
        places = np.flatnonzero(mask).tolist()
        await self._write({i: (counts[i], speeds[i], torques[i]) for i in places})

    async def _aim_here(self, numbers: Sequence[int]) -> None:
        """Hold, and read the goals back, since servos do not answer the frame."""
        for _ in range(_ATTEMPTS):
            sent = await self.hold(numbers)
            if sent == {n: await self.link.value(n, table.GOAL_POSITION) for n in sent}:
                return
        raise FrameError(self._options.port, "servos do not take where they are as their goals")

    async def hold(
        self,
        numbers: Sequence[int],
        instead: Callable[[Sequence[float]], Mapping[int, float]] = lambda _: {},
    ) -> dict[int, int]:
        """Make the present positions of servos their goals and return them; raises `BusError`.

        ``instead`` returns the actuators that hold another position, see `Standstill.instead`.
        """
        states = await self.states()
        angles = self._take(states).angle
        speeds = self._speeds(np.abs(self.joints.jacobian(angles)), self._fastest)
        most = self._most()
        chosen = [i for i, number in enumerate(self.ids) if number in numbers]
        # In the servos' counts: by the actuators' positions, a pair beyond its limit would move.
        counts = [state.position for state in states]
        goal = self.joints.positions(angles)
        if others := instead(goal.tolist()):
            goal[list(others)] = list(others.values())
            wanted = self._units.counts(self.joints.servos(goal))
            paired = {i for pair in self.joints.pairs if set(pair) & set(others) for i in pair}
            for i in {*others, *paired}:
                counts[i] = wanted[i]
        sent = await self._write({i: (counts[i], speeds[i], most[i]) for i in chosen})
        self._goal = goal
        return sent

    def _speeds(self, jacobian: FloatArray, velocities: FloatArray) -> list[int]:
        """Return the speed counts of the servos for velocities of the actuators."""
        rates = (jacobian @ velocities).tolist()
        return [scale.to_speed(rate) for scale, rate in zip(self.scales, rates, strict=True)]

    @property
    def limits_effort(self) -> bool:
        """Whether effort limits can be sent as torque limits."""
        if self.family.limits_torque == "share":
            return all(math.isfinite(scale.stall_torque) for scale in self.scales)
        by_current = all(math.isfinite(scale.torque_per_ampere) for scale in self.scales)
        return self.family.limits_torque == "current" and by_current

    def _torques(self, efforts: FloatArray, jacobian: FloatArray) -> list[int]:
        """Return the servos' torque limits [0.1 % or 6.5 mA] for effort limits of the actuators.

        Two servos with equal torques exert on an actuator that torque times the sum of its column;
        if both efforts of a pair are limited, the smaller torque counts.
        """
        most = self._most()
        if not self.limits_effort or not np.isfinite(efforts).any():
            return most
        limits = efforts / jacobian.sum(axis=0)
        for i, j in self.joints.pairs:
            limits[[i, j]] = min(limits[i], limits[j])
        return [
            min(scale.to_torque_counts(limit), largest) if math.isfinite(limit) else largest
            for scale, limit, largest in zip(self.scales, limits.tolist(), most, strict=True)
        ]

    def _most(self) -> list[int]:
        """Return the largest torque of each servo [0.1 % or 6.5 mA]."""
        share = 1.0 if self._options.torque is None else self._options.torque
        found = [self.found[number].most for number in self.ids]
        if self.family.limits_torque == "current":
            return [round(share * most) for most in found]
        return [min(most, round(share * FULL)) for most in found]

    @property
    def written(self) -> int:
        """Number of bytes written to each servo in a cycle, from the goal position on."""
        return 8 if self.family.limits_torque == "share" else 6

    async def _write(self, goals: Mapping[int, tuple[int, int, int]]) -> dict[int, int]:
        """Set position, speed and torque limit [counts] of servos; return positions by id."""
        family, data, sent = self.family, {}, {}
        by_current = family.limits_torque == "current"
        for i, (position, speed, torque) in goals.items():
            low, high = self.found[self.ids[i]].limits
            # Both limits are 0 in a servo that counts turns.
            if low < high:
                position = min(max(position, low), high)
            values = family.pack(table.GOAL_POSITION, position)
            # HLS servos have the goal torque in this register; in others it is a running time,
            # which only counts without a speed.
            values += family.pack(table.GOAL_TIME, torque if by_current else 0)
            values += family.pack(table.GOAL_SPEED, speed)
            if family.limits_torque == "share":
                values += family.pack(table.TORQUE_LIMIT, torque)
            data[self.ids[i]], sent[self.ids[i]] = values, position
        await self.link.write_all(table.GOAL_POSITION.address, data)
        return sent

    def calibrated(self) -> list[Calibrated]:
        """Return the servos with their present zeros."""
        servos = [self.found[number] for number in self.ids]
        return [
            Calibrated(name, s.id, s.model, s.phase & table.REVERSE, s.offset, scale.zero)
            for name, s, scale in zip(self.joints.names, servos, self.scales, strict=True)
        ]

    def set_zeros(self, states: Sequence[State], positions: FloatArray) -> None:
        """Set the zeros so that states are these positions of the actuators [rad]."""
        angles = self.joints.servos(positions).tolist()
        for scale, state, angle in zip(self.scales, states, angles, strict=True):
            scale.zero = state.position - angle / scale.rad
        self.use_scales()
