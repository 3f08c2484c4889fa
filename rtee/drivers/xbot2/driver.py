"""Drives joints behind XBot2 over xbot2_zmq, such as Dagana or the motors of HERI II."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta, field

from rtee import monotonic
from rtee.buses.parser import CodecError
from rtee.buses.pool import BusPool
from rtee.buses.retry import patiently
from rtee.buses.zmq import ZmqBus
from rtee.drivers.base import Driver
from rtee.drivers.capabilities import Capabilities
from rtee.drivers.options import DeviceOptions, Moment, Positive
from rtee.drivers.scale import LinearScale
from rtee.drivers.xbot2 import codec
from rtee.errors import BusTimeout, ConfigError, suggestion
from rtee.hand.validation import Misfit, Section
from rtee.sample import ActuatorState, FloatArray
from rtee.types import ActuatorSpec, DeviceSpec, Reference

Port = Annotated[int, Meta(gt=0, lt=65536)]


class JointOptions(Section, frozen=True):
    """Options of one joint.

    Positions are mapped linearly from the actuator's limits to the ends given here, separately for
    commands and states, since a gripper may use different units for them (normalised closure, rad).

    Attributes:
        joint: Its name at the server; by default the actuator's.
        command: Commanded values at the actuator's lower and upper limit; by default the limits.
        state: Reported values at these limits; by default those of ``command``.
        effort_sign: Sign of an effort that drives the actuator up.
    """

    joint: str | None = None
    command: tuple[float, float] | None = None
    state: tuple[float, float] | None = None
    effort_sign: Literal[1, -1] = 1

    def __post_init__(self) -> None:
        """Check that the ends of each range differ."""
        for pair in (self.command, self.state):
            if pair is not None and pair[0] == pair[1]:
                raise ValueError("the ends of a range must differ")


class XBot2Options(DeviceOptions, frozen=True):
    """Options of joints behind XBot2.

    Attributes:
        address: The robot's computer, ``tcp://host``.
        state_port: Where it publishes states.
        service_port: Where it answers requests.
        command_port: Where it takes commands.
        joints: The joints of actuators that differ from the defaults.
        control: ``position`` sends positions only. ``limited`` sends the effort limit with each
            position, as the joint's effort reference, for boards that use it so, such as those of
            HERI II. ``effort`` closes and opens with the effort limit, and holds by position at the
            reference.
        rate: Rate at which the server publishes [Hz].
        deadline: Longest time to wait for an answer or the first state [s].
    """

    address: str = "tcp://127.0.0.1"
    state_port: Port = codec.STATE_PORT
    service_port: Port = codec.SERVICE_PORT
    command_port: Port = codec.COMMAND_PORT
    joints: dict[str, JointOptions] = field(default_factory=dict)
    control: Literal["position", "limited", "effort"] = "position"
    rate: Positive = 100.0
    deadline: Moment = 1.0

    def __post_init__(self) -> None:
        """Check the address."""
        host = self.address.removeprefix("tcp://")
        if not host or host == self.address or ":" in host:
            raise Misfit("an address is 'tcp://host'; ports are separate options", "address")


_LATE = 0.25
"""Time by which a state may be late [s]: TCP repeats a lost packet after 0.2 s."""

_BAND = 0.02
"""In effort control, the largest error that causes no motion [range]: a smaller one is within the
play of the grippers' transmissions."""

_NO_EFFORT = (
    "its option 'control' is 'position', which sends positions only; 'limited' also sends the "
    "limit, for boards that accept it, and 'effort' closes and opens with it"
)


