"""The engine of drivers of servos on a shared line: find, set up, power, read, command, stop.

A family of servos adds its link (`ServoLink`), its registers, the code to read measurements and
write goals, and the particulars of its set-up and faults.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Awaitable, Callable, Collection, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from enum import IntFlag
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import numpy as np
from msgspec import structs

from rtee import monotonic
from rtee.buses.pool import BusPool
from rtee.buses.retry import patiently
from rtee.drivers.base import Driver
from rtee.drivers.capabilities import Capabilities
from rtee.drivers.json_files import write_json
from rtee.drivers.servo_lines import (
    Calibrated,
    LineOptions,
    MeasuredServos,
    ServoOptions,
    ServoScale,
    ServoScales,
    check_present,
    fault_of,
    zeros_of,
)
from rtee.errors import CalibrationError, DeviceFault, DriverError, FrameError
from rtee.sample import ActuatorState, FloatArray
from rtee.types import DeviceSpec, Reference

TORQUE_LOST = 0x100
"""Fault code of the driver for lost torque, above the bits of the servos' errors."""

OTHER_MODE = 0x102
"""Fault code of the driver for servos that another program has powered in another mode."""

POWERED = 1
"""Value of the torque register that lets a servo drive."""

_ATTEMPTS = 4
"""Attempts to write values until the servos have them."""


class ServoLink(ABC):
    """The line of a device's servos. All methods raise `BusError`.

    Attributes:
        delay: Time that servos wait before they answer [s].
    """

    delay: float

    @abstractmethod
    def relaxed_deadline(self) -> AbstractContextManager[None]:
        """Let exchanges take longer, outside the cycle."""

    @abstractmethod
    async def model(self, number: int) -> int | None:
        """Return a servo's model number, or ``None`` if it does not answer."""

    @abstractmethod
    async def data(self, number: int, address: int, size: int) -> bytes:
        """Return bytes of a servo's registers."""

    @abstractmethod
    async def values(self, register: Any, numbers: Sequence[int]) -> dict[int, int]:
        """Return a register of several servos, by id."""

    @abstractmethod
    async def set_values(self, register: Any, values: Mapping[int, int]) -> None:
        """Set a register of several servos, which do not answer."""

    async def set_all(self, register: Any, values: Mapping[int, int]) -> dict[int, int]:
        """Set a register of several servos, read it back, and repeat for those without the value.

        Servos do not answer a write to several of them, so the value read back decides.
        Returns the values of the servos that have kept others, by id.
        """
        left, kept = dict(values), dict[int, int]()
        for _ in range(_ATTEMPTS if left else 0):
            await self.set_values(register, left)
            there = await self.values(register, list(left))
            kept = {n: has for n, has in there.items() if has != left[n]}
            left = {number: left[number] for number in kept}
            if not left:
                break
        return kept


@dataclass(frozen=True, slots=True)
class FoundServo:
    """The registers of a servo as found.

    Attributes:
        model: Its model number.
        firmware: Its firmware's version.
        drive_mode: Its drive mode, or phase; 0 if that has another meaning.
        offset: Its position offset [counts].
        mode: Its operating mode.
        return_delay: Its return delay [2 µs].
        limits: Its smallest and largest position [counts]; equal: it has none.
        most: Its largest torque or current [counts].
        powered: Whether its torque is enabled.
        gains: Its P, I and D; empty if they were not read.
        marked: Whether it has the mark, which a power cycle removes.
    """

    id: int
    model: int
    firmware: str
    drive_mode: int
    offset: int
    mode: int
    return_delay: int
    limits: tuple[int, int]
    most: int
    powered: bool
    gains: tuple[int, ...] = ()
    marked: bool = False


