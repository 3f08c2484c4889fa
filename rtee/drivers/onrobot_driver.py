"""Drives an OnRobot gripper: connect through the Compute Box or directly, identify, read, stop."""

from __future__ import annotations

import contextlib
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, Generic, TypeVar

from rtee.buses.modbus import ModbusBus, ModbusRefusal, UnitUnreachable
from rtee.buses.pool import BusPool
from rtee.drivers.base import Driver
from rtee.drivers.onrobot_common import (
    FIRMWARE,
    PRODUCT,
    SERIAL,
    SERIAL_COUNT,
    TARGETS,
    OnRobotOptions,
    serial_number,
    version,
)
from rtee.drivers.register_blocks import Blocks
from rtee.drivers.registers import Registers
from rtee.drivers.wiring import only_actuator
from rtee.errors import BusError, FrameError, NotConnected
from rtee.sample import ActuatorState
from rtee.types import DeviceSpec

CONNECTING = 0.5
"""Longest time for a request about the gripper while connecting [s]; the box may be slow."""

S = TypeVar("S", bound=Registers)


class OnRobotDriver(Driver, Generic[S]):
    """An OnRobot gripper on Modbus, with one actuator.

    It needs no activation and no homing. A cycle is one exchange, which writes a command and reads
    the state; without a command, the driver only reads the state.

    Attributes:
        MODEL: Its name in messages.
        STATUS: The block of its state.
        COMMAND: The block of a command.
        SOURCE: First register of its state.
    """

    MODEL: ClassVar[str]
    STATUS: ClassVar[type[Registers]]
    COMMAND: ClassVar[type[Registers]]
    SOURCE: ClassVar[int]
    options: OnRobotOptions
    link: Blocks[S]

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        only_actuator(spec, self.MODEL)
        status: Any = self.STATUS()
        self._status: S = status

    # --- defined by each model ---------------------------------------------------------------

    @abstractmethod
    async def _described(self, bus: ModbusBus) -> dict[str, str]:
        """Return the identity that only this model reports; raises `HandshakeError`."""

    @abstractmethod
    def _measured(self, status: S, stamp: float) -> ActuatorState:
        """Return a state in SI units."""

    @abstractmethod
    def _refuse(self, status: S) -> None:
        """Raise the fault that a state reports, if any."""

    @abstractmethod
    def _stopping(self) -> Sequence[int]:
        """Return the registers that end its motion and change nothing else."""

    @abstractmethod
    def _forget(self) -> None:
        """Forget the last command."""

    # --- life --------------------------------------------------------------------------------

    def _decoded(self, block: Sequence[int]) -> S:
        status: Any = self.STATUS.from_registers(block, self.options.address)
        self._note(status)
        return self._status

    def _note(self, status: S) -> None:
        """Store a state that was read."""
        self._status = status

    async def configure(self) -> None:
        """Open the connection and identify the gripper; moves nothing."""
        options = self.options
        blocks = await self.open(
            self.buses.modbus,
            options.address,
            lambda bus: Blocks(
                bus,
                options.unit,
                self._decoded,
                output=TARGETS,
                source=self.SOURCE,
                count=self.STATUS.COUNT,
                kind=options.exchange,
                # No document gives a refresh time, so only the wire limits the rate.
                refresh=0.0,
            ),
            emulated={"port": options.address},
            baudrate=options.baudrate,
            parity="E",
        )
        best = blocks.best_rate(self.COMMAND.COUNT) if blocks.bus.rtu else options.rate
        where = f"unit {options.unit} at {options.address}"
        hint = "check supply, cable and `unit` (65; 66 or 67 on a dual quick changer)"
        try:
            # A tool that does not have these registers refuses to read them.
            strangers = ModbusRefusal, FrameError
            with self.identifying(self.MODEL, f"no answer ({where})", hint, *strangers):
                identity = await self._identify(blocks)
        except NotConnected as error:
            if not isinstance(error.__cause__, UnitUnreachable):
                raise
            found = f"the Compute Box finds no tool ({where})"
            raise NotConnected(self.spec.name, found, hint=hint) from error.__cause__
        self.refine(best_rate=best, identity={**self.capabilities.identity, **identity})
        blocks.pace(self.spec, best)

    async def _identify(self, blocks: Blocks[S]) -> dict[str, str]:
        await blocks.read()
        unit, bus = self.options.unit, blocks.bus
        identity = {"address": f"unit {unit}", **await self._described(bus)}
        # Few sources document these registers, so they are shown and nothing depends on them.
        with contextlib.suppress(BusError):
            product, firmware, serial = [
                await bus.read(unit, register, count, deadline=CONNECTING)
                for register, count in ((PRODUCT, 1), (FIRMWARE, 1), (SERIAL, SERIAL_COUNT))
            ]
            identity["product code"] = f"{product[0]:#04x}"
            identity["firmware"] = version(firmware[0])
            identity["serial"] = serial_number(serial)
        return identity

    async def activate(self) -> None:
        """Check that the gripper reports no fault."""
        with self.link.relaxed_deadline():
            self._refuse(await self.link.read())
        self._forget()
        self.active = True

    async def examine(self) -> str:
        """Raise the fault that the gripper reports, if any."""
        self._refuse(await self.link.read())
        return ""

    async def sense(self) -> ActuatorState:
        """Return the state that came with the last exchange, or read it."""
        status, stamp = await self.link.newest()
        if self.active:
            self._refuse(status)
        return self._measured(status, stamp)

    async def stop(self) -> None:
        """End the motion; a gripped object stays gripped."""
        if self.connected and await self.link.insist(self._stopping()):
            self._forget()

    async def recover(self) -> None:
        """Check that the cause of the fault is gone, and stop."""
        with self.link.relaxed_deadline():
            self._refuse(await self.link.read())
        await self.stop()
