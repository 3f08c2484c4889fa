"""Grippers on Modbus that have a block of registers to write and one to read."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from typing import Generic, Literal, TypeVar

from rtee import monotonic
from rtee.buses.modbus import ModbusBus, ModbusRefusal
from rtee.buses.modbus_frames import READ_HOLDING
from rtee.drivers.deadlines import RelaxedDeadline, cycle_deadline
from rtee.errors import BusError, BusTimeout
from rtee.types import DeviceSpec

S = TypeVar("S")

ExchangeKind = Literal["auto", "combined", "separate"]

PATIENT = RelaxedDeadline.PATIENCE
"""Longest time of an exchange outside the cycle, which a busy computer may delay [s]."""

_TRIES = 3
"""Attempts before function 23 counts as not supported, and for a write that must arrive."""

_REFRESH = 0.005
"""Refresh period of the registers of Robotiq's grippers [s]; their manuals, Modbus RTU section."""


class Blocks(RelaxedDeadline, Generic[S]):
    """The output and the input block of one gripper.

    ``S`` is the type of its state, which the input block holds. One exchange writes the output
    block and reads the input block, with function 23 where the gripper supports it, otherwise with
    functions 16 and 3 or 4. Some grippers ignore an unsupported function, so 23 counts as not
    supported after `_TRIES` attempts without any answer.

    Args:
        decode: Returns the state in an input block; raises `FrameError`.
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
        decode: Callable[[tuple[int, ...]], S],
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
        self._decode = decode
        self._output = output
        self._source = source
        self._count = count
        self._kind = kind
        self._function = function
        self._refresh = refresh
        self._silent = 0  # exchanges with function 23 that got no answer
        self._kept: tuple[S, float] | None = None
        self._age = 0.0

    @property
    def combined(self) -> bool:
        """Whether function 23 is used."""
        return self._kind != "separate"

    async def read(self) -> S:
        """Return the state; errors as for `rtee.buses.modbus.ModbusBus.read`, and `FrameError`."""
        place = self.unit, self._source, self._count
        return self._decode(
            await self.bus.read(*place, deadline=self.deadline, function=self._function)
        )

    async def write(self, values: Sequence[int], deadline: float | None = None) -> None:
        """Write the output block, within another deadline [s] if given; errors as for `read`."""
        await self.bus.write(self.unit, self._output, values, deadline=deadline or self.deadline)

    async def insist(self, values: Sequence[int]) -> bool:
        """Write the output block, up to `_TRIES` times; return whether it arrived."""
        for _ in range(_TRIES):
            # A lost frame is no reason to give up a stop.
            with contextlib.suppress(BusError):
                await self.write(values)
                return True
        return False

    async def exchange(self, values: Sequence[int]) -> S:
        """Write the output block, and return and keep the state; errors as for `read`."""
        state = await self._exchange(values)
        # The next `newest` returns the kept state: one exchange in a cycle instead of two.
        self._kept = state, monotonic.now()
        return state

    async def _exchange(self, values: Sequence[int]) -> S:
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
                return self._decode(block)
        await self.write(values)
        return await self.read()

    async def newest(self) -> tuple[S, float]:
        """Return the state kept by the last exchange, or read it, with its time [s]."""
        # Returned only once: a second `sense` in the same cycle must read the gripper.
        kept, self._kept = self._kept, None
        if kept is None or monotonic.now() - kept[1] > self._age:
            kept = await self.read(), monotonic.now()
        return kept

    def pace(self, spec: DeviceSpec, best: float) -> None:
        """Set the deadline of exchanges in the cycle, for the best rate of the wire [Hz]."""
        self.deadline = cycle_deadline(spec, best)
        # Two periods: older states belong to a cycle that was missed.
        self._age = 2.0 * max(1.0 / best, (spec.every or 1) / spec.rate)

    def best_rate(self, sent: int) -> float:
        """Return the fastest rate of exchanges that write ``sent`` registers [Hz]."""
        # Bytes between address and checksum: function, length, two for each register.
        answer = 2 + 2 * self._count
        if self.combined:
            once = self.bus.exchange_time(10 + 2 * sent, answer)
        else:
            once = self.bus.exchange_time(6 + 2 * sent, 5) + self.bus.exchange_time(5, answer)
        return 1.0 / max(once, self._refresh)
