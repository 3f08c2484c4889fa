"""Drives grippers that consist of CiA 402 drives; one SYNC per cycle serves all drives."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Collection
from functools import partial

import numpy as np

from rtee.buses.pool import BusPool
from rtee.buses.retry import patiently
from rtee.drivers.base import Driver
from rtee.drivers.capabilities import Capabilities
from rtee.drivers.cia402 import cia301, codec
from rtee.drivers.cia402.cia301 import NmtCommand
from rtee.drivers.cia402.codec import Control, DriveScale, Limits, Mode, Object, State
from rtee.drivers.cia402.cycle import MODES, SET_UP_WITHIN, DriveCycle
from rtee.drivers.cia402.drive import DriveLink
from rtee.drivers.cia402.options import Cia402Options
from rtee.drivers.wiring import check_names
from rtee.errors import BusTimeout, ConfigError, HandshakeError, NotConnected, RteeError
from rtee.sample import ActuatorState
from rtee.types import DeviceSpec, JointKind, Reference


def identify(drive: DriveLink, device: str, channel: str, mode: Mode) -> tuple[str, str]:
    """Check a node and read its units; return its name and its serial number.

    Runs in the worker thread and writes nothing. Messages name the device and the channel.

    Raises:
        NotConnected: if the node does not answer.
        HandshakeError: if it is another device, or does not support the mode of operation.
        BusError: if the bus fails.
    """
    try:
        kind = drive.number(Object.DEVICE_TYPE) & 0xFFFF
    except BusTimeout as error:
        raise NotConnected(
            device,
            f"node {drive.id} ({drive.name}) does not answer on {channel}",
            hint="check supply, wiring, termination, node id and bit rate; `rtee scan` searches",
        ) from error
    if kind != codec.DEVICE_TYPE:
        raise HandshakeError(
            device,
            f"a CiA 402 drive as node {drive.id}",
            f"a device of profile {kind}",
            hint="is it another node's id?",
        )
    product = drive.number(Object.IDENTITY, 2, default=0)
    wanted = drive.options.product
    if wanted is not None and product != wanted:
        raise HandshakeError(
            device, f"product {wanted:#x} as node {drive.id}", f"product {product:#x}"
        )
    # The object is optional; a drive without it is assumed to support all modes.
    modes = drive.number(Object.SUPPORTED_MODES, default=0xFFFF_FFFF)
    if not modes & mode.bit:
        known = ", ".join(str(bit + 1) for bit in range(16) if modes >> bit & 1)
        raise HandshakeError(
            device,
            f"mode {mode.value} in node {drive.id}",
            f"modes {known}",
            hint="choose another 'mode'",
        )
    drive.scale = read_scale(drive, device)
    name = drive.text(Object.DEVICE_NAME) or f"product {product:#x}"
    return name, str(drive.number(Object.IDENTITY, 4, default=0))


def read_scale(drive: DriveLink, device: str) -> DriveScale:
    """Return a drive's units from its options or its objects, in the worker thread.

    Raises `HandshakeError` if its objects are inconsistent, and `BusError`.
    """
    given = drive.options
    motor = drive.number(Object.GEAR_RATIO, 1, default=1)
    shaft = drive.number(Object.GEAR_RATIO, 2, default=1)
    if given.counts is not None:
        counts = given.counts
    else:
        increments = drive.number(Object.ENCODER_RESOLUTION, 1)
        turns = drive.number(Object.ENCODER_RESOLUTION, 2)
        try:
            counts = given.direction * codec.counts_per_rad(increments, turns, motor, shaft)
        except ValueError as error:
            raise HandshakeError(
                device,
                f"resolution and gear ratio in node {drive.id}",
                str(error),
                hint="give 'counts' per rad",
            ) from error
    torque = given.rated_torque
    if torque is None:
        # Object 6076 is in mN·m.
        rated = drive.number(Object.RATED_TORQUE, default=0) / 1000.0
        torque = rated * motor / shaft if rated > 0.0 and shaft > 0 else math.nan
    return DriveScale(counts, given.zero, torque, given.velocity_unit)


_DISARM_WITHIN = 0.5
"""Longest time, when closing, to stop the drives from watching this program [s]."""

_NOT_HOMED = 0x10001
"""Code of the driver's own fault that a drive is not homed."""

_HANDSHAKES = 10
"""Number of cycles for a drive to acknowledge two set-points, even if frames are lost."""

_FRAME_BITS = 135.0
_SYNC_BITS = 52.0
"""Bits on the wire of a frame of eight bytes and of a SYNC, with maximal stuffing (CAN 2.0A)."""

_SPACING = 1.2
"""Factor for the pauses between frames, since drives answer a SYNC one after the other."""


