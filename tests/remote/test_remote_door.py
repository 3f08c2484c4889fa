"""The network's side: floods of connections, too many sessions, and a door that dies."""

from __future__ import annotations

import os
import signal
import socket
import ssl
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import ExitStack, asynccontextmanager, contextmanager
from pathlib import Path
from unittest.mock import Mock

import anyio
import anyio.to_thread
import pytest
import zenoh

import rtee
from rtee import child
from rtee.actions.library import ActionLibrary
from rtee.hand.model import Hand
from rtee.messages.requests import Role
from rtee.remote import connections, credentials, door
from rtee.remote.client import stop_hand
from rtee.remote.identities import Identities
from rtee.remote.incoming_request import Check
from rtee.remote.rates import CONNECTIONS_FOR_STOPS, CONNECTIONS_OF_CERTIFICATE
from rtee.remote.session import (
    close_session,
    host_of,
    most_sessions,
    open_client,
    open_server,
)

from .serving import Config, Remote, serving, until
from .test_remote_tls import People, as_user, people, tls  # noqa: F401

pytestmark = pytest.mark.anyio

pytest.importorskip("cryptography", reason="needs the extra secure")


async def test_each_certificate_has_so_many_connections(
    hand: Hand,
    library: ActionLibrary,
    people: People,  # noqa: F811
) -> None:
    as_user(people.add("ann", Role.OBSERVER))
    endpoint = tls()
    async with serving(hand, library, config=Config(Remote(listen=[endpoint]))):
        context = credentials_context(people)
        with ExitStack() as stack:
            links: list[socket.socket] = []

            def connect(count: int) -> None:
                for _ in range(count):
                    link = socket.create_connection(("127.0.0.1", host_of(endpoint)[1]))
                    links.append(stack.enter_context(context.wrap_socket(link)))

            connect(CONNECTIONS_OF_CERTIFICATE)
            assert await stop_hand(endpoint=endpoint) == ("small", {"sim": True})
            connect(CONNECTIONS_FOR_STOPS + 4)
            await until(lambda: sum(map(is_closed, links)) >= 4)
            as_user(people.add("bob", Role.OBSERVER))
            assert await stop_hand(endpoint=endpoint) == ("small", {"sim": True})
            people.authority.revoke(people.folder, "ann")
            await until(lambda: all(map(is_closed, links)))
            assert await stop_hand(endpoint=endpoint) == ("small", {"sim": True})


def credentials_context(people: People) -> ssl.SSLContext:  # noqa: F811
    """Return TLS settings with this user's certificate."""
    file = people.files / "chain.pem"
    file.write_text("".join(credentials.identity().blocks[b] for b in ("key", "certificate")))
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    context.load_cert_chain(file)
    return context


def is_closed(link: socket.socket) -> bool:
    link.settimeout(0.0)
    try:
        return link.recv(1) == b""
    except (BlockingIOError, ssl.SSLWantReadError):
        return False
    except OSError:
        return True


@contextmanager
def silent_flood(port: int, rate: float, data: bytes) -> Iterator[list[socket.socket]]:
    """Open connections that send some bytes and say nothing more."""
    opened: list[socket.socket] = []
    ended = threading.Event()

    def flood() -> None:
        while not ended.wait(1.0 / rate):
            link = socket.socket()
            link.setblocking(False)
            link.connect_ex(("127.0.0.1", port))
            opened.append(link)
            for each in opened[-5:]:
                try:
                    each.send(data)
                except OSError:
                    continue

    thread = threading.Thread(target=flood)
    thread.start()
    try:
        yield opened
    finally:
        ended.set()
        thread.join()
        for link in opened:
            link.close()


