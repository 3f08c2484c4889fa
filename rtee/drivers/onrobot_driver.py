"""Drives an OnRobot gripper: connect through the Compute Box or directly, identify, read, stop."""

from __future__ import annotations

import contextlib
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, TypeVar

from rtee.buses.modbus import ModbusBus, ModbusRefusal, UnitUnreachable
from rtee.buses.pool import BusPool
from rtee.capabilities import Capabilities
from rtee.drivers.emulators import emulator_of
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
from rtee.drivers.register_blocks import Blocks, ExchangingDriver
from rtee.drivers.wiring import only_actuator
from rtee.errors import BusError, BusTimeout, FrameError, HandshakeError, NotConnected
from rtee.types import DeviceSpec, Reference

CONNECTING = 0.5
"""Longest time for a request about the gripper while connecting [s]; the box may be slow."""

S = TypeVar("S")


class OnRobotDriver(ExchangingDriver[S]):
    """An OnRobot gripper on Modbus, with one actuator.

    It needs no activation and no homing.

    Attributes:
        MODEL: Its name in messages.
        EMULATOR: The name of its emulator.
        STATUS_TYPE: The class of its state.
        SOURCE: First register of its state.
        COUNT: Registers of its state.
        SENT: Registers of a command.
    """

    MODEL: ClassVar[str]
    EMULATOR: ClassVar[str]
    STATUS_TYPE: ClassVar[type[Any]]
    SOURCE: ClassVar[int]
    COUNT: ClassVar[int]
    SENT: ClassVar[int]

    def __init__(self, spec: DeviceSpec, buses: BusPool, settings: OnRobotOptions) -> None:
        super().__init__(spec, buses)
        self._settings = settings
        only_actuator(spec, self.MODEL)
        self._status: S = self.STATUS_TYPE()

    # --- defined by each model ---------------------------------------------------------------

    @abstractmethod
    async def _described(self, bus: ModbusBus) -> dict[str, str]:
        """Return the identity that only this model reports; raises `HandshakeError`."""

    @abstractmethod
    def _abilities(self, best_rate: float, identity: Mapping[str, str]) -> Capabilities:
        """Return what it measures and accepts."""

    # --- life --------------------------------------------------------------------------------

    async def configure(self) -> None:
        """Open the connection and identify the gripper; moves nothing."""
        options = self._settings
        blocks = await self.connection.open(
            self.buses.modbus(
                options.address,
                owner=self.connection.owner,
                baudrate=options.baudrate,
                parity="E",
                emulator=emulator_of(self.spec, self.EMULATOR, port=options.address),
            ),
            lambda bus: Blocks(
                bus,
                options.unit,
                output=TARGETS,
                source=self.SOURCE,
                count=self.COUNT,
                kind=options.exchange,
                # No document gives a refresh time, so only the wire limits the rate.
                refresh=0.0,
            ),
        )
        best = blocks.best_rate(self.SENT) if blocks.bus.rtu else options.rate
        try:
            identity = await self._identify(blocks.bus)
        except UnitUnreachable as error:
            raise self._absent("the Compute Box finds no tool") from error
        except BusTimeout as error:
            raise self._absent("no answer") from error
        except (ModbusRefusal, FrameError) as error:  # a tool that does not have these registers
            raise HandshakeError(self.spec.name, self.MODEL, error.message) from error
        self.capabilities = self._abilities(best, identity)
        self._pace(best)

    def _absent(self, what: str) -> NotConnected:
        return NotConnected(
            self.spec.name,
            f"{what} (unit {self._settings.unit} at {self._settings.address})",
            hint="check supply, cable and `unit` (65; 66 or 67 on a dual quick changer)",
        )

    async def _identify(self, bus: ModbusBus) -> dict[str, str]:
        self._status = await self._read()
        unit = self._settings.unit
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
        """Check that it reports no fault."""
        with self.connection.link.unhurried():
            self._status = await self._read()
        self._refuse(self._status)
        self._forget()
        self._active = True

    async def examine(self) -> str:
        """Raise the fault that it reports."""
        self._refuse(await self._read())
        return ""

    # --- every cycle -------------------------------------------------------------------------

    async def move(self, reference: Reference) -> None:
        """Send a reference in one frame."""
        if reference.mask[0]:
            await super().move(reference)

    async def recover(self) -> None:
        """Check that the cause of the fault is gone, and stop."""
        with self.connection.link.unhurried():
            self._status = await self._read()
        self._refuse(self._status)
        await self.stop()

    def _decoded(self, block: Sequence[int]) -> S:
        status: S = self.STATUS_TYPE.from_registers(block, self._settings.address)
        return status
