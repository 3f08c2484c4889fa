"""Drives a Wonik Allegro Hand over CAN; the hand accepts torques, so the joint control is here."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta, field

from rtee import monotonic
from rtee.buses.can import CanBus
from rtee.buses.emulator import CanFrame
from rtee.buses.parser import CodecError
from rtee.buses.pool import BusPool
from rtee.buses.retry import heard
from rtee.drivers.allegro import codec
from rtee.drivers.allegro.control import JointControl
from rtee.drivers.base import Driver
from rtee.drivers.capabilities import Capabilities
from rtee.drivers.options import DeviceOptions, Moment, NotNegative, Positive
from rtee.drivers.wiring import numbers_of
from rtee.errors import BusError, BusTimeout, ConfigError, NotConnected
from rtee.sample import ActuatorState
from rtee.types import DeviceSpec, Reference

PATIENCE = 6.0
"""Longest time for an exchange outside the cycle, as a multiple of the deadline."""

OnPositions = Callable[[int, Sequence[int], float], object]
"""Called with a finger's number, the counts of its four joints and their time of arrival [s]."""


class AllegroLink:
    """Talks to one hand; up to four hands with different numbers can share a bus.

    Attributes:
        hand: The hand's number on the bus.
        deadline: Longest time to wait for an answer [s].
    """

    def __init__(self, bus: CanBus, hand: int, deadline: float) -> None:
        self.bus = bus
        self.hand = hand
        self.deadline = deadline
        self._undo: list[Callable[[], None]] = []

    async def _ask(self, command: codec.Command, least: int, within: float) -> CanFrame:
        wanted = codec.identifier(command, self.hand)

        def answers(frame: CanFrame) -> bool:
            return frame.id == wanted and not frame.remote and len(frame.data) >= least

        return await self.bus.request(codec.request(command, self.hand), answers, within, retries=2)

    async def info(self, *, patient: bool = False) -> codec.HandInfo:
        """Return the hand's information; raises `BusError`."""
        within = PATIENCE * self.deadline if patient else self.deadline
        return codec.HandInfo.from_bytes((await self._ask(codec.Command.HAND_INFO, 7, within)).data)

    async def serial(self) -> str:
        """Return the hand's serial number; raises `BusError`."""
        frame = await self._ask(codec.Command.SERIAL, 1, PATIENCE * self.deadline)
        return frame.data.decode("ascii", "replace").strip("\x00 ")

    async def order(self, command: codec.Command) -> None:
        """Send a command without data; raises `BusError`."""
        self.bus.send_now(codec.order(command, self.hand))

    async def set_periods(self, periods: codec.Periods) -> None:
        """Set the periods at which the hand sends data unasked; raises `BusError`."""
        self.bus.send_now(periods.to_frame(self.hand))

    def torques(self, counts: Sequence[Sequence[int]]) -> None:
        """Send the torques of all fingers; raises `BusError`."""
        for finger, four in enumerate(counts):
            number = codec.identifier(codec.Command.SET_TORQUE + finger, self.hand)
            # Without waiting, since this runs in a callback, which cannot await.
            self.bus.send_now(CanFrame(number, codec.pack_counts(four)))

    def listen(self, on_positions: OnPositions) -> None:
        """Call a function with the positions that the hand sends, until `deafen`."""
        for finger in range(codec.FINGERS):
            number = codec.identifier(codec.Command.FINGER_POSE + finger, self.hand)
            self._undo.append(self.bus.subscribe(_reader(finger, on_positions), number))

    def deafen(self) -> None:
        """Stop calling the function; idempotent."""
        for undo in self._undo:
            undo()
        self._undo.clear()


def _reader(finger: int, on_positions: OnPositions) -> Callable[[CanFrame], None]:
    def read(frame: CanFrame) -> None:
        # Another host's request has the same identifier as the hand's answer.
        if frame.remote:
            return
        try:
            counts = codec.read_counts(frame.data)
        except CodecError:
            return
        on_positions(finger, counts, frame.stamp)

    return read


