"""Measure the processor time of the hand's process for requests, answered and refused.

    python benchmarks/request_cpu.py [--hand schunk_svh] [--seconds 4] [--rounds 3] [--only info]

One client sends one kind of request, first a little slower than the hand's limit, so that all are
answered, then as fast as the hand permits, so that most are refused. Printed is the processor time
of the hand's process, less its time without requests: for each request, and for a second of the
flood; medians of the rounds. Other programs change processor time little; `flood.py` measures the
missed ticks.
"""

from __future__ import annotations

import argparse
import functools
import statistics
import threading
import time
from pathlib import Path
from typing import NamedTuple

import anyio
import anyio.to_thread
import processes
import zenoh
from common import Table, command_line
from flood import WAITING

import rtee
from rtee.messages.requests import REQUESTS
from rtee.remote.client import RemoteHand
from rtee.remote.session import direct
from rtee.running.prepare import RunOptions

QUESTIONS: dict[str, dict[str, object]] = {
    "status": {},
    "info": {"name": [], "position": []},
    "actions": {"kind": "", "name": "", "elements": []},
    "primitives": {},
}
"""Requests that are sent, with the fields of their questions: some that a thread answers."""

SLOW = 15.0
"""Requests that are answered [1/s]: fewer than a client may send of any kind."""


def used(pid: int) -> float:
    """Return the processor time of a process so far [s]."""
    tasks = Path(f"/proc/{pid}/task").glob("*/schedstat")
    return sum(int(each.read_text().split()[0]) for each in tasks) / 1e9


class Sent(NamedTuple):
    """The requests sent to the hand in a measurement.

    Attributes:
        count: Requests.
        answered: Those that were not refused.
        size: Bytes of an answer.
        seconds: How long it took [s].
        cost: Processor time of the hand's process, besides what it takes by itself [s].
    """

    count: int
    answered: int
    size: float
    seconds: float
    cost: float


def send(remote: RemoteHand, pid: int, kind: str, seconds: float, gap: float) -> Sent:
    """Send requests of a kind for some time, with a gap after each [s]."""
    before, begin = used(pid), time.monotonic()
    time.sleep(seconds)
    alone = (used(pid) - before) / (time.monotonic() - begin)
    link, places = remote._link, threading.Semaphore(WAITING)
    count, sizes = 0, list[int]()

    def answered(reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            sizes.append(len(reply.ok.payload))

    fields = QUESTIONS[kind]
    question = REQUESTS[kind].question.encode(fields) if fields else b""
    before, begin = used(pid), time.monotonic()
    while time.monotonic() < begin + seconds:
        if places.acquire(timeout=1.0):
            proof = link._signer.attachment(link._signer.number(), kind, question)
            done = direct(answered, places.release)
            key = REQUESTS[kind].key(remote.name)
            link._session.get(key, done, payload=question, attachment=proof, timeout=1.0)
            count += 1
            time.sleep(gap)
    passed = time.monotonic() - begin
    cost = used(pid) - before - alone * passed
    for _ in range(WAITING):
        places.acquire(timeout=2.0)
    return Sent(count, len(sizes), statistics.fmean(sizes or [0]), passed, cost)


async def measure(args: argparse.Namespace, pid: int) -> None:
    """Measure and print."""
    names = ("request", "answer [B]", "one [us]", "flood [1/s]", "answered [1/s]", "one [us]")
    table = Table(*names, "flood [ms/s]", widths=(12,))
    async with rtee.connect(args.hand, wait=30.0) as remote:
        await remote.ready()
        await anyio.sleep(2.0)
        for kind in QUESTIONS:
            if args.only not in (None, kind):
                continue
            slow, fast = list[Sent](), list[Sent]()
            for _ in range(args.rounds):
                for gap, found in ((1 / SLOW, slow), (0.0, fast)):
                    work = functools.partial(send, remote, pid, kind, args.seconds, gap)
                    found.append(await anyio.to_thread.run_sync(work))
            middle = statistics.median
            table.row(
                kind,
                f"{middle(each.size for each in slow):.0f}",
                f"{middle(1e6 * each.cost / each.count for each in slow):.0f}",
                f"{middle(each.count / each.seconds for each in fast):.0f}",
                f"{middle(each.answered / each.seconds for each in fast):.0f}",
                f"{middle(1e6 * each.cost / each.count for each in fast):.0f}",
                f"{middle(1e3 * each.cost / each.seconds for each in fast):.0f}",
            )


def main() -> None:
    """Measure and print."""
    parser = command_line(__doc__, hand="schunk_svh", seconds=4.0, rounds=3, only=str)
    parser.add_argument("--role", choices=("measure", "serve"), default="measure")
    args = parser.parse_args()
    if args.role == "serve":
        # Few ticks, so that what they cost by themselves blurs little.
        processes.serve(args.hand, RunOptions(driver="kinematic", rate=100.0, record=False))
    else:
        (hand,) = processes.start(["serve"])
        anyio.run(measure, args, hand.pid)
        hand.communicate()


if __name__ == "__main__":
    main()
