"""On one computer a hand is reached through a Unix socket, which file permissions protect."""

from __future__ import annotations

import os
import socket
import stat
import subprocess
from pathlib import Path
from typing import Any

import anyio.to_thread
import pytest
from rtee_process import PYTHON

import rtee
from rtee.actions.library import ActionLibrary
from rtee.errors import ConfigError, NoHand
from rtee.hand.model import Hand
from rtee.remote import link, session
from rtee.remote.directory import hands_running
from rtee.remote.link import Link
from rtee.remote.server import Inboxes

from .serving import Config, Remote, free_endpoint, serving

pytestmark = pytest.mark.anyio

NOBODY = 65534
"""A user that owns nothing."""

INTRUDER = """
import os, sys
from rtee.errors import NoHand
from rtee.remote.session import open_client
endpoint, uid = sys.argv[1], int(sys.argv[2])
open_client([endpoint]).close()
print("in")
os.setgroups([])
os.setgid(uid)
os.setuid(uid)
try:
    open_client([endpoint])
    print("in")
except NoHand as error:
    print(error)
"""


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can act as another user")
async def test_another_user_does_not_get_in(
    hand: Hand, library: ActionLibrary, runtime: Path
) -> None:
    async with serving(hand, library) as served:
        words = [*PYTHON, "-c", INTRUDER, served.server.endpoint, str(NOBODY)]
        for _ in range(2):
            own, other = (await ran(words)).stdout.splitlines()
            assert own == "in"
            assert "nothing answers at unixsock-stream/" in other
            assert "Permission denied" in other
            # The second time the folders let everybody in, as after a mistake.
            for folder in (runtime, *runtime.parents):
                if not folder.stat().st_mode & 0o001:
                    folder.chmod(folder.stat().st_mode | 0o001)


async def ran(words: list[str]) -> subprocess.CompletedProcess[str]:
    return await anyio.to_thread.run_sync(
        lambda: subprocess.run(words, capture_output=True, text=True)
    )


async def test_no_port_listens(hand: Hand, library: ActionLibrary, runtime: Path) -> None:
    before = _listening_ports()  # pytest's own
    async with serving(hand, library):
        found = stat.S_IMODE((runtime / "small.sock").stat().st_mode)
        assert found == 0o660
        assert _listening_ports() == before
        (endpoint,) = hands_running()["small"].endpoints
        assert endpoint == f"unixsock-stream/{runtime}/small.sock"
    assert os.listdir(runtime) == []


def _listening_ports() -> list[int]:
    """Return the TCP ports on which this process listens."""
    found = []
    for name in os.listdir("/dev/fd"):
        if not Path("/dev/fd", name).is_socket():
            continue
        with socket.socket(fileno=os.dup(int(name))) as one:
            inet = one.family in (socket.AF_INET, socket.AF_INET6)
            if inet and one.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN):
                found.append(one.getsockname()[1])
    return found


async def test_many_clients_come_and_go(hand: Hand, library: ActionLibrary) -> None:
    async with serving(hand, library) as served:
        for _ in range(3):
            clients = [rtee.connect("small", client=f"c{k}") for k in range(12)]
            remotes = [await client.__aenter__() for client in clients]
            assert len({remote.client for remote in remotes}) == 12
            for remote in remotes:
                assert (await remote.status()).hand == "small"
            for client in clients:
                await client.__aexit__(None, None, None)
        assert served.watcher.events == [] or "client_lost" not in {
            event.kind for event in served.watcher.events
        }


async def test_the_socket_of_a_killed_hand_is_replaced(
    hand: Hand, library: ActionLibrary, runtime: Path
) -> None:
    os.mkdir(runtime, 0o700)
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(runtime / "small.sock"))
    async with serving(hand, library), rtee.connect("small") as remote:
        assert (await remote.status()).hand == "small"


async def test_a_hand_that_ends_while_a_client_comes_is_noticed_at_once(runtime: Path) -> None:
    os.mkdir(runtime, 0o700)
    path = runtime / "small.sock"

    def end(listener: socket.socket) -> None:
        listener.accept()[0].close()  # the probe
        with listener.accept()[0]:  # Zenoh
            listener.close()

    with socket.create_server(str(path), family=socket.AF_UNIX) as listener:
        async with anyio.create_task_group() as group:
            group.start_soon(anyio.to_thread.run_sync, end, listener)
            with pytest.raises(NoHand, match="nothing answers at"):
                await anyio.to_thread.run_sync(
                    session.open_client, [f"unixsock-stream/{path}"], 1e4
                )


async def test_a_hand_that_ends_before_it_subscribes_is_noticed_at_once(
    hand: Hand, library: ActionLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Inboxes, "_listen", lambda *_: None)
    monkeypatch.setattr(link, "_CONNECT_WITHIN", 1e4)
    answered, link_of = anyio.Event(), Link.request

    async def request(self: Link, *arguments: Any, **options: Any) -> Any:
        answer = await link_of(self, *arguments, **options)
        answered.set()
        return answer

    monkeypatch.setattr(Link, "request", request)

    async def come() -> None:
        with pytest.raises(NoHand, match="'small' has ended or no longer answers"):
            async with rtee.connect("small"):
                pass

    async with anyio.create_task_group() as group, serving(hand, library):
        group.start_soon(come)
        await answered.wait()


def test_a_path_that_is_too_long_for_a_socket_is_a_mistake(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"longer than 10. bytes.*RTEE_RUNTIME_DIR"):
        session.local_endpoint(tmp_path / ("x" * 100) / "small.sock")
    with pytest.raises(ConfigError, match=r"may not contain \? or #"):
        session.local_endpoint(tmp_path / "a#b.sock")


def test_brackets_of_an_address_belong_together() -> None:
    assert session.address_of("[::1]:9464", "metrics") == ("::1", 9464)
    assert session.address_of("localhost:9464", "metrics") == ("localhost", 9464)
    for wrong in ("[::1:9464", "::1]:9464", "127.0.0.1]:9464", "[robot]:9464", "robot:65536"):
        with pytest.raises(ConfigError, match=r"metrics: .* should be HOST:PORT"):
            session.address_of(wrong, "metrics")


async def test_a_long_path_of_the_runtime_folder_is_no_obstacle(
    hand: Hand, library: ActionLibrary, runtime: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RTEE_RUNTIME_DIR", str(runtime / ("x" * 120)))
    async with serving(hand, library) as served, rtee.connect("small") as remote:
        assert (await remote.status()).hand == "small"
        place = os.path.dirname(served.server.endpoint.removeprefix("unixsock-stream/"))
        assert os.stat(place).st_mode & 0o777 == 0o700
    with pytest.raises(FileNotFoundError):
        os.stat(place)


async def test_a_hand_that_also_listens_elsewhere_keeps_its_socket(
    hand: Hand, library: ActionLibrary
) -> None:
    before = _listening_ports()
    config = Config(Remote(listen=[free_endpoint()]))
    async with serving(hand, library, config=config) as served:
        assert served.server.endpoint.startswith("unixsock-stream/")
        assert len(_listening_ports()) == len(before) + 1
