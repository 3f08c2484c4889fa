"""Drives an OnRobot 3FG over Modbus, through the Compute Box or directly."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar, Literal

import numpy as np
from pydantic import BaseModel, Field

from rtee.buses.modbus import ModbusBus, ModbusRefusal
from rtee.buses.pool import BusPool
from rtee.capabilities import Capabilities, GripForce
from rtee.drivers.emulators import emulator_of
from rtee.drivers.onrobot_3fg.codec import (
    FIRMWARE,
    GEOMETRY,
    LIMITS,
    PRODUCT,
    SERIAL,
    SERIAL_COUNT,
    STATUS,
    STATUS_COUNT,
    TARGETS,
    Command,
    Control,
    Fingers,
    GripType,
    Scale,
    Status,
    metres,
    offset_metres,
    serial_number,
)
from rtee.drivers.options import DeviceOptions, read_options
from rtee.drivers.register_blocks import PATIENT, Blocks, BlocksDriver, ExchangeKind
from rtee.errors import (
    BusError,
    BusTimeout,
    ConfigError,
    DeviceFault,
    FrameError,
    HandshakeError,
    NotConnected,
)
from rtee.sample import ActuatorState
from rtee.types import DeviceSpec, Reference

_SAME = 10
"""A diameter this near to the measured one asks for no motion [0.1 mm].

