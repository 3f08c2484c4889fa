"""A hand follows a glove; a sine stands in for it.  Run `rtee run schunk_svh` first."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import AsyncIterator

import anyio

import rtee

RATE = 50.0
"""Samples per second [Hz]."""


async def glove() -> AsyncIterator[tuple[float, float, float]]:
    """Yield the time [s] and how far two fingers are closed (0 to 1), as a glove would."""
    begin = time.monotonic()
    for k in range(round(10 * RATE)):
        stamp = begin + k / RATE
        await anyio.sleep(max(0.0, stamp - time.monotonic()))
        yield stamp, 0.5 - 0.5 * math.cos(3.0 * k / RATE), 0.4 - 0.4 * math.cos(2.0 * k / RATE)


async def main() -> None:
    """Stream the glove to the hand that runs."""
    async with rtee.connect() as hand, hand.stream(rate=RATE) as stream:
        async for stamp, pinch, ring in glove():
            await stream.send({"PinchTight index thumb": pinch, "Trig ring": ring}, stamp=stamp)
        status = await stream.status()
    print(f"{status.samples} samples, lag {status.lag * 1e3:.1f} ms, {status.late} late")


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):  # Ctrl-C ends it: the hand brakes and holds
        anyio.run(main)
