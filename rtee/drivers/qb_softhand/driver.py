"""Drives a qb SoftHand: one synergy, or synergy and manipulation of a SoftHand 2."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Coroutine
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from rtee import monotonic
from rtee.buses.pool import BusPool
from rtee.buses.retry import patiently
from rtee.drivers.base import Driver
from rtee.drivers.capabilities import Capabilities
from rtee.drivers.options import DeviceOptions, Moment, Pause, Positive
from rtee.drivers.qb_softhand import codec
from rtee.drivers.qb_softhand.codec import Command, current_limit, limits
from rtee.drivers.qb_softhand.link import QbLink
from rtee.errors import ConfigError, DeviceFault, NotConnected
from rtee.sample import ActuatorState
from rtee.types import DeviceSpec, Reference

CLOSURE_TICKS = 19_000
"""Travel of the motor of a Research hand from open to closed [ticks], the factory setting."""
MANIPULATION_TICKS = -4_000
"""Lower limit of the motors of a two-motor hand [ticks], the factory setting."""


@dataclass(frozen=True, slots=True)
class OneMotorHand:
    """A SoftHand: one actuator, 0 open to 1 closed.

    Attributes:
        ticks: Travel of the motor [ticks].
    """

    ticks: int = CLOSURE_TICKS

    def to_ticks(self, closure: tuple[float, ...]) -> tuple[float, float]:
        """Return the references of both motors [ticks]; that of the missing second one is 0."""
        return closure[0] * self.ticks, 0.0

    def to_closure(self, positions: tuple[int, ...]) -> tuple[float, ...]:
        """Return the closure from the encoders [ticks]."""
        return (positions[0] / self.ticks,)


@dataclass(frozen=True, slots=True)
class TwoMotorHand:
    """A SoftHand 2: synergy 0 (open) to 1 (closed), manipulation -1 to 1.

    The motors are at ``(1 + m) s R - m L`` and ``(1 - m) s R + m L`` for the synergy s and the
    manipulation m, with R half the sum of their limits and L their (negative) lower limit. The
    first and the third measured position are the motors' own encoders.

    Attributes:
        lower: Lower limit of the motors [ticks], negative.
        upper: Upper limit of the motors [ticks].
    """

    lower: int = MANIPULATION_TICKS
    upper: int = CLOSURE_TICKS - MANIPULATION_TICKS

    @property
    def half(self) -> float:
        """Half of the common travel [ticks]."""
        return (self.upper + self.lower) / 2.0

    def to_ticks(self, closure: tuple[float, ...]) -> tuple[float, float]:
        """Return the references of both motors [ticks]."""
        synergy, manipulation = closure
        shift = manipulation * self.lower
        return (
            (1.0 + manipulation) * synergy * self.half - shift,
            (1.0 - manipulation) * synergy * self.half + shift,
        )

    def to_closure(self, positions: tuple[int, ...]) -> tuple[float, ...]:
        """Return synergy and manipulation from the encoders [ticks]."""
        # The motors' sum is 2 s R and their difference m (2 s R - 2 L); solved for s and m.
        first, second = positions[0], positions[2]
        total = first + second
        # At the lower limit of both motors, no manipulation is possible, and none is measured.
        reach = total - 2.0 * self.lower
        return (total / (2.0 * self.half), (first - second) / reach if abs(reach) >= 1.0 else 0.0)


Motors = OneMotorHand | TwoMotorHand
"""Conversion between the hand's actuators and its motors."""


INACTIVE = 1
"""Code of the only detectable fault, inactive motors; the hand itself has no fault codes."""

_CURRENT_LIMIT = 1.5
"""Current limit of a hand that does not report its own [A], the factory setting."""

_ACTIVATION = 0.5
"""Longest time from ACTIVATE until the motors are active [s]."""

_BOTH = b"\x03"
"""Mask to activate both motors; published hosts send it to a hand with one motor, too."""


class QbSoftHandOptions(DeviceOptions, frozen=True):
    """Options of a qb SoftHand.

    Attributes:
        port: A tty, ``socket://host:port`` or ``rfc2217://host:port``.
        device: Its number on the line.
        motors: 1 (SoftHand) or 2 (SoftHand 2).
        baudrate: Rate that the hand is set to [baud].
        closure_ticks: Travel of a motor from open to closed [ticks]; by default as the hand
            reports, or 19000.
        effort_per_ampere: Effort per motor current; by default such that the current limit is the
            actuator's effort limit.
        watchdog: Silence after which the hand deactivates [s], if its firmware has a watchdog;
            0: off.
        status_every: Number of exchanges after which the driver checks that the motors are active.
        deadline: Longest time for one exchange, retries included [s].
        retries: How often a request is sent again within that time.
        turnaround: Time between a request and its answer besides that on the wire [s].
    """

    port: str = "/dev/ttyUSB0"
    # 0 is the broadcast number.
    device: Annotated[int, Meta(ge=1, le=127)] = 1
    motors: Literal[1, 2] = 1
    baudrate: Literal[2_000_000, 460_800] = 2_000_000
    closure_ticks: Annotated[int, Meta(gt=0, le=32767)] | None = None
    effort_per_ampere: Positive | None = None
    watchdog: Annotated[float, Meta(ge=0.0, le=5.0)] = 0.0
    status_every: Annotated[int, Meta(ge=1)] = 50
    deadline: Moment = 0.03
    retries: Annotated[int, Meta(ge=0, le=10)] = 2
    turnaround: Pause = codec.TURNAROUND


