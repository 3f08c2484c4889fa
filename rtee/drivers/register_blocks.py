"""Grippers on Modbus that have a block of registers to write and one to read."""

from __future__ import annotations

import contextlib
from abc import abstractmethod
from collections.abc import Sequence
from typing import Generic, Literal, TypeVar

from rtee import monotonic
from rtee.buses.modbus import ModbusBus, ModbusRefusal
from rtee.buses.modbus_frames import READ_HOLDING
from rtee.buses.pool import BusPool
from rtee.drivers.connection import Connection
from rtee.drivers.deadlines import Unhurried, cycle_deadline
from rtee.drivers.gripper import GripperDriver
from rtee.errors import BusError, BusTimeout
from rtee.sample import ActuatorState
from rtee.types import DeviceSpec, Reference

S = TypeVar("S")

ExchangeKind = Literal["auto", "combined", "separate"]

PATIENT = Unhurried.PATIENCE
"""Longest time of an exchange outside the cycle, which a busy computer may delay [s]."""

_TRIES = 3
"""Attempts before function 23 counts as not supported, and for a write that must arrive."""

_REFRESH = 0.005
"""Robotiq's grippers refresh their registers every 5 ms [s]; their manuals, Modbus RTU section."""


class Blocks(Unhurried):
    """The output and the input block of one gripper.

    One exchange writes the output block and reads the input block, with function 23 where the
    gripper supports it, else with functions 16 and 3 or 4. Some grippers ignore an unsupported
    function, so 23 counts as not supported after `_TRIES` attempts without any answer.

    Args:
        output: First register of the output block.
        source: First register of the input block.
        count: Registers of the input block.
        kind: Whether to use function 23.
        function: Function to read the input block with, 3 or 4.
        refresh: Period at which the gripper refreshes its registers [s].

    Attributes:
        bus: The line or connection.
        unit: The gripper's number on it.
        deadline: Longest time of one exchange [s].
    """

    def __init__(
        self,
        bus: ModbusBus,
        unit: int,
        *,
        output: int,
        source: int,
        count: int,
        kind: ExchangeKind = "auto",
        function: int = READ_HOLDING,
        refresh: float = _REFRESH,
    ) -> None:
        self.bus = bus
        self.unit = unit
        self.deadline = PATIENT
        self._output = output
        self._source = source
        self._count = count
        self._kind = kind
        self._function = function
        self._refresh = refresh
        self._silent = 0  # exchanges with function 23 that got no answer
        self._cached: tuple[tuple[int, ...], float] | None = None

    @property
    def combined(self) -> bool:
        """Whether function 23 is used."""
        return self._kind != "separate"

    async def read(self) -> tuple[int, ...]:
        """Return the input block; errors as for `rtee.buses.modbus.ModbusBus.read`."""
        place = self.unit, self._source, self._count
        return await self.bus.read(*place, deadline=self.deadline, function=self._function)

    async def write(self, values: Sequence[int], deadline: float | None = None) -> None:
        """Write the output block, within another deadline [s] if given; errors as for `read`."""
        await self.bus.write(self.unit, self._output, values, deadline=deadline or self.deadline)

    async def exchange(self, values: Sequence[int]) -> tuple[int, ...]:
        """Write the output block and return the input block; errors as for `read`."""
        if self.combined:
            try:
                places = self.unit, self._output, values, self._source, self._count
                block = await self.bus.exchange(*places, deadline=self.deadline)
            except ModbusRefusal as refusal:
                # Exception 1: the gripper does not support the function, so it is not tried again.
                if self._kind != "auto" or refusal.code != 1:
                    raise
                self._kind = "separate"
            except BusTimeout:
                # A lost frame looks the same as a gripper that ignores function 23; only repeated
                # silence counts.
                self._silent += 1
                if self._kind != "auto" or self._silent < _TRIES:
                    raise
                self._kind = "separate"
            else:
                # An answer proves that the gripper supports the function.
                self._kind = "combined"
                return block
        await self.write(values)
        return await self.read()

    def keep(self, block: tuple[int, ...]) -> None:
        """Keep an input block that came with an exchange, for the next `fresh`."""
        self._cached = block, monotonic.now()

    def fresh(self, age: float) -> tuple[tuple[int, ...], float] | None:
        """Return the kept block and its time, once; ``None`` when older than ``age`` [s]."""
        # Returned only once: a second `sense` in the same cycle must read the gripper.
        cached, self._cached = self._cached, None
        if cached is None or monotonic.now() - cached[1] > age:
            return None
        return cached

    def best_rate(self, sent: int) -> float:
        """Return the fastest rate of exchanges that write ``sent`` registers [Hz]."""
        # Bytes between address and checksum: function, length, two for each register.
        answer = 2 + 2 * self._count
        if self.combined:
            once = self.bus.exchange_time(10 + 2 * sent, answer)
        else:
            once = self.bus.exchange_time(6 + 2 * sent, 5) + self.bus.exchange_time(5, answer)
        return 1.0 / max(once, self._refresh)


