"""Measure the ticks that a hand misses while clients send requests as fast as they can.

    python benchmarks/flood.py [--hand schunk_svh] [--rate 1000] [--seconds 3] [--rounds 10]

The hand runs in a process of its own with the kinematic driver and the network. Three clients send
one kind of request, as fast as Zenoh accepts them: to the hand, and by turns to another process,
which only answers at once. Both figures therefore include the cost of the computer's load; the
difference is rtee's work. All kinds and both receivers are measured in each round, in an order that
changes from round to round. Printed are medians, the median of the rounds' differences, and the
interval that contains its true value with at least 95 % certainty.
"""

from __future__ import annotations

import argparse
import random
import statistics
import subprocess
import sys
import threading

import anyio
import anyio.to_thread
import processes
import zenoh
from common import Table, command_line, interval_of_median
from witness import child

import rtee
from rtee.messages.identity import Signer
from rtee.messages.requests import HERE, REQUESTS, SAMPLE, inbox_key
from rtee.remote.client import RemoteHand
from rtee.remote.session import direct, open_client
from rtee.running.prepare import RunOptions

CLIENTS = 3
"""Clients that send at the same time: more than one process could send."""

KINDS = ("stop", "do", "jog", "acquire", "status", "info", "actions", "add", "hello")
"""Requests that are sent."""

MOST = 1.0
"""Most ticks that a flood may cost [%]: the requirement."""

WAITING = 32
"""Queries of a client that wait for their answers at a time."""


def question_of(kind: str, source: random.Random) -> bytes:
    """Return a question that differs from all before, so that no answer is cached."""
    fields = {
        "acquire": {"client": "x", "what": ""},
        "stop": {"client": "x", "what": ""},
        "hello": {"client": f"x{source.random()}", "what": f"{source.getrandbits(128):032x}"},
        "info": {"name": [], "position": [source.random()]},
        "jog": {
            "client": "x",
            "source": "",
            "name": ["x"],
            "value": [source.random()],
            "limit": 1.0,
        },
    }
    if kind in fields:
        return REQUESTS[kind].question.encode(fields[kind])
    return source.randbytes(60) if REQUESTS[kind].question.fields else b""


async def send(kind: str, hand: str, endpoint: str) -> None:
    """Send requests of a kind until standard input ends; print how many there were."""
    if endpoint:
        session, signer = open_client([endpoint]), Signer("x")
        count = flood(kind, hand, session, signer, "x")
    else:
        async with rtee.connect(hand) as remote:
            link = remote._link
            count = flood(kind, hand, link._session, link._signer, remote.client)
    print(count, flush=True)


def flood(kind: str, hand: str, session: zenoh.Session, signer: Signer, client: str) -> int:
    """Send requests of a kind until standard input ends; return how many there were."""
    print("there", flush=True)
    sys.stdin.readline()
    ended = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.readline(), ended.set()), daemon=True).start()
    places, source, count = threading.Semaphore(WAITING), random.Random(1), 0
    key = f"rtee/{hand}/hello/here" if kind == "hello" else REQUESTS[kind].key(hand)
    if kind == SAMPLE:
        key = inbox_key(hand, HERE, client)
    while not ended.is_set():
        question = question_of(kind, source)
        proof = signer.attachment(signer.number(), kind, question)
        if kind == SAMPLE:
            block = zenoh.CongestionControl.BLOCK
            session.put(key, question, attachment=proof, congestion_control=block)
        elif places.acquire(timeout=1.0):
            done = direct(lambda _: None, places.release)
            session.get(key, done, payload=question, attachment=proof, timeout=1.0)
        count += 1
    return count


async def missed(remote: RemoteHand, kind: str, endpoint: str, args: argparse.Namespace) -> float:
    """Return the share of ticks that the hand misses while clients send [%]."""
    words = [sys.executable, __file__, "--role", "send", "--kind", kind, "--hand", args.hand]
    clients = [
        child([*words, "--endpoint", endpoint], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        for _ in range(CLIENTS)
    ]
    for one in clients:
        assert one.stdout is not None
        await anyio.to_thread.run_sync(one.stdout.readline)
    before = (await remote.status()).statistics
    for one in clients:
        assert one.stdin is not None
        one.stdin.write("\n")
        one.stdin.flush()
    await anyio.sleep(args.seconds)
    for one in clients:  # first, since the hand may be slow to answer
        assert one.stdin is not None
        one.stdin.write("\n")
        one.stdin.flush()
    after = (await remote.status()).statistics
    for one in clients:
        one.kill()  # what it has not sent yet does not matter any more
        one.communicate()
    ticks, lost = after.ticks - before.ticks, after.missed - before.missed
    return 100.0 * lost / (ticks + lost)


async def measure(args: argparse.Namespace, endpoint: str) -> None:
    """Measure all kinds by turns and print."""
    kinds = [kind for kind in KINDS if args.only is None or args.only in kind]
    found: dict[tuple[str, str], list[float]] = {(k, e): [] for k in kinds for e in (endpoint, "")}
    order, places, source = [*kinds], [endpoint, ""], random.Random(1)
    async with rtee.connect(args.hand, wait=30.0) as remote:
        await remote.ready()
        await anyio.sleep(1.0)
        for _ in range(args.rounds):
            # So that what else the computer does falls on all alike; the two places of a kind one
            # right after the other, since it is their difference that counts.
            source.shuffle(order)
            for kind in order:
                source.shuffle(places)
                for place in places:
                    found[kind, place].append(await missed(remote, kind, place, args))
    table = Table(
        "request", "elsewhere [%]", "to the hand [%]", "more [%]", "≥ 95 %", "≤ 1 %", widths=(9,)
    )
    for kind in kinds:
        beside, under = found[kind, endpoint], found[kind, ""]
        more = [there - here for here, there in zip(beside, under, strict=True)]
        low, high = interval_of_median(more)
        medians = (f"{statistics.median(shares):.1f}" for shares in (beside, under))
        verdict = "yes" if high <= MOST else "no" if low > MOST else "open"
        between = f"{low:+.1f} to {high:+.1f}"
        table.row(kind, *medians, f"{statistics.median(more):+.1f}", between, verdict)


def main() -> None:
    """Measure and print."""
    parser = command_line(__doc__, hand="schunk_svh", rate=1000.0, seconds=3.0, rounds=10, only=str)
    parser.add_argument("--role", choices=("measure", "serve", "echo", "send"), default="measure")
    parser.add_argument("--kind", choices=KINDS, help=argparse.SUPPRESS)
    parser.add_argument("--endpoint", default="", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.role == "serve":
        options = RunOptions(driver="kinematic", rate=args.rate, record=False)
        processes.serve(args.hand, options)
    elif args.role == "echo":
        processes.echo()
    elif args.role == "send":
        anyio.run(send, args.kind, args.hand, args.endpoint)
    else:
        hand, other = processes.start(["serve", "echo"])
        assert other.stdout is not None
        anyio.run(measure, args, other.stdout.readline().strip())
        for one in (hand, other):
            one.communicate()


if __name__ == "__main__":
    main()
