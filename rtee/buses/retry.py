"""Asking again where a single answer that was late or garbled means nothing."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import TypeVar

from rtee.errors import BusTimeout, FrameError

T = TypeVar("T")


async def patiently(call: Callable[[], Awaitable[T]], times: int = 8) -> T:
    """Call what may time out on a busy computer, again if it did.

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
            await asyncio.sleep(0.01)
    return await call()
