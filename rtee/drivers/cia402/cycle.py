"""What CiA 402 drives do every cycle: take set-points on SYNC, tell their state."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from rtee.buses.canopen import CanopenBus
from rtee.buses.emulator import CanFrame
from rtee.drivers.base import Driver
from rtee.drivers.cia402 import cia301
from rtee.drivers.cia402.cia301 import NmtState, emergency_name
from rtee.drivers.cia402.codec import Limits, Mode, State, StatusBit
from rtee.drivers.cia402.drive import DriveLink
from rtee.drivers.cia402.options import Cia402Options
from rtee.drivers.hold_on_attach import Attached
from rtee.drivers.options import read_options
from rtee.errors import (
    BusTimeout,
    ConfigError,
    DeviceFault,
    NotConnected,
)
from rtee.types import ActuatorState, Capabilities, DeviceSpec, JointKind, Reference

if TYPE_CHECKING:
    from rtee.buses.pool import BusPool

NOT_ENABLED = 0x10002
_MODES = {"profile_position": Mode.PROFILE_POSITION, "cyclic_position": Mode.CYCLIC_POSITION}
_FRAME_BITS = 135.0
_SYNC_BITS = 52.0


class Cia402Cycle(Driver):
    """What happens every cycle: set-points, SYNC, states.

    Attributes:
        drives: The drives, in the order of the actuators.
    """

    Options: ClassVar[type[Cia402Options]] = Cia402Options

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        self.options = read_options(Cia402Options, spec)
        names = [a.name for a in spec.actuators]
        if set(names) != set(self.options.nodes):
            absent = sorted(set(names) ^ set(self.options.nodes))
            raise ConfigError(
                f"device '{spec.name}': option 'nodes' must name the device's actuators, each "
                f"once; these do not match: {', '.join(absent)}"
            )
        for actuator in spec.actuators:
            prismatic = actuator.kind is JointKind.PRISMATIC
            if prismatic and self.options.nodes[actuator.name].counts is None:
                raise ConfigError(
                    f"device '{spec.name}': '{actuator.name}' is prismatic, so its node needs "
                    "'counts' per m: drives do not tell the unit of their feed"
                )
        self.mode = _MODES[self.options.mode]
        self.drives: list[DriveLink] = []
        self._bus: CanopenBus | None = None
        self._told = asyncio.Event()
        self._beat = -math.inf
        self._homed: set[int] = set()
        self._home_asked = False
        self._active = False
        self._operational = False
        self._attached = Attached(spec.actuators)
        n = len(names)
        bits = _SYNC_BITS + n * 3 * _FRAME_BITS
        self.capabilities = Capabilities(
            measures=frozenset({"position", "velocity", "effort"}),
            accepts=frozenset({"position", "max_effort", "max_velocity"}),
            best_rate=self.options.bitrate / (bits * 1.2),
            homing=any(node.homing_method is not None for node in self.options.nodes.values()),
            watchdog=self.options.watchdog > 0.0,
            recoverable=True,
        )

    @property
    def _network(self) -> CanopenBus:
        if self._bus is None:
            raise NotConnected(self.spec.name, "is not connected")
        return self._bus

    async def _synchronise(self) -> None:
        """Send a SYNC and wait for the state of all drives.

        Raises:
            BusTimeout: if one does not answer.
            NotConnected: if one has started anew.
        """
        bus, options = self._network, self.options
        now = time.monotonic()
        if options.watchdog > 0.0 and now - self._beat > options.watchdog / 4.0:
            self._beat = now
            bus.send_now(cia301.heartbeat(options.host, NmtState.OPERATIONAL))
        before = [drive.stamp for drive in self.drives]
        bus.send_now(CanFrame(cia301.SYNC))
        bus.counters.transactions += 1
        end = now + options.deadline
        while True:
            bus.check()
            late = [d.id for d, stamp in zip(self.drives, before, strict=True) if d.stamp <= stamp]
            restarted = [d for d in self.drives if d.booted]
            if restarted:
                raise NotConnected(
                    self.spec.name, f"node {restarted[0].id} has started anew; was its supply cut?"
                )
            if not late:
                return
            self._told.clear()
            try:
                async with asyncio.timeout(end - time.monotonic()):
                    await self._told.wait()
            except TimeoutError:
                bus.counters.timeouts += 1
                nodes = ", ".join(str(number) for number in late)
                raise BusTimeout(bus.name, f"no process data from node {nodes}") from None

    async def _exchange(self) -> None:
        for drive in self.drives:
            drive.send_command(self.mode)
        await self._synchronise()

    async def sense(self) -> ActuatorState:
        """Have the drives take their set-points and tell their state, by one SYNC."""
        await self._synchronise()
        if self._active:
            self._refuse()
        drives = self.drives
        return ActuatorState.measured(
            [d.scale.to_position(self._measured(d)) for d in drives],
            min(d.stamp for d in drives),
            velocity=[d.scale.to_velocity(d.motion.velocity) for d in drives],
            effort=[d.scale.to_effort(d.motion.torque) for d in drives],
            warnings=tuple(
                f"node {d.id} ({d.name}) warns"
                for d in drives
                if d.status is not None and d.status.statusword & StatusBit.WARNING
            ),
        )

    async def move(self, reference: Reference) -> None:
        """Send limits that have changed, then set-points; the next SYNC makes them count."""
        left: Collection[int] = ()
        if self._attached:
            here = [d.scale.to_position(self._measured(d)) for d in self.drives]
            left = self._attached.left(reference, np.array(here))
        for i, drive in enumerate(self.drives):
            if reference.mask[i]:
                effort, velocity = float(reference.max_effort[i]), float(reference.max_velocity[i])
                drive.send_limits(self._limits(drive, effort, velocity))
            if reference.mask[i] and i not in left:
                drive.target = drive.scale.to_counts(float(reference.position[i]))
            drive.send_command(self.mode)

    def _limits(self, drive: DriveLink, effort: float, velocity: float) -> Limits:
        torque = self.options.max_torque
        if math.isfinite(effort) and math.isfinite(drive.scale.rated_torque):
            torque = min(torque, drive.scale.to_permille(effort))
        fastest = velocity
        if not math.isfinite(fastest):
            name = drive.name
            fastest = next(a.velocity for a in self.spec.actuators if a.name == name)
        counts = drive.scale.to_velocity_limit(fastest) if math.isfinite(fastest) else 2**31 - 1
        return Limits(torque, counts)

    def _refuse(self) -> None:
        for drive in self.drives:
            if drive.state in (State.FAULT, State.FAULT_REACTION):
                raise self._fault(drive)
            if drive.state is not State.ENABLED:
                raise DeviceFault(
                    self.spec.name,
                    NOT_ENABLED,
                    f"node {drive.id} ({drive.name}) is {drive.state.name.lower()}",
                    hint="`rtee recover` enables it again",
                )

    def _fault(self, drive: DriveLink) -> DeviceFault:
        code = drive.motion.error or (drive.emergency.code if drive.emergency else 0)
        name = emergency_name(code) if code else "no reason told"
        return DeviceFault(
            self.spec.name,
            code,
            f"node {drive.id} ({drive.name}): {name}",
            hint="remove the cause, then `rtee recover`",
        )

    async def _settled(self) -> None:
        """Have the drives tell their state, patiently; raises `BusTimeout` in the end."""
        end = time.monotonic() + self.options.enable_timeout
        while True:
            try:
                await self._synchronise()
            except BusTimeout:
                if time.monotonic() > end:
                    raise
                continue
            return

    @staticmethod
    def _measured(drive: DriveLink) -> int:
        return 0 if drive.status is None else drive.status.position

    def counters(self) -> Mapping[str, int]:
        """Return the counters of the network."""
        return {} if self._bus is None else self._bus.counters.as_mapping()
