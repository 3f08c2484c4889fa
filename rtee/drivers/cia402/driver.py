"""Drives grippers whose motors are CiA 402 drives: process data on SYNC, one cycle for all."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from dataclasses import replace
from functools import partial

from rtee.buses.emulator import CanFrame
from rtee.buses.retry import patiently
from rtee.drivers.cia402 import cia301, codec
from rtee.drivers.cia402.cia301 import NmtCommand
from rtee.drivers.cia402.codec import Control, Mode, Object, State, StatusBit
from rtee.drivers.cia402.cycle import NOT_ENABLED, Cia402Cycle
from rtee.drivers.cia402.drive import DriveLink
from rtee.drivers.cia402.emulator import Cia402Emulator
from rtee.drivers.cia402.identity import identify
from rtee.drivers.emulators import emulator_of, owner_of
from rtee.errors import (
    BusError,
    BusTimeout,
    DeviceFault,
    HandshakeError,
    RteeError,
)

_SETTING_UP = 10.0
_DISARMING = 0.5
_NOT_HOMED = 0x10001
_HOMING_FAILED = 0x10003
_HOMING_PERIOD = 0.005
_OLD_NEWS = 0.05
"""A drive tells of its homing at most so long after it has begun [s]."""
_HANDSHAKES = 10
"""Cycles in which two set-points are taken, with room for lost frames."""


class Cia402Driver(Cia402Cycle):
    """CiA 402 drives on one CANopen network.

    A cycle is one SYNC: it makes all drives take the set-points sent before and answer with their
    state. Drives are watched by heartbeat in both directions; theirs shows a restart, ours arms
    their reaction to a silent host. A drive that is enabled already is not disabled and gets its
    own position for the first target.

    Attributes:
        drives: The drives, in the order of the actuators.
    """

    # --- life --------------------------------------------------------------------------------

    async def configure(self) -> None:
        """Open the network, identify the drives, set up their process data; enables nothing."""
        await self.close()
        options = self.options
        bus = self._bus = await self.buses.canopen(
            options.channel,
            owner=owner_of(self.spec),
            interface=options.interface,
            bitrate=options.bitrate,
            emulator=emulator_of(self.spec, Cia402Emulator),
        )
        self.drives = [DriveLink(bus, options.nodes[a.name], a.name) for a in self.spec.actuators]
        for drive in self.drives:
            drive.attach(options.sdo_timeout, self._told.set)
        identities = [
            await bus.run(
                partial(identify, drive, self.spec.name, options.channel, self.mode), _SETTING_UP
            )
            for drive in self.drives
        ]
        self.capabilities = replace(
            self.capabilities,
            identity={
                "model": ", ".join(dict.fromkeys(model for model, _ in identities)),
                "serial": ", ".join(serial for _, serial in identities),
            },
        )
        for drive in self.drives:
            await bus.send(cia301.nmt(NmtCommand.PRE_OPERATIONAL, drive.id))
        for drive in self.drives:
            await bus.run(partial(self._set_up, drive), _SETTING_UP)
        for drive in self.drives:
            drive.booted = False
            await bus.send(cia301.nmt(NmtCommand.START, drive.id))
        self._operational = True
        try:
            await self._first_answer()
        except BusTimeout as error:
            # They have answered SDO: supply, wiring and bit rate are right.
            raise HandshakeError(
                self.spec.name,
                "process data after each SYNC",
                f"{error.message}, though SDO is answered",
                hint="its PDOs must support transmission type 1, and no other master may stop it",
            ) from error

    def _set_up(self, drive: DriveLink) -> None:
        options = self.options
        every = self.spec.every or max(1, math.ceil(self.spec.rate / self.capabilities.best_rate))
        drive.set_up(
            self.mode,
            watch=(options.host, options.watchdog, options.on_silence),
            beat=options.heartbeat,
            period=every / self.spec.rate,
        )
        drive.forget()

    async def _first_answer(self) -> None:
        """Wait for the drives' state without telling them anything."""
        await self._settled()
        for drive in self.drives:
            enabled = drive.state is State.ENABLED
            if not enabled:
                # It may have lost its supply, and with it what homing had found.
                self._homed.discard(drive.id)
            drive.controlword = Control.ENABLE if enabled else Control.DISABLE_VOLTAGE
            here, told = self._measured(drive), drive.found_target
            # A target means something only in the mode in which it was given.
            same = drive.status is not None and drive.status.mode == self.mode
            drive.stand(told if enabled and same and told is not None else here)

    async def close(self) -> None:
        """Give the network back; drives that are enabled stay so, without watching for us."""
        bus = self._bus
        if bus is not None and bus.connected and self._operational and self.options.watchdog > 0.0:
            with contextlib.suppress(RteeError, OSError):
                await bus.run(self._disarm, _DISARMING)
        self._active = self._operational = False
        for drive in self.drives:
            drive.detach()
        self.drives = []
        self._bus = None
        if bus is not None:
            await bus.detach(owner_of(self.spec))

    def _disarm(self) -> None:
        for drive in self.drives:
            drive.download(Object.CONSUMER_HEARTBEAT, 1, "I", 0, tries=1)

    # --- enabling ----------------------------------------------------------------------------

    async def activate(self) -> None:
        """Enable the drives where they stand; homes first where that is needed and allowed."""
        await self._settled()
        needy = self._needy()
        if needy and self.options.home != "on_connect" and not self._home_asked:
            raise DeviceFault(
                self.spec.name,
                _NOT_HOMED,
                f"not homed: {', '.join(d.name for d in needy)}",
                hint="`rtee recover`, or `rtee run --home`, homes it, which moves it",
            )
        holding = [d.state is State.ENABLED for d in self.drives]
        await self._walk(State.ENABLED)
        for drive in needy:
            await self._home(drive)
        self._home_asked = False
        for drive, holds in zip(self.drives, holding, strict=True):
            if not holds:
                drive.stand(self._measured(drive))
        self._attached.begin(i for i, holds in enumerate(holding) if holds)
        self._active = True

    def _needy(self) -> list[DriveLink]:
        """Return the drives that do not know where they are."""
        return [
            d
            for d in self.drives
            if d.options.homing_method is not None
            and d.id not in self._homed
            and d.state is not State.ENABLED
        ]

    async def examine(self) -> str:
        """Return which drives are not homed; raises the fault that one reports."""
        await self._settled()
        for drive in self.drives:
            if drive.state in (State.FAULT, State.FAULT_REACTION):
                raise self._fault(drive)
        needy = ", ".join(d.name for d in self._needy())
        return f"not homed: {needy}" if needy else ""

    async def _walk(self, goal: State) -> None:
        """Bring all drives to a state, one transition at a time.

        Raises:
            DeviceFault: if one is in fault, or does not get on in time.
        """
        end = time.monotonic() + self.options.enable_timeout
        while True:
            for drive in self.drives:
                if drive.state in (State.FAULT, State.FAULT_REACTION):
                    raise self._fault(drive)
                control = next_control_to(drive.state, goal)
                if control is not None:
                    drive.controlword = control
                if drive.state is not State.ENABLED:
                    # Enabled, it would go to the target it was given: that is where it stands.
                    drive.stand(self._measured(drive))
            if all(d.state is goal for d in self.drives):
                return
            if time.monotonic() > end:
                slow = next(d for d in self.drives if d.state is not goal)
                raise DeviceFault(
                    self.spec.name,
                    NOT_ENABLED,
                    f"node {slow.id} ({slow.name}) stays {slow.state.name.lower()}",
                    hint="is the motor's supply on, and no safe stop active?",
                )
            with contextlib.suppress(BusTimeout):
                await self._exchange()

    async def _home(self, drive: DriveLink) -> None:
        """Let one drive look for its zero; cancelling disables it."""
        bus, mode = self._network, self.mode
        method = drive.options.homing_method or 0
        await bus.run(lambda: drive.download(Object.HOMING_METHOD, 0, "b", method), _SETTING_UP)
        end = time.monotonic() + self.options.homing_timeout
        begun = math.inf
        self.doing = f"homing {drive.name}"
        try:
            self.mode = Mode.HOMING
            while True:
                if drive.status is not None and drive.status.mode == Mode.HOMING:
                    begun = min(begun, time.monotonic())
                started = math.isfinite(begun)
                drive.controlword = Control.ENABLE | (codec.HOMING_START if started else 0)
                with contextlib.suppress(BusTimeout):
                    await self._exchange()
                if drive.state is State.FAULT:
                    raise self._fault(drive)
                status = 0 if drive.status is None else drive.status.statusword
                # At first it may still tell of a homing before this one.
                told = time.monotonic() > begun + _OLD_NEWS
                found = status & StatusBit.ACKNOWLEDGED and status & StatusBit.REACHED
                failed = told and status & StatusBit.HOMING_ERROR
                if told and found and not failed:
                    break
                if failed or time.monotonic() > end:
                    raise DeviceFault(
                        self.spec.name,
                        _HOMING_FAILED,
                        f"homing failed: {drive.name}",
                        hint="free it; `rtee recover` homes again",
                    )
                await asyncio.sleep(_HOMING_PERIOD)
        except BaseException:
            drive.controlword = Control.DISABLE_VOLTAGE
            with contextlib.suppress(BusError):
                drive.send_command(self.mode)
                bus.send_now(CanFrame(cia301.SYNC))
            raise
        finally:
            self.mode, self.doing = mode, ""
        drive.controlword = Control.ENABLE
        self._homed.add(drive.id)

    async def deactivate(self) -> None:
        """Take the motors' power away."""
        self._active = False
        if self._operational:
            for drive in self.drives:
                drive.controlword = Control.SHUTDOWN
                drive.forget()
            await self._exchange()

    async def stop(self) -> None:
        """Hold the measured pose."""
        with contextlib.suppress(RteeError, OSError):
            await patiently(self._synchronise)
            self._attached.begin()
            for drive in self.drives:
                drive.target = self._measured(drive)
            # In profile mode a set-point that is under way has to be acknowledged first.
            for _ in range(_HANDSHAKES):
                await patiently(self._exchange)
                if all(drive.took(self.mode) for drive in self.drives):
                    break

    async def disable(self) -> None:
        """Take the motors' voltage away; they go limp as far as their gears let them."""
        self._active = False
        with contextlib.suppress(RteeError, OSError):
            for drive in self.drives:
                drive.controlword = Control.DISABLE_VOLTAGE
            await patiently(self._exchange)

    async def recover(self) -> None:
        """Reset faults; the drives stay disabled until `activate`."""
        self._active = False
        end = time.monotonic() + self.options.enable_timeout
        await self._settled()
        while True:
            broken = [d for d in self.drives if d.state in (State.FAULT, State.FAULT_REACTION)]
            if not broken:
                break
            if time.monotonic() > end:
                raise self._fault(broken[0])
            for drive in broken:
                # The reset is the rising edge of its bit.
                edge = drive.controlword == Control.DISABLE_VOLTAGE
                drive.controlword = Control.FAULT_RESET if edge else Control.DISABLE_VOLTAGE
                drive.forget()
            with contextlib.suppress(BusTimeout):
                await self._exchange()
        for drive in self.drives:
            drive.emergency = None
            drive.controlword = (
                Control.ENABLE if drive.state is State.ENABLED else Control.DISABLE_VOLTAGE
            )
        self._home_asked = True


def next_control_to(state: State, goal: State) -> Control | None:
    """Return the controlword that brings a drive nearer to a state, or ``None``: it is there."""
    return None if state is goal else codec.next_control(state)
