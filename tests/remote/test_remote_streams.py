"""Streams of set-points over a real network, into a real loop."""

from __future__ import annotations

import math
import os
import signal
import time
from pathlib import Path
from typing import Any

import anyio
import anyio.lowlevel
import anyio.to_thread
import pytest

import rtee
from rtee.actions.library import ActionLibrary
from rtee.commands import STREAM_ENDED, StreamTargets
from rtee.errors import GoalRejected, LeaseHeld, NoHand, RequestRejected
from rtee.hand.model import Hand
from rtee.messages.convert import STREAM_TARGETS
from rtee.remote.client import RemoteHand
from rtee.remote.stream import Stream, paced

from .serving import LASTING, Served, serving, until
from .test_remote_lost import started

pytestmark = pytest.mark.anyio

STREAMER = """
import math, anyio, rtee
async def main():
    async with rtee.connect("small") as hand, hand.stream(rate=50) as stream:
        for k in range(10**6):
            await stream.send({"near": 0.7 + 0.5 * math.sin(0.06 * k)})
            if k == 20:
                print("there", flush=True)
            await anyio.sleep(0.02)
anyio.run(main)
"""


def position(served: Served, name: str = "near") -> float:
    loop = served.loop
    return float(loop.snapshot().reference_position[loop.hand.actuator_index(name)])


async def sent(stream: Stream, count: int, **to: float) -> None:
    for _ in range(count):
        await stream.send(to)
        await anyio.sleep(0.02)


async def followed(served: Served, stream: Stream, most: float = 1e-3, **to: float) -> int:
    """Send targets until the reference is there; return how many samples that took."""
    count = 0
    while any(abs(position(served, name) - value) > most for name, value in to.items()):
        await sent(stream, 1, **to)
        count += 1
    return count


async def refused(remote: RemoteHand, stream: Stream) -> str:
    """Wait until the refusal of a sample has come, and return what it says."""
    while True:
        try:
            stream.check()
        except RequestRejected as error:
            return str(error)
        await anyio.sleep(0.005)


