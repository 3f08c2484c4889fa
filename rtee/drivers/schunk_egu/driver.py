"""Drives a SCHUNK EGU or EGK over Modbus RTU."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from rtee import monotonic
from rtee.buses.modbus import ModbusBus, ModbusRefusal
from rtee.buses.pool import BusPool
from rtee.drivers.base import Driver
from rtee.drivers.capabilities import Capabilities, GripForce
from rtee.drivers.deadlines import time_limit
from rtee.drivers.options import DeviceOptions, Length, Positive, Rate
from rtee.drivers.register_blocks import PATIENT, Blocks
from rtee.drivers.scale import LinearScale
from rtee.drivers.schunk_egu import codec
from rtee.drivers.step_follower import Order, Settle, StepFollower
from rtee.drivers.wiring import only_actuator
from rtee.errors import BusError, ConfigError, DeviceFault, FrameError, HandshakeError
from rtee.sample import ActuatorState
from rtee.types import DeviceSpec, Reference

_NEWER = 0.2
"""Weight of the newest exchange in the usual duration of one."""
_MOVES = 20.0
"""Travel after which a grip counts as begun [µm]: more than the noise of an encoder."""
_JITTER = 1e-3
"""Least time between two positions that give a speed [s]."""


class GripTimer:
    """Times the stop of a grip by the positions read during the grip.

    Attributes:
        reading: Usual duration of a reading [s].
        writing: Usual duration of a write [s].
    """

    def __init__(self) -> None:
        self.reading = self.writing = 0.0
        self._speed = 0.0  # [µm/s]
        self._from = 0.0
        self._seen: tuple[float, float] | None = None  # way closed [µm] and time [s]

    def begin(self, closed: float) -> None:
        """Record the start of a grip and the closure at that time [µm]."""
        self._seen, self._from = None, closed

    def see(self, closed: float, asked: float, answered: float) -> None:
        """Record a measured closure [µm] and the times of request and answer [s]."""
        at = 0.5 * (asked + answered)
        if self._seen is not None:
            self._speed = (closed - self._seen[0]) / max(at - self._seen[1], _JITTER)
        if self._seen is not None or closed - self._from > _MOVES:
            self._seen = closed, at

    def read(self, took: float) -> None:
        """Record the duration of a reading [s]."""
        self.reading += _NEWER * (took - self.reading)

    def wrote(self, took: float) -> None:
        """Record the duration of a write [s]."""
        self.writing += _NEWER * (took - self.writing)

    def due(self, left: float, writes: int) -> float:
        """Return the time [s] to begin the writes that stop the grip after a further travel [µm].

        The time is infinite while the gripper does not move.
        """
        if self._seen is None or self._speed <= 0.0:
            return math.inf
        return self._seen[1] + left / self._speed - writes * self.writing


_WHAT = "an EGU or EGK"


@dataclass(frozen=True, slots=True)
class EguIdentity:
    """A gripper.

    Attributes:
        name: Its model.
        serial: Its serial number.
        firmware: The version of its software.
        least: Smallest distance between the fingers [mm].
        most: Largest distance between the fingers [mm].
        force: Largest grip force [N].
        speed: Largest speed of that distance [mm/s].
        grip_speed: Largest speed of a grip [mm/s]; that of motions if it reports none.
    """

    name: str
    serial: str
    firmware: str
    least: float
    most: float
    force: float
    speed: float
    grip_speed: float


async def identify(bus: ModbusBus, unit: int, device: str) -> EguIdentity:
    """Read the identity of the gripper with a number on a line.

    Args:
        bus: The line.
        unit: The gripper's number.
        device: Its name in errors.

    Raises:
        HandshakeError: if another device answers.
        BusError: if no device answers, or the gripper refuses a request.
    """

    async def read(what: codec.Parameter, count: int) -> tuple[int, ...]:
        return await bus.read(unit, what.register, count, deadline=PATIENT)

    async def number(what: codec.Parameter) -> float:
        return codec.float_of(await read(what, 2))

    # The bytes of the register are in the gripper's order, low byte first.
    module = (await read(codec.Parameter.MODULE, 1))[0].to_bytes(2, "big")
    name = codec.MODULES.get(int.from_bytes(module, "little"))
    if name is None:
        raise HandshakeError(
            device, _WHAT, f"a device of module type {int.from_bytes(module, 'little')}"
        )
    least = await number(codec.Parameter.LEAST_POSITION)
    most = await number(codec.Parameter.MOST_POSITION)
    force = await number(codec.Parameter.MOST_FORCE)
    speed = await number(codec.Parameter.MOST_SPEED)
    # Another device may return zeros for registers that it does not have.
    if not (least < most and force > 0.0 and speed > 0.0):
        raise HandshakeError(
            device, _WHAT, f"positions {least} to {most} mm, {force} N, {speed} mm/s"
        )
    texts = {what: codec.text_of(await read(what, count)) for what, count in codec.TEXTS.items()}
    try:
        grip_speed = await number(codec.Parameter.MOST_GRIP_SPEED)
    except ModbusRefusal:
        grip_speed = speed
    return EguIdentity(
        name,
        texts[codec.Parameter.SERIAL],
        texts[codec.Parameter.SOFTWARE],
        least,
        most,
        force,
        speed,
        grip_speed if 0.0 < grip_speed < speed else speed,
    )


_PER_FINGER = 2e6  # image counts [µm] per metre of one finger: images hold the fingers' distance
_SAME, _REACHED = 1000.0, 200.0
"""Difference to the measured position within which a target commands no motion just after
connecting, and within which it counts as reached [µm]."""
_TAKEN = 0.3
"""Longest time until a command is accepted [s]; the maker's tools wait as long."""
_READY = 1.0
"""Longest time until the gripper is ready after an acknowledgement [s]."""
_BRAKE_TEST = 5.0
"""Longest time of a brake test [s]; no document states it."""
_POLL = 0.01
"""Time between two readings while waiting [s]."""
_WRITE_GAP = 0.1
"""Pause between withdrawing an acknowledgement and the next one [s], as in the maker's tools."""
_SHARE = 0.85
"""Share of a cycle in which a grip is watched; the rest leaves time for a stop."""
_MISFIT = 1e-3
"""How far the actuator's range may exceed the gripper's stroke [m]: rounding in models."""
_EXPECTED = frozenset({codec.FAST_STOP, codec.SILENT, codec.UNHEARD})
_BRAKE = 0x28  # error code of a failed brake test