class ServoCoupling(Protocol):
    """Servos that drive several actuators together."""

    @property
    def pairs(self) -> Sequence[tuple[int, int]]:
        """The indices of each pair, the same for the servos and the actuators."""
        ...

    def servos(self, positions: FloatArray) -> FloatArray:
        """Return the servos' angles [rad] for the actuators' positions [rad]."""
        ...

    def positions(self, angles: FloatArray) -> FloatArray:
        """Return the actuators' positions [rad] at the servos' angles [rad]."""
        ...

    def jacobian(self, angles: FloatArray) -> FloatArray:
        """Return the derivative of the servos' angles by the actuators' positions ``(n, n)``."""
        ...

    def limit_warnings(self, positions: FloatArray, angles: FloatArray) -> tuple[str, ...]:
        """Return a warning for each actuator whose reference the servos cannot follow."""
        ...


@dataclass(frozen=True, slots=True)
class Readings:
    """The servos' reports of a cycle.

    Attributes:
        columns: Position, speed, effort, current, temperature and voltage ``(6, n)`` [counts].
        errors: Error byte of each servo, by id.
    """

    columns: FloatArray
    errors: Mapping[int, int]


@dataclass(frozen=True, slots=True)
class Goals:
    """A command to servos.

    Attributes:
        chosen: The indices of those that get a goal.
        positions: Positions of all servos [counts], within the limits of the servos.
        rates: Largest rates of all joints [rad/s], which may be infinite.
        efforts: Largest torques of all joints [N·m], which may be infinite.
    """

    chosen: list[int]
    positions: list[int]
    rates: list[float]
    efforts: list[float]


L = TypeVar("L", bound=ServoLink)


