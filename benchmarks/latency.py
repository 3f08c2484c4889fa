"""Time from a client's goal to the first changed reference, in another process on this computer.

    python benchmarks/latency.py [--hand schunk_svh] [--rate 1000] [--goals 200] [--realtime]

The hand runs in a process of its own with the kinematic driver and the network, as `rtee run`
would run it. A client sends goals from standstill, at random moments of the loop's period. Both
clocks are CLOCK_MONOTONIC. Measured beside it, in the same run: a bare Zenoh query between two
processes, answered at once, which is what the network alone takes there and back.
"""

from __future__ import annotations

import argparse
import json
import random
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import anyio
import numpy as np

import rtee
from rtee.loop.observer import Observer, TickRecord
from rtee.remote.client import RemoteHand
from rtee.remote.session import direct, open_client, open_server

STILL = 20
"""Ticks without change after which the reference counts as standing."""


class Changes(Observer):
    """Notes when the reference begins to move after it has stood."""

    def __init__(self) -> None:
        self._last: np.ndarray | None = None
        self._still = 0
        self.found: list[int] = []

    def on_tick(self, record: TickRecord) -> None:
        now = record.reference_position
        if self._last is not None and not np.array_equal(now, self._last):
            if self._still >= STILL:
                self.found.append(time.monotonic_ns())
            self._still = 0
        else:
            self._still += 1
        self._last = now


def serve(arguments: argparse.Namespace) -> None:
    """Run the hand until standard input ends; then print when the reference began to move."""
    from rtee.remote.server import Server
    from rtee.run import RunOptions, run_hands

    changes = Changes()

    def with_observer(loop, hand, config):  # type: ignore[no-untyped-def]
        loop.add_observer(changes)
        return Server(loop, hand, config)

    async def main() -> None:
        until = anyio.Event()

        async def wait() -> None:
            await anyio.to_thread.run_sync(sys.stdin.read)
            until.set()

        async with anyio.create_task_group() as group:
            group.start_soon(wait)
            options = RunOptions(
                driver="kinematic",
                rate=arguments.rate,
                realtime=arguments.realtime,
                record=arguments.record,
                log=Path(arguments.log) if arguments.record else None,
            )
            said = lambda line: print(line, file=sys.stderr)  # noqa: E731
            await run_hands([arguments.hand], options, serve=with_observer, until=until, say=said)
        print(json.dumps(changes.found))

    anyio.run(main)


def echo(arguments: argparse.Namespace) -> None:
    """Answer a Zenoh query at once until standard input ends."""
    session, endpoint = open_server([], [])

    def answer(query) -> None:  # type: ignore[no-untyped-def]
        with query:
            query.reply(query.key_expr, b"", express=True)

    session.declare_queryable("rtee/echo", direct(answer))
    print(endpoint, flush=True)
    sys.stdin.read()
    session.close()


async def send_goals(hand: RemoteHand, action: tuple[str, ...], count: int) -> list[int]:
    """Send goals from standstill; return when each was sent [ns]."""
    source = random.Random(1)
    sent = []
    for i in range(count):
        await anyio.sleep(0.2 + source.uniform(0.0, 0.01))
        now = time.monotonic_ns()
        result = await hand.do(*action, intensity=0.02 if i % 2 else 0.04, tolerance=0.002)
        sent.append(now)
        assert result.succeeded, result
    return sent


async def measure_network(endpoint: str, count: int) -> list[float]:
    """Return the times of bare Zenoh queries there and back [s]."""
    import asyncio

    session = open_client([endpoint])
    loop = asyncio.get_running_loop()
    times = []
    for _ in range(count):
        await anyio.sleep(0.005)
        came: asyncio.Future[None] = loop.create_future()

        def on_reply(_: object, came: asyncio.Future[None] = came) -> None:
            loop.call_soon_threadsafe(came.set_result, None)

        begin = time.perf_counter()
        session.get("rtee/echo", direct(on_reply), payload=bytes(200), express=True)
        await came
        times.append(time.perf_counter() - begin)
    session.close()
    return times


def show(what: str, times: list[float]) -> None:
    ordered = sorted(times)
    p95 = ordered[int(0.95 * (len(ordered) - 1))]
    median = statistics.median(ordered)
    print(
        f"{what:58} median {median * 1e3:6.3f} ms   p95 {p95 * 1e3:6.3f} ms   "
        f"worst {ordered[-1] * 1e3:6.3f} ms"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--hand", default="schunk_svh")
    parser.add_argument("--action", nargs="+", default=["Trig", "index"])
    parser.add_argument("--rate", type=float, default=1000.0)
    parser.add_argument("--goals", type=int, default=200)
    parser.add_argument("--realtime", action="store_true")
    parser.add_argument("--record", action="store_true", help="also record every tick")
    parser.add_argument("--log", default="")
    parser.add_argument("--role", choices=("measure", "serve", "echo"), default="measure")
    arguments = parser.parse_args()
    if arguments.role != "measure":
        {"serve": serve, "echo": echo}[arguments.role](arguments)
        return
    with tempfile.TemporaryDirectory() as log:
        words = [sys.executable, __file__, *sys.argv[1:], "--log", log]
        hand = subprocess.Popen(
            [*words, "--role", "serve"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        other = subprocess.Popen(
            [*words, "--role", "echo"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

        async def run() -> tuple[list[int], list[float]]:
            async with rtee.connect(arguments.hand, wait=20.0) as remote:
                await anyio.sleep(1.0)
                sent = await send_goals(remote, tuple(arguments.action), arguments.goals)
            return sent, await measure_network(other.stdout.readline().strip(), arguments.goals)

        sent, network = anyio.run(run)
        other.communicate()
        changed = np.array(json.loads(hand.communicate()[0].splitlines()[-1]))
    # The first change after each goal; a goal always comes from standstill.
    times = [(changed[np.searchsorted(changed, at)] - at) * 1e-9 for at in sent]
    period = 1.0 / arguments.rate
    how = "real-time" if arguments.realtime else "ordinary process"
    show(f"goal to first changed reference ({arguments.rate:g} Hz, {how})", times)
    show("bare Zenoh query, there and back", network)
    print(f"waiting for the next tick takes {period / 2 * 1e3:.3f} ms of it on average")


if __name__ == "__main__":
    main()
