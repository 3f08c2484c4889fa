"""Drives a Robotiq two-finger gripper over Modbus."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import ClassVar, Literal

from pydantic import BaseModel, Field

from rtee.buses.modbus import ModbusBus
from rtee.buses.pool import BusPool
from rtee.drivers.base import Driver
from rtee.drivers.emulators import emulator_of, owner_of
from rtee.drivers.options import DeviceOptions, read_options
from rtee.drivers.robotiq import Blocks, ExchangeKind
from rtee.drivers.robotiq_2f.calibration import (
    EndStops,
    checked,
    read_end_stops,
    write_end_stops,
)
from rtee.drivers.robotiq_2f.codec import (
    COUNT,
    FAULTS,
    INPUT,
    MODELS,
    OUTPUT,
    Activation,
    Command,
    Grasp,
    Scale,
    Status,
)
from rtee.drivers.robotiq_2f.emulator import Robotiq2FEmulator
from rtee.errors import (
    BusError,
    BusTimeout,
    CalibrationError,
    ConfigError,
    DeviceFault,
    FrameError,
    HandshakeError,
    NotConnected,
)
from rtee.types import ActuatorState, Capabilities, DeviceSpec, FloatArray, Reference

_Check = Callable[[Status], bool]
_NOT_ACTIVATED = 0x07
_HINT = (
    "`rtee recover` activates it: the fingers close and open once, so nothing may be between them; "
    "or set `home: on_connect`"
)
_SAME = 2
"""A position this near to the measured one asks for no motion [counts]."""


class Robotiq2FOptions(DeviceOptions):
    """Options of a Robotiq two-finger gripper."""

    port: str = Field("/dev/ttyUSB0", description="tty, socket://, rfc2217:// (RTU) or tcp://")
    unit: int = Field(9, ge=1, le=247, description="Modbus number of the gripper")
    baudrate: int = Field(115200, gt=0)
    model: Literal["2f_85", "2f_140", "hand_e"] = "2f_85"
    home: Literal["on_demand", "on_connect"] = Field(
        "on_demand", description="when an inactive gripper is activated, which moves the fingers"
    )
    open_count: int = Field(3, ge=0, le=254, description="measured position when fully open")
    closed_count: int = Field(230, ge=1, le=255, description="measured position when fully closed")
    calibration: Path | None = Field(
        None, description="file of a calibration (`rtee calibrate`); its counts replace these"
    )
    closed_position: float | None = Field(
        None, description="actuator's position when fully closed; by default its upper limit"
    )
    register_base: int | None = Field(
        None, description="first register of both blocks, 0 for the old universal controller"
    )
    function: Literal[3, 4] = Field(3, description="Modbus function to read with")
    exchange: ExchangeKind = Field("auto", description="function 23, or 16 and a read")
    activation_timeout: float = Field(15.0, gt=0.0, description="[s]")


class Robotiq2FDriver(Driver):
    """A 2F-85, 2F-140 or Hand-E.

    It attaches to a gripper that is active without writing anything: the first write comes with the
    first reference that differs from where the gripper is. A gripper that holds an object and is
    asked to stay where it is keeps its grip.
    """

    Options: ClassVar[type[BaseModel] | None] = Robotiq2FOptions

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        self.options = read_options(Robotiq2FOptions, spec)
        if len(spec.actuators) != 1:
            raise ConfigError(
                f"device '{spec.name}': a two-finger gripper has one actuator, "
                f"not {len(spec.actuators)}",
                key=f"devices.{spec.name}.actuators",
            )
        self.scale = self._scaled(self.options.open_count, self.options.closed_count)
        self._bus: ModbusBus | None = None
        self._blocks: Blocks | None = None
        self._status = Status()
        self._active = False
        self._home_asked = False
        self._sent: Command | None = None
        self.capabilities = self._abilities(100.0)

    def _scaled(self, open_count: int, closed_count: int) -> Scale:
        actuator, closed = self.spec.actuators[0], self.options.closed_position
        return Scale(
            MODELS[self.options.model],
            actuator.lower,
            actuator.upper if closed is None else closed,
            open_count,
            closed_count,
        )

    def _abilities(self, best_rate: float) -> Capabilities:
        return Capabilities(
            measures=frozenset({"position", "current", "grasped"}),
            accepts=frozenset({"position", "max_effort", "max_velocity"}),
            best_rate=best_rate,
            homing=True,
            recoverable=True,
            identity={"model": self.scale.model.name, "address": f"unit {self.options.unit}"},
        )

    # --- life --------------------------------------------------------------------------------

    async def configure(self) -> None:
        """Open the line and see whether a two-finger gripper answers; moves nothing."""
        await self.close()
        options = self.options
        if options.calibration is not None:
            stops = read_end_stops(options.calibration, self.spec.name, options.model, options.unit)
            self.scale = self._scaled(stops.open_count, stops.closed_count)
        self._bus = bus = await self.buses.modbus(
            options.port,
            owner=owner_of(self.spec),
            baudrate=options.baudrate,
            # Found active, as after an earlier run, unless it is to be homed on connecting.
            emulator=emulator_of(
                self.spec,
                Robotiq2FEmulator,
                emulator={"activated": options.home == "on_demand", **options.emulator},
            ),
        )
        base = options.register_base
        self._blocks = Blocks(
            bus,
            options.unit,
            output=OUTPUT if base is None else base,
            source=INPUT if base is None else base,
            count=COUNT,
            deadline=0.5,
            # Where both blocks begin at 0, function 23 cannot tell them apart.
            kind="separate" if base == 0 and options.exchange == "auto" else options.exchange,
            function=options.function,
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
                f"a Robotiq {self.scale.model.name}",
                error.message,
                hint="is it another gripper, or is another program using the line?",
            ) from error

    async def activate(self) -> None:
        """Attach to an active gripper; activate an inactive one where that was asked for."""
        status = self._status = await self._read()
        self._refuse(status)
        if not status.ready:
            if self.options.home != "on_connect" and not self._home_asked:
                raise self._fault(_NOT_ACTIVATED)
            await self._activate()
        self._home_asked = False
        self._sent = None
        self._active = True

    async def _activate(self) -> None:
        """Reset the gripper, then let it find its end stops; cancelling stops it."""
        try:
            async with asyncio.timeout(self.options.activation_timeout):
                await self._write(Command())
                await self._until(lambda status: status.activation is Activation.RESET)
                await self._write(Command(activate=True))
                await self._until(lambda status: status.ready)
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

    async def _until(self, done: _Check) -> None:
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
        kept = blocks.fresh(2.0 * max(1.0 / self.capabilities.best_rate, self._period()))
        if kept is None:
            self._status, stamp = await self._read(), time.monotonic()
        else:
            stamp = kept[1]
        status = self._status
        if self._active:
            self._refuse(status)
            if not status.ready and status.activation is not Activation.UNDER_WAY:
                raise self._fault(_NOT_ACTIVATED, "lost its activation; was its supply cut?")
        return ActuatorState.measured(
            [self.scale.position(status.position)],
            stamp,
            current=[status.current],
            grasped=(self._grasped(status),),
            warnings=self._warnings(status),
        )

    async def move(self, reference: Reference) -> None:
        """Send position, speed and force in one frame, and read what the gripper says to it."""
        blocks = self._open()
        if not reference.mask[0]:
            return
        status = self._status
        count = self.scale.count(float(reference.position[0]))
        command = Command(
            activate=True,
            go=True,
            position=count,
            speed=self.scale.speed_count(float(reference.max_velocity[0])),
            force=self.scale.force_count(float(reference.max_effort[0])),
        )
        if abs(count - status.position) <= _SAME and (self._sent is None or _holds(status)):
            if self._sent is None:
                return
            command = Command(
                activate=True,
                go=True,
                position=self._sent.position,
                speed=command.speed,
                force=command.force,
            )
        block = await blocks.exchange(command.to_registers())
        self._sent = command
        self._status = Status.from_registers(block, self.options.port)
        blocks.keep(block)

    def _period(self) -> float:
        return (self.spec.every or 1) / self.spec.rate

    # --- stop and faults ---------------------------------------------------------------------

    async def stop(self) -> None:
        """Clear rGTO: the fingers stop where they are, and what they hold stays held."""
        if self._blocks is None:
            return
        status = self._status
        command = Command(
            activate=status.activated,
            position=status.requested,
            speed=self._sent.speed if self._sent else 255,
            force=self._sent.force if self._sent else 255,
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
        elif fault is not None and not fault.warning and status.fault != _NOT_ACTIVATED:
            raise self._fault(status.fault)
        self._home_asked = True

    def _refuse(self, status: Status) -> None:
        """Raise the fault that the gripper reports, unless it is only a warning."""
        fault = FAULTS.get(status.fault)
        if fault is not None and not fault.warning and status.fault != _NOT_ACTIVATED:
            self._active = False
            raise self._fault(status.fault)

    def _fault(self, code: int, name: str = "") -> DeviceFault:
        fault = FAULTS[code]
        self._active = False
        hint = _HINT if code == _NOT_ACTIVATED else fault.hint
        return DeviceFault(self.spec.name, code, name or fault.name, hint=hint)

    def _warnings(self, status: Status) -> tuple[str, ...]:
        found = []
        fault = FAULTS.get(status.fault)
        if fault is not None and fault.warning:
            found.append(fault.name)
        if status.controller_fault:
            found.append(f"the optional controller reports fault {status.controller_fault}")
        return tuple(found)

    def _grasped(self, status: Status) -> bool:
        """Return whether something is held: by the gripper's word and by where it stands.

        Contact is not reported for thin objects: then the fingers stand short of a request that
        they could have reached.
        """
        if not status.going:
            return False
        if status.grasp is Grasp.CONTACT_CLOSING:
            return status.position < self.scale.closed_count - 1
        if status.grasp is Grasp.CONTACT_OPENING:
            return status.position > self.scale.open_count + 1
        reachable = min(max(status.requested, self.scale.open_count), self.scale.closed_count)
        return status.grasp is Grasp.AT_REQUEST and reachable - status.position > 2 * _SAME

    # --- calibration -------------------------------------------------------------------------

    async def calibrate(
        self, path: Path, rest: FloatArray, ready: Callable[[str], Awaitable[None]]
    ) -> EndStops:
        """Close and open the gripper fully, gently, and store the counts where it ends.

        Args:
            path: File to write.
            rest: Not needed here.
            ready: Called with what the user is to do; returns when it is done.

        Raises:
            BusError: if the line fails.
            CalibrationError: if the fingers did not go all the way.
            ConfigError: if the file cannot be written.
        """
        await ready("Take everything out of the gripper's reach: it will close and open fully.")
        self._home_asked = True
        await self.activate()
        closed = await self._end_stop(255)
        opened = await self._end_stop(0)
        stops = checked(
            EndStops(self.options.model, self.options.unit, opened, closed), self.spec.name
        )
        write_end_stops(path, stops)
        return stops

    async def _end_stop(self, request: int) -> int:
        """Go to an end slowly and weakly; return the count where the gripper stands still."""
        command = Command(activate=True, go=True, position=request, speed=64, force=0)
        try:
            async with asyncio.timeout(15.0):
                await self._write(command)
                await self._until(
                    lambda s: s.requested == request and s.going and s.grasp is not Grasp.MOVING
                )
        except TimeoutError:
            raise CalibrationError(self.spec.name, "the fingers did not come to an end") from None
        return self._status.position

    # --- the wire ----------------------------------------------------------------------------

    def _open(self) -> Blocks:
        if self._blocks is None:
            raise NotConnected(self.spec.name, "is not connected")
        return self._blocks

    async def _read(self) -> Status:
        return Status.from_registers(await self._open().read(), self.options.port)

    async def _write(self, command: Command) -> None:
        await self._open().write(command.to_registers())


def _holds(status: Status) -> bool:
    return status.going and status.grasp in (Grasp.CONTACT_CLOSING, Grasp.CONTACT_OPENING)