class XBot2Driver(Driver):
    """Joints behind XBot2.

    XBot2 owns the motors: it powers them, interpolates references and monitors them. This driver is
    one of its clients. It sends a joint nothing until a reference asks the joint to move, so a
    joint that holds an object keeps it when the driver connects and when others move. A joint gets
    a position and an effort together only with ``control: limited``, for boards where the effort
    is a limit.
    """

    Options = XBot2Options
    options: XBot2Options
    link: ZmqBus

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        names = [a.name for a in spec.actuators]
        for name in self.options.joints:
            if name not in names:
                raise ConfigError(
                    f"device '{spec.name}': option 'joints' names '{name}', which is not one of "
                    f"its actuators; {suggestion(name, names)}"
                )
        given = [self.options.joints.get(a.name, JointOptions()) for a in spec.actuators]
        self._names = [g.joint or a.name for g, a in zip(given, spec.actuators, strict=True)]
        self._signs = [g.effort_sign for g in given]
        pairs = list(zip(given, spec.actuators, strict=True))
        self._commanded = [_scale(g.command, a, spec) for g, a in pairs]
        self._reported = [_scale(g.state or g.command, a, spec) for g, a in pairs]
        self._undo: Callable[[], None] | None = None
        self._state: codec.State | None = None
        self._index: list[int] = []
        self._stamp = -math.inf
        self._seen = -math.inf
        self._arrived = asyncio.Event()
        effort = self.options.control != "position"
        self._limits = [math.inf] * len(names)
        self.capabilities = Capabilities(
            measures=frozenset({"position", "velocity", "effort"}),
            accepts=frozenset({"position", "max_effort"} if effort else {"position"}),
            refuses={} if effort else {"max_effort": _NO_EFFORT},
            best_rate=self.options.rate,
            recoverable=True,
        )

    # --- life --------------------------------------------------------------------------------

    async def configure(self) -> None:
        """Connect, check that the server has the joints, and wait for their first state."""
        # On reconnection, the old subscription must end.
        await self.close()
        # Any joint may hold an object.
        self.attached.begin(range(len(self._names)))
        options = self.options
        joints = {
            a.name: {"joint": n} for a, n in zip(self.spec.actuators, self._names, strict=True)
        }
        # The emulated server has one range for all joints, so it gets the widest.
        ends = [end for scale in self._commanded for end in scale.raw]
        bus = await self.open(
            self.buses.zmq,
            options.address,
            lambda bus: bus,
            emulated={"joints": joints, "ends": (min(ends), max(ends)), "rate": options.rate},
            ports=(options.state_port, options.command_port, options.service_port),
        )
        # Before the request, since states arrive all the time and the wait below needs one.
        self._undo = bus.subscribe(self._take)
        with self._identifying():
            raw = await bus.request(codec.request("joint_names"), options.deadline)
            known = codec.joint_names(raw)
        missing = [name for name in self._names if name not in known]
        if missing:
            raise self.stranger(
                f"joints {', '.join(self._names)}",
                f"no {', '.join(missing)}",
                hint=suggestion(missing[0], known),
            )
        with self._identifying():
            try:
                async with asyncio.timeout(options.deadline):
                    while self._state is None:
                        # Other messages arrive, too, so the state decides and not the event.
                        self._arrived.clear()
                        await self._arrived.wait()
            except TimeoutError:
                raise BusTimeout(bus.name, "no state") from None
        self.refine(
            identity={
                "model": "XBot2",
                "server": options.address,
                "joints": ", ".join(self._names),
                "control": options.control,
            },
        )

    def _identifying(self) -> AbstractContextManager[None]:
        return self.identifying(
            "xbot2_zmq",
            f"xbot2_zmq does not answer at {self.options.address}",
            "does XBot2 run there with its plugin zmq, and are the ports open?",
            CodecError,
            check="check the ports",
        )

    def _take(self, message: bytes, stamp: float) -> None:
        try:
            state = codec.State.from_bytes(message)
            if state is None:
                return
            # Each message names its joints, so their order may change.
            self._index = [state.names.index(name) for name in self._names]
        except (CodecError, ValueError):
            self.link.counters.checksum_errors += 1
            return
        self._state, self._stamp = state, stamp
        self._arrived.set()

    async def close(self) -> None:
        """Close the connection; XBot2 keeps the last reference."""
        if self._undo is not None:
            self._undo()
            self._undo = None
        self._state = None
        await super().close()

    # --- every cycle -------------------------------------------------------------------------

    async def sense(self) -> ActuatorState:
        """Return the newest state that XBot2 has published; waits briefly for a new one."""
        bus = self.link
        bus.check()
        # Only if there is no new state: one that has arrived already must not cost a wait.
        if self._stamp == self._seen:
            self._arrived.clear()
            with contextlib.suppress(TimeoutError):
                # One and a half periods: a state that is only late is still the newest one.
                async with asyncio.timeout(1.5 / self.options.rate):
                    await self._arrived.wait()
        state = self._state
        # States are not requested: the next one is due after a period.
        longest = 1.0 / self.options.rate + _LATE
        if state is None or monotonic.now() - self._stamp > longest:
            # Nor can the bus count a missing one.
            bus.counters.timeouts += 1
            raise BusTimeout(bus.name, f"no state for more than {longest:.2g} s")
        fresh, self._seen = self._stamp != self._seen, self._stamp
        joints = list(zip(self._index, self._reported, self._signs, strict=True))
        return ActuatorState.measured(
            [scale.to_si(state.position[i]) for i, scale, _ in joints],
            self._stamp,
            velocity=[state.velocity[i] * scale.gain for i, scale, _ in joints],
            effort=[sign * state.effort[i] for i, _, sign in joints],
            temperature=[state.temperature[i] for i, _, _ in joints],
            fresh=fresh,
        )

    async def move(self, reference: Reference) -> None:
        """Send position references, or efforts with ``control: effort``."""
        left = self.attached.holding(reference, self._here()) if self.attached else ()
        chosen = [i for i in range(len(self._names)) if reference.mask[i] and i not in left]
        if not chosen:
            return
        if self.options.control == "limited":
            for i in chosen:
                limit = float(reference.max_effort[i])
                most = self.spec.mechanism(self.spec.actuators[i]).effort
                # After a smaller limit, the full effort has to be sent, too.
                if limit < most or math.isfinite(self._limits[i]):
                    self._limits[i] = max(min(limit, most), 0.0)
        by_effort = self.options.control == "effort"
        pushed = [self._effort(i, reference) if by_effort else None for i in chosen]
        if all(effort is None for effort in pushed):
            self._send_positions(chosen, [float(reference.position[i]) for i in chosen])
            return
        # The server keeps only the newest message, so positions and efforts share one.
        positions: tuple[float, ...] = ()
        if any(effort is None for effort in pushed):
            positions = tuple(
                self._commanded[i].to_raw(float(reference.position[i])) for i in chosen
            )
        control = tuple(
            codec.Control.POSITION if e is None else codec.Control.EFFORT for e in pushed
        )
        efforts = tuple(0.0 if effort is None else effort for effort in pushed)
        names = tuple(self._names[i] for i in chosen)
        self.link.send_now(codec.Command(names, positions, efforts, control).to_bytes())

    def _here(self) -> FloatArray:
        """Return the newest positions of the joints ``(n,)`` [rad | m]; ``NaN``: not known."""
        state = self._state
        if state is None:
            return np.full(len(self._names), math.nan)
        pairs = zip(self._index, self._reported, strict=True)
        return np.array([scale.to_si(state.position[i]) for i, scale in pairs])

    def _effort(self, i: int, reference: Reference) -> float | None:
        """Return the effort that drives a joint to its reference; ``None``: use the position."""
        if self._state is None:
            return None
        actuator = self.spec.actuators[i]
        here = self._reported[i].to_si(self._state.position[self._index[i]])
        error = float(reference.position[i]) - here
        if abs(error) <= _BAND * (actuator.upper - actuator.lower):
            return None
        size = min(float(reference.max_effort[i]), actuator.effort)
        # An infinite effort cannot be sent, so the position is used.
        if not math.isfinite(size):
            return None
        return math.copysign(size, error) * self._signs[i]

    def _send_positions(self, chosen: list[int], positions: list[float]) -> None:
        names = tuple(self._names[i] for i in chosen)
        raw = tuple(
            self._commanded[i].to_raw(position)
            for i, position in zip(chosen, positions, strict=True)
        )
        limits = [self._limits[i] for i in chosen]
        efforts = tuple(limit if math.isfinite(limit) else 0.0 for limit in limits)
        control = tuple(
            codec.Control.POSITION
            | (codec.Control.EFFORT if math.isfinite(limit) else codec.Control(0))
            for limit in limits
        )
        limited = any(math.isfinite(limit) for limit in limits)
        command = codec.Command(names, raw, efforts if limited else (), control)
        self.link.send_now(command.to_bytes())

    async def hold(self) -> None:
        """Command the measured posture."""
        here = (await patiently(self.sense)).position.tolist()
        instead = self.standstill.instead(here)
        held = [instead.get(i, q) for i, q in enumerate(here)]
        self._send_positions(list(range(len(held))), held)

    async def recover(self) -> None:
        """Check that XBot2 still publishes states; a client cannot reset XBot2's faults."""
        await self.sense()


def _scale(
    ends: tuple[float, float] | None, actuator: ActuatorSpec, spec: DeviceSpec
) -> LinearScale:
    mechanism = spec.mechanism(actuator)
    lower, upper = mechanism.lower, mechanism.upper
    if not math.isfinite(upper - lower):
        if ends is not None:
            raise ConfigError(f"device '{spec.name}': '{actuator.name}' has no limits to map")
        # An unlimited joint is not mapped: the server's units are the actuator's.
        return LinearScale((0.0, 1.0), (0.0, 1.0))
    return LinearScale((lower, upper) if ends is None else ends, (lower, upper))
