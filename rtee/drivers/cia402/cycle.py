"""The cycle of CiA 402 drives on one network: SYNC exchanges set-points and states."""

from __future__ import annotations

import asyncio
import contextlib
import math
from functools import partial

from rtee import monotonic
from rtee.buses.canopen import CanopenBus
from rtee.buses.emulator import CanFrame
from rtee.drivers.cia402 import cia301, codec
from rtee.drivers.cia402.cia301 import NmtState, emergency_cure, emergency_name
from rtee.drivers.cia402.codec import Control, Mode, Object, State, StatusBit
from rtee.drivers.cia402.drive import DriveLink
from rtee.drivers.cia402.options import Cia402Options
from rtee.errors import BusError, BusTimeout, DeviceFault, NotConnected
from rtee.types import DeviceSpec

MODES = {"profile_position": Mode.PROFILE_POSITION, "cyclic_position": Mode.CYCLIC_POSITION}
"""Mode of operation (object 6060h) by the name of the option."""

SET_UP_WITHIN = 10.0
"""Longest time to set up one drive, in roughly forty SDO transfers [s]."""

_NOT_ENABLED = 0x10002
_HOMING_FAILED = 0x10003
"""Codes of the driver's own faults, above the drives' 16-bit error codes."""

_HOMING_PERIOD = 0.005
"""Pause between two SYNCs while a drive homes [s]; homing takes seconds."""

_OLD_STATUS = 0.05
"""Time after the start of homing in which a drive may still report the previous homing [s]."""


