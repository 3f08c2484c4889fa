"""A stop has a way of its own, which nobody can use up."""

from __future__ import annotations

import json
import os
import resource
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

import anyio
import anyio.to_thread
import pytest
from rtee_process import PYTHON

import rtee
from rtee.actions.library import ActionLibrary
from rtee.commands import StreamTargets
from rtee.errors import NoHand, RequestRejected
from rtee.hand.model import Hand
from rtee.messages.convert import STREAM_TARGETS
from rtee.messages.requests import HERE
from rtee.remote import client, identities
from rtee.remote.client import stop_hand
from rtee.remote.connections import user_of, vouching
from rtee.remote.stopping import _client, stop_at, stop_path

from .serving import Served, serving, until
from .test_remote_attacks import Intruder
from .test_remote_socket import NOBODY, ran
from .test_remote_streams import sent

pytestmark = pytest.mark.anyio


def path_of(served: Served) -> Path:
    path = stop_path(served.server.endpoint)
    assert path is not None
    return path


async def stops(served: Served, client: str = "test") -> dict[str, bool]:
    return await anyio.to_thread.run_sync(stop_at, path_of(served), "small", client)


async def test_a_stop_needs_no_session(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        goal = await remote.start("fist", speed=0.1)
        assert await stop_hand(client="a.test") == ("small", {"sim": True})
        assert (await goal.result()).cancelled
        [event] = [e for e in served.watcher.events if e.kind == "stop"]
        who = f"a.test (process {os.getpid()} of user {os.getuid()})"
        assert event.text == f"small: stopped by {who}; confirmed"


async def test_a_stop_says_which_device_did_not_confirm(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library) as served:
        served.driver.unplug()
        await anyio.sleep(0.05)
        assert await stops(served) == {"sim": False}


async def test_whatever_comes_is_a_stop(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        for junk in (b"", b"\xff" * 5, os.urandom(60_000), b"{" * 300, b"0 \n\x1b[31m"):
            goal = await remote.start("fist", speed=0.1)
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
                sender.sendto(junk, str(path_of(served)))
            assert (await goal.result()).cancelled
        assert all(event.text.isprintable() for event in served.watcher.events)


async def test_a_cleaner_of_files_does_not_keep_a_hand_from_being_stopped(
    hand: Hand, library: ActionLibrary
) -> None:
    async with serving(hand, library) as served:
        path_of(served).unlink()
        # Until the socket is there again, the stop goes through the network's.
        async with rtee.connect("small") as remote:
            assert await remote.stop() == {"sim": True}
        await until(path_of(served).exists)
        assert await stops(served) == {"sim": True}
    assert not path_of(served).exists()
    with pytest.raises(FileNotFoundError):
        await stops(served)


async def test_a_device_that_has_not_confirmed_is_stopped_again(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as hand:
        hand.bind(str(tmp_path / "stop"))

        def answer() -> None:
            for done in (False, False, True):
                data, sender = hand.recvfrom(100)
                name = data.decode().partition(" ")[0]
                hand.sendto(json.dumps({"to": name, "confirmed": {"sim": done}}).encode(), sender)

        async with anyio.create_task_group() as group:
            group.start_soon(anyio.to_thread.run_sync, answer)
            stopped = client._stopped(tmp_path / "stop", "small", "test", anyio.sleep_forever)
            assert await stopped == {"sim": True}


async def test_a_hand_that_is_silent_is_not_waited_for(
    hand: Hand, library: ActionLibrary, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(client, "stop_at", partial(stop_at, within=0.05))
    monkeypatch.setattr(client, "stop_path", lambda endpoint: tmp_path / "frozen")
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        remote._stops = tmp_path / "frozen"
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as frozen:
            frozen.bind(str(remote._stops))
            for stop in (stop_hand, remote.stop):
                with pytest.raises(NoHand, match=r"'small' does not confirm .* emergency stop"):
                    await stop()
            assert frozen.recv(100).endswith(b" python"), "it would stop as soon as it goes on"
        assert not served.watcher.events


@contextmanager
def flood(path: Path, senders: int = 4) -> Iterator[None]:
    ended = threading.Event()

    def send() -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            sender.settimeout(0.1)
            while not ended.is_set():
                try:
                    sender.sendto(b"x", str(path))
                except OSError:
                    continue

    threads = [threading.Thread(target=send) for _ in range(senders)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        ended.set()
        for thread in threads:
            thread.join()


async def test_a_flood_of_stops_keeps_no_stop_away(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library) as served:
        with flood(path_of(served)):
            for _ in range(10):
                assert await stops(served) == {"sim": True}


async def test_connections_that_say_nothing_keep_no_stop_away(
    hand: Hand, library: ActionLibrary
) -> None:
    async with serving(hand, library) as served:
        with ExitStack() as stack:
            for _ in range(150):
                link = stack.enter_context(socket.socket(socket.AF_UNIX))
                link.connect(str(path_of(served).with_suffix(".sock")))
            assert await stop_hand() == ("small", {"sim": True})


async def test_64_clients_of_one_user_keep_no_stop_away_and_no_client_of_another_user(
    hand: Hand, library: ActionLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(identities, "CLIENTS_OF_SHARE", 2)
    async with serving(hand, library), rtee.connect("small") as one, rtee.connect("small"):
        with pytest.raises(RequestRejected, match="clients already"):
            async with rtee.connect("small"):
                pass
        assert await stop_hand() == ("small", {"sim": True})
        # Nor one that goes through the network: it needs no hello.
        one._stops = None
        assert await one.stop() == {"sim": True}
        monkeypatch.setattr(identities, "user_of", lambda token: NOBODY)
        async with rtee.connect("small") as other:
            assert (await other.do("fist", intensity=0.1)).reached


def test_a_client_shows_whose_it_is_and_hides_its_token() -> None:
    token = "0" * 32
    assert user_of(token) == -1
    with vouching(token):
        assert user_of(token) == os.getuid()
        assert token not in Path("/proc/net/unix").read_text()
    program = "import os, sys; from rtee.remote.connections import vouching\nos.setuid(65534)\n"
    program += f"with vouching('{token}'): print(flush=True); sys.stdin.read()"
    if os.geteuid() == 0:  # only root can act as another user
        words, pipe = [*PYTHON, "-c", program], subprocess.PIPE
        with subprocess.Popen(words, stdin=pipe, stdout=pipe) as other:
            assert other.stdout is not None
            other.stdout.readline()
            assert user_of(token) == NOBODY
            other.communicate()


async def test_samples_without_lease_take_none_of_the_stream(
    hand: Hand, library: ActionLibrary
) -> None:
    async with (
        serving(hand, library) as served,
        rtee.connect("small") as holder,
        rtee.connect("small") as other,
        holder.stream(rate=50) as stream,
        anyio.create_task_group() as group,
    ):
        await stream.send({"near": 0.1})

        async def steal() -> None:
            while True:
                for _ in range(6):
                    now = time.monotonic()
                    stolen = StreamTargets(stream.name, now, {"near": 1.4}, {}, other.client)
                    other._link.put(STREAM_TARGETS.encode(stolen), "x")
                await anyio.sleep(0.02)

        group.start_soon(steal)
        await sent(stream, 100, near=0.3)
        status = await stream.status()
        assert status.samples >= 95
        assert served.loop.snapshot().reference_position[0] == pytest.approx(0.3, abs=0.01)
        group.cancel_scope.cancel()


async def test_a_client_cannot_pass_for_that_of_another_person(
    hand: Hand, library: ActionLibrary
) -> None:
    async with serving(hand, library) as served:
        admitted = {HERE: identities.Admitted(identities.Role.OPERATOR, "ann.")}
        served.server._identities._admitted = admitted.get
        link = Intruder(served.server.endpoint, "peer")
        for name in ("ann-b.gui-1", "ann.b.gui-1", "ann", "annb.x", "bob.x"):
            with pytest.raises(RequestRejected, match=r"dot|begin"):
                await anyio.to_thread.run_sync(hello, link, name)
        link.session.close()


def hello(link: Intruder, name: str) -> None:
    from rtee.messages.requests import REQUESTS
    from rtee.messages.schema import message_type

    question = REQUESTS["hello"].question.encode({"client": name, "what": "0" * 32})
    [answer] = link.session.get(f"rtee/small/hello/{HERE}", payload=question, timeout=5.0)
    assert answer.err is not None
    reply = message_type("rtee_msgs/msg/Reply").decode(answer.err.payload.to_bytes())
    raise RequestRejected(reply["reason"])


STRANGER = """
import os, sys
from pathlib import Path
from rtee.remote.stopping import stop_at
path, uid = Path(sys.argv[1]), int(sys.argv[2])
os.setgroups([])
os.setgid(uid)
os.setuid(uid)
try:
    print(stop_at(path, "small", "stranger", 0.2))
except OSError as error:
    print(error.strerror)
"""


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can act as another user")
async def test_another_user_stops_nothing(
    hand: Hand, library: ActionLibrary, runtime: Path
) -> None:
    async with serving(hand, library) as served:
        words = [*PYTHON, "-c", STRANGER, str(path_of(served)), str(NOBODY)]
        for _ in range(2):
            assert (await ran(words)).stdout == "Permission denied\n"
            for folder in (runtime, *runtime.parents):  # as after a mistake
                if not folder.stat().st_mode & 0o001:
                    folder.chmod(folder.stat().st_mode | 0o001)
        assert not served.watcher.events


async def test_a_stop_needs_no_file_of_the_hand(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library) as served:
        with _client(path_of(served)) as sender:
            sender.settimeout(5.0)
            soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
            resource.setrlimit(resource.RLIMIT_NOFILE, (3, hard))
            try:
                with pytest.raises(OSError, match="Too many open files"):
                    os.open(os.devnull, os.O_RDONLY)
                sender.send(b"x test")
                assert b"true" in await anyio.to_thread.run_sync(sender.recv, 1000)
            finally:
                resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_a_process_may_open_as_many_files_as_the_system_lets_it() -> None:
    program = "from rtee.remote.connections import raise_file_limit as r; print(r())"
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    words = ["sh", "-c", f'ulimit -S -n 100; exec {sys.executable} -c "{program}"']
    assert int(subprocess.run(words, capture_output=True, text=True).stdout) == hard
