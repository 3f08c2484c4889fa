"""Drives a Robotiq gripper: identify, attach or activate, exchange, stop, recover.

All of this is the same for the two-finger grippers and the 3-Finger; only the registers differ.
"""

from __future__ import annotations

import asyncio
import contextlib
from abc import abstractmethod
from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import ClassVar, Generic, TypeVar

from rtee import monotonic
from rtee.buses.pool import BusPool
from rtee.drivers.base import Driver
from rtee.drivers.capabilities import Capabilities
from rtee.drivers.deadlines import time_limit
from rtee.drivers.register_blocks import PATIENT, Blocks
from rtee.drivers.robotiq_common import (
    NOT_ACTIVATED,
    Fault,
    RobotiqCommand,
    RobotiqOptions,
    RobotiqStatus,
)
from rtee.errors import BusError, BusTimeout, DeviceFault, FrameError
from rtee.sample import ActuatorState
from rtee.types import DeviceSpec, Reference

_POLL = 0.01
"""Time between two readings of the status while the gripper moves by itself [s]."""

_MISSED = 5
"""Consecutive missing answers tolerated during such a motion: the gripper may be busy."""

S = TypeVar("S", bound=RobotiqStatus)
C = TypeVar("C", bound=RobotiqCommand)


class RobotiqDriver(Driver, Generic[S, C]):
    """A Robotiq gripper on Modbus.

    A cycle is one exchange, which writes a reference and reads the status. To a gripper that was
    active already, the driver writes nothing until a reference differs from its position.

    Attributes:
        MODEL: Its name in the message when another device answers.
        STATUS: Its input block.
        COMMAND: Its output block.
        FAULTS: Its fault codes.
        HINT: What to do about a gripper that is not activated.
        USED: Number of registers at the start of the output block that hold the activation and the
            common request of all fingers.
    """

    MODEL: ClassVar[str]
    STATUS: ClassVar[type[RobotiqStatus]]
    COMMAND: ClassVar[type[RobotiqCommand]]
    FAULTS: ClassVar[Mapping[int, Fault]]
    HINT: ClassVar[str]
    USED: ClassVar[int] = 3
    options: RobotiqOptions
    link: Blocks[S]

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        self._status: S = self._decoded([0] * self.STATUS.COUNT)
        self._sent: C | None = None
        self.capabilities = Capabilities(
            measures=frozenset({"position", "current", "grasped"}),
            accepts=frozenset({"position", "max_effort", "max_velocity"}),
            best_rate=100.0,
            homing=True,
            recoverable=True,
            identity=self._identity(),
        )

    def _decoded(self, block: Sequence[int]) -> S:
        status: S = self.STATUS.from_registers(block, self.options.port)  # type: ignore[assignment]
        return status

    def _action(self, activate: bool) -> Sequence[int]:
        """Return the registers that set only rACT, or clear it, which resets the gripper."""
        return self.COMMAND(activate=activate).to_registers()[: self.USED]

    # --- defined by each model ---------------------------------------------------------------

    @abstractmethod
    def _places(self) -> tuple[int, int, int]:
        """Return the first registers of the output and input blocks, and the read function."""

    def _gap(self) -> float | None:
        """Return the silence needed before a request [s]; ``None``: the line's default."""
        return None

    @abstractmethod
    def _identity(self) -> Mapping[str, str]:
        """Return the identity of the gripper, as shown to users."""

    @abstractmethod
    def _measured(self, status: S, stamp: float) -> ActuatorState:
        """Return a status in SI units."""

    @abstractmethod
    def _registers_for(self, reference: Reference) -> Sequence[int] | None:
        """Return the registers to send for a reference, or ``None`` to send nothing."""

    @abstractmethod
    def _stopping(self) -> Sequence[int]:
        """Return the registers that end its motion and change nothing else."""

    # --- life --------------------------------------------------------------------------------

    async def configure(self) -> None:
        """Open the line and check that such a gripper answers; moves nothing."""
        options = self.options
        output, source, function = self._places()
        # Where both blocks begin at the same register, function 23 cannot distinguish them.
        mixed = output == source and options.exchange == "auto"
        blocks = await self.open(
            self.buses.modbus,
            options.port,
            lambda bus: Blocks(
                bus,
                options.unit,
                self._decoded,
                output=output,
                source=source,
                count=self.STATUS.COUNT,
                kind="separate" if mixed else options.exchange,
                function=function,
            ),
            # An emulated gripper starts activated, as after an earlier run, unless it must home.
            emulated={"emulator": {"activated": options.home == "on_demand", **options.emulator}},
            baudrate=options.baudrate,
            gap=self._gap(),
        )
        best = blocks.best_rate(self.COMMAND.COUNT)
        self.refine(best_rate=best)
        await self._identify()
        blocks.pace(self.spec, best)

    async def _identify(self) -> None:
        options = self.options
        with self.identifying(
            f"a {self.MODEL}",
            f"no answer from unit {options.unit} at {options.port}",
            "check supply, wiring, `unit` and `baudrate`",
            FrameError,
            check="is it another gripper, or is another program using the line?",
        ):
            self._status = await self.link.read()

    async def activate(self) -> None:
        """Attach to an active gripper; activate an inactive one where that is allowed."""
        with self.link.relaxed_deadline():
            status = self._status = await self.link.read()
        self._refuse(status)
        allowed = self.options.home == "on_connect" or self._home_asked
        if not status.ready:
            if not allowed:
                raise self._gripper_fault(NOT_ACTIVATED)
            await self._within("activating itself", self._activate, self._too_slow)
        await self._prepare(allowed)
        self._home_asked = False
        self._sent = None
        self.active = True

    async def _prepare(self, allowed: bool) -> None:
        """Finish the preparation of the gripper, which may move it only if ``allowed``."""

    async def _activate(self) -> None:
        # A gripper that was activated already starts again only from a reset.
        await self._write(self._action(False))
        await self._until(lambda status: status.reset)
        await self._write(self._action(True))
        await self._until(lambda status: status.ready)

    async def _within(
        self, doing: str, steps: Callable[[], Awaitable[None]], too_slow: Callable[[], DeviceFault]
    ) -> None:
        """Run steps in which the gripper moves by itself, in limited time; cancelling stops it."""
        seconds = self.options.activation_timeout
        with self.busy(doing), self.link.relaxed_deadline():
            async with time_limit(seconds, too_slow, end=self._end_activation):
                await steps()

    def _too_slow(self) -> DeviceFault:
        hint = "free the fingers, then `rtee recover`"
        return self.fault(0x0D, "activation did not finish in time", hint=hint)

    async def _end_activation(self) -> None:
        # Only a reset ends an activation; without it the gripper goes on once its fingers are free.
        with contextlib.suppress(BusError):
            await self._write(self._action(False))

    async def _until(self, done: Callable[[S], bool]) -> None:
        missed = 0
        while True:
            try:
                status = self._status = await self.link.read()
            except (BusTimeout, FrameError):
                missed += 1
                if missed > _MISSED:
                    raise
                continue
            missed = 0
            if done(status):
                return
            self._refuse(status)
            await asyncio.sleep(_POLL)

    async def examine(self) -> str:
        """Return ``not activated`` if it is not; raises the fault that the gripper reports."""
        status = self._status = await self.link.read()
        self._refuse(status)
        return "" if status.ready else "not activated"

    # --- every cycle -------------------------------------------------------------------------

    async def sense(self) -> ActuatorState:
        """Return the state that came with the last exchange, or read it."""
        self._status, stamp = await self.link.newest()
        if self.active:
            self._refuse(self._status)
            if not self._status.ready:
                # A write with rACT set has started an activation, which moves the fingers.
                await self.link.insist(self._action(False))
                name = "lost its activation; was its supply cut?"
                raise self._gripper_fault(NOT_ACTIVATED, name)
        return self._measured(self._status, stamp)

    async def move(self, reference: Reference) -> None:
        """Send a reference in one frame, and read the state with it."""
        registers = self._registers_for(reference)
        if registers is not None:
            self._status = await self.link.exchange(registers)

    # --- stop and faults ---------------------------------------------------------------------

    async def stop(self) -> None:
        """End the motion; a gripped object stays gripped."""
        if self.connected and await self.link.insist(self._stopping()):
            self._sent = None

    async def recover(self) -> None:
        """Clear a fault; if that ends the activation, the next `activate` may move the fingers."""
        with self.link.relaxed_deadline():
            status = self._status = await self.link.read()
            fault = self.FAULTS.get(status.fault)
            if fault is not None and fault.major:
                await self._clear()
        self._refuse(self._status)
        # By asking for recovery the user agrees to a motion that the activation may need.
        self._home_asked = True

    async def _clear(self) -> None:
        """Reset the gripper, and wait a moment until its fault clears."""
        await self._write(self._action(False))
        end = monotonic.now() + PATIENT
        while self._status.fault or self._status.activated:
            if monotonic.now() > end:
                raise self._gripper_fault(self._status.fault or NOT_ACTIVATED)
            await asyncio.sleep(_POLL)
            self._status = await self.link.read()

    def _refuse(self, status: S) -> None:
        """Raise the fault that the gripper reports, unless it is only a warning."""
        fault = self.FAULTS.get(status.fault)
        # Code 7, not activated, must not keep callers from activating it; they check `ready`.
        if fault is not None and not fault.warning and status.fault != NOT_ACTIVATED:
            raise self._gripper_fault(status.fault)

    def _gripper_fault(self, code: int, name: str = "") -> DeviceFault:
        fault = self.FAULTS.get(code, Fault("unknown fault", "recover"))
        hint = self.HINT if code == NOT_ACTIVATED else fault.hint
        return self.fault(code, name or fault.name, hint)

    def _warnings(self, status: S) -> tuple[str, ...]:
        if not any(status.to_registers()):
            # Either an inactive gripper whose encoder is at 0, or a device without these registers.
            return (f"all its registers are 0; is it a {self.MODEL}?",)
        fault = self.FAULTS.get(status.fault)
        return (fault.name,) if fault is not None and fault.warning else ()

    # --- the wire ----------------------------------------------------------------------------

    async def _write(self, registers: Sequence[int]) -> None:
        await self.link.write(registers, PATIENT)