class Cia402Driver(Driver):
    """CiA 402 drives on one CANopen network.

    A cycle is one SYNC: it makes all drives apply the set-points sent before and answer with their
    state. Heartbeats go both ways: those of the drives show a restart, that of this program arms
    their reaction to a silent host. A drive that is already enabled stays enabled and keeps its
    target.
    """

    Options = Cia402Options
    options: Cia402Options
    link: DriveCycle

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        check_names(spec, "nodes", self.options.nodes)
        _check_prismatic(spec, self.options)
        self._homed: set[int] = set()
        bits = _SYNC_BITS + len(spec.actuators) * 3 * _FRAME_BITS
        self.capabilities = Capabilities(
            measures=frozenset({"position", "velocity", "effort"}),
            accepts=frozenset({"position", "max_effort", "max_velocity"}),
            best_rate=self.options.bitrate / (bits * _SPACING),
            homing=any(node.homing_method is not None for node in self.options.nodes.values()),
            watchdog=self.options.watchdog > 0.0,
            recoverable=True,
        )

    # --- life --------------------------------------------------------------------------------

    async def configure(self) -> None:
        """Open the network, identify the drives, set up their process data; enables nothing."""
        # `open` is not enough: the subscriptions of the old links must end, too.
        await self.close()
        options = self.options
        cycle = await self.open(
            self.buses.canopen,
            options.channel,
            lambda bus: DriveCycle(self.spec, bus, options),
            interface=options.interface,
            bitrate=options.bitrate,
        )
        # SDO transfers block, so they run in the worker thread, one drive after the other.
        bus = cycle.bus
        identities = [
            await bus.run(
                partial(identify, drive, self.spec.name, options.channel, cycle.mode), SET_UP_WITHIN
            )
            for drive in cycle.drives
        ]
        self.refine(
            identity={
                "model": ", ".join(dict.fromkeys(model for model, _ in identities)),
                "serial": ", ".join(serial for _, serial in identities),
            },
        )
        for drive in cycle.drives:
            # PDOs can be mapped only in this state; an enabled drive keeps its power.
            bus.send_now(cia301.nmt(NmtCommand.PRE_OPERATIONAL, drive.id))
        for drive in cycle.drives:
            await bus.run(partial(self._set_up, drive), SET_UP_WITHIN)
        for drive in cycle.drives:
            # A drive that was just switched on may have sent its boot-up message meanwhile.
            drive.booted, drive.nmt = False, None
            bus.send_now(cia301.nmt(NmtCommand.START, drive.id))
        cycle.operational = True
        await self._attach(cycle)

    def _set_up(self, drive: DriveLink) -> None:
        options = self.options
        every = self.spec.every or max(1, math.ceil(self.spec.rate / self.capabilities.best_rate))
        drive.set_up(
            MODES[options.mode],
            watch=(options.host, options.watchdog, options.on_silence),
            beat=options.heartbeat,
            period=every / self.spec.rate,
        )
        drive.forget()

    async def _attach(self, cycle: DriveCycle) -> None:
        """Wait for the drives' first state and attach to them as they are; commands nothing."""
        try:
            await cycle.settle()
        except BusTimeout as error:
            # They have answered SDO, so supply, wiring and bit rate are right.
            raise self.stranger(
                "process data after each SYNC",
                f"{error.message}, although the drives answer SDO",
                hint="its PDOs must support transmission type 1, and no other master may stop it",
            ) from error
        for drive in cycle.drives:
            drive.attach_as_found(cycle.mode)
            if drive.state is not State.ENABLED:
                # It may have had a power cycle, which loses the result of homing.
                self._homed.discard(drive.id)

    async def close(self) -> None:
        """Detach from the network; enabled drives stay enabled and stop watching the host."""
        self.active = False
        if self.connected:
            cycle = self.link
            # Otherwise the drives would take the end of the heartbeats for a failure.
            if cycle.bus.connected and cycle.operational and self.options.watchdog > 0.0:
                with contextlib.suppress(RteeError, OSError):
                    await cycle.bus.run(partial(_disarm, cycle), _DISARM_WITHIN)
            cycle.detach()
        await super().close()

    # --- enabling ----------------------------------------------------------------------------

    async def activate(self) -> None:
        """Enable the drives at their positions, and home them if needed and allowed."""
        cycle = self.link
        await cycle.settle()
        unhomed = self._unhomed(cycle)
        if unhomed and self.options.home != "on_connect" and not self._home_asked:
            raise self.fault(
                _NOT_HOMED,
                f"not homed: {', '.join(d.name for d in unhomed)}",
                hint="`rtee recover` or `rtee run --home` homes it, which moves it",
            )
        # Before enabling, since drives that are enabled already keep their target.
        holding = [d.state is State.ENABLED for d in cycle.drives]
        await cycle.enable()
        for drive in unhomed:
            with self.busy(f"homing {drive.name}"):
                await cycle.home(drive)
            self._homed.add(drive.id)
        self._home_asked = False
        for drive, holds in zip(cycle.drives, holding, strict=True):
            # Homing has moved the drive and its zero, so an older target means nothing.
            if not holds:
                drive.assume(drive.position)
        self.attached.begin(i for i, holds in enumerate(holding) if holds)
        self.active = True

    def _unhomed(self, cycle: DriveCycle) -> list[DriveLink]:
        """Return the drives that are not homed."""
        return [
            d
            for d in cycle.drives
            if d.options.homing_method is not None
            and d.id not in self._homed
            and d.state is not State.ENABLED
        ]

    async def examine(self) -> str:
        """Return which drives are not homed; raises `DeviceFault` if a drive is in fault."""
        cycle = self.link
        await cycle.settle()
        cycle.check_faults()
        unhomed = ", ".join(d.name for d in self._unhomed(cycle))
        return f"not homed: {unhomed}" if unhomed else ""

    # --- every cycle -------------------------------------------------------------------------

    async def sense(self) -> ActuatorState:
        """Send a SYNC, with which the drives apply their set-points and report their states."""
        cycle = self.link
        await cycle.synchronise()
        if self.active:
            cycle.check_enabled()
        drives = cycle.drives
        return ActuatorState.measured(
            [d.scale.to_position(d.position) for d in drives],
            # The oldest, since the state has one time for all drives.
            min(d.stamp for d in drives),
            velocity=[d.scale.to_velocity(d.motion.velocity) for d in drives],
            effort=[d.scale.to_effort(d.motion.torque) for d in drives],
            warnings=tuple(
                f"node {d.id} ({d.name}): {text}" for d in drives for text in d.warnings
            ),
        )

    async def move(self, reference: Reference) -> None:
        """Send changed limits, then set-points; they take effect with the next SYNC."""
        cycle = self.link
        left: Collection[int] = ()
        if self.attached:
            here = [d.scale.to_position(d.position) for d in cycle.drives]
            left = self.attached.holding(reference, np.array(here))
        for i, drive in enumerate(cycle.drives):
            if reference.mask[i]:
                drive.send_limits(self._limits(i, drive, reference))
                if i not in left:
                    drive.target = drive.scale.to_counts(float(reference.position[i]))
            # To every drive, since drives expect a set-point in each cycle.
            drive.send_command(cycle.mode)

    def _limits(self, i: int, drive: DriveLink, reference: Reference) -> Limits:
        """Return the limits of a reference in a drive's units."""
        effort, velocity = float(reference.max_effort[i]), float(reference.max_velocity[i])
        torque = self.options.max_torque
        if math.isfinite(effort) and math.isfinite(drive.scale.rated_torque):
            torque = min(torque, drive.scale.to_permille(effort))
        if not math.isfinite(velocity):
            velocity = self.spec.actuators[i].velocity
        counts = drive.scale.to_velocity_limit(velocity) if math.isfinite(velocity) else 2**31 - 1
        return Limits(torque, counts)

    # --- stop and faults ---------------------------------------------------------------------

    async def hold(self) -> None:
        """Command the measured posture."""
        cycle = self.link
        # A SYNC first, so that the positions to hold are up to date.
        await patiently(cycle.synchronise)
        for drive in cycle.drives:
            drive.target = drive.position
        here = [drive.scale.to_position(drive.position) for drive in cycle.drives]
        for i, position in self.standstill.instead(here).items():
            cycle.drives[i].target = cycle.drives[i].scale.to_counts(position)
        # In profile mode, a previous set-point has to be acknowledged first.
        for _ in range(_HANDSHAKES):
            await patiently(cycle.exchange)
            if all(drive.acknowledged(cycle.mode) for drive in cycle.drives):
                break

    async def disable(self) -> None:
        """Disable the motors' voltage; they go limp if their gears can be back-driven."""
        self.active = False
        cycle = self.link
        for drive in cycle.drives:
            drive.controlword = Control.DISABLE_VOLTAGE
            drive.forget()
        await patiently(cycle.exchange)

    async def recover(self) -> None:
        """Reset faults; the drives stay disabled until `activate`."""
        self.active = False
        await self.link.reset_faults()
        # By asking for recovery, the user agrees to the motion of homing.
        self._home_asked = True


def _disarm(cycle: DriveCycle) -> None:
    """Stop the drives from watching this program's heartbeat, in the worker thread."""
    for drive in cycle.drives:
        # One attempt: closing must not wait long for a drive that is gone.
        drive.download(Object.CONSUMER_HEARTBEAT, 1, "I", 0, tries=1)


def _check_prismatic(spec: DeviceSpec, options: Cia402Options) -> None:
    """Raise `ConfigError` if the node of a prismatic actuator has no counts per metre."""
    for actuator in spec.actuators:
        prismatic = actuator.kind is JointKind.PRISMATIC
        if prismatic and options.nodes[actuator.name].counts is None:
            raise ConfigError(
                f"device '{spec.name}': '{actuator.name}' is prismatic, so its node needs "
                "'counts' per m: drives do not report the unit of their feed"
            )
