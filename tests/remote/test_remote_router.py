"""A router between hands and clients, which see nothing of each other but through it."""

from __future__ import annotations

import threading
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path

import anyio
import anyio.to_thread
import pytest

import rtee
from rtee.cli._fleet import _table as fleet_table
from rtee.errors import ConfigError, LeaseHeld, NoHand, RemoteError
from rtee.hand.config_schema import SecuritySettings
from rtee.hand.files import write_together
from rtee.messages.requests import Role
from rtee.remote import credentials, server
from rtee.remote.credentials import Credentials
from rtee.remote.fleet import following
from rtee.remote.router import route, router_settings
from rtee.remote.session import close_session, open_client

from .serving import (
    LASTING,
    Config,
    Remote,
    Served,
    free_endpoint,
    make_hand,
    make_library,
    serving,
    until,
)

pytestmark = pytest.mark.anyio


@asynccontextmanager
async def routing(endpoint: str, site: Credentials | None) -> AsyncIterator[list[str]]:
    """Run a router for as long as the context lasts; yields the hands that it has admitted."""
    told: list[str] = []
    async with anyio.create_task_group() as group:
        group.start_soon(route, site, [endpoint], told.append)
        await until(lambda: bool(told))
        yield told
        group.cancel_scope.cancel()


@asynccontextmanager
async def behind(
    endpoint: str, folder: Path, secured: bool, *names: str
) -> AsyncIterator[list[Served]]:
    """Run hands that connect to a router."""
    async with AsyncExitStack() as stack:
        hands = []
        for name in names:
            own = SecuritySettings(folder=folder / name if secured else None, insecure=not secured)
            config = Config(Remote(connect=[endpoint], security=own))
            hand = make_hand(folder, name)
            opened = serving(hand, make_library(hand), config=config)
            hands.append(await stack.enter_async_context(opened))
        yield hands