class BlocksDriver(GripperDriver):
    """A driver of such a gripper: connection, deadline, newest input block."""

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        self.connection: Connection[Blocks] = Connection(spec)

    def _pace(self, best: float) -> None:
        """Set the deadline of exchanges in the cycle, for the wire's best rate [Hz]."""
        self.connection.link.deadline = cycle_deadline(self.spec, best)

    def _last_read(self) -> tuple[tuple[int, ...], float] | None:
        """Return the block of the last exchange and its time [s], unless it is old or used."""
        period = (self.spec.every or 1) / self.spec.rate
        # Two periods: older blocks belong to a cycle that was missed.
        return self.connection.link.fresh(2.0 * max(1.0 / self.capabilities.best_rate, period))

    async def _insist(self, registers: Sequence[int]) -> bool:
        """Write registers, several times if need be; return whether they arrived."""
        # A stop may come before the connection is open or after it was closed, and must not raise.
        for _ in range(_TRIES if self.connection.is_open else 0):
            # A lost frame is no reason to give up a stop.
            with contextlib.suppress(BusError):
                await self.connection.link.write(registers)
                return True
        return False


class ExchangingDriver(BlocksDriver, Generic[S]):
    """A driver whose cycle is one exchange: it writes a reference and reads the state with it.

    It attaches without writing anything. ``S`` is the type of the gripper's state.
    """

    _status: S

    @abstractmethod
    def _decoded(self, block: Sequence[int]) -> S:
        """Return the state in an input block; raises `FrameError`."""

    @abstractmethod
    def _refuse(self, status: S) -> None:
        """Raise the fault that a state reports, if any."""

    @abstractmethod
    def _measured(self, status: S, stamp: float) -> ActuatorState:
        """Return a state in SI units."""

    @abstractmethod
    def _registers_for(self, reference: Reference) -> Sequence[int] | None:
        """Return the registers to send for a reference; ``None``: nothing."""

    @abstractmethod
    def _stopping(self) -> Sequence[int]:
        """Return the registers that end its motion and change nothing else."""

    async def _supervise(self) -> None:
        """Raise the fault that the newest state of an active gripper reports."""
        self._refuse(self._status)

    def _note(self, status: S) -> None:
        """Store a state that was read."""
        self._status = status

    def _accepted(self) -> None:
        """Note that the gripper has received the last command."""

    def _forget(self) -> None:
        """Forget the last command."""

    async def _read(self) -> S:
        return self._decoded(await self.connection.link.read())

    async def sense(self) -> ActuatorState:
        """Return the state that came with the last exchange, or read it."""
        kept = self._last_read()
        if kept is None:
            self._note(await self._read())
        stamp = monotonic.now() if kept is None else kept[1]
        if self._active:
            await self._supervise()
        return self._measured(self._status, stamp)

    async def move(self, reference: Reference) -> None:
        """Send a reference in one frame, and read the state with it."""
        blocks = self.connection.link
        registers = self._registers_for(reference)
        if registers is None:
            return
        # The answer is kept for the next `sense`: one exchange in a cycle instead of two.
        block = await blocks.exchange(registers)
        self._note(self._decoded(block))
        self._accepted()
        blocks.keep(block)

    async def stop(self) -> None:
        """End the motion; what is gripped stays gripped."""
        if await self._insist(self._stopping()):
            self._forget()
