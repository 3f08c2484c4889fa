"""Retry calls that may time out on a busy computer."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Final, TypeVar

from rtee.errors import BusTimeout, FrameError, RteeError

T = TypeVar("T")

_PAUSE = 0.01
"""Time between two attempts [s], so that the other tasks of a busy event loop can run."""


LATE: Final[tuple[type[RteeError], ...]] = (BusTimeout, FrameError)
"""Errors of an exchange whose answer came late, or in pieces."""


async def patiently(
    call: Callable[[], Awaitable[T]], times: int = 8, late: tuple[type[RteeError], ...] = LATE
) -> T:
    """Call a function that may time out on a busy computer, and repeat it if it did.

    Args:
        call: The function.
        times: Largest number of calls.
        late: The errors after which the call is repeated.

    Raises:
        RteeError: the error of the last call.
    """
    for _ in range(times - 1):
        try:
            return await call()
        except late:
            await asyncio.sleep(_PAUSE)
    return await call()
