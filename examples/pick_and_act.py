"""Pick a part, and act on every outcome; try `rtee run robotiq_2f_85 --emulated --object 50mm`."""

import asyncio

import rtee
from rtee import Outcome


async def main() -> None:
    async with rtee.connect("robotiq_2f_85", wait="10s") as hand:
        result = await hand.grasp("50mm", force="40N")
        match result.outcome:
            case Outcome.HELD:
                print(f"holds {result.to_dict()['opening']} m; on to the box")
            case Outcome.WRONG_WIDTH | Outcome.UNKNOWN:
                print("another part, or none: show it to the camera")
            case Outcome.EMPTY | Outcome.STALLED | Outcome.TIMED_OUT:
                print("no part: try the next place")
            case _:
                print(f"ended early: {result.reason}")
        await hand.open()


asyncio.run(main())