@pytest.mark.parametrize("data", [b"", b"\x16\x03\x01\x02"])
async def test_connections_that_say_nothing_keep_nobody_out(
    hand: Hand,
    library: ActionLibrary,
    people: People,  # noqa: F811
    data: bytes,
) -> None:
    as_user(people.add("ann", Role.OBSERVER))
    endpoint = tls()
    async with serving(hand, library, config=Config(Remote(listen=[endpoint]))):
        with silent_flood(host_of(endpoint)[1], 100.0, data) as opened:
            # More than Zenoh shakes hands with at a time.
            await until(lambda: len(opened) > 150)
            for _ in range(2):
                assert await stop_hand("small", endpoint=endpoint) == ("small", {"sim": True})
            assert await stop_hand("small") == ("small", {"sim": True})
            async with rtee.connect(endpoint=endpoint) as remote:
                assert (await remote.status()).hand == "small"


STOPS = """
import asyncio, sys
import rtee
from rtee.remote.client import stop_hand

async def main():
    for _ in range(int(sys.argv[2])):
        async with rtee.connect(endpoint=sys.argv[1]) as remote:
            print(await remote.stop())
    for _ in range(int(sys.argv[3])):
        print((await stop_hand(endpoint=sys.argv[1]))[1])

asyncio.run(main())
"""
"""Stops the hand at an address so often after connecting, and so often without."""


async def stopped(endpoint: str, connecting: int, without: int) -> None:
    """Stop the hand so often in another process.

    In this one, one thread receives for the hand, for the flood and for its other clients.
    """
    stops = child.python("-c", STOPS, endpoint, str(connecting), str(without))
    done = await anyio.run_process(stops, env=child.environment(), check=False)
    said = done.stdout.decode().splitlines()
    assert said == ["{'sim': True}"] * (connecting + without), done.stderr.decode()[-500:]


FLOOD = """
import sys, time
import zenoh
from rtee.remote.session import open_client

sessions = [open_client([sys.argv[1]]) for _ in range(8)]
print("flooding", flush=True)
while True:
    for session in sessions:
        session.get(sys.argv[2], zenoh.handlers.FifoChannel(1), payload=b"junk", timeout=1.0)
    time.sleep(0.001)
"""
"""Greets the hand at an address with junk, under a key, in eight sessions."""


@asynccontextmanager
async def flooding(endpoint: str) -> AsyncIterator[None]:
    """Flood the hand with greetings under this user's certificate, in another process."""
    key = f"rtee/small/hello/{credentials.common_name(credentials.identity().name)}"
    flood = child.python("-c", FLOOD, endpoint, key)
    async with await anyio.open_process(flood, env=child.environment(), stderr=None) as process:
        try:
            assert process.stdout is not None
            assert await process.stdout.receive()
            await anyio.sleep(0.5)
            yield
        finally:
            process.kill()


async def test_a_flood_of_hello_keeps_no_other_certificate_out(
    hand: Hand,
    library: ActionLibrary,
    people: People,  # noqa: F811
) -> None:
    as_user(people.add("ann", Role.OBSERVER))
    endpoint = tls()
    config = Config(Remote(listen=[endpoint]))
    async with serving(hand, library, config=config), flooding(endpoint):
        as_user(people.add("bob", Role.OBSERVER))
        await stopped(endpoint, 4, 1)
        assert await stop_hand("small") == ("small", {"sim": True})


