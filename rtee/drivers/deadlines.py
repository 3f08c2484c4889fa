"""Deadlines of drivers: for exchanges in and outside the cycle, and for operations like homing."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import ClassVar

from rtee.errors import BusTimeout
from rtee.types import DeviceSpec


class RelaxedDeadline:
    """A link whose exchanges may take longer outside the cycle.

    Attributes:
        PATIENCE: Longest time for an exchange outside the cycle [s].
        deadline: Longest time for one exchange, including retries [s].
    """

    PATIENCE: ClassVar[float] = 0.5
    deadline: float

    @contextmanager
    def relaxed_deadline(self) -> Iterator[None]:
        """Extend the deadline for exchanges outside the cycle, which a busy computer may delay."""
        usual, self.deadline = self.deadline, max(self.deadline, self.PATIENCE)
        try:
            yield
        finally:
            self.deadline = usual


def cycle_deadline(spec: DeviceSpec, best_rate: float) -> float:
    """Return the longest time for an exchange in the cycle of a device [s].

    Args:
        spec: The device; a deadline in its configuration takes precedence.
        best_rate: The fastest rate of exchanges that its wire allows [Hz].
    """
    every = spec.every or math.ceil(spec.rate / best_rate)
    # One and a half of its periods leaves room for jitter, five exchanges for a retry.
    return spec.deadline or max(1.5 * every / spec.rate, 5.0 / best_rate)


@asynccontextmanager
async def time_limit(
    seconds: float,
    fault: Callable[[], Exception],
    *,
    end: Callable[[], Awaitable[None]] | None = None,
) -> AsyncIterator[None]:
    """Limit the time that a device has for an operation such as homing.

    Args:
        seconds: The longest time [s].
        fault: Makes the exception to raise when the time is up.
        end: Ends the operation on the device when the time is up or the task is cancelled.

    Raises:
        BusTimeout: if the device does not answer.
    """
    try:
        async with asyncio.timeout(seconds):
            yield
    # A `BusTimeout` is a `TimeoutError`, too, but means a lost device and not a slow one.
    except BusTimeout:
        raise
    except (TimeoutError, asyncio.CancelledError) as ended:
        # The device must not go on without supervision. A cancelled task can still wait for this:
        # the cancellation is raised only once.
        if end is not None:
            await end()
        if isinstance(ended, asyncio.CancelledError):
            raise
        raise fault() from None
