"""Drives a LinkerHand O6 or L10: over Modbus RTU, or on CAN."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta, field

from rtee import monotonic
from rtee.buses.modbus import ModbusRefusal
from rtee.buses.pool import BusPool
from rtee.buses.retry import patiently
from rtee.drivers import wiring
from rtee.drivers.base import Driver
from rtee.drivers.capabilities import Capabilities
from rtee.drivers.deadlines import cycle_deadline
from rtee.drivers.linkerhand import codec
from rtee.drivers.linkerhand.codec import Table
from rtee.drivers.linkerhand.link import CanLink, LinkerLink, ModbusLink
from rtee.drivers.options import CanRate, DeviceOptions, Moment, Pause
from rtee.drivers.scale import LinearScale
from rtee.errors import CommandRejected, ConfigError
from rtee.sample import ActuatorState, FloatArray
from rtee.types import DeviceSpec, Reference

Motor = Literal[
    "thumb_bend", "thumb_yaw", "index", "middle", "ring", "little",
    "index_roll", "ring_roll", "little_roll", "thumb_roll",
]  # fmt: skip

CAN_SPACING = 0.005
"""Pause between two frames on CAN [s]; an assumption, as no source gives one."""

_YAWS = ("yaw", "rot", "oppos")
_ROLLS = ("roll", "abduct", "spread")
"""Parts of actuator names that indicate motors which do not bend a finger."""

_End = Annotated[float, Meta(ge=-math.pi, le=math.pi)]
"""End of a motor's range [rad]: no finger turns further, so degrees are refused."""


class LinkerHandOptions(DeviceOptions, frozen=True):
    """Options of a LinkerHand."""

    model: Literal["o6", "l10"] = "o6"
    """The kind of hand."""
    port: str = "/dev/ttyUSB0"
    """RS-485: a tty, socket:// or rfc2217://; without ``channel``."""
    channel: str | None = None
    """CAN channel instead, for example can0."""
    interface: str = "socketcan"
    """Python-can interface of the channel."""
    bitrate: CanRate = codec.BITRATE
    """Rate of CAN [bit/s]."""
    unit: Annotated[int, Meta(ge=1, le=247)] = codec.RIGHT
    """39 is a right, 40 a left hand; its identifier on CAN, too."""
    motors: dict[str, Motor] = field(default_factory=dict)
    """The motor that drives each actuator; by default by its name."""
    ranges: dict[Motor, tuple[_End, _End]] = field(default_factory=dict)
    """Positions at 255 and at 0 of a motor [rad]; by default those of the SDK."""
    travel_time: Moment = 1.0
    """Time for the full travel at speed 255 [s]; an assumption."""
    check_model: bool = True
    """Refuse a hand that reports another number of motors (RS-485)."""
    health_every: Annotated[int, Meta(ge=1)] = 10
    """Number of exchanges between readings of faults and temperatures."""
    spacing: Pause | None = None
    """Pause between two frames [s]; by default 0.03 (O6), 0.005 (L10, CAN)."""
    retries: Annotated[int, Meta(ge=0, le=10)] = 1

    def __post_init__(self) -> None:
        """Check that the options fit each other."""
        known = self.kind.motors
        for name in (*self.motors.values(), *self.ranges):
            if name not in known:
                raise ValueError(f"an {self.kind.name} has no motor '{name}': {', '.join(known)}")

    @property
    def kind(self) -> codec.Model:
        """The kind of hand."""
        return codec.MODELS[self.model]

    @property
    def pause(self) -> float:
        """The pause between two frames [s]."""
        if self.spacing is not None:
            return self.spacing
        return self.kind.spacing if self.channel is None else CAN_SPACING

    @property
    def where(self) -> str:
        """The port or CAN channel, for messages."""
        return self.port if self.channel is None else f"CAN channel {self.channel}"


def motors_of(spec: DeviceSpec, options: LinkerHandOptions) -> tuple[int, ...]:
    """Return the motor of each actuator, by its index in the tables; raises `ConfigError`."""
    return wiring.motors_of(spec, "motors", options.motors, options.kind.motors, _motor_of)