class SchunkEguOptions(DeviceOptions, frozen=True):
    """Options of an EGU or EGK."""

    port: str = "/dev/ttyUSB0"
    """A tty, socket:// or rfc2217://."""
    unit: Annotated[int, Meta(ge=1, le=247)] = 12
    """Modbus number of the gripper."""
    baudrate: Rate = 115200
    """Rate of the line (8E1) [baud]."""
    opens: Literal["up", "down"] = "up"
    """Whether its position grows or falls while the fingers open."""
    speed: Length = 0.02
    """Speed of a motion whose reference has no limit, per finger [m/s]."""
    rate: Positive = 25.0
    """Exchanges per second; below 20 the gripper may miss them and stop."""
    brake_test: bool = False
    """Test the brake whenever it is activated."""
    settle: Settle = 0.1
    step: Length = 0.003
    """A moving reference is followed in steps of at least this, per finger [m]."""


class SchunkEguDriver(Driver):
    """An EGU or EGK.

    A command is given by the rising edge of its bit; the gripper toggles a bit of the status when
    it accepts the command. A motion that meets an object is an error, so the driver closes the
    gripper by *grip*, with the effort limit, and stops it at the reference; it opens the gripper by
    *release* and by motions to a position. It follows a moving reference in steps: see
    `StepFollower`.
    """

    Options = SchunkEguOptions
    options: SchunkEguOptions
    link: Blocks[codec.Input]

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        options = self.options
        only_actuator(spec, "an EGU or EGK")
        self._follower = StepFollower(options.settle, options.step * _PER_FINGER, _SAME, _REACHED)
        self._input = codec.Input()
        self._gripping = False
        self._asked: tuple[bool, float] | None = None
        self._running = False
        self._most_speed = self._grip_speed = 0.0
        self._cycle_began = 0.0
        self._timer = GripTimer()
        self._word: codec.Control | None = None
        self.capabilities = self._adopt(0.0, _PER_FINGER * self._range, 1.0, {}, options.rate)

    @property
    def _range(self) -> float:
        """Travel of a finger from its open end to the actuator's upper limit [m]."""
        actuator = self.spec.actuators[0]
        return actuator.upper - self.spec.mechanism(actuator).lower

    def _adopt(
        self, least: float, most: float, force: float, identity: Mapping[str, str], best_rate: float
    ) -> Capabilities:
        """Derive scales and capabilities from the gripper's limits: positions [µm], force [N]."""
        actuator = self.spec.actuators[0]
        opened, closed = (most, least) if self.options.opens == "up" else (least, most)
        # The position of the actuator is the travel of one finger [m], open at its lower end.
        lower = self.spec.mechanism(actuator).lower
        end = opened + math.copysign(self._range * _PER_FINGER, closed - opened)
        self.position = LinearScale((opened, end), (lower, actuator.upper), ends=(least, most))
        # The smallest force is 1 %, the resolution of the register. The actuator moves both
        # fingers, so a grip force of 1 N takes an effort of 2 N.
        weakest = force / 100.0
        self.effort = LinearScale((1.0, 100.0), (2.0 * weakest, 2.0 * force))
        return Capabilities(
            measures=frozenset({"position", "grasped"}),
            accepts=frozenset({"position", "max_effort", "max_velocity"}),
            best_rate=best_rate,
            recoverable=True,
            watchdog=True,
            grip={actuator.name: GripForce(self.effort.si, (weakest,), (force,))},
            identity={"model": "SCHUNK EGU or EGK", **identity},
        )

    # --- life --------------------------------------------------------------------------------

    async def configure(self) -> None:
        """Open the line and identify the gripper; moves nothing."""
        options = self.options
        blocks = await self.open(
            self.buses.modbus,
            options.port,
            lambda bus: Blocks(
                bus,
                options.unit,
                lambda words: codec.Input.from_registers(words, options.port),
                output=codec.Parameter.OUTPUT.register,
                source=codec.Parameter.INPUT.register,
                count=codec.IMAGE,
                # The gripper has no function that writes and reads at once.
                kind="separate",
                refresh=0.0,
            ),
            baudrate=options.baudrate,
            parity="E",
        )
        with self.identifying(
            "an EGU or EGK",
            f"no answer from unit {options.unit} at {options.port}",
            "check supply, wiring, `unit`, `baudrate` and even parity",
            FrameError,
            ModbusRefusal,
        ):
            await self._identify(blocks)
        blocks.pace(self.spec, self.capabilities.best_rate)

    async def _identify(self, blocks: Blocks[codec.Input]) -> None:
        bus = blocks.bus
        found = await identify(bus, self.options.unit, self.spec.name)
        stroke = found.most - found.least
        way = stroke / 2.0
        if self._range > 1e-3 * way + _MISFIT:
            raise ConfigError(
                f"device '{self.spec.name}': each finger of this {found.name} moves {way:.1f} mm, "
                f"but the actuator has {1e3 * self._range:.1f} mm; set its limits in the URDF",
                key=f"devices.{self.spec.name}.actuators",
            )
        self._most_speed, self._grip_speed = 1e3 * found.speed, 1e3 * found.grip_speed
        self._timer.reading = bus.exchange_time(5, 2 + 2 * codec.IMAGE)
        self._timer.writing = bus.exchange_time(6 + 2 * codec.IMAGE, 5)
        # Three exchanges: the image is read, and a command takes two writes.
        wire = self._timer.reading + 2 * self._timer.writing
        self.capabilities = self._adopt(
            1e3 * found.least,
            1e3 * found.most,
            found.force,
            {
                "model": f"SCHUNK {found.name}",
                "address": f"unit {self.options.unit}",
                "serial": found.serial,
                "firmware": found.firmware,
                "stroke between the fingers": f"{stroke:.1f} mm",
                "largest force": f"{found.force:g} N",
            },
            min(1.0 / wire, self.options.rate) if wire > 0.0 else self.options.rate,
        )
        self._input = await self.link.read()

    async def activate(self) -> None:
        """Attach to a ready gripper; acknowledge the errors that are normal after power-up."""
        link = self.link
        with link.relaxed_deadline():
            now = self._input = await self.link.read()
            if now.error not in _EXPECTED:
                self._refuse(now)
            if not self._ready(now):
                await self._acknowledge()
            if self.options.brake_test:
                await self._test_brake()
        self._forget()
        self.active = True

    @staticmethod
    def _ready(now: codec.Input) -> bool:
        return bool(now.status & codec.Status.READY) and not now.status & codec.Status.ERROR

    async def _acknowledge(self) -> None:
        """Withdraw a fast stop and acknowledge errors; wait until the gripper is ready."""
        await self._write(codec.Output(codec.Control.RUN))
        await asyncio.sleep(_WRITE_GAP if self._input.error == codec.SILENT else 0.0)
        await self._write(codec.Output(codec.Control.RUN | codec.Control.ACKNOWLEDGE))
        try:
            await self._until(self._ready, _READY)
        # The gripper's own error says more than a timeout.
        except DeviceFault:
            self._refuse(self._input)
            raise
        finally:
            # The next acknowledgement needs a rising edge, too.
            with contextlib.suppress(BusError):
                await self._write(codec.Output(codec.Control.RUN))

    async def _test_brake(self) -> None:
        await self._write(codec.Output(codec.Control.RUN))
        before = self._input.status & codec.Status.RECEIVED
        await self._write(codec.Output(codec.Control.RUN | codec.Control.BRAKE_TEST))

        def done(now: codec.Input) -> bool:
            self._refuse(now)
            return now.status & codec.Status.RECEIVED != before and bool(now.status & codec.RESULTS)

        with self.busy("testing its brake"):
            await self._until(done, _BRAKE_TEST)
        if self._input.status & codec.Status.NOT_FEASIBLE:
            raise self._error(_BRAKE, "brake test not feasible; does this model have a brake?")
        await self._write(codec.Output(codec.Control.RUN))

    async def _until(self, done: Callable[[codec.Input], bool], within: float) -> None:
        """Read until a condition holds; raises `DeviceFault` when that takes too long [s]."""

        def too_slow() -> DeviceFault:
            return self._error(self._input.error, f"{self.doing or 'becoming ready'} took too long")

        async with time_limit(within, too_slow):
            while True:
                if done(await self._read_on()):
                    return
                await asyncio.sleep(_POLL)

    async def examine(self) -> str:
        """Raise the error that the gripper reports, unless activation acknowledges it."""
        now = await self.link.read()
        if now.error not in _EXPECTED:
            self._refuse(now)
        return ""

    # --- every cycle -------------------------------------------------------------------------

    async def sense(self) -> ActuatorState:
        """Return the position and whether something is gripped."""
        self._cycle_began = monotonic.now()
        now = await self._read_on()
        stamp = monotonic.now()
        if self.active:
            self._refuse(now)
        gripped = bool(now.status & codec.Status.GRIPPED) and not now.status & codec.Status.LOST
        return ActuatorState.measured(
            [self.position.to_si(now.position)],
            stamp,
            grasped=(gripped,),
            warnings=self._warnings(now),
        )

    def _warnings(self, now: codec.Input) -> tuple[str, ...]:
        warnings = []
        if now.warning:
            warnings.append(codec.WARNINGS.get(now.warning, f"warning {now.warning:#04x}"))
        if now.status & codec.Status.LOST:
            warnings.append("workpiece lost")
        if now.status & codec.Status.WRONG_WORKPIECE:
            warnings.append("wrong workpiece")
        return tuple(warnings)

    async def move(self, reference: Reference) -> None:
        """Follow a reference in steps."""
        if not reference.mask[0] or self._waits():
            return
        target = float(self.position.to_count(float(reference.position[0])))
        force = self.effort.to_count(float(reference.max_effort[0]))
        now = self._input
        here, held = float(now.position), bool(now.status & codec.Status.GRIPPED)
        if self._gripping and self._running:
            if force < (self._follower.force or 0.0):
                await self._halt()
            else:
                await self._watch(target)
            return
        order = self._follower.next(target, force, here, busy=self._running, held=held)
        if order is Order.STOP:
            await self._command(codec.Control.STOP)
            self._follower.sent()
        elif order is Order.GO and self._word != codec.Control.RUN:
            # In a separate cycle: together with the command it would take longer than a cycle.
            await self._write(codec.Output(codec.Control.RUN))
        elif order is Order.GO:
            await self._go(here, target, force, float(reference.max_velocity[0]), held)

    async def _go(self, here: float, target: float, force: int, speed: float, held: bool) -> None:
        if self._closing_travel(here, target) > _REACHED or (held and here == target):
            await self._command(codec.Control.GRIP, force=force)
            self._follower.sent()
            await self._watch(target)
        elif held:
            # It opens by its own release distance; the motion to the target follows.
            await self._command(codec.Control.RELEASE)
            self._follower.forget()
        else:
            wanted = speed if math.isfinite(speed) else self.options.speed
            limited = max(1, round(min(wanted * _PER_FINGER, self._most_speed)))
            await self._command(codec.Control.MOVE, position=round(target), speed=limited)
            self._follower.sent()

    async def _watch(self, target: float) -> None:
        """Stop a grip at its target [µm] if it reaches the target before the next cycle.

        A grip closes fully unless it is stopped. The time of the stop follows from the position and
        the speed, which two readings give; until there are two, the speed of the last grip counts.
        """
        end = self._cycle_began + _SHARE * self._period
        later = self._cycle_began + self._period + self._timer.reading  # the next cycle's stop
        while self._running:
            left = self._closing_travel(float(self._input.position), target)
            if left <= _REACHED:
                await self._halt()
                return
            if left > 2.0 * self._period * self._grip_speed:
                return
            now = monotonic.now()
            due = self._timer.due(left, 1 if self._word == codec.Control.RUN else 2)
            # Read as long as there is time: a grip that has met an object must not be stopped.
            last = due - now < self._timer.reading or now + self._timer.reading > end
            if (
                due - now > self._timer.writing
                and self._asked is None
                and self._word != codec.Control.RUN
            ):
                # The bit of the grip is withdrawn in time, so that the stop is a single write.
                await self._write(codec.Output(codec.Control.RUN))
                continue
            if due < math.inf and last:
                # If the stop is due between this cycle and the next, the nearer one sends it.
                if due > end and due - end > later - due:
                    return
                await asyncio.sleep(max(0.0, min(due, end) - now))
                await self._halt()
                return
            if now + self._timer.reading > end:
                return
            await self._read_on()

    async def _halt(self) -> None:
        """Stop a grip under way."""
        await self._command(codec.Control.STOP)
        self._follower.halted(float(self._input.position))

    @property
    def _period(self) -> float:
        """Time between two cycles [s]."""
        rate = self.spec.rate
        return (self.spec.every or math.ceil(rate / self.capabilities.best_rate)) / rate

    def _closing_travel(self, here: float, target: float) -> float:
        """Return the closing travel from a position to a target [µm], negative if it opens."""
        return target - here if self.options.opens == "down" else here - target

    async def _command(
        self, control: codec.Control, *, position: int = 0, speed: int = 0, force: int = 0
    ) -> None:
        """Give a command by the rising edge of its bit, which first needs a write without it."""
        if self._word != codec.Control.RUN:
            await self._write(codec.Output(codec.Control.RUN))
        # Before the write: if only the answer is lost, the command has begun.
        self._gripping = control is codec.Control.GRIP
        self._running = True
        self._timer.begin(self._closing_travel(0.0, float(self._input.position)))
        self._asked = bool(self._input.status & codec.Status.RECEIVED), monotonic.now()
        await self._write(codec.Output(codec.Control.RUN | control, position, speed, force))

    def _waits(self) -> bool:
        """Return whether the last command is not accepted yet; give it up after `_TAKEN`."""
        if self._asked is None:
            return False
        if monotonic.now() - self._asked[1] > _TAKEN:
            self._asked, self._running = None, False
            self._follower.forget()
            return False
        return True

    def _forget(self) -> None:
        self._follower.forget()
        self._asked = self._word = None
        self._gripping = self._running = False

    # --- stop and faults ---------------------------------------------------------------------

    async def stop(self) -> None:
        """End the motion; a gripped object stays gripped."""
        if not self.connected:
            return
        if self._input.status & codec.Status.GRIPPED and not self._running:
            # A stop is not needed, and might end the grip.
            self._forget()
            return
        # Without the bit first: the command is its rising edge, and it may be set already.
        await self.link.insist(codec.Output(codec.Control.RUN).to_registers())
        if await self.link.insist(
            codec.Output(codec.Control.RUN | codec.Control.STOP).to_registers()
        ):
            self._forget()

    async def recover(self) -> None:
        """Acknowledge the error; the interrupted command is not continued."""
        with self.link.relaxed_deadline():
            await self._read_on()
            if not self._ready(self._input):
                await self._acknowledge()
        self._refuse(self._input)
        self._forget()

    def _refuse(self, now: codec.Input) -> None:
        if now.status & codec.Status.ERROR:
            raise self._error(now.error, codec.ERRORS.get(now.error, "an undocumented error"))

    def _error(self, code: int, name: str) -> DeviceFault:
        remedy = codec.REMEDIES.get(code, "remove the cause")
        return self.fault(code, name, f"{remedy}, then `rtee recover`, which acknowledges it")

    # --- the wire ----------------------------------------------------------------------------

    async def _read_on(self) -> codec.Input:
        """Read the image and update the progress of the last command."""
        asked = monotonic.now()
        now = self._input = await self.link.read()
        answered = monotonic.now()
        self._timer.read(answered - asked)
        if self._asked is not None and bool(now.status & codec.Status.RECEIVED) != self._asked[0]:
            self._asked = None
        if self._asked is None and now.status & codec.RESULTS:
            self._running = False
        if self._asked is None and self._gripping:
            self._timer.see(self._closing_travel(0.0, float(now.position)), asked, answered)
        return now

    async def _write(self, output: codec.Output) -> None:
        # Unknown until the gripper has answered.
        self._word = None
        begun = monotonic.now()
        await self.link.write(output.to_registers())
        self._timer.wrote(monotonic.now() - begun)
        self._word = output.control
