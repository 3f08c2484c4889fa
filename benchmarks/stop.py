"""Measure how long a hand still gets references after a stop was sent, under attack.

    python benchmarks/stop.py [--times 100] [--rate 1000] [--only silent] [--tls] [--realtime]

A hand of this benchmark's own runs at 1 kHz in a process of its own, with a kinematic device, one
whose exchanges hang now and then, and TLS. It is moving whenever a stop is sent. Printed are, for
each attack and for all at once, the time from sending the stop until the last reference that a
device received before it stood still, and how many stops the device that answers has confirmed:
through the hand's stop socket (as `rtee stop` does on the same computer), or with --tls through an
open session of another certificate than the attackers', and the whole time until the answer. The
same is measured without an attack, in the same run. The command itself, Python's start included,
comes last. With --realtime the hand and the program that stops it have precedence over all others,
so that other programs of a busy computer count for less.

The attacks are programs of their own: *silent*: 60 connections a second to the TLS port that send
four bytes; *sessions*: one certificate opens as many sessions as it gets, and says hello 1500 times
a second; *samples*: a client without the lease sends 300 samples a second for the stream of
another; *clients*: 64 clients of the same user; *requests*: three clients ask for as much as they
get; *page*: an observer's page of the GUI sends junk.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import itertools
import json
import os
import random
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from functools import partial
from pathlib import Path

import anyio
import anyio.to_thread
import msgspec.msgpack
from common import Table, command_line
from websockets.exceptions import ConnectionClosed
from websockets.sync.connection import Connection
from witness import child

import rtee
from rtee import monotonic
from rtee.buses.pool import BusPool
from rtee.commands import StreamTargets
from rtee.drivers.kinematic.driver import KinematicDriver
from rtee.errors import RteeError
from rtee.gui.access import Access
from rtee.gui.access import PageRole as Visitor
from rtee.gui.app import App
from rtee.gui.visitors import Visitors
from rtee.hand.config_schema import RemoteSettings
from rtee.loop.clock import Clock
from rtee.loop.handloop import HandLoop, drive
from rtee.loop.observer import Observer
from rtee.loop.realtime import backend_options, share_the_interpreter
from rtee.loop.settings import DeviceSettings, LoopSettings
from rtee.messages.convert import STREAM_TARGETS
from rtee.messages.requests import Role
from rtee.remote import authority, credentials
from rtee.remote.client import stop_hand
from rtee.remote.directory import hands_running
from rtee.remote.server import Server
from rtee.remote.session import host_of, open_client
from rtee.remote.stopping import stop_at, stop_path
from rtee.sample import ActuatorState
from rtee.types import DeviceSpec, Event, Reference

ATTACKS = ("silent", "sessions", "samples", "requests", "page", "clients")

HANGS = 200
"""One exchange in so many hangs."""


MOVE_EVERY = 0.2
"""Time between two motions, there and back [s]."""

SPEED = 0.4
"""Speed of these motions [rad/s]: the hand never arrives."""


class Noting(KinematicDriver):
    """Notes when it received its last reference that moves it."""

    last = 0.0
    before: tuple[float, ...] = ()

    async def move(self, reference: Reference) -> None:
        position = tuple(reference.position.tolist())
        if position != self.before:
            self.last, self.before = time.monotonic(), position
        await super().move(reference)


class Hanging(KinematicDriver):
    """Does not answer now and then."""

    chance = random.Random(1)

    async def sense(self) -> ActuatorState:
        if self.chance.randrange(HANGS) == 0:
            await asyncio.sleep(10.0)
        return await super().sense()


class Stops(Observer):
    """Prints when the last reference before each stop was sent."""

    def __init__(self, driver: Noting) -> None:
        self._driver = driver

    def on_event(self, event: Event) -> None:
        if event.kind == "stop":
            print(json.dumps([event.stamp, self._driver.last]), flush=True)


async def serve(endpoint: str, rate: float) -> None:
    """Run the hand until standard input ends."""
    sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
    from remote.serving import make_hand, make_library

    with tempfile.TemporaryDirectory() as folder:
        hand = make_hand(Path(folder))
        names = hand.actuator_names
        specs = [
            DeviceSpec(name, hand.name, "kinematic", tuple(map(hand.actuator, part)), rate=rate)
            for name, part in (("answers", names[:1]), ("hangs", names[1:]))
        ]
        async with BusPool() as pool:
            noting, hanging = Noting(specs[0], pool), Hanging(specs[1], pool)
            devices = [(DeviceSettings(specs[0]), noting), (DeviceSettings(specs[1]), hanging)]
            loop = HandLoop(hand, make_library(hand), LoopSettings(rate=rate), devices)
            loop.add_observer(Stops(noting))
            opened = Server.open(loop, RemoteSettings(listen=(endpoint,)))
            async with loop, opened, anyio.create_task_group() as group:
                await loop.ready()
                group.start_soon(drive, [loop], Clock(rate))
                group.start_soon(move, loop)
                await anyio.to_thread.run_sync(sys.stdin.read)
                group.cancel_scope.cancel()


async def move(loop: HandLoop) -> None:
    """Keep the hand moving, without a client that an attack could be in the way of."""
    for target in itertools.cycle((1.4, 0.1)):
        with contextlib.suppress(RteeError):  # its device is not active yet
            loop.jog({"near": target}, SPEED)
        await anyio.sleep(MOVE_EVERY)


def attack(kind: str, endpoint: str, hand: str) -> None:
    """Attack until killed."""
    match kind:
        case "silent":
            host, port = host_of(endpoint)
            links: list[socket.socket] = []
            while True:
                links.append(socket.create_connection((host, port)))
                links[-1].send(b"\x16\x03\x01\x02")
                del links[:-900]  # as many as an ordinary user has files
                time.sleep(1.0 / 60.0)
        case "sessions":
            sessions = []
            name = credentials.common_name(credentials.identity().name)
            while True:
                if len(sessions) < 40:
                    try:
                        sessions.append(open_client([endpoint]))
                    except RteeError:
                        time.sleep(0.1)
                for session in sessions[:3]:
                    session.get(f"rtee/small/hello/{name}", lambda _: None, payload=b"junk")
                time.sleep(0.002)
        case "page":
            anyio.run(page)
        case _:
            anyio.run(client_attack, kind, hand)


async def client_attack(kind: str, hand: str) -> None:
    """Attack as a client on this computer."""
    async with anyio.create_task_group() as group:

        async def one() -> None:
            while True:  # with 64 clients, not all attackers get in at once
                with contextlib.suppress(RteeError):
                    async with rtee.connect(hand) as remote:
                        await use(remote)
                await anyio.sleep(1.0)

        async def use(remote: rtee.RemoteHand) -> None:
            while True:
                if kind == "samples":
                    sample = StreamTargets("x", time.monotonic(), {"thumb": 0.1}, {}, remote.client)
                    remote._link.put(STREAM_TARGETS.encode(sample), "x")
                    await anyio.sleep(1.0 / 300.0)
                elif kind == "requests":
                    for name in ("info", "status", "hello"):
                        remote._link.send(name, os.urandom(60)).add_done_callback(
                            lambda future: future.exception()
                        )
                    await anyio.sleep(0.001)
                else:
                    await anyio.sleep(1.0)

        for _ in range({"samples": 1, "requests": 3, "clients": 64}[kind]):
            group.start_soon(one)
            await anyio.sleep(0.02)


async def page() -> None:
    """Serve a GUI, to whose page an observer sends junk."""
    from gui_onlooker import admitted, window

    access = Access(observers=True)
    visitors = Visitors(access)
    server = visitors.open_server(0)

    def send() -> None:
        visit = admitted(access.links(server.get_port())[Visitor.OBSERVER])
        while True:
            # The server may close the connection of who sends so much.
            with contextlib.suppress(ConnectionClosed, OSError), window(visit) as connection:
                junk(connection)
            time.sleep(0.1)

    def junk(connection: Connection) -> None:
        while True:
            for uuid in list(server.gui._gui_input_handle_from_uuid):
                for updates in ({"removed": True}, {"update_cb": []}, {"disabled": True}):
                    message = {"type": "GuiUpdateMessage", "uuid": uuid, "updates": updates}
                    connection.send(msgspec.msgpack.encode(message))
            time.sleep(0.01)

    async with anyio.create_task_group() as group:
        group.start_soon(App(server, "small", None, visitors).run)
        await anyio.sleep(2.0)
        group.start_soon(anyio.to_thread.run_sync, send)


Send = Callable[[], Awaitable[dict[str, bool]]]
"""Sends a stop; returns which devices have confirmed it."""


async def here() -> dict[str, bool]:
    """Stop the hand as `rtee stop` does on this computer."""
    path = stop_path(hands_running()["small"].endpoints[0])
    assert path is not None
    return await anyio.to_thread.run_sync(stop_at, path, "small", "benchmark")


@contextlib.asynccontextmanager
async def sending(endpoint: str, *, tls: bool) -> AsyncIterator[Send]:
    """Yield what sends a stop: here, or through a session of a certificate of its own."""
    if not tls:
        yield here
        return
    attackers = os.environ[credentials.IDENTITY_VARIABLE]
    os.environ[credentials.IDENTITY_VARIABLE] = str(Path(attackers).with_name("ben.pem"))
    async with rtee.connect("small", endpoint=endpoint) as remote:
        os.environ[credentials.IDENTITY_VARIABLE] = attackers
        yield remote.stop


class Judge:
    """Moves the hand, stops it, and reads what the hand says about it."""

    def __init__(self, hand: subprocess.Popen[str]) -> None:
        self._said: list[list[float]] = []
        self._reader = threading.Thread(target=self._read, args=(hand,), daemon=True)
        self._reader.start()

    def _read(self, hand: subprocess.Popen[str]) -> None:
        assert hand.stdout is not None
        for line in hand.stdout:
            self._said.append(json.loads(line))

    async def stop(self, send: Send) -> tuple[float, float, bool]:
        """Return the times to the last reference and to the answer [s], and whether confirmed."""
        await anyio.sleep(random.uniform(1.1, 1.5) * MOVE_EVERY)  # it moves again
        seen, sent = len(self._said), time.monotonic()
        try:
            confirmed = await send()
        except RteeError:
            return 1.0, 1.0, False
        answered = time.monotonic()
        while len(self._said) == seen:
            await anyio.sleep(0.001)
        last = max(0.0, self._said[-1][1] - sent)
        return last, answered - sent, confirmed.get("answers", False)


def quantiles(values: list[float]) -> str:
    """Return median, 99th percentile and largest of some times [s], in ms."""
    ordered = sorted(values)
    high = ordered[min(len(ordered) - 1, round(0.99 * (len(ordered) - 1)))]
    return f"{statistics.median(ordered) * 1e3:.1f} / {high * 1e3:.1f} / {ordered[-1] * 1e3:.1f}"


async def measure(
    hand: subprocess.Popen[str], endpoint: str, times: int, only: str, *, tls: bool
) -> None:
    """Measure all attacks by turns with none, and print."""
    judge = Judge(hand)
    table = Table(
        "attack", "to the last reference [ms]", "to the answer [ms]", "confirmed", widths=(12,)
    )
    cases = [(), *((kind,) for kind in ATTACKS if only in kind), ATTACKS]
    while "small" not in hands_running():
        await anyio.sleep(0.1)
    await anyio.sleep(2.0)
    for case in cases:
        words = [sys.executable, __file__, "--role"]
        attackers = [child([*words, kind, "--endpoint", endpoint]) for kind in case]
        for one in attackers:  # they have no precedence
            os.sched_setscheduler(one.pid, os.SCHED_OTHER, os.sched_param(0))
        await anyio.sleep(3.0 if case else 0.0)
        try:
            async with sending(endpoint, tls=tls) as send:
                found = [await judge.stop(send) for _ in range(times)]
        finally:
            for one in attackers:
                one.kill()
                one.wait()
        name = "none" if not case else case[0] if len(case) == 1 else "all at once"
        last, answer = [each[0] for each in found], [each[1] for each in found]
        done = 100.0 * sum(each[2] for each in found) / times
        table.row(name, quantiles(last), quantiles(answer), f"{done:.0f} %")
        await anyio.sleep(1.0)
    print(f"\nLoad of the computer: {', '.join(f'{each:.1f}' for each in os.getloadavg())}")
    began = monotonic.now()
    await stop_hand("small", endpoint=endpoint)
    print(f"\nstop_hand() over TLS, with its session: {monotonic.now() - began:.2f} s")
    began = monotonic.now()
    subprocess.run([sys.executable, "-m", "rtee", "stop", "small"], stdout=subprocess.DEVNULL)
    print(f"rtee stop, the whole command: {monotonic.now() - began:.2f} s")


def main() -> None:
    """Parse the command line and measure."""
    parser = command_line(__doc__, times=100, rate=1000.0, only="", tls=False, realtime=False)
    parser.add_argument("--role", default="", help=argparse.SUPPRESS)
    parser.add_argument("--endpoint", default="", help=argparse.SUPPRESS)
    parser.add_argument("--name", default="small", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.realtime:
        # With threads that are started later: all of them take part in a stop.
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    if args.role == "hand":
        share_the_interpreter()
        options = backend_options()
        anyio.run(serve, args.endpoint, args.rate, backend_options=options)
    elif args.role:
        attack(args.role, args.endpoint, args.name)
    else:
        with tempfile.TemporaryDirectory() as place, socket.socket() as probe:
            folder = Path(place) / "small"
            os.environ[credentials.FOLDER_VARIABLE] = place
            authority.make_authority(folder, "small")
            for name in ("ann", "ben"):
                _, text = authority.add_client(folder, name, Role.OBSERVER)
                authority.write_private(folder.parent / f"{name}.pem", text)
            os.environ[credentials.IDENTITY_VARIABLE] = str(folder.parent / "ann.pem")
            probe.bind(("127.0.0.1", 0))
            endpoint = f"tls/127.0.0.1:{probe.getsockname()[1]}"
            probe.close()
            words = [sys.executable, __file__, "--role", "hand", "--endpoint", endpoint]
            words += ["--rate", str(args.rate), *["--realtime"][: args.realtime]]
            hand = child(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
            todo = partial(measure, hand, endpoint, args.times, args.only, tls=args.tls)
            anyio.run(todo)
            hand.kill()


if __name__ == "__main__":
    main()