def _motor_of(name: str) -> str:
    """Return the motor that an actuator's name suggests; empty if it suggests none."""
    lowered = name.lower().replace("pinky", "little")
    rolls = any(word in lowered for word in _ROLLS)
    if "thumb" in lowered:
        turns = any(word in lowered for word in _YAWS)
        return "thumb_yaw" if turns else "thumb_roll" if rolls else "thumb_bend"
    finger = next((f for f in ("index", "middle", "ring", "little") if f in lowered), "")
    return f"{finger}_roll" if finger and rolls else finger


def scales_of(
    spec: DeviceSpec, options: LinkerHandOptions, motors: tuple[int, ...]
) -> tuple[LinearScale, ...]:
    """Return the scale of each actuator's position.

    Raises `ConfigError` if a motor's range is empty, or does not overlap its actuator's.
    """
    scales = []
    for actuator, motor in zip(spec.actuators, motors, strict=True):
        name = options.kind.motors[motor]
        ends = options.ranges.get(name, options.kind.ranges[motor])  # type: ignore[call-overload]
        low, high = sorted(ends)
        if not max(low, actuator.lower) < min(high, actuator.upper):
            raise ConfigError(
                f"device '{spec.name}': motor '{name}' reaches {low:g} to {high:g} rad, actuator "
                f"'{actuator.name}' {actuator.lower:g} to {actuator.upper:g} rad; set 'ranges'",
                key=f"devices.{spec.name}.options.ranges",
            )
        scales.append(LinearScale((255.0, 0.0), ends))
    return tuple(scales)


_SHORT = 6
"""Distance from the set-point at which a resting motor presses on something [counts]: 2 % of the
travel, more than the position error of a free motor."""
_RESTING = 0.2
"""Time for which a motor must have rested [s]: three readings of the slowest hand."""


