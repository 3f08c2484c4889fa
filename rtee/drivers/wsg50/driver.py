"""Drives a SCHUNK WSG 50 with its binary commands over TCP."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

from rtee import monotonic
from rtee.buses.parser import CodecError
from rtee.buses.pool import BusPool
from rtee.drivers.base import Driver
from rtee.drivers.capabilities import Capabilities, GripForce
from rtee.drivers.deadlines import time_limit
from rtee.drivers.options import DeviceOptions, Length, Positive
from rtee.drivers.scale import LinearScale
from rtee.drivers.step_follower import Order, Settle, StepFollower
from rtee.drivers.wiring import only_actuator
from rtee.drivers.wsg50 import codec
from rtee.drivers.wsg50.link import WsgLink, WsgRefusal, WsgReport
from rtee.errors import BusError, CommandRejected, DeviceFault, FrameError
from rtee.sample import ActuatorState
from rtee.types import DeviceSpec, Reference

_TRIES = 3
"""Attempts to send a stop, which must arrive."""
_POLL = 0.05
"""Time between two reports while it homes [s]; published programs do not poll faster."""
_SAME, _REACHED = 1.0, 0.3
"""Difference to the measured width within which a target commands no motion just after connecting,
and within which it counts as reached [mm]; fingers on an object yield a little."""
_EMPTY = 1.0
"""Fingers within this distance of each other hold nothing [mm]."""
_NOT_REFERENCED = 0
"""Code of the fault of a gripper that is not homed: like other codes, the number of a state bit."""
_HOME = "`rtee recover`, or `rtee run --home`, homes it: the fingers move over their whole range"
_FAULTS: Mapping[codec.State, tuple[str, str]] = {
    codec.State.FAST_STOP: (
        "fast stop",
        "see what caused it, then `rtee recover`, which clears it",
    ),
    codec.State.TEMPERATURE_ERROR: ("over temperature", "let it cool down, then `rtee recover`"),
    codec.State.POWER_ERROR: ("supply out of range", "check the 24 V supply, then `rtee recover`"),
    codec.State.CURRENT_ERROR: ("motor current too high", "free the fingers, then `rtee recover`"),
    codec.State.FINGER_ERROR: (
        "finger fault",
        "check the fingers' connectors, then `rtee recover`",
    ),
}
_WARNINGS: Mapping[codec.State, str] = {
    codec.State.TEMPERATURE_WARNING: "near its highest temperature",
    codec.State.SOFT_LIMIT_MINUS: "at its lower soft limit",
    codec.State.SOFT_LIMIT_PLUS: "at its upper soft limit",
    codec.State.SCRIPT_ERROR: "its script has failed",
}
_GRASP_WARNINGS: Mapping[codec.Grasping, str] = {
    codec.Grasping.PART_LOST: "part lost",
    codec.Grasping.ERROR: "its grasp has failed",
}
_GRASP_MOVES = frozenset(
    {codec.Grasping.CLOSING, codec.Grasping.RELEASING, codec.Grasping.POSITIONING}
)
"""States of a grasp in which the gripper accepts no other motion."""


class Wsg50Options(DeviceOptions, frozen=True):
    """Options of a WSG 50."""

    port: str = f"socket://192.168.1.20:{codec.PORT}"
    """socket://host:port; by default the factory address."""
    home: Literal["on_demand", "on_connect"] = "on_demand"
    """When a gripper that is not referenced is homed, which moves it."""
    home_timeout: Positive = 20.0
    """Longest time for homing [s]."""
    settle: Settle = 0.1
    step: Length = 0.005
    """A moving reference is followed in steps of at least this width [m]."""
    rate: Positive = 20.0
    """Exchanges per second; a higher rate may upset the gripper."""