async def test_a_flood_that_the_hand_is_slow_to_take_holds_up_no_other_stop(
    hand: Hand,
    library: ActionLibrary,
    people: People,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ann, bob = people.add("ann", Role.OBSERVER), people.add("bob", Role.OBSERVER)
    endpoint, ended = tls(), threading.Event()
    welcome = Identities.welcome

    def slow(identities: Identities, access_path: str) -> Check:
        ended.wait(0.03)
        return welcome(identities, access_path)

    def greet(session: zenoh.Session, key: str) -> None:
        while not ended.is_set():
            session.get(key, zenoh.handlers.FifoChannel(1), payload=b"junk", timeout=1.0)
        close_session(session)

    async with serving(hand, library, config=Config(Remote(listen=[endpoint]))):
        as_user(bob)  # the door opens their way to the hand
        assert await stop_hand(endpoint=endpoint) == ("small", {"sim": True})
        as_user(ann)
        key = f"rtee/small/hello/{credentials.common_name(credentials.identity().name)}"
        sessions = [await anyio.to_thread.run_sync(open_client, [endpoint]) for _ in range(8)]
        monkeypatch.setattr(Identities, "welcome", slow)
        threads = [threading.Thread(target=greet, args=(each, key)) for each in sessions]
        for thread in threads:
            thread.start()
        try:
            await anyio.sleep(0.5)
            as_user(bob)
            await stopped(endpoint, 0, 8)
        finally:
            ended.set()
            for thread in threads:
                thread.join()


async def test_a_door_that_dies_is_opened_again(
    hand: Hand,
    library: ActionLibrary,
    people: People,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(door, "_AGAIN_AFTER", 0.01)
    as_user(people.add("ann", Role.OPERATOR))
    endpoint = tls()
    async with serving(hand, library, config=Config(Remote(listen=[endpoint]))):
        pid = children()
        async with rtee.connect(endpoint=endpoint) as remote:
            os.kill(pid[0], signal.SIGKILL)
            await until(lambda: remote._link.gone)
        async with rtee.connect("small", endpoint=endpoint, wait=20.0) as remote:
            assert (await remote.do("Trig", "index", intensity=0.1)).reached
        assert children() != pid
    assert children() == []


def children() -> list[int]:
    """Return the processes of doors of this process."""
    found = []
    for each in Path(f"/proc/{os.getpid()}/task").glob("*/children"):
        for pid in each.read_text().split():
            if b"rtee.remote.door" in Path(f"/proc/{pid}/cmdline").read_bytes():
                found.append(int(pid))
    return found


def test_each_user_has_so_many_connections(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "CONNECTIONS_OF_USER", 3)
    path = tmp_path / "x.sock"
    session, endpoint = open_server(path)
    judged = connections.Connections(session, str(path))
    with ExitStack() as stack:
        stack.callback(session.close)
        stack.callback(judged.close)
        for _ in range(5):
            stack.callback(open_client([endpoint]).close)
        # Those that are closed come again, and are closed again.
        wait(lambda: len(list(session.info.links())) == 3)


def test_a_close_just_before_a_look_is_not_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "_TOGETHER", 0.0)
    judged = connections.Connections(Mock(), "x.sock")
    new, clear = judged._new, judged._new.clear

    def late() -> None:
        judged._ended.set()
        new.set()
        clear()

    monkeypatch.setattr(new, "clear", late)
    new.set()
    judged._thread.join(20)
    assert not judged._thread.is_alive()


def test_connections_leave_files_for_devices_and_stops(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("resource.getrlimit", lambda _: (100, 100))
    assert most_sessions() == 36
    monkeypatch.setattr("resource.getrlimit", lambda _: (10, 10))
    assert most_sessions() == 1


async def test_tokens_cost_no_look_at_the_files(
    hand: Hand, library: ActionLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[float] = []
    connected = connections._connected

    def counted() -> Iterator[tuple[socket.socket, object]]:
        looks.append(0.0)
        return connected()

    async with serving(hand, library) as served:
        session = await anyio.to_thread.run_sync(open_client, [served.server.endpoint])
        remote = session.liveliness()
        monkeypatch.setattr(connections, "_connected", counted)
        for number in range(300):
            token = remote.declare_token(f"rtee/small/clients/{number:032x}")
            token.undeclare()  # type: ignore[no-untyped-call]
        last = remote.declare_token(f"rtee/small/clients/{300:032x}")
        await until(lambda: f"{300:032x}" in served.server._identities._tokens)
        # Those of the new connection, and of their surplus; not one for each token.
        assert len(looks) <= 2
        last.undeclare()  # type: ignore[no-untyped-call]
        session.close()


def wait(condition: Callable[[], bool]) -> None:
    """Wait until something is true; the test's timeout ends it."""
    while not condition():
        time.sleep(0.01)