async def test_a_router_as_it_comes_passes_on_all(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    async with (
        routing(endpoint, None),
        behind(endpoint, tmp_path, False, "left"),
        rtee.connect(endpoint=endpoint, wait=60.0) as remote,
    ):
        assert (await remote.do("Trig", "index", intensity=0.2)).reached
        assert (await anext(remote.states(50.0))).names
        assert await remote.stop() == {"sim": True}
        # Who watches many sees it through the router, and on its own computer.
        nobody = free_endpoint()
        async with following([endpoint, nobody]) as fleet:
            await fleet.known()
            looks = await fleet.look()
            places = [(look.place.hand, look.place.endpoint) for look in looks]
            assert places == [("", nobody), ("left", ""), ("left", endpoint)]
            assert [look.condition for look in looks] == ["absent", "ready", "ready"]
            assert looks[2].status is not None
            counts = looks[2].status.counts
            assert (counts.goals, counts.stops, counts.clients) == ({"reached": 1}, 1, 3)
            assert counts.lateness == tuple(sorted(counts.lateness))
            later = (await fleet.look())[2].status  # another thread counts ticks meanwhile
            assert later is not None
            assert 0 < counts.busy[-1] <= later.statistics.ticks
            lines = fleet_table(looks).lines()
            assert "nothing answers" in lines[1]
            assert "reached" in lines[3]


async def test_a_second_hand_of_a_name_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    endpoint = free_endpoint()
    async with routing(endpoint, None), behind(endpoint, tmp_path, False, "left"):
        # As on another computer, where no lock tells of the first.
        (tmp_path / "elsewhere").mkdir(mode=0o700)
        monkeypatch.setenv("RTEE_RUNTIME_DIR", str(tmp_path / "elsewhere"))
        with pytest.raises(ConfigError, match=f"'left' is already running at {endpoint}; give"):
            async with behind(endpoint, tmp_path, False, "left"):
                pass
        async with behind(endpoint, tmp_path, False, "right"):
            pass
    # Nobody of this name is left.
    async with routing(endpoint, None), behind(endpoint, tmp_path, False, "left"):
        pass


async def test_of_two_hands_of_a_name_that_start_at_once_one_stays() -> None:
    endpoint, refused = free_endpoint(), list[str]()
    sessions = []

    def begin() -> None:
        session = open_client([endpoint], 10.0)
        sessions.append(session)
        try:
            own, claim = server._claim_name("left", session)
            server._check_name("left", own, endpoint, {})
            claims.append(claim)
        except ConfigError as error:
            refused.append(error.message)
            close_session(session)  # as the hand ends

    async with routing(endpoint, None):
        claims = list[object]()
        try:
            async with anyio.create_task_group() as group:
                for _ in range(3):
                    group.start_soon(anyio.to_thread.run_sync, begin)
            assert len(claims) == 1
            assert len(refused) == 2
            assert all("'left' is already running" in each for each in refused)
        finally:
            for session in sessions:
                close_session(session)


async def test_silent_routers_are_waited_for_at_the_same_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    met = threading.Barrier(3)

    def silent(*_: object) -> None:
        # One after the other would not meet.
        met.wait(timeout=20.0)
        raise NoHand("nothing answers")

    monkeypatch.setattr(server, "open_client", silent)
    own = SecuritySettings(insecure=True)
    config = Config(Remote(connect=[free_endpoint() for _ in range(3)], security=own))
    hand = make_hand(tmp_path, "left")
    async with serving(hand, make_library(hand), config=config):
        assert not met.broken


async def test_two_hands_and_three_clients_with_certificates(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    authority = pytest.importorskip("rtee.remote.authority", reason="needs the extra secure")
    site, files = tmp_path / "site", {}
    authority.make_authority(site, "site")
    for name, role in (("ann", Role.OPERATOR), ("bob", Role.OPERATOR), ("eve", Role.OBSERVER)):
        files[name] = tmp_path / f"{name}.pem"
        write_together({files[name]: authority.add_client(site, name, role)[1]}, private=True)
    for name in ("left", "right"):
        authority.add_hand(site, name, tmp_path / name)
    strangers = {name: tmp_path / f"{name}.pem" for name in ("new", "old")}
    for name, file in strangers.items():
        write_together({file: authority.add_client(site, name, Role.OPERATOR)[1]}, private=True)
    authority.revoke(site, "old")
    endpoint = free_endpoint().replace("tcp/", "tls/")

    @asynccontextmanager
    async def client(name: str, hand: str) -> AsyncIterator[rtee.RemoteHand]:
        monkeypatch.setenv(credentials.IDENTITY_VARIABLE, str(files[name]))
        async with rtee.connect(hand, endpoint=endpoint, wait=60.0) as remote:
            yield remote

    monkeypatch.setenv(credentials.IDENTITY_VARIABLE, str(files["eve"]))
    async with (
        routing(endpoint, Credentials(site)) as told,
        behind(endpoint, tmp_path, True, "left", "right") as (left, right),
        # Who watches many stays, keeps no new hand out, and sees it.
        following([endpoint], here=False) as fleet,
    ):
        assert told == ["left, right"]
        (tmp_path / "elsewhere").mkdir(mode=0o700)
        with monkeypatch.context() as elsewhere:
            elsewhere.setenv("RTEE_RUNTIME_DIR", str(tmp_path / "elsewhere"))
            with pytest.raises(ConfigError, match="'left' is already running at tls/"):
                async with behind(endpoint, tmp_path, True, "left"):
                    pass
        await fleet.known()
        # Certificates that only the router knows yet, or does not know any more.
        for name, said in (("new", "people.json is older"), ("old", "as this certificate may see")):
            monkeypatch.setenv(credentials.IDENTITY_VARIABLE, str(strangers[name]))
            with pytest.raises(RemoteError, match=said):
                async with rtee.connect("left", endpoint=endpoint):
                    pass
        async with (
            client("ann", "left") as ann,
            client("bob", "right") as bob,
            client("eve", "left") as eve,
        ):
            assert [each.client.partition(".")[0] for each in (ann, bob, eve)] == [*files]
            events = eve.events()
            running = await ann.start("Trig", "index", **LASTING)
            assert (await bob.do("Trig", "index", intensity=0.2)).reached
            # Each hand has its own lease, and clients of another keep out of it.
            async with client("bob", "left") as second:
                with pytest.raises(LeaseHeld):
                    await second.do("Trig", "index")
            # The router drops what a role may not, and whoever it is may stop.
            with pytest.raises(RemoteError), anyio.fail_after(300):
                await eve.hold()
            assert await eve.stop() == {"sim": True}
            async for event in events:
                if event.kind == "stop":
                    assert event.text == "left: stopped by eve; confirmed"
                    break
            assert not (await running.result()).reached
            assert [len(each.watcher.goals) for each in (left, right)] == [1, 1]
            # Who is revoked is refused as soon as the hand's copy of the list says so.
            access_path = left.server._identities.access_path(ann.client)
            authority.revoke(tmp_path / "left", "ann")
            await until(lambda: left.server._identities._admitted(access_path) is None)
            with pytest.raises(RemoteError):
                await ann.status()
            # Another hand waits until nobody would be interrupted.
            authority.add_hand(site, "third", tmp_path / "third")
            await until(lambda: told[1:] == ["left, right, third, once no client is connected"])
        await until(lambda: told[2:] == ["left, right, third"])
        async with (
            behind(endpoint, tmp_path, True, "third"),
            client("ann", "third") as ann,
            client("bob", "right") as bob,
        ):
            for each in (ann, bob):
                assert (await each.do("Trig", "index", intensity=0.3)).reached
            await until(
                lambda: {place.hand for place in fleet._monitors} == {"left", "right", "third"}
            )


def test_what_cannot_be_secured_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="write tls/HOST:PORT"):
        router_settings(Credentials(tmp_path), ["tcp/0.0.0.0:7447"])