class Wsg50Driver(Driver):
    """A WSG 50.

    A motion is one command, and another is refused until it has ended. So references are followed
    in steps: see `StepFollower`. An object that blocks a closing motion is grasped with the effort
    limit of the reference, and released before the fingers open. Connecting writes nothing.
    """

    Options = Wsg50Options
    options: Wsg50Options
    link: WsgLink

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        options = self.options
        only_actuator(spec, "a WSG 50")
        self._follower = StepFollower(options.settle, options.step * 1e3, _SAME, _REACHED)
        self._report = WsgReport()
        self._moving_to: float | None = None
        self._force = float("nan")
        # The default limits, until the gripper reports its own.
        self._adopt(codec.Limits(), {})

    def _adopt(self, limits: codec.Limits, identity: Mapping[str, str]) -> None:
        """Derive scales and capabilities from the gripper's limits."""
        actuator = self.spec.actuators[0]
        self._limits = limits
        ends = self.spec.mechanism(actuator)
        self.position = LinearScale((limits.stroke, 0.0), (ends.lower, ends.upper))
        per_position = 1e-3 * limits.stroke / (ends.upper - ends.lower)
        self._speed_of = 1e3 * per_position  # speed of the width [mm/s] per actuator velocity
        least, nominal, _ = limits.force
        self.effort = LinearScale((least, nominal), (least * per_position, nominal * per_position))
        self.capabilities = Capabilities(
            measures=frozenset({"position", "velocity", "effort", "grasped"}),
            accepts=frozenset({"position", "max_effort", "max_velocity"}),
            best_rate=self.options.rate,
            homing=True,
            recoverable=True,
            grip={actuator.name: GripForce(self.effort.si, (least,), (nominal,))},
            identity={"model": "WSG 50", **identity},
        )

    # --- life --------------------------------------------------------------------------------

    async def configure(self) -> None:
        """Connect and check that a WSG answers; moves nothing."""
        options = self.options
        link = await self.open(
            self.buses.serial,
            options.port,
            lambda bus: WsgLink(bus, 0.5),
            # An emulated gripper starts referenced, as after an earlier run, unless it must home.
            emulated={"emulator": {"referenced": options.home == "on_demand", **options.emulator}},
        )
        with (
            link.relaxed_deadline(),
            self.identifying(
                "a WSG 50",
                f"no answer at {options.port}",
                "check supply, cable and address; only one program can be connected",
                CodecError,
                WsgRefusal,
                FrameError,
            ),
        ):
            info = codec.Info.from_bytes(
                (await link.ask(codec.Frame(codec.Command.INFO))).payload[2:]
            )
            limits = codec.Limits.from_frame(await link.ask(codec.Frame(codec.Command.LIMITS)))
            self._report = await link.report()
        self._adopt(
            limits,
            {
                "address": options.port,
                "firmware": info.version,
                "serial": str(info.serial),
                "stroke": f"{limits.stroke:g} mm",
            },
        )
        every = self.spec.every or max(1.0, self.spec.rate / options.rate)
        # One and a half of its periods leaves room for jitter; a tenth of a second for networks.
        link.deadline = self.spec.deadline or max(1.5 * every / self.spec.rate, 0.1)

    async def activate(self) -> None:
        """Attach to a referenced gripper; home one that is not referenced where that is allowed."""
        link = self.link
        with link.relaxed_deadline():
            self._report = await link.report()
            self._refuse(self._report)
            if not self._report.state & codec.State.REFERENCED:
                if not (self.options.home == "on_connect" or self._home_asked):
                    raise self._unreferenced()
                await self._homed(link)
        self._home_asked = False
        self._forget()
        self.active = True

    async def _homed(self, link: WsgLink) -> None:
        def too_slow() -> DeviceFault:
            hint = "free the fingers, then `rtee recover`"
            return self.fault(_NOT_REFERENCED, "homing did not finish in time", hint)

        with self.busy("homing"):
            async with time_limit(self.options.home_timeout, too_slow, end=self.stop):
                await link.begin(codec.home())
                while True:
                    await asyncio.sleep(_POLL)
                    report = self._report = await link.report()
                    self._refuse(report)
                    if (
                        report.state & codec.State.REFERENCED
                        and not report.state & codec.State.MOVING
                    ):
                        return

    async def examine(self) -> str:
        """Return ``not homed`` if it is not; raises the fault that the gripper reports."""
        report = self._report = await self.link.report()
        self._refuse(report)
        return "" if report.state & codec.State.REFERENCED else "not homed"

    # --- every cycle -------------------------------------------------------------------------

    async def sense(self) -> ActuatorState:
        """Return width, speed, force and grasp."""
        report = self._report = await self.link.report()
        stamp = monotonic.now()
        if self.active:
            self._refuse(report)
            if not report.state & codec.State.REFERENCED:
                raise self._unreferenced()
        # Widths grow while it opens, positions while it closes; a force presses inwards.
        return ActuatorState.measured(
            [self.position.to_si(report.width)],
            stamp,
            velocity=[-report.speed / self._speed_of],
            effort=[self.effort.gain * report.force],
            grasped=(self._holds,),
            warnings=self._warnings(report),
        )

    @staticmethod
    def _warnings(report: WsgReport) -> tuple[str, ...]:
        states = [text for bit, text in _WARNINGS.items() if report.state & bit]
        grasps = [text for state, text in _GRASP_WARNINGS.items() if report.grasping is state]
        return (*states, *grasps)

    @property
    def _holds(self) -> bool:
        report = self._report
        return report.grasping is codec.Grasping.HOLDING and report.width > _EMPTY

    @property
    def _busy(self) -> bool:
        # A grasp still builds up its force when the fingers have come to rest.
        return (
            bool(self._report.state & codec.State.MOVING) or self._report.grasping in _GRASP_MOVES
        )

    async def move(self, reference: Reference) -> None:
        """Follow a reference in steps."""
        if not reference.mask[0]:
            return
        limits, report, link = self._limits, self._report, self.link
        width = min(max(self.position.to_raw(float(reference.position[0])), 0.0), limits.stroke)
        least, nominal, _ = limits.force
        wanted = self.effort.to_raw(float(reference.max_effort[0]))
        force = min(max(wanted, least), nominal)
        speed = float(reference.max_velocity[0]) * self._speed_of
        speed = min(max(speed, limits.speed[0]), limits.speed[1])
        held = report.grasping is codec.Grasping.HOLDING
        order = self._follower.next(width, force, report.width, busy=self._busy, held=held)
        try:
            if order is Order.STOP:
                await link.ask(codec.Frame(codec.Command.STOP))
                self._follower.sent()
            elif order is Order.GO or self._meets(width):
                # Before the motion, which applies the limit when it begins.
                await self._limit_force(link, force)
                motion = self._motion(width, speed)
                if motion.command == codec.Command.RELEASE:
                    # Before it is sent: a stop before the next report must end the release.
                    self._report = replace(self._report, grasping=codec.Grasping.RELEASING)
                if await link.begin(motion):
                    self._follower.sent()
        except WsgRefusal as refusal:
            # For example a width beyond the soft limits that were set on its web page.
            raise CommandRejected(self.spec.name, refusal.message) from refusal

    def _meets(self, width: float) -> bool:
        """Return whether a closing motion has just met an object to grasp."""
        report = self._report
        closes = self._moving_to is not None and width < report.width - _REACHED
        return closes and bool(report.state & codec.State.BLOCKED_MINUS) and not self._busy

    def _motion(self, width: float, speed: float) -> codec.Frame:
        """Return the command to reach a width [mm] at a speed [mm/s]."""
        report, meets = self._report, self._meets(width)
        self._moving_to = None
        held = report.grasping is codec.Grasping.HOLDING
        if meets or (held and width <= report.width):
            return codec.grasp(report.width, speed)
        if held:
            return codec.release(width, speed)
        self._moving_to = width
        return codec.move(width, speed, stop_on_block=True)

    async def _limit_force(self, link: WsgLink, force: float) -> None:
        if force != self._force:
            await link.ask(codec.setting(codec.Command.SET_FORCE, force))
            self._force = force

    def _forget(self) -> None:
        self._follower.forget()
        self._moving_to = None
        # NaN equals no force, so the next one is sent.
        self._force = float("nan")

    # --- stop and faults ---------------------------------------------------------------------

    async def stop(self) -> None:
        """End the motion; a gripped object stays gripped."""
        if not self.connected:
            return
        for _ in range(_TRIES):
            with contextlib.suppress(BusError):
                # A grasp that holds has no motion to end.
                if self._report.grasping is not codec.Grasping.HOLDING:
                    await self.link.ask(codec.Frame(codec.Command.STOP))
                self._forget()
                return

    async def recover(self) -> None:
        """Clear a fast stop; a gripper that lost its reference may then home."""
        link = self.link
        with link.relaxed_deadline():
            self._report = await link.report()
            if self._report.state & codec.State.FAST_STOP:
                await link.ask(codec.acknowledge())
                self._report = await link.report()
        self._refuse(self._report)
        # By asking for recovery the user agrees to the motion that homing may need.
        self._home_asked = True

    def _refuse(self, report: WsgReport) -> None:
        for bit, (name, hint) in _FAULTS.items():
            if report.state & bit:
                raise self.fault(bit.bit_length() - 1, name, hint)

    def _unreferenced(self) -> DeviceFault:
        return self.fault(_NOT_REFERENCED, "not homed", _HOME)

    async def close(self) -> None:
        """Announce the end of the connection, so that no fast stop follows, and detach."""
        self.active = False  # even if the announcement is cancelled
        if self.connected:
            with contextlib.suppress(BusError, DeviceFault):
                # Sent once: a gripper that is gone must not delay closing.
                await self.link.ask(codec.Frame(codec.Command.DISCONNECT), retries=0)
        await super().close()