class AllegroOptions(DeviceOptions, frozen=True):
    """Options of an Allegro Hand.

    Attributes:
        channel: CAN channel, for example ``can0``.
        interface: python-can interface.
        hand: The hand's number on the bus.
        version: 4 or 5; by default as the hand reports.
        side: ``left`` or ``right``; a hand of the other side is refused.
        joints: Joint on the wire, 0 to 15, of each actuator; by default in their order.
        period: Period of the hand's position frames [ms]; by default 3 (version 4) or 2 (5).
        kp: Stiffness of the joints [N·m/rad].
        kd: Damping of the joints [N·m·s/rad].
        ki: Integral gain of the joints [N·m/(rad·s)], against friction and weight; 0: none.
        max_integral: Largest torque of the integral [N·m].
        max_torque: Largest torque [N·m], besides the hand's own limits.
        smoothing: Time constant of the velocity filter [s].
        info_every: Number of exchanges after which temperature and faults are read.
        deadline: Longest time to wait for an answer, or for late positions [s].
    """

    channel: str = "can0"
    interface: str = "socketcan"
    hand: Annotated[int, Meta(ge=0, le=3)] = 0
    version: Literal[4, 5] | None = None
    side: Literal["left", "right"] | None = None
    joints: dict[str, Annotated[int, Meta(ge=0, lt=codec.JOINTS)]] = field(default_factory=dict)
    period: Annotated[int, Meta(ge=1, le=50)] | None = None
    kp: NotNegative = 1.0
    kd: NotNegative = 0.04
    ki: NotNegative = 8.0
    max_integral: NotNegative = 0.05
    max_torque: Positive = 0.5
    smoothing: Positive = 0.006
    info_every: Annotated[int, Meta(ge=1)] = 100
    deadline: Moment = 0.1


def wire_order(spec: DeviceSpec, options: AllegroOptions) -> list[int]:
    """Return the joint on the wire of each actuator; raises `ConfigError`."""
    names = [a.name for a in spec.actuators]
    if not options.joints:
        if len(names) != codec.JOINTS:
            raise ConfigError(
                f"device '{spec.name}': an Allegro Hand has {codec.JOINTS} actuators "
                f"({', '.join(codec.NAMES)}, four each), not {len(names)}; list those that are "
                "present in the option 'joints'"
            )
        return list(range(codec.JOINTS))
    return numbers_of(spec, "joints", options.joints, "joint")


_SERVO_OFF = 0x100
"""Code of the driver's own fault "motors off", above the eight status bits of the hand."""

_LET_GO = 0x101
"""Code of the driver's own fault "limp": a finger sent no positions."""

_PAUSE = 0.0005
"""Pause after switching the motors on or off [s]; the vendor's driver waits 0.1 ms."""


def _of(fingers: Sequence[int]) -> str:
    return f" of {', '.join(codec.NAMES[finger] for finger in fingers)}" if fingers else ""


