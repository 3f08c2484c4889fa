"""Send set-points at a steady rate, as a glove or a policy does; `rtee run schunk_svh` runs."""

import asyncio
import math

import rtee

SECONDS = 2.0


async def main() -> None:
    async with (
        rtee.connect("schunk_svh", wait="10s") as hand,
        hand.stream(rate=50, effort=0.5) as stream,
    ):
        async for t in stream.pace():
            if t > SECONDS:
                break
            pinch = 0.5 - 0.5 * math.cos(math.pi * t)
            await stream.send({"PinchTight index thumb": pinch, "Trig ring": 0.3 * pinch})
        print((await stream.status()).samples, "samples played")


asyncio.run(main())