class DriveCycle:
    """Exchanges process data with the drives of a device, one SYNC per cycle.

    A set-point takes effect with the next SYNC, and every drive answers a SYNC with its state.

    Args:
        spec: The device.
        options: The device's options.

    Attributes:
        bus: The network.
        drives: The drives, in the order of the actuators.
        mode: Commanded mode of operation.
        operational: Whether the drives have been started, so that they answer SYNC.
    """

    def __init__(self, spec: DeviceSpec, bus: CanopenBus, options: Cia402Options) -> None:
        self.bus = bus
        self.mode = MODES[options.mode]
        self.operational = False
        self.drives = [DriveLink(bus, options.nodes[a.name], a.name) for a in spec.actuators]
        self._device = spec.name
        self._options = options
        self._news = asyncio.Event()
        self._beat = -math.inf
        for drive in self.drives:
            drive.attach(options.sdo_timeout, self._news.set)

    def detach(self) -> None:
        """Stop listening to the drives."""
        for drive in self.drives:
            drive.detach()

    # --- every cycle -------------------------------------------------------------------------

    async def synchronise(self) -> None:
        """Send a SYNC and wait for the state of all drives.

        Raises:
            BusTimeout: if a drive does not answer.
            NotConnected: if a drive has restarted.
        """
        bus, now = self.bus, monotonic.now()
        self._send_heartbeat(now)
        # Before sending, since an answer counts only if it is newer than this SYNC.
        before = [drive.stamp for drive in self.drives]
        bus.send_now(CanFrame(cia301.SYNC))
        # Counted here, since the bus sees only single frames.
        bus.counters.transactions += 1
        end = now + self._options.deadline
        while True:
            bus.check()
            late = [d.id for d, stamp in zip(self.drives, before, strict=True) if d.stamp <= stamp]
            # Checked before missing answers, since a restart explains those.
            restarted = [d for d in self.drives if d.booted]
            if restarted:
                raise NotConnected(
                    self._device, f"node {restarted[0].id} has restarted; was its supply cut?"
                )
            if not late:
                return
            # Cleared after the list was made, so that no report in between is missed.
            self._news.clear()
            try:
                async with asyncio.timeout(end - monotonic.now()):
                    await self._news.wait()
            except TimeoutError:
                bus.counters.timeouts += 1
                silent = [d for d in self.drives if d.id in late]
                nodes = ", ".join(
                    f"{d.id} ({d.absence})" if d.absence else str(d.id) for d in silent
                )
                raise BusTimeout(bus.name, f"no process data from node {nodes}") from None

    def _send_heartbeat(self, now: float) -> None:
        """Send this program's heartbeat when due, four times within the drives' watchdog time."""
        watchdog = self._options.watchdog
        if watchdog > 0.0 and now - self._beat > watchdog / 4.0:
            self._beat = now
            self.bus.send_now(cia301.heartbeat(self._options.host, NmtState.OPERATIONAL))

    async def exchange(self) -> None:
        """Send all set-points, then `synchronise`."""
        for drive in self.drives:
            drive.send_command(self.mode)
        await self.synchronise()

    async def settle(self) -> None:
        """Synchronise until all drives answer; raises `BusTimeout` if they do not in time."""
        end = monotonic.now() + self._options.enable_timeout
        while True:
            try:
                await self.synchronise()
            except BusTimeout:
                if monotonic.now() > end:
                    raise
            else:
                return

    # --- faults ------------------------------------------------------------------------------

    def broken(self) -> list[DriveLink]:
        """Return the drives that are in fault."""
        return [d for d in self.drives if d.state in (State.FAULT, State.FAULT_REACTION)]

    def check_faults(self) -> None:
        """Raise the `DeviceFault` of the first drive that is in fault."""
        for drive in self.broken():
            raise self._fault(drive)

    def check_enabled(self) -> None:
        """Raise `DeviceFault` unless every drive is enabled."""
        if all(drive.state is State.ENABLED for drive in self.drives):
            return
        self.check_faults()
        for drive in self.drives:
            if drive.state is not State.ENABLED:
                raise DeviceFault(
                    self._device,
                    _NOT_ENABLED,
                    f"node {drive.id} ({drive.name}) is {drive.state.name.lower()}",
                    hint="`rtee recover` enables it again",
                )

    def _fault(self, drive: DriveLink) -> DeviceFault:
        code = drive.motion.error or (drive.emergency.code if drive.emergency else 0)
        name = emergency_name(code) if code else "no reason given"
        return DeviceFault(
            self._device,
            code,
            f"node {drive.id} ({drive.name}): {name}",
            hint=f"{emergency_cure(code)}, then `rtee recover`",
        )

    async def reset_faults(self) -> None:
        """Reset the drives that are in fault; they stay disabled.

        Raises `DeviceFault` if a drive stays in fault, and `BusError`.
        """
        end = monotonic.now() + self._options.enable_timeout
        await self.settle()
        while broken := self.broken():
            if monotonic.now() > end:
                raise self._fault(broken[0])
            for drive in broken:
                # The rising edge of the reset bit resets a fault.
                edge = drive.controlword == Control.DISABLE_VOLTAGE
                drive.controlword = Control.FAULT_RESET if edge else Control.DISABLE_VOLTAGE
                drive.forget()
            # A lost frame costs one round; only the end of the whole time is a failure.
            with contextlib.suppress(BusTimeout):
                await self.exchange()
        for drive in self.drives:
            drive.emergency = None
            # Drives that had no fault keep their power.
            enabled = drive.state is State.ENABLED
            drive.controlword = Control.ENABLE if enabled else Control.DISABLE_VOLTAGE

    # --- power and homing --------------------------------------------------------------------

    async def enable(self) -> None:
        """Enable all drives at their positions, one transition of their state machine at a time.

        Raises `DeviceFault` if a drive is in fault or is not enabled in time, and `BusError`.
        """
        end = monotonic.now() + self._options.enable_timeout
        while True:
            self.check_faults()
            disabled = [d for d in self.drives if d.state is not State.ENABLED]
            for drive in disabled:
                control = codec.next_control(drive.state)
                if control is not None:
                    drive.controlword = control
                # An enabled drive moves to its target, so the target must be its position.
                drive.assume(drive.position)
            if not disabled:
                return
            if monotonic.now() > end:
                slow = disabled[0]
                raise DeviceFault(
                    self._device,
                    _NOT_ENABLED,
                    f"node {slow.id} ({slow.name}) does not leave the state "
                    f"{slow.state.name.lower()}",
                    hint="is the motor's supply on, and no safe stop active?",
                )
            with contextlib.suppress(BusTimeout):
                await self.exchange()

    async def home(self, drive: DriveLink) -> None:
        """Home one enabled drive; disable it on cancellation or an error.

        Raises:
            DeviceFault: if it reports a fault or a homing error, or takes too long.
            BusError: if the network fails.
        """
        mode, method = self.mode, drive.options.homing_method or 0
        await self.bus.run(
            partial(drive.download, Object.HOMING_METHOD, 0, "b", method), SET_UP_WITHIN
        )
        # For all drives, as every set-point carries the mode; the others stay where they are.
        self.mode = Mode.HOMING
        try:
            await self._search(drive)
        # A drive must not continue homing without supervision.
        except BaseException:
            drive.controlword = Control.DISABLE_VOLTAGE
            with contextlib.suppress(BusError):
                drive.send_command(self.mode)
                self.bus.send_now(CanFrame(cia301.SYNC))
            raise
        finally:
            self.mode = mode
        drive.controlword = Control.ENABLE

    async def _search(self, drive: DriveLink) -> None:
        """Start homing once the drive is in homing mode, and wait until it is done."""
        end = monotonic.now() + self._options.homing_timeout
        begun = math.inf
        while True:
            if drive.status is not None and drive.status.mode == Mode.HOMING:
                begun = min(begun, monotonic.now())
            # The rising edge of the start bit begins homing, but only in homing mode.
            started = math.isfinite(begun)
            drive.controlword = Control.ENABLE | (codec.HOMING_START if started else 0)
            with contextlib.suppress(BusTimeout):
                await self.exchange()
            if drive.state is State.FAULT:
                raise self._fault(drive)
            status = 0 if drive.status is None else drive.status.statusword
            current = monotonic.now() > begun + _OLD_STATUS
            failed = current and status & StatusBit.HOMING_ERROR
            reached = status & StatusBit.ACKNOWLEDGED and status & StatusBit.REACHED
            if current and reached and not failed:
                return
            if failed or monotonic.now() > end:
                raise DeviceFault(
                    self._device,
                    _HOMING_FAILED,
                    f"homing failed: {drive.name}",
                    hint="free it, or see in its manual which `homing_method` it knows; then "
                    "`rtee recover` homes it again",
                )
            await asyncio.sleep(_HOMING_PERIOD)