class AllegroDriver(Driver):
    """An Allegro Hand, version 4 or 5.

    The hand sends its positions unasked every 2 or 3 ms and applies the torques that it received
    last. So the joint control (PD with an integral) runs here, once per set of position frames, in
    the event loop and independent of the cycle of `sense` and `move`: `move` changes its reference,
    `sense` returns its newest measurement. The hand cannot hold anything by itself; without the
    control, its motors are off.

    Attributes:
        control: The joint control.
    """

    Options = AllegroOptions
    options: AllegroOptions
    link: AllegroLink

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        self._joints = wire_order(spec, self.options)
        self._info: codec.HandInfo | None = None
        self._count = 0
        self._returned = -1
        self.control = self._controller(self.options.version or 4)
        self.capabilities = Capabilities(
            measures=frozenset({"position", "velocity", "effort", "temperature"}),
            accepts=frozenset({"position", "max_effort"}),
            best_rate=1000.0 / self._period(self.options.version or 4),
            recoverable=True,
            gains=("kp", "ki", "kd"),
        )

    def _controller(self, version: int) -> JointControl:
        options = self.options
        return JointControl(
            codec.SCALES[version],
            kp=options.kp,
            kd=options.kd,
            ki=options.ki,
            most_integral=options.max_integral,
            max_torque=options.max_torque,
            smoothing=options.smoothing,
            period=self._period(version) * 1e-3,
        )

    def _period(self, version: int) -> int:
        return self.options.period or codec.SCALES[version].period_ms

    # --- life --------------------------------------------------------------------------------

    async def configure(self) -> None:
        """Open the bus, identify the hand and start its position frames; no torque is sent."""
        # `open` closes an open bus, too, but only this makes a hand that still receives go limp.
        await self.close()
        options = self.options
        link = await self.open(
            self.buses.can,
            options.channel,
            lambda bus: AllegroLink(bus, options.hand, options.deadline),
            interface=options.interface,
            bitrate=codec.BITRATE,
        )
        info, serial = await self._identify(link)
        version = info.version if options.version is None else options.version
        # A new one, so that no position of an earlier connection counts as measured.
        self.control = self._controller(version)
        # Before the periods are set, so that no frame of the first set is missed.
        link.listen(self._receive)
        await link.set_periods(codec.Periods(self._period(version)))
        await self._first_set()
        self.refine(
            best_rate=1000.0 / self._period(version),
            identity={
                "model": f"Allegro Hand V{info.version}",
                "firmware": f"{info.firmware:#06x}",
                "serial": serial or "not reported",
            },
        )

    async def _identify(self, link: AllegroLink) -> tuple[codec.HandInfo, str]:
        options = self.options
        with self.identifying(
            "an Allegro Hand",
            f"no Allegro Hand answers as number {options.hand} on {options.channel}",
            "is its supply on, the bus terminated and at 1 Mbit/s, and `hand` right?",
        ):
            info = await link.info(patient=True)
        expected = {options.version} if options.version else set(codec.SCALES)
        if info.version not in expected:
            raise self.stranger(
                " or ".join(f"version {v}" for v in sorted(expected)),
                f"version {info.version}",
                hint="the scales of other versions are not known",
            )
        # Nothing but the side of a version 5 depends on it, so a hand may keep it to itself.
        serial = await heard(link.serial()) or ""
        side = codec.side_of(info, serial)
        if options.side is not None and side != options.side:
            # Also without an answer: a hand driven as the other one bends joints the wrong way.
            raise self.stranger(
                f"a {options.side} hand",
                f"a {side} one" if side else "one that does not report its side",
            )
        return info, serial

    async def _first_set(self) -> None:
        end = monotonic.now() + PATIENCE * self.options.deadline
        while not self.control.sets:
            if monotonic.now() > end:
                raise NotConnected(self.spec.name, "the hand does not report its positions")
            # About one period of the hand's frames.
            await asyncio.sleep(0.002)

    async def activate(self) -> None:
        """Switch the motors on and hold the measured posture."""
        await self._new_set()
        self._hold()
        self.control.let_go = None
        try:
            await self.link.order(codec.Command.SYSTEM_ON)
            await asyncio.sleep(_PAUSE)
            # Before the check, which reports motors that have stayed off only while driving.
            self.active = True
            self._refuse(await self.link.info(patient=True))
        except BaseException:
            # Also on cancellation: a hand that is not active must not be driven.
            with contextlib.suppress(BusError):
                self._go_limp()
            raise
        # Again, since a limp hand may have sunk while its motors were switched on.
        self._hold()

    async def _new_set(self) -> None:
        """Wait for positions if the newest are old: after a power cycle, the hand has sent none."""
        end = monotonic.now() + self.options.deadline
        while True:
            try:
                return self._check_age()
            except BusTimeout:
                if monotonic.now() > end:
                    raise
            await asyncio.sleep(0.002)

    async def examine(self) -> str:
        """Raise `DeviceFault` if the hand reports a fault."""
        self._refuse(await self.link.info(patient=True))
        return ""

    def _hold(self) -> None:
        try:
            self._check_age()
        except BusTimeout:
            # Since then the hand may have sunk, or been pushed, so it would jump to that position.
            self._end_control()
            raise
        for joint in self._joints:
            self.control.refer(joint, self.control.position[joint])

    async def disable(self) -> None:
        """Send no torque, then switch the motors off."""
        self._go_limp()
        await self.link.order(codec.Command.SYSTEM_OFF)

    def _go_limp(self) -> None:
        """End the control and send zero torques; raises `BusError`."""
        self.active = False
        self._end_control()

    def _end_control(self) -> None:
        """Remove all references and send zero torques; raises `BusError`."""
        self.control.limp()
        if self.connected:
            # The hand may store its last torques and apply them when it is switched on again.
            self.link.torques([[0] * (codec.JOINTS // codec.FINGERS)] * codec.FINGERS)

    async def close(self) -> None:
        """Switch the hand off, stop its position frames and detach from the bus."""
        if self.connected:
            link = self.link
            # First, so that positions that still arrive cause no more torques.
            link.deafen()
            with contextlib.suppress(BusError):
                if self.active:
                    await self.disable()
                await link.set_periods(codec.Periods())
        await super().close()

    # --- the joint control -------------------------------------------------------------------

    def _receive(self, finger: int, counts: Sequence[int], stamp: float) -> None:
        torques = self.control.receive(finger, counts, stamp)
        if torques is not None and self.active and self.connected:
            # The caller is the bus, which cannot handle the error; `sense` reports a broken bus.
            with contextlib.suppress(BusError):
                self.link.torques(torques)

    # --- every cycle -------------------------------------------------------------------------

    async def sense(self) -> ActuatorState:
        """Return the newest complete set of positions; effort is the torque sent."""
        bus = self.link.bus
        bus.check()
        self._count += 1
        if self._count % self.options.info_every == 0:
            self._refuse(await self.link.info())
        control = self.control
        if self.active and control.let_go is not None:
            raise self.fault(
                _LET_GO,
                f"limp: no positions{_of(control.let_go)}",
                hint="check that finger's cable; `rtee recover` holds the hand where it is then",
            )
        self._check_age()
        fresh, self._returned = control.sets != self._returned, control.sets
        info = self._info
        temperature = math.nan if info is None else float(info.temperature)
        # The loop may be faster than the hand: the same set must not count as a new measurement.
        return ActuatorState.measured(
            [control.position[j] for j in self._joints],
            control.stamp,
            velocity=[control.velocity[j] for j in self._joints],
            effort=[control.torque[j] for j in self._joints],
            temperature=np.full(len(self._joints), temperature),
            fresh=fresh,
        )

    def _check_age(self) -> None:
        """Raise `BusTimeout` if the newest positions are old."""
        # Positions are not requested: the next ones are due after a period.
        longest = self._period(self.control.scale.version) * 1e-3 + self.options.deadline
        if (now := monotonic.now()) - self.control.stamp > longest:
            of = _of(self.control.missing(now - longest))
            raise BusTimeout(self.link.bus.name, f"no positions{of} for more than {longest:g} s")

    async def move(self, reference: Reference) -> None:
        """Change the reference and the limits of the joint control; a limp hand stays limp."""
        self.link.bus.check()
        if self.control.let_go is not None:
            return
        for i, joint in enumerate(self._joints):
            if reference.mask[i]:
                self.control.limit(joint, float(reference.max_effort[i]))
                self.control.refer(
                    joint, float(reference.position[i]), float(reference.velocity[i])
                )

    def _refuse(self, info: codec.HandInfo) -> None:
        """Store the hand's information; raises `DeviceFault` if it reports a fault."""
        self._info = info
        faults = [
            (
                codec.Status.OVER_TEMPERATURE,
                "over-temperature",
                "let it cool down, then `rtee recover`",
            ),
            (
                codec.Status.COMMUNICATION,
                "internal communication",
                "`rtee recover`, or a power cycle",
            ),
        ]
        for bit, name, hint in faults:
            if info.status & bit:
                raise self.fault(int(bit), name, hint=hint)
        # After a power cycle it answers again, but its motors stay off until they are switched on.
        if self.active and not info.status & codec.Status.SERVO_ON:
            raise self.fault(
                _SERVO_OFF,
                "motors off",
                hint="was its supply cut? `rtee recover` switches them on again",
            )

    def gains(self) -> Mapping[str, float]:
        """See `Driver.gains`."""
        return {"kp": self.control.kp, "ki": self.control.ki, "kd": self.control.kd}

    async def set_gains(self, gains: Mapping[str, float]) -> None:
        """Change stiffness ``kp`` [N·m/rad], damping ``kd`` [N·m·s/rad] and integral ``ki``."""
        self.control.kp = max(0.0, gains.get("kp", self.control.kp))
        self.control.ki = max(0.0, gains.get("ki", self.control.ki))
        self.control.kd = max(0.0, gains.get("kd", self.control.kd))

    async def hold(self) -> None:
        """Command the measured posture; a limp hand stays limp."""
        if self.control.let_go is not None:
            self._end_control()
            return
        self._hold()
        here = [self.control.position[joint] for joint in self._joints]
        for i, position in self.standstill.instead(here).items():
            self.control.refer(self._joints[i], position)

    async def recover(self) -> None:
        """Switch the hand off and on, which clears faults whose cause is gone; it stays limp."""
        link = self.link
        await self.disable()
        await asyncio.sleep(_PAUSE)
        # A hand after a power cycle has lost its periods and sends nothing.
        await link.set_periods(codec.Periods(self._period(self.control.scale.version)))
        await link.order(codec.Command.SYSTEM_ON)
        await asyncio.sleep(_PAUSE)
        self._refuse(await link.info(patient=True))