async def test_actuators_joints_and_blends(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        async with remote.stream(rate=50) as stream:
            count = await followed(served, stream, 1e-4, near=0.9, push=0.02)
            while abs(position(served) - 0.6) > 1e-3:  # far is 0.5 near + 0.1
                await sent(stream, 1, far=0.4)
                count += 1
            blend = {"PinchTight index thumb": 0.5, "Trig thumb": 0.25}
            there = {"near": 0.5, "thumb": 0.65}
            while any(abs(position(served, name) - at) > 1e-3 for name, at in there.items()):
                await stream.send(blend, velocity=dict.fromkeys(blend, 0.0))
                await anyio.sleep(0.02)
                count += 1
            # The last samples may be on their way.
            while (status := await stream.status()).samples < count:  # noqa: ASYNC110
                await anyio.sleep(0.005)
            assert status.stream == stream.name
            assert status.samples == count
            assert status.lag > 0.0
            assert (await remote.status()).holder == remote.client
            state = await remote.state()
            assert len(state.channels["stream/lag"]) == 2
        await until(lambda: served.loop.controller.stream is None)
        status = (await remote.status()).stream
        assert status.stream == ""
        assert (await remote.status()).holder == ""


async def test_a_stream_keeps_to_its_effort_limits(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        limits, near = served.loop.controller.reference_effort, hand.actuator_index("near")
        async with remote.stream(rate=50, effort={"near": 0.5}) as stream:
            await sent(stream, 10, near=0.3, push=0.02)
            assert limits[near] == 0.5
            assert limits[hand.actuator_index("push")] == 40.0
        async with remote.stream(rate=50, effort=0.25) as stream:
            await sent(stream, 10, near=0.5)
            assert limits[near] == 0.5
            assert limits[hand.actuator_index("push")] == 40.0  # this stream does not move it
        for effort, said in (
            ({"near": 5.0}, "must be above 0 and at most 2, not 5"),
            ({"near": math.nan}, "'near' must be a finite number, not nan"),
            ({"nera": 1.0}, "did you mean 'near'"),
            (-0.5, "above 0 and at most 1"),
        ):
            with pytest.raises((RequestRejected, GoalRejected), match=said):
                async with remote.stream(rate=50, effort=effort):
                    pytest.fail("it was begun")


async def test_bad_samples_are_refused_in_one_sentence(
    hand: Hand, library: ActionLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        now = time.monotonic()
        async with remote.stream(rate=50, deadline=0.5) as stream:
            with pytest.raises(GoalRejected, match="finite"):
                await stream.send({"near": math.nan})
            with pytest.raises(GoalRejected, match="finite"):
                await stream.send({"near": 0.1}, stamp=math.inf)
            with pytest.raises(GoalRejected, match="finite"):
                await stream.send({"near": 0.1}, velocity={"near": math.nan})
            for targets, stamp, said in (
                ({"near": 57.0}, now, "degrees"),
                ({"nose": 0.1}, now, "neither an actuator"),
                ({"Trig index": 40.0}, now, "0 to 1"),
                ({}, now, "at least one target"),
            ):
                await stream.send(targets, stamp=stamp)
                assert said in await refused(remote, stream)
                await anyio.sleep(0.11)  # refusals in quick succession are only counted
            await stream.send({"near": 0.0}, stamp=now)
            await stream.send({"near": 1.0}, stamp=now + 3600.0)
            assert "ahead of those before" in await refused(remote, stream)
            await anyio.sleep(0.2)
            assert position(served) == 0.0
            await stream.send({"near": 57.0}, stamp=now + 0.3)
            await until(lambda: stream._refused is not None)
            went: list[bytes] = []
            monkeypatch.setattr(remote._link, "put", lambda data, _label: went.append(data))
            with pytest.raises(RequestRejected, match="degrees"):
                await stream.send({"near": 0.1})
            assert STREAM_TARGETS.decode(went[0]).targets == {"near": 0.1}  # sent all the same
            for wrong in ({"near": "0.1"}, {1: 0.1}, [0.1]):
                with pytest.raises(GoalRejected, match="target of a sample"):
                    await stream.send(wrong)  # type: ignore[arg-type]
        with pytest.raises(RequestRejected, match=r"was closed|its client ended it"):
            await stream.send({"near": 0.1})
        with pytest.raises(RequestRejected, match=r"was closed|its client ended it"):
            await anext(stream.pace())


def test_a_pacer_leaves_out_what_it_has_missed() -> None:
    now = 0.0
    steps = paced(10.0, lambda: now)
    seen = []
    for late in (0.0, 0.02, 0.37, 0.0):
        due, wait = next(steps)
        now += wait + late
        seen.append(round(due, 6))
    assert seen == [0.0, 0.1, 0.2, 0.5]


async def flooded(served: Served, remote: RemoteHand, stream: Stream) -> None:
    """Send 2000 samples as fast as possible, and check that hardly any of them is read."""
    begin, ticks = time.monotonic(), served.watcher.ticks
    for k in range(2000):
        sample = StreamTargets(stream.name, k * 1e-4, {"near": 0.5}, {}, remote.client)
        remote._link.put(STREAM_TARGETS.encode(sample), stream._number)
        await anyio.lowlevel.checkpoint()
    while True:
        status = await stream.status()
        if status.samples + status.thinned + status.refused == 2000:
            break
    lasted = time.monotonic() - begin
    assert status.samples + status.refused <= 21 + 75 * lasted
    assert served.watcher.ticks > ticks


async def test_a_stream_at_10_khz_is_refused_or_thinned(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        with pytest.raises(RequestRejected, match="up to 200 samples a second, not 10000"):
            async with remote.stream(rate=10_000):
                pass
        async with remote.stream(rate=50) as stream:
            await flooded(served, remote, stream)  # what is thinned is no error of the next sample


async def test_others_are_kept_out(hand: Hand, library: ActionLibrary) -> None:
    async with (
        serving(hand, library) as served,
        rtee.connect("small") as one,
        rtee.connect("small") as other,
    ):
        async with one.stream() as stream:
            await sent(stream, 5, near=0.3)
            with pytest.raises(LeaseHeld):
                await other.do("open")
            with pytest.raises(LeaseHeld):
                async with other.stream():
                    pass
            data = STREAM_TARGETS.encode(
                StreamTargets(stream.name, time.monotonic(), {"near": 1.5}, {}, other.client)
            )
            for _ in range(5):
                other._link.put(data, "s9")
                await stream.send({"near": 0.3})
                await anyio.sleep(0.02)
            await followed(served, stream, near=0.3)
            await other.stop()  # always possible
            await until(lambda: bool(stream.ended))
            with pytest.raises(RequestRejected, match="the stream ended: stopped by"):
                await stream.send({"near": 0.5})
        async with other.stream() as stream:
            await sent(stream, 3, near=0.5)


async def test_a_stream_of_somebody_who_sends_nothing_holds_nobody_up(
    hand: Hand, library: ActionLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An open stream kept the lease for ever, as a gamepad that nobody touched."""
    monkeypatch.setattr("rtee.remote.lease.IDLE", 0.3)
    async with (
        serving(hand, library),
        rtee.connect(client="one") as one,
        rtee.connect(client="other") as other,
    ):

        async def held_by(client: str) -> None:
            while (await other.status()).holder != client:  # noqa: ASYNC110
                await anyio.sleep(0.02)

        async with one.stream(rate=50) as stream:
            await held_by("")
            await stream.send({"near": 0.1})  # somebody comes back
            await held_by(one.client)
            await held_by("")
            assert (await other.do("Trig", "index", intensity=0.2)).reached
            await until(lambda: bool(stream.ended))
            with pytest.raises(RequestRejected, match="took over"):
                await stream.send({"near": 0.1})


async def test_who_gives_up_before_a_stream_is_open_does_not_keep_it(
    hand: Hand, library: ActionLibrary
) -> None:
    async with serving(hand, library), rtee.connect() as one, rtee.connect() as other:
        with anyio.CancelScope() as scope:
            scope.cancel()
            async with one.stream(rate=50):
                pass
        assert scope.cancelled_caught
        assert (await other.status()).stream.stream == ""
        assert (await other.do("Trig", "index", intensity=0.2)).reached


async def test_a_stream_whose_first_answer_is_lost_does_not_stay_open(
    hand: Hand, library: ActionLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with serving(hand, library), rtee.connect() as one, rtee.connect() as other:
        ask = one._link.ask

        async def losing(name: str, *question: Any, **options: Any) -> dict[str, Any]:
            answer = await ask(name, *question, **options)
            if name == "begin_stream":
                raise NoHand("no answer")
            return answer

        monkeypatch.setattr(one._link, "ask", losing)
        with pytest.raises(NoHand):
            async with one.stream(rate=50):
                pass
        assert (await other.do("Trig", "index", intensity=0.2)).reached


async def test_a_goal_takes_over(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        running = await remote.start("fist", **LASTING)
        async with remote.stream() as stream:
            assert not running.done
            await sent(stream, 5, near=0.3)
            assert (await running.result()).preempted
            assert (await remote.do("poke")).reached
            assert "poke took over" in stream.ended
            with pytest.raises(RequestRejected, match="poke took over"):
                await stream.send({"near": 0.5})
        assert [event.kind for event in served.watcher.events].count(STREAM_ENDED) == 1


@pytest.mark.samples("9")
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTSTP])
async def test_a_dead_client_is_noticed(hand: Hand, library: ActionLibrary, how: int) -> None:
    async with serving(hand, library) as served:
        process = await started(STREAMER)
        async with rtee.connect("small") as remote:
            assert (await remote.status()).stream.samples > 0
            os.kill(process.pid, how)
            await served.event("client_lost")
            if how == signal.SIGTSTP:
                process.kill()
            await process.aclose()
            assert "is lost" in (await served.event(STREAM_ENDED)).text
            await until(lambda: not served.loop.controller.moving)
            assert (await remote.status()).holder == ""
            assert (await remote.do("poke")).reached
        if how == signal.SIGTSTP:  # the network takes a second to notice, the hand brakes before
            kinds = [event.kind for event in served.watcher.events]
            assert kinds.index("stream_paused") < kinds.index("client_lost")


async def test_the_blocking_twin(hand: Hand, library: ActionLibrary, tmp_path: Path) -> None:
    def use() -> None:
        with rtee.connect_blocking("small") as remote, remote.stream(rate=50) as stream:
            count, before = 0, 0.0
            for _ in stream.pace():
                # Twice: samples of a busy computer come late, and the hand may pass it first.
                if max(abs(before - 0.4), abs(position(served) - 0.4)) < 1e-3:
                    break
                before = position(served)
                stream.send({"near": 0.4}, {"near": 0.0})
                count += 1
            while stream.status().samples < count:  # they go another way than what asks for it
                time.sleep(0.01)
            assert stream.status().samples == count
            assert stream.ended == ""
            remote.hold()
            while not stream.ended:
                time.sleep(0.01)
            with pytest.raises(RequestRejected, match="asked to hold"):
                stream.send({"near": 0.4})

    async with serving(hand, library) as served:
        await anyio.to_thread.run_sync(use)
        assert position(served) == pytest.approx(0.4, abs=1e-2)
