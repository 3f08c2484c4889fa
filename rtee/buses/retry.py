"""Retry calls that may time out on a busy computer."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import TypeVar

from rtee.errors import BusTimeout, FrameError

T = TypeVar("T")

_PAUSE = 0.01
"""Time between two attempts [s], so that the other tasks of a busy event loop can run."""


async def patiently(call: Callable[[], Awaitable[T]], times: int = 8) -> T:
    """Call a function that may time out on a busy computer, and repeat it if it did.

    Args:
        call: The function.
        times: Largest number of calls.

    Raises:
        BusTimeout: if the last call timed out.
        FrameError: if the last call received an invalid frame.
    """
    for _ in range(times - 1):
        try:
            return await call()
        except (BusTimeout, FrameError):
            await asyncio.sleep(_PAUSE)
    return await call()
