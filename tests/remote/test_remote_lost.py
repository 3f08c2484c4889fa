from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

import anyio
import pytest
from rtee_process import PYTHON

import rtee
from rtee.actions.library import ActionLibrary
from rtee.errors import NoHand
from rtee.hand.config_schema import Behaviour, SafetySettings
from rtee.hand.model import Hand
from rtee.loop.settings import LoopSettings

from .serving import LASTING, RATE, serving, until

pytestmark = pytest.mark.anyio

HOLDER = """
import sys, anyio, rtee
async def main():
    async with rtee.connect("small") as hand:
        if sys.argv[1] == "goal":
            await hand.start("fist", speed=0.001, timeout=3600)
        elif sys.argv[1] == "jog":
            await hand.jog({"near": 1.0}, 0.1)
        elif sys.argv[1] == "acquire":
            await hand.acquire_lease()
        print("there", flush=True)
        await anyio.sleep_forever()
anyio.run(main)
"""

RUN = """
import sys, anyio
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from remote.serving import make_hand, make_library, serving
async def main():
    hand = make_hand(Path(sys.argv[2]))
    async with serving(hand, make_library(hand)):
        print("there", flush=True)
        await anyio.sleep_forever()
anyio.run(main)
"""


async def started(code: str, *arguments: str, program: Sequence[str] = PYTHON) -> anyio.abc.Process:
    process = await anyio.open_process([*program, "-c", code, *arguments], stderr=None)
    assert await printed_line(process) == b"there"
    return process


async def printed_line(process: anyio.abc.Process) -> bytes:
    """Return the next line; what unbuffered Python prints comes in pieces."""
    assert process.stdout is not None
    line = b""
    while not line.endswith(b"\n"):
        line += await process.stdout.receive(1)
    return line[:-1]


@pytest.mark.samples("goal")
@pytest.mark.parametrize("how", ["goal", "jog", "acquire"])
async def test_a_killed_client_that_holds_the_hand_is_noticed(
    hand: Hand, library: ActionLibrary, how: str
) -> None:
    async with serving(hand, library) as served:
        process = await started(HOLDER, how)
        process.kill()
        event = await served.event("client_lost")
        await process.aclose()
        assert event.source.startswith("python-")
        if how == "goal":
            await until(lambda: bool(served.watcher.results))
            assert served.watcher.results[0].cancelled
        async with rtee.connect("small") as remote:
            assert (await remote.status()).holder == ""


async def test_a_frozen_client_is_noticed(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library) as served:
        # It holds without moving: what ends a goal, too, is tested with clients that are killed.
        process = await started(HOLDER, "acquire")
        os.kill(process.pid, signal.SIGTSTP)
        await served.event("client_lost")
        async with rtee.connect("small") as remote:
            assert (await remote.status()).holder == ""
        process.kill()
        await process.aclose()


READER = """
import anyio, rtee
async def main():
    async with rtee.connect("small") as hand, hand.collected_states(1000.0):
        print("there", flush=True)
        await anyio.sleep_forever()
anyio.run(main)
"""


@pytest.mark.heavy
async def test_closing_the_connection_of_a_frozen_client_holds_up_no_other(
    hand: Hand, library: ActionLibrary
) -> None:
    # With linger, two of three such clients block the thread of Zenoh that receives, for 10 s.
    async with serving(hand, library, settings=LoopSettings(rate=1000.0)) as served:
        readers = [await started(READER) for _ in range(4)]
        async with rtee.connect("small") as other:
            clients = served.server._identities
            await until(lambda: len(clients) == 5)
            for process in readers:
                os.kill(process.pid, signal.SIGTSTP)
            still = 20
            while still:
                still -= len(clients) == 1
                await other.status()  # fails when there is no answer within 5 s
                await anyio.sleep(0.05)
        for process in readers:
            process.kill()
            await process.aclose()


async def test_a_client_that_holds_nothing_may_leave(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library) as served:
        process = await started(HOLDER, "nothing")
        process.kill()
        await process.aclose()
        async with rtee.connect("small") as one:
            await one.acquire_lease()
            await one.release_lease()
        async with rtee.connect("small") as two:
            assert (await two.do("Trig", "index", intensity=0.1)).reached
        assert [event.kind for event in served.watcher.events].count("client_lost") == 0


async def test_leaving_after_a_jog_is_no_loss(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library) as served:
        async with rtee.connect("small") as remote:
            await remote.jog({"near": 1.0}, 0.5)
        async with rtee.connect("small") as next_one:
            assert (await next_one.status()).holder == "", "it may be moved by others at once"
            await next_one.jog({"near": 0.5}, 0.5)
            await next_one.acquire_lease()
        lost = await served.event("client_lost")
        assert lost.source == next_one.client, "what was taken was not given back"
        assert [event.kind for event in served.watcher.events].count("client_lost") == 1


async def test_leaving_while_a_goal_runs_is_being_lost(hand: Hand, library: ActionLibrary) -> None:
    safety = SafetySettings(on_client_lost=Behaviour.OPEN)
    settings = LoopSettings(rate=RATE, safety=safety)
    async with serving(hand, library, settings=settings) as served:
        async with rtee.connect("small") as remote:
            await remote.start("fist", **LASTING)
        await served.event("client_lost")
        await until(lambda: [goal.what.action for goal in served.watcher.goals] == ["fist", "open"])


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGSTOP])
async def test_a_killed_or_frozen_hand_is_noticed(tmp_path: Path, end: signal.Signals) -> None:
    tests = str(Path(__file__).parents[1])
    # A real process, which is gone once its end is known.
    process = await started(RUN, tests, str(tmp_path), program=(sys.executable,))
    async with rtee.connect("small") as remote:
        running = await remote.start("fist", **LASTING)
        states = remote.states(20.0)
        await anext(states)
        process.send_signal(end)
        with pytest.raises(NoHand, match="has ended or no longer answers"):
            await running.result()
        with pytest.raises(NoHand, match="has ended or no longer answers"):
            async for _ in states:
                pass
    if end is signal.SIGSTOP:
        process.kill()
    await process.aclose()
    with pytest.raises(NoHand, match="no hand is running"):
        async with rtee.connect():
            pass