class LinkerHandDriver(Driver):
    """A LinkerHand O6 or L10.

    A cycle reads the positions and writes the set-points that have changed; from time to time, it
    also reads faults and temperatures. The motors cannot be switched off, and the hand reports
    neither efforts nor contacts: a motor that rests short of its set-point counts as holding
    something.
    """

    Options = LinkerHandOptions
    options: LinkerHandOptions
    link: LinkerLink

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        options = self.options
        self._model = options.kind
        self._motors = motors_of(spec, options)
        self._scales = scales_of(spec, options, self._motors)
        self._here: FloatArray = np.full(len(self._motors), math.nan)
        self._counts: tuple[int, ...] = ()
        # Values that the hand has confirmed; a missing table is unknown.
        self._sent: dict[Table, list[int]] = {}
        self._temperatures: tuple[int, ...] = ()
        self._turn = 0
        self._moved = [0.0] * self._model.count
        self._rested: list[int] = []
        self.capabilities = Capabilities(
            measures=frozenset({"position", "temperature", "grasped"}),
            accepts=frozenset({"position", "max_effort", "max_velocity"}),
            recoverable=True,
        )

    # --- life --------------------------------------------------------------------------------

    async def configure(self) -> None:
        """Open the bus and identify the hand; moves nothing."""
        options = self.options
        self._sent = {}
        link = await self._open()
        name, check = f"a LinkerHand {self._model.name}", "check `model` and `unit`"
        with (
            link.relaxed_deadline(),
            self.identifying(
                name,
                f"no {name[2:]} answers as unit {options.unit} on {options.where}",
                "check supply, wires, `model` and `unit`: 39 is a right hand, 40 a left one; "
                "power-cycle a hand that stays silent",
                ModbusRefusal,
                check=check,
            ),
        ):
            version = await link.version()
            self._temperatures, _ = await link.health()
            self._keep(await link.read(Table.POSITION))
        if version is not None and options.check_model and version.motors != self._model.count:
            found = f"another device (one with {version.motors} motors)"
            raise self.stranger(name, found, hint=check)
        best = 1.0 / link.cycle_time()
        link.deadline = cycle_deadline(self.spec, best)
        self.refine(best_rate=best, identity=self._identity(version))

    def _identity(self, version: codec.Version | None) -> dict[str, str]:
        found = {"model": f"LinkerHand {self._model.name}", "address": f"unit {self.options.unit}"}
        if version is not None:
            found["side"] = version.side.name.lower()
            found["firmware"] = codec.dotted(version.software)
            found["hardware"] = codec.dotted(version.hardware)
        return found

    async def _open(self) -> LinkerLink:
        options = self.options
        arguments = (self._model, options.unit, 0.0, options.retries, options.pause)
        if options.channel is not None:
            return await self.open(
                self.buses.can,
                options.channel,
                lambda bus: CanLink(bus, *arguments),
                interface=options.interface,
                bitrate=options.bitrate,
            )
        return await self.open(
            self.buses.modbus,
            options.port,
            lambda bus: ModbusLink(bus, *arguments),
            baudrate=codec.BAUDRATE,
        )

    async def _examine(self) -> None:
        """Read temperatures and fault codes; raises `DeviceFault` and `BusError`."""
        self._temperatures, codes = await self.link.health()
        self._check(codes)

    async def activate(self) -> None:
        """Attach to the hand as it is: its motors are always on and keep their set-points."""
        await self.examine()
        self.attached.begin(range(len(self._motors)))

    async def examine(self) -> str:
        """Raise `DeviceFault` if the hand reports a fault."""
        with self.link.relaxed_deadline():
            await self._examine()
        return ""

    # --- every cycle -------------------------------------------------------------------------

    def _keep(self, counts: tuple[int, ...]) -> None:
        """Store the measured positions, and when and where each motor last moved."""
        now = monotonic.now()
        self._rested = self._rested or list(counts)
        for motor, (new, old) in enumerate(zip(counts, self._rested, strict=True)):
            # One count is noise, but a slow motor takes each of them in a reading of its own.
            if abs(new - old) > 1:
                self._moved[motor], self._rested[motor] = now, new
        self._counts = counts

    async def sense(self) -> ActuatorState:
        """Return the hand's measurements."""
        link, every = self.link, self.options.health_every
        self._turn = (self._turn + 1) % every
        if self._turn == 0:
            await self._examine()
        self._keep(await link.read(Table.POSITION))
        both = tuple(zip(self._motors, self._scales, strict=True))
        position = [scale.to_si(self._counts[motor]) for motor, scale in both]
        self._here = np.array(position)
        now = monotonic.now()
        return ActuatorState.measured(
            position,
            now,
            temperature=[float(self._temperatures[motor]) for motor in self._motors],
            grasped=tuple(self._holds(motor, now) for motor in self._motors),
        )

    def _holds(self, motor: int, now: float) -> bool | None:
        """Return whether a motor rests short of its set-point; ``None``: not known."""
        targets = self._sent.get(Table.POSITION)
        if targets is None:
            return None
        return self._short(motor, targets) and now - self._moved[motor] > _RESTING

    def _short(self, motor: int, targets: Sequence[int]) -> bool:
        """Return whether a motor is measured short of its set-point."""
        return abs(targets[motor] - self._counts[motor]) > _SHORT

    def _check(self, codes: tuple[int, ...]) -> None:
        """Raise the fault that the motors report, if any."""
        faulty = {self._model.motors[m]: codes[m] for m in self._motors if codes[m]}
        if not faulty:
            return
        names = [
            f"{motor}: {codec.FAULT_NAMES.get(code, f'unknown fault {code}')}"
            for motor, code in faulty.items()
        ]
        hint = "`rtee recover`; if that does not help, cut the hand's supply"
        if codec.Fault.OVER_TEMPERATURE in faulty.values():
            hint = "let it cool down, then `rtee recover`"
        elif codec.Fault.SUPPLY in faulty.values():
            hint = "check its supply, then `rtee recover`"
        raise self.fault(max(faulty.values()), "; ".join(names), hint=hint)

    async def move(self, reference: Reference) -> None:
        """Write the set-points, and the limits if they have changed."""
        # One frame sets all motors, and the present set-points of the others cannot be read.
        if self.attached.all_holding(reference, self._here):
            return
        full = [codec.MOST] * self._model.count
        targets = list(self._sent.get(Table.POSITION, self._counts))
        torques = list(self._sent.get(Table.TORQUE, full))
        speeds = list(self._sent.get(Table.SPEED, full))
        mask = reference.mask.tolist()
        for i, (motor, scale) in enumerate(zip(self._motors, self._scales, strict=True)):
            if not mask[i]:
                continue
            most = self.spec.mechanism(self.spec.actuators[i]).effort
            # Without an effort limit in the model, the effort at 255 is not known.
            limited = math.isfinite(most)
            torques[motor] = (
                _share(float(reference.max_effort[i]) / most) if limited else codec.MOST
            )
            fastest = abs(scale.gain) * codec.MOST / self.options.travel_time
            speeds[motor] = _share(float(reference.max_velocity[i]) / fastest)
            targets[motor] = scale.to_count(float(reference.position[i]))
        try:
            await self._set({Table.TORQUE: torques, Table.SPEED: speeds, Table.POSITION: targets})
        except ModbusRefusal as error:
            raise CommandRejected(self.spec.name, error.message) from error

    async def _set(self, wanted: dict[Table, list[int]]) -> None:
        """Write the positions if any table has changed, and the limits if these have changed."""
        if wanted == self._sent:
            return
        sent, self._sent = self._sent, {}
        before, targets = sent.pop(Table.POSITION, None), wanted[Table.POSITION]
        limited = any(wanted[table] != sent.get(table) for table in (Table.TORQUE, Table.SPEED))
        await self.link.write(wanted if limited else {Table.POSITION: targets})
        now = monotonic.now()
        for motor in range(len(targets)):
            # A motor gets time to begin before it counts as resting; one that rests short of a
            # moving set-point has had it.
            if before is None or not self._short(motor, before):
                self._moved[motor] = now
        self._sent = wanted

    async def hold(self) -> None:
        """Command the measured pose."""
        # Within the cycle's deadline: a lost answer must not use up the time of a stop.
        await patiently(lambda: self._hold(self._motors, self.standstill.instead))

    async def _hold(
        self,
        motors: tuple[int, ...],
        instead: Callable[[Sequence[float]], Mapping[int, float]] = lambda _: {},
    ) -> None:
        """Make the measured positions of some motors their set-points.

        ``instead`` returns the actuators that hold another position; see `Standstill.instead`.
        """
        link = self.link
        self._keep(await link.read(Table.POSITION))
        targets = list(self._sent.pop(Table.POSITION, self._counts))
        for motor in motors:
            targets[motor] = self._counts[motor]
        both = tuple(zip(self._motors, self._scales, strict=True))
        here = [scale.to_si(self._counts[motor]) for motor, scale in both]
        for i, position in instead(here).items():
            motor, scale = both[i]
            targets[motor] = scale.to_count(position)
        await link.write({Table.POSITION: targets})
        self._sent[Table.POSITION] = targets

    async def recover(self) -> None:
        """Make motors that had a fault hold their position, and check that the fault is gone."""
        link = self.link
        with link.relaxed_deadline():
            _, codes = await link.health()
            faulty = tuple(motor for motor in self._motors if codes[motor])
            if faulty or Table.POSITION not in self._sent:
                # No source says whether a motor continues to its old set-point afterwards.
                await self._hold(faulty or self._motors)
            await self._examine()
        self.attached.begin(range(len(self._motors)))


def _share(part: float) -> int:
    """Return the count for a share of the largest speed or torque, which may be infinite."""
    # At least 1: no source says what 0 does.
    return max(1, round(codec.MOST * min(part, 1.0)))
