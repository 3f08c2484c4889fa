"""Drives Robotiq's three-finger gripper over Modbus."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections.abc import Callable, Coroutine, Mapping
from typing import Any, ClassVar

from pydantic import BaseModel

from rtee.buses.modbus import ModbusBus
from rtee.buses.pool import BusPool
from rtee.drivers.base import Driver
from rtee.drivers.emulators import emulator_of, owner_of
from rtee.drivers.options import read_options
from rtee.drivers.robotiq import Blocks
from rtee.drivers.robotiq_3f.codec import (
    AXES,
    COUNT,
    FAULTS,
    INPUT,
    OUTPUT,
    AxisStatus,
    Command,
    Contact,
    Mode,
    Progress,
    Request,
    Scale,
    Status,
)
from rtee.drivers.robotiq_3f.emulator import Robotiq3FEmulator
from rtee.drivers.robotiq_3f.options import Robotiq3FOptions, roles_of
from rtee.errors import (
    BusError,
    BusTimeout,
    DeviceFault,
    FrameError,
    HandshakeError,
    NotConnected,
)
from rtee.types import ActuatorState, Capabilities, DeviceSpec, Reference

_NOT_ACTIVATED = 0x07
_HINT = (
    "`rtee recover` activates it: all fingers and the scissor then move, so nothing may be between "
    "them; or set `home: on_connect`"
)
_SAME = 2
"""A position this near to the measured one asks for no motion [counts]."""


class Robotiq3FDriver(Driver):
    """The three-finger gripper: all fingers together or each for itself, and the scissor.

    It attaches to a gripper that is active without writing anything: the first write comes with the
    first reference that differs from where the gripper is. A motor that presses on an object and is
    asked to stay where it is keeps pressing.
    """

    Options: ClassVar[type[BaseModel] | None] = Robotiq3FOptions

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        self.options = read_options(Robotiq3FOptions, spec)
        self.roles = roles_of(spec, self.options)
        self.scale = Scale()
        self._individual = any(role in ("a", "b", "c") for role in self.roles)
        self._scissor = "scissor" in self.roles
        self._bus: ModbusBus | None = None
        self._blocks: Blocks | None = None
        self._status = Status()
        self._active = False
        self._home_asked = False
        self._sent: Command | None = None
        self.capabilities = self._abilities(50.0)

    def _abilities(self, best_rate: float) -> Capabilities:
        return Capabilities(
            measures=frozenset({"position", "current", "grasped"}),
            accepts=frozenset({"position", "max_effort", "max_velocity"}),
            best_rate=best_rate,
            homing=True,
            recoverable=True,
            identity={
                "model": "Robotiq 3-Finger",
                "address": f"unit {self.options.unit}",
                "mode": self.options.mode,
            },
        )

    # --- life --------------------------------------------------------------------------------

    async def configure(self) -> None:
        """Open the line and see whether a three-finger gripper answers; moves nothing."""
        await self.close()
        options = self.options
        self._bus = bus = await self.buses.modbus(
            options.port,
            owner=owner_of(self.spec),
            baudrate=options.baudrate,
            # Found active, as after an earlier run, unless it is to be homed on connecting.
            emulator=emulator_of(
                self.spec,
                Robotiq3FEmulator,
                emulator={"activated": options.home == "on_demand", **options.emulator},
            ),
        )
        network = options.port.startswith("tcp://")
        base = options.register_base
        zero = network if base is None else base == 0
        self._blocks = Blocks(
            bus,
            options.unit,
            output=0 if zero else OUTPUT,
            source=0 if zero else INPUT,
            count=COUNT,
            deadline=0.5,
            # Where both blocks begin at 0, function 23 cannot tell them apart.
            kind="separate" if zero and options.exchange == "auto" else options.exchange,
            function=options.function or (4 if network else 3),
        )
        self.capabilities = self._abilities(self._blocks.best_rate(COUNT))
        await self._identify()
        self._blocks.deadline = self._deadline(self.capabilities.best_rate)

    def _deadline(self, best: float) -> float:
        every = self.spec.every or math.ceil(self.spec.rate / best)
        return self.spec.deadline or max(1.5 * every / self.spec.rate, 3.0 / best)

    async def _identify(self) -> None:
        try:
            self._status = await self._read()
        except BusTimeout as error:
            raise NotConnected(
                self.spec.name,
                f"no answer from unit {self.options.unit} at {self.options.port}",
                hint="check supply, wiring, `unit` and `baudrate`; `rtee doctor` helps",
            ) from error
        except FrameError as error:
            raise HandshakeError(
                self.spec.name,
                "a Robotiq 3-Finger",
                error.message,
                hint="is it another gripper, or is another program using the line?",
            ) from error

    async def activate(self) -> None:
        """Attach to an active gripper; activate it or change its mode where that was asked for."""
        status = self._status = await self._read()
        self._refuse(status)
        allowed = self.options.home == "on_connect" or self._home_asked
        if not status.ready:
            if not allowed:
                raise self._fault(_NOT_ACTIVATED)
            await self._within(self._activate())
        if not self._scissor and self._status.mode is not self._mode:
            if not allowed:
                raise DeviceFault(
                    self.spec.name,
                    0x06,
                    f"in mode '{self._status.mode.name.lower()}', not '{self.options.mode}'",
                    hint="`rtee recover` changes the mode, which moves the scissor",
                )
            await self._within(self._change_mode())
        self._home_asked = False
        self._sent = None
        self._active = True

    @property
    def _mode(self) -> Mode:
        return Mode[self.options.mode.upper()]

    async def _within(self, steps: Coroutine[Any, Any, None]) -> None:
        """Do what moves the gripper, in time; cancelling stops it."""
        try:
            async with asyncio.timeout(self.options.activation_timeout):
                await steps
        except TimeoutError:
            raise DeviceFault(
                self.spec.name,
                0x0D,
                "activation not done in time",
                hint="free the fingers, then `rtee recover`",
            ) from None
        except asyncio.CancelledError:
            with contextlib.suppress(BusError):
                await self._write(Command())
            raise

    async def _activate(self) -> None:
        await self._write(Command())
        await self._until(lambda status: status.progress is Progress.RESET)
        await self._write(Command(activate=True))
        await self._until(lambda status: status.ready)

    async def _change_mode(self) -> None:
        await self._write(Command(activate=True, mode=self._mode))
        await self._until(lambda status: status.ready and status.mode is self._mode)

    async def _until(self, done: Callable[[Status], bool]) -> None:
        missed = 0
        while True:
            try:
                status = self._status = await self._read()
            except (BusTimeout, FrameError):
                missed += 1
                if missed > 5:
                    raise
                continue
            missed = 0
            if done(status):
                return
            self._refuse(status)
            await asyncio.sleep(0.01)

    async def deactivate(self) -> None:
        """Stop; the gripper stays activated, for it would lose its grip otherwise."""
        await self.stop()
        self._active = False

    async def close(self) -> None:
        """Give the line back."""
        self._active = False
        bus, self._bus, self._blocks = self._bus, None, None
        if bus is not None:
            await bus.release(owner_of(self.spec))

    def counters(self) -> Mapping[str, int]:
        """Return the counters of the line."""
        return {} if self._bus is None else self._bus.counters.as_mapping()

    # --- every cycle -------------------------------------------------------------------------

    async def sense(self) -> ActuatorState:
        """Return what the last exchange brought, or read it."""
        blocks = self._open()
        period = (self.spec.every or 1) / self.spec.rate
        kept = blocks.fresh(2.0 * max(1.0 / self.capabilities.best_rate, period))
        if kept is None:
            self._status, stamp = await self._read(), time.monotonic()
        else:
            stamp = kept[1]
        status = self._status
        if self._active:
            self._refuse(status)
            if not status.activated or status.progress is Progress.RESET:
                raise self._fault(_NOT_ACTIVATED, "lost its activation; was its supply cut?")
        return ActuatorState.measured(
            [self.scale.angle(role, self._position(role)) for role in self.roles],
            stamp,
            current=[self._current(role) for role in self.roles],
            grasped=tuple(self._grasped(role) for role in self.roles),
            warnings=self._warnings(status),
        )

    def _axes(self, role: str) -> tuple[AxisStatus, ...]:
        """Return the motors that an actuator drives."""
        axes = self._status.axes
        return axes[:3] if role == "fingers" else (axes[AXES.index(role)],)

    def _position(self, role: str) -> float:
        """Return an actuator's count: for all fingers together, their mean."""
        axes = self._axes(role)
        return sum(axis.position for axis in axes) / len(axes)

    def _current(self, role: str) -> float:
        return max(axis.raw_current for axis in self._axes(role)) * self.options.current_per_count

    def _grasped(self, role: str) -> bool | None:
        """Return whether an actuator's motors press on something, short of their end stops."""
        if role == "scissor" and self._status.mode is not Mode.SCISSOR:
            return None
        if not self._status.going:
            return False
        return any(
            (axis.contact is Contact.CLOSING and axis.position < 250)
            or (axis.contact is Contact.OPENING and axis.position > 10)
            for axis in self._axes(role)
        )

    async def move(self, reference: Reference) -> None:
        """Send positions, speeds and forces in one frame, and read what the gripper says."""
        blocks = self._open()
        command = self._command(reference)
        if command is None:
            return
        block = await blocks.exchange(self._registers(command))
        self._sent = command
        self._status = Status.from_registers(block, self.options.port)
        blocks.keep(block)

    def _registers(self, command: Command) -> tuple[int, ...]:
        """Return what must be written: the simple control needs only the first three registers."""
        registers = command.to_registers()
        return registers if self._individual or self._scissor else registers[:3]

    def _command(self, reference: Reference) -> Command | None:
        """Return what a reference asks for; ``None`` while it asks for what is there already."""
        axes = [self._kept(index) for index in range(4)]
        moving = self._sent is not None
        for index, role in enumerate(self.roles):
            if not reference.mask[index]:
                continue
            request = Request(
                self.scale.count(role, float(reference.position[index])),
                self.scale.speed_count(role, float(reference.max_velocity[index])),
                self.scale.force_count(role, float(reference.max_effort[index])),
            )
            stays = abs(request.position - self._position(role)) <= _SAME
            moving |= not stays
            for at in (0, 1, 2) if role == "fingers" else (AXES.index(role),):
                axes[at] = self._asked(at, request, stays)
        if not moving:
            return None
        return Command(
            activate=True,
            mode=self._status.mode if self._scissor else self._mode,
            go=True,
            individual=self._individual,
            scissor=self._scissor,
            axes=(axes[0], axes[1], axes[2], axes[3]),
        )

    def _asked(self, at: int, request: Request, stays: bool) -> Request:
        pressing = self._status.axes[at].contact in (Contact.OPENING, Contact.CLOSING)
        if not (stays and (self._sent is None or pressing)):
            return request
        return Request(self._kept(at).position, request.speed, request.force)

    def _kept(self, at: int) -> Request:
        """Return the request that changes nothing for a motor."""
        if self._sent is not None:
            return self._sent.axes[at]
        axis = self._status.axes[at]
        if axis.contact in (Contact.OPENING, Contact.CLOSING):
            first = self._status.axes[0].requested
            echo = axis.requested or (first if at < 3 else 0)
            return Request(echo or axis.position, 255, 255)
        return Request(axis.position, 255, 255)

    # --- stop and faults ---------------------------------------------------------------------

    async def stop(self) -> None:
        """Clear rGTO: the fingers stop where they are, and what they hold stays held."""
        if self._blocks is None:
            return
        status = self._status
        axes = [self._kept(at) for at in range(4)]
        command = Command(
            activate=status.activated,
            mode=status.mode,
            individual=self._individual,
            scissor=self._scissor,
            axes=(axes[0], axes[1], axes[2], axes[3]),
        )
        for _ in range(3):
            with contextlib.suppress(BusError):
                await self._write(command)
                self._sent = None
                return

    async def recover(self) -> None:
        """Clear a fault; where that costs the activation, the next `activate` may move."""
        status = self._status = await self._read()
        fault = FAULTS.get(status.fault)
        if fault is not None and fault.major:
            try:
                async with asyncio.timeout(0.5):
                    await self._write(Command())
                    while self._status.fault or self._status.activated:
                        await asyncio.sleep(0.01)
                        self._status = await self._read()
            except TimeoutError:
                raise self._fault(self._status.fault) from None
        self._home_asked = True

    def _refuse(self, status: Status) -> None:
        """Raise the fault that the gripper reports, unless it is only a warning."""
        fault = FAULTS.get(status.fault)
        if fault is not None and not fault.warning and status.fault != _NOT_ACTIVATED:
            raise self._fault(status.fault)

    def _fault(self, code: int, name: str = "") -> DeviceFault:
        self._active = False
        fault = FAULTS[code]
        hint = _HINT if code == _NOT_ACTIVATED else fault.hint
        return DeviceFault(self.spec.name, code, name or fault.name, hint=hint)

    def _warnings(self, status: Status) -> tuple[str, ...]:
        fault = FAULTS.get(status.fault)
        return (fault.name,) if fault is not None and fault.warning else ()

    # --- the wire ----------------------------------------------------------------------------

    def _open(self) -> Blocks:
        if self._blocks is None:
            raise NotConnected(self.spec.name, "is not connected")
        return self._blocks

    async def _read(self) -> Status:
        return Status.from_registers(await self._open().read(), self.options.port)

    async def _write(self, command: Command) -> None:
        await self._open().write(self._registers(command))
