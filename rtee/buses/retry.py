"""Retry calls that may time out on a busy computer."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import TypeVar

from rtee.errors import BusTimeout, FrameError

T = TypeVar("T")

_PAUSE = 0.01
"""Time between two attempts [s], in which other tasks of a busy loop catch up."""


async def patiently(call: Callable[[], Awaitable[T]], times: int = 8) -> T:
    """Call a function that may time out on a busy computer, and call it again if it did.

    Args:
        call: What to call.
        times: How often at most.

    Raises:
        BusTimeout: if it did every time.
        FrameError: if it did every time.
    """
    for _ in range(times - 1):
        try:
            return await call()
        except (BusTimeout, FrameError):
            await asyncio.sleep(_PAUSE)
    return await call()