class QbSoftHandDriver(Driver):
    """A qb SoftHand on its serial line.

    Currents and positions are read in one exchange (two with two motors, for which the combined
    answer of older firmware is wrong); a reference is sent without an answer. The protocol has no
    set-points for effort and speed, and no fault codes: the only visible fault is that the motors
    are inactive. An active hand stays active when the connection is closed.

    Attributes:
        mapping: Transmission between the actuators and the motors' ticks.
    """

    Options = QbSoftHandOptions
    options: QbSoftHandOptions
    link: QbLink

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        if len(spec.actuators) != self.options.motors:
            raise ConfigError(
                f"device '{spec.name}': a hand with {self.options.motors} motor(s) needs as many "
                f"actuators, not {len(spec.actuators)}"
            )
        self.mapping: Motors = OneMotorHand() if self.options.motors == 1 else TwoMotorHand()
        self._effort_per_ma = self._efforts(_CURRENT_LIMIT)
        self._count = 0
        self._closure = (0.0,) * self.options.motors
        self._here = np.full(self.options.motors, math.nan)
        self.capabilities = Capabilities(
            measures=frozenset({"position", "current", "effort"}),
            accepts=frozenset({"position"}),
            refuses={
                "max_effort": "a SoftHand takes its current limit from a stored parameter, not "
                "from commands; a smaller intensity closes it less hard"
            },
            best_rate=1.0 / self._exchange_time(),
            recoverable=True,
            watchdog=self.options.watchdog > 0.0,
        )

    def _exchange_time(self) -> float:
        # Bytes of requests (six each) with their answers, and of the reference; ten bits per byte.
        sizes = [6 + 16, 10] if self.options.motors == 1 else [6 + 14, 6 + 10, 10]
        wire = sum(sizes) * 10.0 / self.options.baudrate
        return wire + self.options.turnaround * (len(sizes) - 1)

    async def configure(self) -> None:
        """Open the line and identify the hand; moves nothing."""
        options = self.options
        link = await self.open(
            self.buses.serial,
            options.port,
            lambda bus: QbLink(bus, options.device, options.deadline, options.retries),
            baudrate=options.baudrate,
            # An answer does not identify its request, so a late one could be taken for the next.
            fresh=True,
        )
        with link.relaxed_deadline():
            parameters = await self._identify(link)
            self._adopt(limits(parameters))
            # Its references would be voltages or currents, or have no effect.
            if mode := codec.other_mode(parameters):
                raise self.stranger(
                    "a hand that takes positions from this computer",
                    f"one with {mode}",
                    hint="set both modes to 0 with qb's own program, which stores them",
                )
            self.active = await self._all_active()
        self._effort_per_ma = self._efforts(current_limit(parameters) or _CURRENT_LIMIT)
        self.refine(
            identity={
                "model": "qb SoftHand" if options.motors == 1 else "qb SoftHand 2",
                "number": str(options.device),
                "parameters": str(len(parameters)) if parameters else "unknown",
            },
        )

    async def _identify(self, link: QbLink) -> dict[int, codec.Parameter]:
        """Return the parameters of the hand, which must answer to its number."""
        if not await link.ping():
            # By broadcast, so that the message can name a hand with another number.
            found = await link.anybody()
            if found is None:
                raise NotConnected(
                    self.spec.name,
                    f"no SoftHand answers at {self.options.port}",
                    hint="is its supply on, and is it the right port and baud rate?",
                )
            # Its own number: only its first answers were late or lost.
            if found != self.options.device:
                raise self.stranger(
                    f"hand number {self.options.device}",
                    f"number {found}",
                    hint=f"set 'device: {found}'",
                )
        return await link.parameters()

    def _adopt(self, reported: tuple[tuple[int, int], ...]) -> None:
        options = self.options
        if reported and len(reported) != options.motors:
            raise self.stranger(
                f"a hand with {options.motors} motor(s)",
                f"one with {len(reported)}",
                hint=f"set 'motors: {len(reported)}'",
            )
        if options.motors == 1:
            ticks = options.closure_ticks or (reported[0][1] if reported else CLOSURE_TICKS)
            self.mapping = OneMotorHand(ticks)
        else:
            factory = TwoMotorHand()
            lower, upper = reported[0] if reported else (factory.lower, factory.upper)
            # The second synergy needs a range below 0; if a hand reports none, use the factory's.
            if lower >= 0:
                lower = factory.lower
            if options.closure_ticks is not None:
                # Chosen so that the common travel, upper + lower, is the given one.
                upper = options.closure_ticks - lower
            self.mapping = TwoMotorHand(lower, upper)

    async def activate(self) -> None:
        """Activate the motors at their positions; an active hand is left as it is."""
        link = self.link
        with link.relaxed_deadline():
            if self.options.watchdog > 0.0:
                byte = codec.watchdog_byte(self.options.watchdog)
                # Before the motors, so that they are never active without a watchdog.
                await link.send(Command.SET_WATCHDOG, bytes([byte]))
            held = await self._all_active()
            if not held:
                await self._switch_on()
            # Actuators without a reference keep this closure.
            self._closure = await self._measured()
        self.attached.begin(range(self.options.motors) if held else ())
        self.active = True

    async def _all_active(self) -> bool:
        every = (1 << self.options.motors) - 1
        # With one motor, some firmware reports both bits and some the true mask.
        return await self.link.active() & every == every

    async def _switch_on(self) -> None:
        await self.link.send(Command.ACTIVATE, _BOTH)
        end = monotonic.now() + _ACTIVATION
        while not await self._all_active():
            if monotonic.now() > end:
                raise self._inactive("is the supply high enough?")
            await asyncio.sleep(0.01)

    def _inactive(self, hint: str) -> DeviceFault:
        return self.fault(INACTIVE, "motors inactive", hint=hint)

    async def _measured(self) -> tuple[float, ...]:
        least = 1 if self.options.motors == 1 else 3
        link = self.link
        return self.mapping.to_closure(await link.integers(Command.GET_MEASUREMENTS, least))

    async def sense(self) -> ActuatorState:
        """Return closures and motor currents."""
        self._count += 1
        # Not in every cycle, since the check takes another exchange.
        if self.active and self._count % self.options.status_every == 0:
            await self._check()
        if self.options.motors == 1:
            both = await self.link.integers(Command.GET_CURR_AND_MEAS, 5)
            positions, currents = both[2:], both[:1]
        else:
            positions = await self.link.integers(Command.GET_MEASUREMENTS, 3)
            currents = await self.link.integers(Command.GET_CURRENTS, 2)
        self._here = np.array(self.mapping.to_closure(positions))
        return ActuatorState.measured(
            self._here,
            monotonic.now(),
            effort=[c * f for c, f in zip(currents, self._effort_per_ma, strict=True)],
            current=[c * 1e-3 for c in currents],
        )

    def _efforts(self, current_limit: float) -> list[float]:
        """Return the effort of each actuator per motor current [N·m/mA]; ``NaN``: unknown."""
        given = self.options.effort_per_ampere
        if given is not None:
            return [given * 1e-3] * self.options.motors
        full = [self.spec.mechanism(actuator).effort for actuator in self.spec.actuators]
        return [e / current_limit * 1e-3 if math.isfinite(e) else math.nan for e in full]

    async def _check(self) -> None:
        if not await self._all_active():
            raise self._inactive("was the supply low, or the line silent too long? `rtee recover`")

    async def move(self, reference: Reference) -> None:
        """Send the references of the motors; the hand does not answer."""
        # One frame commands both motors.
        if self.attached.all_holding(reference, self._here):
            return
        wanted, mask = reference.position.tolist(), reference.mask.tolist()
        if not all(mask):
            # A frame always has the references of both motors, so the others keep their last one.
            both = zip(wanted, mask, self._closure, strict=True)
            wanted = [new if commanded else kept for new, commanded, kept in both]
        self._closure = tuple(wanted)
        await self._send(self._closure)

    def _send(self, closure: tuple[float, ...]) -> Coroutine[Any, Any, None]:
        data = codec.pack_int16(*self.mapping.to_ticks(closure))
        return self.link.send(Command.SET_INPUTS, data)

    async def hold(self) -> None:
        """Command the measured posture."""
        # Stored, since a later reference for one motor repeats this one for the other.
        here = await patiently(self._measured)
        instead = self.standstill.instead(here)
        self._closure = tuple(instead.get(i, q) for i, q in enumerate(here))
        await self._send(self._closure)

    async def recover(self) -> None:
        """Activate the motors again at their positions."""
        with self.link.relaxed_deadline():
            await self._switch_on()
            self._closure = await self._measured()
        # After `ACTIVATE` the motors hold their positions, which need not be their references.
        self.attached.begin(range(self.options.motors))
        self.active = True

    async def disable(self) -> None:
        """Deactivate the motors; the hand relaxes as far as friction allows."""
        self.active = False
        await self.link.send(Command.ACTIVATE, b"\x00")
