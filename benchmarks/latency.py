"""Measure the time from a client's goal to the first changed reference, in another process.

    python benchmarks/latency.py [--hand schunk_svh] [--rate 1000] [--goals 300] [--realtime]
                                 [--fresh]

The hand runs in a process of its own with the kinematic driver and the network, as `rtee run`
would run it. A client sends goals from standstill, at random moments of the loop's period. The time
ends with the first reference that differs in any bit from the one before: at its stamp (the due
time of its tick, as in recordings), and when the device's driver receives it, which is later by the
tick's lateness and work. All clocks are CLOCK_MONOTONIC. Two goals are sent by turns, as programs
repeat theirs; with ``--fresh``, each goal differs from all before.

The stages of this time are printed, too, with the processor time of those that run in one thread,
which other programs change less; and for comparison a bare Zenoh query of the same size to another
process, measured in the same run: until that process's callback runs, and there and back.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import random
import statistics
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import anyio
import processes
import zenoh
from common import Table, command_line

import rtee
from rtee.remote.client import RemoteHand
from rtee.remote.server import Server
from rtee.remote.session import direct, open_client
from rtee.running.prepare import RunOptions
from rtee.types import Goal, Reference

STAGES = (
    "client: until the request is on the network",
    "network: until the server's callback runs",
    "server: until the goal is checked and planned",
    "waiting for the tick, until its wake-up",
    "tick: until the driver is handed the change",
)
"""The stages between the moments noted for a goal."""

IN_ONE_THREAD = (0, 2, 4)
"""Those that begin and end in the same thread."""

QUESTION = bytes(200)
"""A request of the size of a goal."""

now = time.monotonic_ns

Moment = tuple[int, int]
"""A time, and the processor time of the thread so far [ns]."""


def moment() -> Moment:
    """Return the present moment."""
    return now(), time.thread_time_ns()


class Noted(Server):
    """A server that notes the arrivals of requests."""

    came: Moment = (0, 0)

    def _on_control(self, query: zenoh.Query) -> None:
        Noted.came = moment()
        super()._on_control(query)


class Notes:
    """Notes the moments at which goals pass through a loop.

    Attributes:
        found: By goal: the callback, the goal planned, the tick's wake-up, the driver's call.
        stamps: By goal: when its first tick was due, the stamp of the reference in recordings [ns].
    """

    def __init__(self, loop: Any) -> None:
        self.found: dict[str, list[Moment]] = {}
        self.stamps: dict[str, int] = {}
        self._submit = loop.submit
        loop.submit = self._noted_submit
        self._changing = ""
        self._last = b""
        self._accept = loop.controller.accept
        loop.controller.accept = self._noted_accept
        for device in loop.devices.values():
            self._watch(device.driver)

    def _noted_submit(self, goal: Goal, **options: Any) -> None:
        self.found[goal.goal_id] = times = [Noted.came]
        self._submit(goal, **options)
        # Not at the end: the tick may have begun already.
        times.insert(1, moment())

    def _noted_accept(self, plan: Any, stamp: float) -> None:
        self.found[plan.goal_id].append(moment())
        self.stamps[plan.goal_id] = round(stamp * 1e9)
        self._changing = plan.goal_id
        self._accept(plan, stamp)

    def _watch(self, driver: Any) -> None:
        move = driver.move

        async def noted(reference: Reference) -> None:
            position = reference.position.tobytes()
            # Bit for bit: the first change of a jerk-limited motion is far below any tolerance.
            if position != self._last and self._changing:
                self.found[self._changing].append(moment())
                self._changing = ""
            self._last = position
            await move(reference)

        driver.move = noted


def serve(arguments: argparse.Namespace) -> None:
    """Run the hand until standard input ends; then print the noted times."""
    notes: list[Notes] = []

    def with_notes(loop: Any, *others: Any) -> Any:
        notes.append(Notes(loop))
        return Noted.open(loop, *others)

    options = RunOptions(
        driver="kinematic",
        rate=arguments.rate,
        realtime=arguments.realtime,
        record=arguments.record,
        log=Path(arguments.log) if arguments.record else None,
    )
    processes.serve(arguments.hand, options, with_notes)
    print(json.dumps([notes[0].found, notes[0].stamps]))


async def send_goals(
    hand: RemoteHand, action: tuple[str, ...], count: int, fresh: bool
) -> list[tuple[str, Moment, Moment]]:
    """Send goals from standstill; return each name with the moments of call and sending."""
    source = random.Random(1)
    # The moment at which Zenoh takes over is seen nowhere else.
    session = hand._link._session
    handed = moment()

    class Watched:
        def get(self, *arguments: Any, **options: Any) -> None:
            nonlocal handed
            session.get(*arguments, **options)
            handed = moment()

        def __getattr__(self, name: str) -> Any:
            return getattr(session, name)

    hand._link._session = Watched()  # type: ignore[assignment]
    sent = []
    for i in range(count):
        await anyio.sleep(0.1)
        # asyncio sleeps whole milliseconds: always to the same moment of the period.
        time.sleep(source.uniform(0.0, 1e-3))
        # Two intensities by turns, so that every goal moves; both small, so that it ends soon.
        intensity = (0.02 if i % 2 else 0.04) + fresh * i * 1e-6
        begin = moment()
        running = await hand.start(*action, intensity=intensity, tolerance=0.002)
        sent.append((running.goal.goal_id, begin, handed))
        # To the end: the next goal must find the hand at rest.
        result = await running.result()
        assert result.succeeded, result
    return sent


async def measure_network(endpoint: str, count: int) -> tuple[list[float], list[float]]:
    """Return the times of bare Zenoh queries [s]: there, and there and back."""
    session = open_client([endpoint])
    loop = asyncio.get_running_loop()
    there, back = [], []
    for _ in range(count):
        await anyio.sleep(0.02)
        came: asyncio.Future[int] = loop.create_future()

        def on_reply(reply: zenoh.Reply, came: asyncio.Future[int] = came) -> None:
            assert reply.ok is not None
            loop.call_soon_threadsafe(came.set_result, int(reply.ok.payload.to_bytes()))

        begin = now()
        # Express, as the client's own requests: Zenoh would wait to batch it otherwise.
        session.get("rtee/echo", direct(on_reply), payload=QUESTION, express=True)
        there.append((await came - begin) * 1e-9)
        back.append((now() - begin) * 1e-9)
    session.close()
    return there, back


def show(table: Table, what: str, times: Sequence[float]) -> None:
    """Print a row [ms]."""
    ordered = sorted(times)
    p95 = ordered[int(0.95 * (len(ordered) - 1))]
    median = statistics.median(ordered)
    table.row(what, *(f"{value * 1e3:.3f}" for value in (median, p95, ordered[-1])))


def main() -> None:
    """Measure and print."""
    parser = command_line(
        __doc__,
        hand="schunk_svh",
        rate=1000.0,
        goals=300,
        realtime=False,
        record=False,
        fresh=False,
    )
    parser.add_argument("--action", nargs="+", default=["Trig", "index"])
    parser.add_argument("--log", default="", help=argparse.SUPPRESS)
    parser.add_argument("--role", choices=("measure", "serve", "echo"), default="measure")
    arguments = parser.parse_args()
    if arguments.role == "serve":
        serve(arguments)
    elif arguments.role == "echo":
        processes.echo(lambda: str(now()).encode())  # the time at which the query came
    else:
        measure(arguments)


def measure(arguments: argparse.Namespace) -> None:
    """Start the other processes, measure and print."""
    with tempfile.TemporaryDirectory() as log:
        hand, other = processes.start(["serve", "echo"], "--log", log)
        assert other.stdout is not None
        endpoint = other.stdout.readline().strip()

        async def run() -> tuple[list[tuple[str, Moment, Moment]], tuple[list[float], list[float]]]:
            async with rtee.connect(arguments.hand, wait=20.0) as remote:
                # Connecting leaves work for a moment, which would count as latency.
                await anyio.sleep(1.0)
                sent = await send_goals(
                    remote, tuple(arguments.action), arguments.goals, arguments.fresh
                )
            return sent, await measure_network(endpoint, arguments.goals)

        sent, (there, back) = anyio.run(run)
        other.communicate()
        found, stamps = json.loads(hand.communicate()[0].splitlines()[-1])
    ways = [(begin, handed, *found[goal]) for goal, begin, handed in sent]
    how = "real-time set-up" if arguments.realtime else "ordinary process"
    table = Table(f"{arguments.rate:g} Hz, {how} [ms]", "median", "p95", "worst", widths=(64,))
    due = [(stamps[goal] - begin[0]) * 1e-9 for goal, begin, _ in sent]
    show(table, "goal to first changed reference: its stamp", due)
    handed = [(way[-1][0] - way[0][0]) * 1e-9 for way in ways]
    show(table, "goal to first changed reference: handed to the driver", handed)
    for k, stage in enumerate(STAGES):
        show(table, f"– {stage}", [(way[k + 1][0] - way[k][0]) * 1e-9 for way in ways])
    for k in IN_ONE_THREAD:
        used = [(way[k + 1][1] - way[k][1]) * 1e-9 for way in ways]
        show(table, f"processor time, {STAGES[k]}", used)
    show(table, "a bare Zenoh query, there", there)
    show(table, "a bare Zenoh query, there and back", back)


if __name__ == "__main__":
    main()
