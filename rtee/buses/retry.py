"""Exchanges that may fail: retry those that a busy computer delays, or accept a silence."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any, Final, TypeVar

from rtee.errors import BusBroken, BusClosed, BusError, BusTimeout, FrameError, RteeError

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


async def heard(answer: Awaitable[T]) -> T | None:
    """Return the answer; ``None`` if none arrives or it cannot be decoded.

    Raises:
        BusError: if the bus is broken or closed, which says nothing about the device.
    """
    try:
        return await answer
    except (BusBroken, BusClosed):
        raise
    except BusError:
        return None


async def answered(answer: Awaitable[Any]) -> bool:
    """Return whether anything answers; answers of several devices, which collide, count, too.

    Raises:
        BusError: if the bus is broken or closed.
    """
    try:
        await answer
    except FrameError:
        return True
    except BusTimeout:
        return False
    return True