It is ten times the resolution: a held object yields by some of that.
"""

_REACHED = 3
"""A diameter this near to the measured one counts as reached [0.1 mm]: resolution and rounding."""

_STUCK_BUSY = 0.5
"""Busy without moving for this long, it is stopped before it is asked to grip [s]."""

_GRIP_POINTS = 33
"""Diameters at which the force is computed: linear interpolation between them is off by 1 %."""

_GATEWAY = (0x0A, 0x0B)
"""Exceptions by which the Compute Box reports that no tool answers."""

_CONNECTING = 0.5
"""Longest time for a request about the gripper while connecting [s]; the box may be slow."""


class OnRobot3FGOptions(DeviceOptions):
    """Options of a 3FG15 or 3FG25."""

    host: str = Field("192.168.1.1", description="the Compute Box's address (Modbus TCP)")
    port: str | None = Field(
        None, description="instead of `host`: tty, socket://, rfc2217:// (RTU) or tcp://host:port"
    )
    unit: int = Field(65, ge=0, le=255, description="65; 66 and 67 on a dual quick changer")
    baudrate: int = Field(1_000_000, gt=0, description="of a direct line (8E1)")
    grip: Literal["external", "internal"] = "external"
    force: float = Field(240.0, gt=0.0, description="largest force of the model [N]")
    smallest: float = Field(
        0.0346, gt=0.0, description="raw diameter at the actuator's upper limit [m]"
    )
    largest: float | None = Field(
        None, gt=0.0, description="raw diameter at its lower limit [m]; by default as it reports"
    )
    target: Literal["raw", "tips"] = Field(
        "raw",
        description="what the target diameter means: between the fingertips' centres, or their "
        "surfaces",
    )
    settle: float = Field(
        0.1, ge=0.0, description="a reference that rests this long is gripped at with force [s]"
    )
    exchange: ExchangeKind = Field("auto", description="function 23, or 16 and 3")
    rate: float = Field(50.0, gt=0.0, description="exchanges per second through the Compute Box")

    @property
    def address(self) -> str:
        """The address of the bus."""
        return self.port or f"tcp://{self.host}"


class OnRobot3FGDriver(BlocksDriver):
    """A 3FG15 or 3FG25.

    The gripper accepts no speed, and force only with the command *grip*, which it ignores while it
    is busy. So a reference that changes is followed by *move*; one that rests is gripped at, with
    its effort, as soon as the gripper is free. It attaches without writing anything.
    """

    Options: ClassVar[type[BaseModel] | None] = OnRobot3FGOptions

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        self.options = read_options(OnRobot3FGOptions, spec)
        if len(spec.actuators) != 1:
            raise ConfigError(
                f"device '{spec.name}': a 3FG has one actuator, not {len(spec.actuators)}",
                key=f"devices.{spec.name}.actuators",
            )
        self.scale = self._scaled(self.options.largest or 0.150)
        self._fingers = Fingers()
        self._kind = GripType[self.options.grip.upper()]
        self._status = Status()
        self._sent: Command | None = None
        self._tips = 0
        self._wanted: tuple[int, int] = (0, 0)
        self._wanted_since = 0.0
        self._moved_at = 0.0
        self.capabilities = self._abilities(self.options.rate, {})

    def _scaled(self, largest: float) -> Scale:
        actuator = self.spec.actuators[0]
        return Scale(
            actuator.lower, actuator.upper, largest, self.options.smallest, self.options.force
        )

    def _abilities(self, best_rate: float, identity: Mapping[str, str]) -> Capabilities:
        return Capabilities(
            measures=frozenset({"position", "effort", "grasped"}),
            accepts=frozenset({"position", "max_effort"}),
            best_rate=best_rate,
            recoverable=True,
            grip={self.spec.actuators[0].name: self._grip_force()},
            identity={"model": "OnRobot 3FG", "address": f"unit {self.options.unit}", **identity},
        )

    def _grip_force(self) -> GripForce:
        """Return the total force of the three fingers by diameter; see `Fingers.leverage`."""
        actuator, scale = self.spec.actuators[0], self.scale
        positions = np.linspace(actuator.lower, actuator.upper, _GRIP_POINTS)
        diameters = [metres(1) * scale.position.to_raw(q) for q in positions.tolist()]
        most = tuple(self.options.force * self._fingers.leverage(d) for d in diameters)
        # The force register counts from 0, so the weakest grip has no force anywhere.
        none = (0.0,) * _GRIP_POINTS
        return GripForce(scale.effort.si, none, most, tuple(positions.tolist()))

    # --- life --------------------------------------------------------------------------------

    async def configure(self) -> None:
        """Open the connection and see whether a 3FG answers; moves nothing."""
        options = self.options
        blocks = await self.connection.open(
            self.buses.modbus(
                options.address,
                owner=self.connection.owner,
                baudrate=options.baudrate,
                parity="E",
                emulator=emulator_of(self.spec, "onrobot_3fg", port=options.address),
            ),
            lambda bus: Blocks(
                bus,
                options.unit,
                output=TARGETS,
                source=STATUS,
                count=STATUS_COUNT,
                deadline=PATIENT,
                kind=options.exchange,
                # No document gives a refresh time, so only the wire limits the rate.
                refresh=0.0,
            ),
        )
        sent = len(Command(0, 0).to_registers())
        best = blocks.best_rate(sent) if blocks.bus.rtu else options.rate
        try:
            identity = await self._identify(blocks.bus)
        except BusTimeout as error:
            raise self._absent("no answer") from error
        except ModbusRefusal as error:
            if error.code not in _GATEWAY:
                raise HandshakeError(self.spec.name, "an OnRobot 3FG", error.message) from error
            raise self._absent("the Compute Box finds no tool") from error
        except FrameError as error:
            raise HandshakeError(self.spec.name, "an OnRobot 3FG", error.message) from error
        self.capabilities = self._abilities(best, identity)
        self._pace(best)

    def _absent(self, what: str) -> NotConnected:
        return NotConnected(
            self.spec.name,
            f"{what} (unit {self.options.unit} at {self.options.address})",
            hint="check supply, cable and `unit` (65; 66 or 67 on a dual quick changer)",
        )

    async def _identify(self, bus: ModbusBus) -> dict[str, str]:
        self._status = await self._read()
        unit = self.options.unit
        smallest, largest = await bus.read(unit, LIMITS, 2, deadline=_CONNECTING)
        length, _, hole, offset = await bus.read(unit, GEOMETRY, 4, deadline=_CONNECTING)
        # Other tools of the vendor answer these registers with other contents.
        if hole not in (1, 2, 3) or not smallest < largest:
            raise HandshakeError(
                self.spec.name,
                "an OnRobot 3FG",
                f"a tool with finger position {hole} and diameters {smallest} to {largest}",
                hint="is another tool mounted?",
            )
        self._fingers = Fingers(metres(length), hole, abs(offset_metres(offset)))
        if self.options.target == "tips":
            self._tips = round(self._kind.sign * 2.0 * offset_metres(offset) / metres(1))
        self.scale = self._scaled(self.options.largest or metres(largest))
        if self.scale.largest <= self.scale.smallest:
            raise ConfigError(
                f"device '{self.spec.name}': `smallest` ({self.scale.smallest} m) is not below the "
                f"largest diameter ({self.scale.largest} m)",
                key=f"devices.{self.spec.name}.options.smallest",
            )
        identity = {
            "finger length": f"{metres(length) * 1000:.1f} mm",
            "finger position": str(hole),
            "diameters": f"{metres(smallest) * 1000:.1f} to {metres(largest) * 1000:.1f} mm",
        }
        # Only one source documents these registers, so they are shown and nothing depends on them.
        with contextlib.suppress(BusError):
            product, firmware, serial = [
                await bus.read(unit, register, count, deadline=_CONNECTING)
                for register, count in ((PRODUCT, 1), (FIRMWARE, 1), (SERIAL, SERIAL_COUNT))
            ]
            identity["product code"] = f"{product[0]:#04x}"
            identity["firmware"] = f"{firmware[0] >> 8}.{firmware[0] & 0xFF}"
            identity["serial"] = serial_number(serial)
        return identity

    async def activate(self) -> None:
        """See that the calibration is valid; the gripper needs no activation and no homing."""
        with self.connection.link.unhurried():
            self._status = await self._read()
        self._refuse(self._status)
        self._sent = None
        self._active = True

    async def examine(self) -> str:
        """Raise the fault that it reports."""
        self._refuse(await self._read())
        return ""

    # --- every cycle -------------------------------------------------------------------------

    async def sense(self) -> ActuatorState:
        """Return what the last exchange brought, or read it."""
        kept = self._last_read()
        if kept is None:
            self._note(await self._read())
        stamp = time.monotonic() if kept is None else kept[1]
        status = self._status
        if self._active:
            self._refuse(status)
        return ActuatorState.measured(
            [self.scale.position.to_si(status.raw_diameter)],
            stamp,
            effort=[self.scale.effort.to_si(status.force)],
            grasped=(status.grip_detected,),
        )

    async def move(self, reference: Reference) -> None:
        """Follow a reference that changes, grip at one that rests; in one frame."""
        blocks = self.connection.link
        if not reference.mask[0]:
            return
        command = self._next(
            self.scale.position.to_count(float(reference.position[0])),
            self.scale.effort.to_count(float(reference.max_effort[0])),
            time.monotonic(),
        )
        if command is None:
            return
        block = await blocks.exchange(self._registers(command))
        self._sent = command
        self._note(Status.from_registers(block, self.options.address))
        blocks.keep(block)

    def _next(self, diameter: int, force: int, now: float) -> Command | None:
        """Return what to send for a target [0.1 mm, 0.1 %], or ``None`` for nothing."""
        if (diameter, force) != self._wanted:
            self._wanted, self._wanted_since = (diameter, force), now
        if self._stays(diameter):
            return None
        if self._may_grip(diameter, now):
            if self._sent == self._command(force, diameter, Control.GRIP):
                return None
            if not self._status.busy:
                return self._command(force, diameter, Control.GRIP)
            # Some obstacle keeps the motion from ending, and grip is ignored while it is busy.
            if now - self._moved_at > _STUCK_BUSY:
                return self._command(force, diameter, Control.STOP)
        return self._motion(diameter, force)

    def _stays(self, diameter: int) -> bool:
        """Return whether a target is where it is, with nothing sent yet or an object held."""
        near = abs(diameter - self._status.raw_diameter) <= _SAME
        return near and (self._sent is None or self._status.grip_detected)

    def _may_grip(self, diameter: int, now: float) -> bool:
        """Return whether the target rests and is one to grip at; one reached by a move is not."""
        rests = now - self._wanted_since >= self.options.settle
        return rests and self._tightens(diameter) and (self._gripping or not self._at(diameter))

    def _motion(self, diameter: int, force: int) -> Command | None:
        """Return the command that moves to a target; a grip under way has to be stopped before."""
        busy, asked = self._status.busy, self._sent is not None and self._sent.diameter == diameter
        if asked and (self._at(diameter) or busy or self._gripping):
            return None
        stop = self._gripping and busy
        return self._command(force, diameter, Control.STOP if stop else Control.MOVE)

    @property
    def _gripping(self) -> bool:
        return self._sent is not None and self._sent.control is Control.GRIP

    def _at(self, diameter: int) -> bool:
        """Return whether a diameter counts as reached."""
        return abs(diameter - self._status.raw_diameter) <= _REACHED

    def _tightens(self, diameter: int) -> bool:
        """Return whether a target lies in the direction of gripping, or is reached."""
        if self._kind is GripType.EXTERNAL:
            return diameter <= self._status.raw_diameter + _SAME
        return diameter >= self._status.raw_diameter - _SAME

    def _command(self, force: int, diameter: int, control: Control) -> Command:
        return Command(force, diameter, self._kind, control)

    def _registers(self, command: Command) -> Sequence[int]:
        """Return what goes over the wire for a command whose diameter is raw."""
        wanted = max(command.diameter + self._tips, 0)
        return replace(command, diameter=wanted).to_registers()

    def _note(self, status: Status) -> None:
        # A change of one count may be noise at standstill.
        if abs(status.raw_diameter - self._status.raw_diameter) > 1:
            self._moved_at = time.monotonic()
        self._status = status

    # --- stop and faults ---------------------------------------------------------------------

    async def stop(self) -> None:
        """End the motion; what is gripped stays gripped."""
        status = self._status
        force = self._sent.force if self._sent else status.force
        command = self._command(force, status.raw_diameter, Control.STOP)
        if await self._insist(self._registers(command)):
            self._sent = None

    async def recover(self) -> None:
        """Stop, and see that the calibration is valid again."""
        with self.connection.link.unhurried():
            self._status = await self._read()
        self._refuse(self._status)
        await self.stop()

    def _refuse(self, status: Status) -> None:
        if not status.calibrated:
            self._active = False
            raise DeviceFault(
                self.spec.name,
                3,
                "calibration lost",
                hint="restart the tool from the Compute Box's web page, then recover",
            )

    # --- the wire ----------------------------------------------------------------------------

    async def _read(self) -> Status:
        return Status.from_registers(await self.connection.link.read(), self.options.address)