class ServoDriver(Driver, Generic[L]):
    """Servos on one line; ``L`` is their link.

    Opening and closing the line changes neither the torque nor the goals of the servos.

    Attributes:
        TORQUE: The register that switches the torque.
        GOAL: The register of the goal position.
        GAINS: The registers of the gains that can be tuned, by name.
        MOST_GAIN: Largest gain [counts].
        STORED: Number of bytes at the beginning of the table that hold a servo's set-up.
        NEAR: Tolerance for the goal read back from a servo without torque [counts].
        FOLLOWS: The operating modes in which a servo stops at a goal.
        GOAL_POWERS: Whether writing a goal enables the torque.
        HINT: What `recover` does about the errors that servos report.
        LOST: What to do about servos that have lost their torque.
        mode: Operating mode in which they follow goals.
        ids: The servos' ids, in the order of the actuators.
        names: Their names by id.
        scales: Their units.
        found: Their registers as found, by id.
    """

    TORQUE: ClassVar[Any]
    GOAL: ClassVar[Any]
    GAINS: ClassVar[Mapping[str, Any]]
    MOST_GAIN: ClassVar[int]
    STORED: ClassVar[int]
    NEAR: ClassVar[int] = 0
    FOLLOWS: ClassVar[Collection[int]] = (0,)
    GOAL_POWERS: ClassVar[bool] = True
    HINT: ClassVar[str]
    LOST: ClassVar[str] = "`rtee recover` powers it again"
    options: LineOptions
    link: L
    mode: int = 0

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        servos, (count, middle), self._coupling = self._wired()
        self.ids = [servo.id for servo in servos.values()]
        self.names = dict(zip(self.ids, servos, strict=True))
        self.scales = [
            ServoScale(count, middle if s.zero is None else s.zero, s.direction, s.gear)
            for s in servos.values()
        ]
        self.found: dict[int, FoundServo] = {}
        self._servos = servos
        self._pairs = [] if self._coupling is None else list(self._coupling.pairs)
        self._count = 0
        self._angles: FloatArray = np.full(len(self.ids), math.nan)
        self._goal: FloatArray = np.full(len(self.ids), math.nan)
        self._accepted: list[tuple[int, int] | None] = [None] * len(self.ids)
        self._warnings: tuple[str, ...] = ()
        self.capabilities = Capabilities(
            measures=frozenset({"position", "velocity", "temperature"}),
            accepts=frozenset({"position", "max_velocity"}),
            recoverable=True,
            gains=tuple(self.GAINS),
        )

    # --- defined by each family ----------------------------------------------------------------

    @abstractmethod
    def _wired(
        self,
    ) -> tuple[Mapping[str, ServoOptions], tuple[float, float], ServoCoupling | None]:
        """Return the servos by their names, in the order of the actuators, and their coupling.

        The middle item of the result has the angle per count [rad] and the middle position [counts]
        of a servo.
        """

    @abstractmethod
    async def _connect(self) -> L:
        """Open the line."""

    @abstractmethod
    def _model(self, number: int | None) -> str:
        """Return the name of a model number."""

    @abstractmethod
    def _check_model(self, name: str, servo: ServoOptions, model: int) -> None:
        """Raise `HandshakeError` if a servo's model cannot be driven."""

    @abstractmethod
    def _as_found(self, number: int, stored: bytes, powered: bool) -> FoundServo:
        """Return the registers of a servo from the first bytes of its table."""

    @abstractmethod
    def _check_found(self, name: str, found: FoundServo) -> None:
        """Raise `HandshakeError` if the set-up of a servo prevents driving it."""

    @abstractmethod
    def _adopt(self, servo: ServoOptions, found: FoundServo, scale: ServoScale) -> None:
        """Set the units of a servo according to its identity."""

    @abstractmethod
    def _described(self) -> tuple[float, str]:
        """Return the best rate of cycles [Hz], and how the servos are read."""

    @abstractmethod
    def _refuses_effort(self) -> str:
        """Return the reason why effort limits are not accepted; empty if they are."""

    async def _place(self) -> None:
        """Derive values from the positions before the driver uses the positions."""

    @abstractmethod
    def _check_range(self, number: int, ends: Sequence[float]) -> None:
        """Raise `ConfigError` if a servo cannot go to the ends of its range [rad]."""

    @abstractmethod
    async def _prepare(self, off: Sequence[int]) -> None:
        """Set up servos without torque; their goals and torque follow."""

    async def _arm(self) -> Collection[int]:
        """Arm the watchdogs of powered servos; return the servos that a watchdog has stopped."""
        return ()

    async def _watch(self) -> None:
        """Make the checks of every cycle that measurements do not cover; raises `DeviceFault`."""

    @abstractmethod
    async def _readings(self) -> Readings:
        """Read the servos; raises `BusError`."""

    @abstractmethod
    async def _errors(self, errors: Mapping[int, int]) -> Mapping[int, IntFlag]:
        """Return the errors that the servos' error bytes stand for, by id."""

    @abstractmethod
    def _most(self, i: int) -> int:
        """Return the largest torque of a servo [counts of the limit]."""

    @abstractmethod
    async def _write(self, goals: Goals) -> None:
        """Set goals, which lie within the servos' limits."""

    def _believe(self, readings: Readings, stamp: float) -> None:
        """Raise `FrameError` for impossible readings."""

    # --- set-up ----------------------------------------------------------------------------------

    async def configure(self) -> None:
        """Open the line and find every servo; writes nothing."""
        link = await self._connect()
        with link.relaxed_deadline():
            await self.find()
            # After finding the servos, since a calibration of other servos is refused.
            if self.options.calibration is not None:
                zeros = zeros_of(self.options.calibration, self.spec.name, self._calibrated())
                for scale, zero in zip(self.scales, zeros, strict=True):
                    scale.zero = zero
                self._use_scales()
            await self._place()
        self._describe()

    async def find(self) -> None:
        """Find all servos and adopt the units of their models; writes nothing.

        Raises:
            NotConnected: if none answers.
            HandshakeError: if some are missing or differ from what is expected.
            BusError: if the line fails.
        """
        link = self.link
        # All are pinged first, so that one message names all missing servos.
        models = {number: await link.model(number) for number in self.ids}
        expected = {name: (servo.id, servo.model) for name, servo in self._servos.items()}
        check_present(self.spec.name, self.options.port, expected, models, self._model)
        for name, servo in self._servos.items():
            self._check_model(name, servo, models[servo.id] or 0)
        for number in self.ids:
            stored = await link.data(number, 0, self.STORED)
            torque = await link.values(self.TORQUE, [number])
            self.found[number] = self._as_found(number, stored, torque[number] == POWERED)
        for number, name in self.names.items():
            self._check_found(name, self.found[number])
        limits = [self.found[number].limits for number in self.ids]
        # A servo that takes any position has two equal limits.
        self._accepted = [(low, high) if low < high else None for low, high in limits]
        for servo, scale in zip(self._servos.values(), self.scales, strict=True):
            self._adopt(servo, self.found[servo.id], scale)
        self._use_scales()

    def _use_scales(self) -> None:
        """Apply changes of the servos' units."""
        self._units = ServoScales(self.scales)

    def _describe(self) -> None:
        """Refine the capabilities according to the servos found."""
        models = Counter(self._model(servo.model) for servo in self.found.values())
        known = {
            "current": all(math.isfinite(scale.current_unit) for scale in self.scales),
            "effort": all(math.isfinite(scale.effort_unit) for scale in self.scales),
        }
        refusal = self._refuses_effort()
        accepts = {"position", "max_velocity"} | (set() if refusal else {"max_effort"})
        rate, reading = self._described()
        self.refine(
            measures=frozenset(
                {"position", "velocity", "temperature", *(name for name in known if known[name])}
            ),
            accepts=frozenset(accepts),
            refuses={"max_effort": refusal} if refusal else {},
            best_rate=rate,
            identity={
                "model": ", ".join(f"{count} x {name}" for name, count in models.items()),
                "firmware": ", ".join(sorted({s.firmware for s in self.found.values()})),
                "read": reading,
            },
        )

    def _check_places(self, readings: Readings) -> None:
        """Check that the servos cover the whole range, and that the actuators are within limits.

        Raises:
            CalibrationError: if an actuator is far outside its limits.
            ConfigError: if a servo cannot go where its actuator can.
        """
        ends = self._ends()
        for i, number in enumerate(self.ids):
            self._check_range(number, [self.scales[i].to_counts(angle) for angle in ends[i]])
        positions = self._to_actuators(self._units.measured(readings.columns).angle)
        for actuator, position in zip(self.spec.actuators, positions.tolist(), strict=True):
            mechanism = self.spec.mechanism(actuator)
            outside = max(mechanism.lower - position, position - mechanism.upper)
            if outside > self.options.outside:
                raise CalibrationError(
                    self.spec.name,
                    f"'{actuator.name}' is at {position:.2f} rad, {outside:.2f} rad outside its "
                    "limits; a zero or direction is wrong, or two ids are swapped; `rtee "
                    "calibrate` finds the zeros",
                )

    def _ends(self) -> list[tuple[float, float]]:
        """Return the smallest and the largest angle of each servo [rad]."""
        return [(actuator.lower, actuator.upper) for actuator in self.spec.actuators]

    async def activate(self) -> None:
        """Set up the servos without torque and power them at their positions.

        Raises:
            DeviceFault: if a servo reports an error, or its torque cannot be enabled.
            DriverError: if a servo does not accept a setting.
        """
        link = self.link
        with link.relaxed_deadline():
            # Again, since a power cycle in the meantime may have reset the settings.
            await self.find()
            await self._refuse(await self._readings())
            self._check_modes()
            await self._place()
            self._check_places(await self._readings())
            off = [number for number in self.ids if not self.found[number].powered]
            if off:
                await self._prepare(off)
                # The settings have changed the registers, which limit the goals.
                await self.find()
                # Before the torque, since the servo would jump to an old goal.
                await self._hold(off, within=self.NEAR)
                kept = await link.set_all(self.TORQUE, dict.fromkeys(off, POWERED))
                if kept:
                    # Raised only if no error that the servos report explains it.
                    await self._refuse(await self._readings())
                    raise self._lost(kept)
            stopped = await self._arm()
            if stopped:
                await self._hold(list(stopped), within=self.NEAR)
            self._goal = self._to_actuators(self._take(await self._readings()).angle)
        held = {i for i, n in enumerate(self.ids) if n not in off and n not in stopped}
        for i, j in self._pairs:
            # Both servos drive both actuators, so a pair holds only if both servos do.
            if not {i, j} <= held:
                held -= {i, j}
        self.attached.begin(held)
        # At the end: until here, missing torque is not a fault.
        self.active = True

    def _misled(self, powered: Iterable[int]) -> list[int]:
        """Return those of some powered servos that would not stop at a goal, by their mode."""
        return [number for number in powered if self.found[number].mode not in self.FOLLOWS]

    def _check_modes(self) -> None:
        """Raise `DeviceFault` if another program has powered servos in another operating mode.

        A goal or its limits would be ignored, or its speed limit become a speed that never ends.
        """
        other = [n for n, found in self.found.items() if found.powered and found.mode != self.mode]
        if other:
            modes = ", ".join(str(mode) for mode in sorted({self.found[n].mode for n in other}))
            raise self._lost(
                other,
                f"powered in operating mode {modes}, not {self.mode:d}",
                OTHER_MODE,
                hint="another program has set it; end that program, then `rtee recover` switches "
                "the torque off and sets the mode"
                if self._misled(other)
                else "another program has set it, and they hold what they grip; let that program, "
                "or a power cycle, switch their torque off, then `rtee recover` sets the mode",
            )

    async def _set(self, register: Any, values: Mapping[int, int]) -> None:
        """Set a register of several servos; raises `DriverError` if one does not accept it."""
        for number, kept in (await self.link.set_all(register, values)).items():
            raise DriverError(
                self.spec.name,
                f"servo {number} does not accept {values[number]} at address {register.address}; "
                f"it has {kept}",
            )

    async def _set_gains(self, off: Sequence[int]) -> None:
        """Set the gains of servos whose gains differ from those in the options."""
        for i, (name, register) in enumerate(self.GAINS.items()):
            common, wanted = getattr(self.options, name), dict[int, int]()
            for servo in self._servos.values():
                gain = getattr(servo, name)
                gain = common if gain is None else gain
                has = self.found[servo.id].gains
                # Only differences, since values are read back.
                if servo.id in off and gain is not None and (not has or has[i] != gain):
                    wanted[servo.id] = gain
            await self._set(register, wanted)

    async def examine(self) -> str:
        """Raise the fault that the servos report, or an error of their positions."""
        with self.link.relaxed_deadline():
            readings = await self._readings()
            await self._refuse(readings)
            self._check_modes()
            self._check_places(readings)
        return ""

    async def _release(self, numbers: Iterable[int] | None = None) -> None:
        """Switch off the torque of all servos, or of some; raises `BusError`."""
        which = self.ids if numbers is None else numbers
        for number in await self.link.set_all(self.TORQUE, dict.fromkeys(which, 0)):
            raise FrameError(self.options.port, f"servo {number} does not switch off its torque")

    # --- every cycle -------------------------------------------------------------------------

    def _to_actuators(self, angles: FloatArray) -> FloatArray:
        return angles if self._coupling is None else self._coupling.positions(angles)

    def _to_servos(self, positions: FloatArray) -> FloatArray:
        return positions if self._coupling is None else self._coupling.servos(positions)

    async def _refuse(self, readings: Readings) -> None:
        """Raise a `DeviceFault` if readings report errors."""
        if any(readings.errors.values()) and (errors := await self._errors(readings.errors)):
            raise fault_of(self.spec.name, self.names, errors, self.HINT)

    def _lost(
        self,
        numbers: Iterable[int],
        what: str = "torque lost",
        code: int = TORQUE_LOST,
        hint: str = "",
    ) -> DeviceFault:
        """Return the error for a fault of some servos that the driver itself has detected."""
        named = ", ".join(f"{n} ({self.names[n]})" for n in numbers)
        return DeviceFault(self.spec.name, code, f"{what}: servo {named}", hint=hint or self.LOST)

    def _take(self, readings: Readings) -> MeasuredServos:
        measured = self._units.measured(readings.columns)
        self._angles = measured.angle
        return measured

    async def sense(self) -> ActuatorState:
        """Return the servos' measurements.

        Raises:
            DeviceFault: if a servo has lost its torque, or reports an error.
            FrameError: if a servo reports an impossible position.
            BusError: if the line fails.
        """
        await self._watch()
        self._count += 1
        readings = await self._readings()
        stamp = monotonic.now()
        self._believe(readings, stamp)
        if self.active:
            await self._refuse(readings)
        found = self._take(readings)
        velocity, effort = found.rate, found.torque
        current, temperature = found.current, found.temperature
        if self._coupling is not None:
            jacobian = self._coupling.jacobian(found.angle)
            # Power is the same on both sides, so efforts follow by the transpose.
            velocity = np.linalg.inv(jacobian) @ velocity
            effort = jacobian.T @ effort
            for i, j in self._pairs:
                # Both servos drive both actuators, so the worse of the two counts for both.
                temperature[[i, j]] = max(temperature[i], temperature[j])
                current[[i, j]] = np.abs(current[[i, j]]).max()
        return ActuatorState.measured(
            self._to_actuators(found.angle),
            stamp,
            velocity=velocity,
            effort=effort,
            current=current,
            temperature=temperature,
            extras={"voltage": found.voltage},
            warnings=self._warnings,
        )

    async def move(self, reference: Reference) -> None:
        """Set the goals, with speed and torque limits, of the servos that a reference commands."""
        mask = reference.mask
        if self.attached:
            here = self._to_actuators(self._angles)
            # A copy, since the reference belongs to the caller.
            mask = mask.copy()
            mask[list(self.attached.holding(reference, here))] = False
        # Before the pairs are joined: an actuator without a reference keeps its goal.
        angles = self._goal = np.where(mask, reference.position, self._goal)
        rates, efforts, wanted = reference.max_velocity, reference.max_effort, mask.tolist()
        for i, j in self._pairs:
            wanted[i] = wanted[j] = wanted[i] or wanted[j]
        chosen = [i for i, commanded in enumerate(wanted) if commanded]
        if not chosen:
            return
        if self._coupling is not None:
            angles = self._coupling.servos(self._goal)
            self._warnings = self._coupling.limit_warnings(self._goal, angles)
            rates, efforts = self._limits(rates, efforts)
        counts = self._within(self._units.counts(angles))
        await self._write(Goals(chosen, counts, rates.tolist(), efforts.tolist()))

    def _limits(self, rates: FloatArray, efforts: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Convert the actuators' limits to limits of the servos."""
        if self._coupling is None:
            return rates, efforts
        fastest = np.array([1.5 * a.velocity for a in self.spec.actuators])
        # Absolute values, since in the worst case both actuators' motions add up in one servo.
        jacobian = np.abs(self._coupling.jacobian(self._angles))
        # Two servos with equal torques exert on an actuator that torque times the sum of its
        # column; if both efforts of a pair are limited, the smaller torque counts.
        efforts = efforts / jacobian.sum(axis=0)
        for i, j in self._pairs:
            efforts[[i, j]] = min(efforts[i], efforts[j])
        return jacobian @ np.where(np.isfinite(rates), rates, fastest), efforts

    def _within(self, counts: list[int]) -> list[int]:
        """Return positions [counts] that the servos accept."""
        return [
            min(max(at, ends[0]), ends[1]) if ends else at
            for at, ends in zip(counts, self._accepted, strict=True)
        ]

    async def _hold(
        self,
        numbers: Collection[int],
        instead: Callable[[Sequence[float]], Mapping[int, float]] = lambda _: {},
        within: int = 0,
    ) -> None:
        """Make the present positions of servos their goals, and read the goals back.

        ``instead`` returns the actuators that hold another position, see `Standstill.instead`; the
        goals read back may differ by ``within`` [counts]. Raises `BusError`.
        """
        if not numbers:
            return
        n = len(self.ids)
        for _ in range(_ATTEMPTS):
            readings = await self._readings()
            angles = self._take(readings).angle
            # In the servos' counts: goals from the actuators' positions would move a pair that is
            # beyond its limit.
            counts = [int(position) for position in readings.columns[0]]
            goal = self._to_actuators(angles)
            if others := instead(goal.tolist()):
                goal = np.array(goal)
                goal[list(others)] = list(others.values())
                wanted = self._units.counts(self._to_servos(goal))
                paired = {i for pair in self._pairs if set(pair) & set(others) for i in pair}
                for i in {*others, *paired}:
                    counts[i] = wanted[i]
            rates, efforts = self._limits(np.full(n, math.inf), np.full(n, math.inf))
            counts = self._within(counts)
            chosen = [i for i, number in enumerate(self.ids) if number in numbers]
            await self._write(Goals(chosen, counts, rates.tolist(), efforts.tolist()))
            self._goal = goal
            there = await self.link.values(self.GOAL, [self.ids[i] for i in chosen])
            if all(abs(there[self.ids[i]] - counts[i]) <= within for i in chosen):
                return
        raise FrameError(self.options.port, "the servos do not accept their positions as goals")

    async def set_gains(self, gains: Mapping[str, float]) -> None:
        """Write gains of the position controllers of all servos."""
        link = self.link
        with link.relaxed_deadline():
            for name, value in gains.items():
                count = min(max(round(value), 0), self.MOST_GAIN)
                await link.set_all(self.GAINS[name], dict.fromkeys(self.ids, count))

    # --- stop --------------------------------------------------------------------------------

    async def hold(self) -> None:
        """Command the measured posture; servos without torque stay without.

        Servos in another operating mode, which would not stop at a goal, lose their torque.
        """
        if self.active and not self.GOAL_POWERS:
            # At a low baud rate, another read would take too much of the time of a stop. One that
            # has restarted unnoticed stays without torque, and need not keep its goal exactly.
            await patiently(partial(self._hold, self.ids, self.standstill.instead, self.NEAR))
            return
        # Read even if active, since writing a goal enables the torque of some servos: one that has
        # restarted unnoticed would be powered in the mode that it stores.
        torque = await patiently(partial(self.link.values, self.TORQUE, self.ids))
        powered = [number for number, value in torque.items() if value]
        loose = [] if self.active else self._misled(powered)
        still = [number for number in powered if number not in loose]
        try:
            # Within the cycle's deadline: a lost answer must not use up the time of a stop.
            await patiently(partial(self._hold, still, self.standstill.instead))
        # Afterwards and in any case: neither may prevent the stop of the other servos.
        finally:
            if loose:
                await patiently(partial(self._release, loose))

    async def disable(self) -> None:
        """Disable the torque; the fingers go limp."""
        # From here on, missing torque is not a fault.
        self.active = False
        # Within the cycle's deadline, as for a stop.
        await patiently(self._release)

    # --- calibration -------------------------------------------------------------------------

    def _calibrated(self) -> list[Calibrated]:
        """Return the servos with their present zeros."""
        servos = [self.found[number] for number in self.ids]
        return [
            Calibrated(self.names[s.id], s.id, s.model, s.drive_mode, s.offset, scale.zero)
            for s, scale in zip(servos, self.scales, strict=True)
        ]

    async def calibrate(
        self, path: Path, rest: FloatArray, ready: Callable[[str], Awaitable[None]]
    ) -> list[Calibrated]:
        """Let the user put the hand into its rest posture; set and store the zeros.

        Arguments and errors as for `Calibrates.calibrate`.
        """
        # Servos with torque would resist the user, who bends the joints.
        await self.disable()
        await ready("Put every joint into the rest posture; the torque of the servos is off.")
        with self.link.relaxed_deadline():
            readings = await patiently(self._readings)
        angles = self._to_servos(rest).tolist()
        for scale, position, angle in zip(
            self.scales, readings.columns[0].tolist(), angles, strict=True
        ):
            scale.zero, scale.turns = self._zero(position - angle / scale.rad), 0
        self._use_scales()
        servos = self._calibrated()
        write_json(path, {"servos": [structs.asdict(servo) for servo in servos]})
        return servos

    def _zero(self, position: float) -> float:
        """Return the zero for a position at 0 rad [counts]."""
        return position
