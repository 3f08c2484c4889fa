"""A hand on a network: TLS with certificates, roles, revocation."""

from __future__ import annotations

import os
import shutil
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import anyio
import anyio.to_thread
import pytest

import rtee
from rtee.actions.library import ActionLibrary
from rtee.cli import secure
from rtee.drivers.diagnosis.checks import Verdict
from rtee.errors import ConfigError, NoHand, RemoteError, RequestRejected
from rtee.hand.config_schema import SecuritySettings
from rtee.hand.files import write_together
from rtee.hand.model import Hand
from rtee.messages.requests import Role
from rtee.remote import credentials, protection
from rtee.remote.client import RemoteHand
from rtee.remote.identities import Admitted
from rtee.remote.session import direct, is_safe, open_client
from rtee.types import Event

from .serving import Config, Remote, free_endpoint, serving, until

pytestmark = pytest.mark.anyio

pytest.importorskip("cryptography", reason="needs the extra secure")


class People:
    """A hand's certificates, and files for its clients."""

    def __init__(self, folder: Path) -> None:
        from rtee.remote import authority

        self.authority = authority
        self.folder = folder / "secure" / "small"
        self.files = folder
        authority.make_authority(self.folder, "small")

    def add(self, name: str, role: Role) -> Path:
        path = self.files / f"{name}.pem"
        _, text = self.authority.add_client(self.folder, name, role)
        write_together({path: text}, private=True)
        return path


@pytest.fixture
def people(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> People:
    monkeypatch.setenv(credentials.FOLDER_VARIABLE, str(tmp_path / "secure"))
    monkeypatch.setenv(credentials.IDENTITY_VARIABLE, "")  # restored after the test
    return People(tmp_path)


def tls() -> str:
    return free_endpoint().replace("tcp/", "tls/")


async def refused(what: object) -> str:
    with pytest.raises(RemoteError) as caught:
        await what  # type: ignore[misc]
    return str(caught.value)


async def test_each_role_may_do_what_it_should(
    hand: Hand, library: ActionLibrary, people: People, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = {role: people.add(role.name.lower(), role) for role in Role}
    endpoint = tls()
    async with serving(hand, library, config=Config(Remote(listen=[endpoint]))) as served:
        for role, file in files.items():
            monkeypatch.setenv(credentials.IDENTITY_VARIABLE, str(file))
            async with rtee.connect(endpoint=endpoint) as remote:
                assert remote.client.startswith(f"{role.name.lower()}.python-")
                assert remote.role is role
                assert (await remote.status()).hand == "small"
                assert (await anext(remote.states(50.0))).names
                assert list(await remote.stop()) == ["sim"]
                await _tries(remote, role)
        stops = [event.text for event in served.watcher.events if event.kind == "stop"]
        # A stop that is confirmed late is sent again, and told each time.
        once = list(dict.fromkeys(stops))
        assert once == [f"small: stopped by {role.name.lower()}; confirmed" for role in files]
        moved = {goal.client.partition(".")[0] for goal in served.watcher.goals}
        assert moved == {"operator", "maintainer"}


async def _tries(remote: RemoteHand, role: Role) -> None:
    moves = [
        lambda: remote.do("Trig", "index", intensity=0.1),
        remote.hold,
        remote.acquire_lease,
        remote.release_lease,
    ]
    changes = [
        lambda: remote.add_generic(f"x_{role.value}", {"near": 0.5}),
        lambda: remote.set_gains({"grip_effort": 0.3}),
    ]
    for least, calls in ((Role.OPERATOR, moves), (Role.MAINTAINER, changes)):
        for call in calls:
            if role >= least:
                await call()
                continue
            # Zenoh drops it; the hand itself would refuse it, too.
            with (
                pytest.raises(RequestRejected, match=f"needs the role {least.name.lower()}"),
                anyio.fail_after(300),
            ):
                await call()


async def test_the_hand_itself_refuses_what_a_role_may_not(
    hand: Hand, library: ActionLibrary, people: People, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = people.add("ann", Role.MAINTAINER)
    monkeypatch.setenv(credentials.IDENTITY_VARIABLE, str(file))
    endpoint = tls()
    async with serving(hand, library, config=Config(Remote(listen=[endpoint]))) as served:
        # Zenoh's rules are still those of a maintainer.
        name = credentials.common_name(name_of(file))
        served.server._identities._admitted = {name: Admitted(Role.OBSERVER, "ann.")}.get
        async with rtee.connect(endpoint=endpoint) as remote:
            assert "has the role observer" in await refused(remote.hold())
            assert "needs the role maintainer" in await refused(
                remote.set_gains({"grip_effort": 0.3})
            )
            assert list(await remote.stop()) == ["sim"]


async def test_without_a_certificate_nobody_gets_in(
    hand: Hand,
    library: ActionLibrary,
    people: People,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    endpoint = tls()
    async with serving(hand, library, config=Config(Remote(listen=[endpoint]))):
        monkeypatch.setenv(credentials.IDENTITY_VARIABLE, str(tmp_path / "none.pem"))
        with pytest.raises(ConfigError, match="add-client"):
            async with rtee.connect(endpoint=endpoint):
                pass
        stranger = People(tmp_path / "elsewhere")
        monkeypatch.setenv(credentials.IDENTITY_VARIABLE, str(stranger.add("eve", Role.MAINTAINER)))
        monkeypatch.setattr("rtee.remote.session._CONNECT_WITHIN", 2)
        with pytest.raises(NoHand):
            async with rtee.connect(endpoint=endpoint):
                pass
        with pytest.raises(NoHand):
            async with rtee.connect(endpoint=endpoint.replace("tls/", "tcp/")):
                pass


@pytest.fixture
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Changes of who is admitted are seen soon."""
    monkeypatch.setattr(protection, "_LOOK_EVERY", 0.02)


async def test_a_revoked_client_sees_and_does_nothing_any_more(
    hand: Hand,
    library: ActionLibrary,
    people: People,
    monkeypatch: pytest.MonkeyPatch,
    soon: None,
) -> None:
    ann, bob = people.add("ann", Role.OPERATOR), people.add("bob", Role.OPERATOR)
    endpoint = tls()
    async with serving(hand, library, config=Config(Remote(listen=[endpoint]))) as served:
        as_user(ann)
        async with rtee.connect(endpoint=endpoint) as remote, remote.collected_states() as seen:
            as_user(bob)
            async with rtee.connect(endpoint=endpoint) as other, other.collected_states() as others:
                events = remote.events()
                await remote.acquire_lease()
                await until(lambda: len(seen.drain()) > 0)
                people.authority.revoke(people.folder, "ann")
                # What it held is free again, as if the client were lost.
                await served.event("client_lost")
                with pytest.raises(RemoteError, match=r"revoked|no longer answers|does not answer"):
                    await remote.hold()
                await until(lambda: remote._link.gone)  # its connection is closed
                seen.drain()
                assert (await other.do("Trig", "index", intensity=0.2)).reached
                # Last: a stop is sent again until it is answered, so one may come after the answer.
                await other.stop()
                await until(lambda: len(others.drain()) > 0)
                assert seen.drain() == []
                with pytest.raises(NoHand):
                    await told(events)
            as_user(ann)
            with pytest.raises(RemoteError):
                async with rtee.connect(endpoint=endpoint):
                    pass
    async with serving(hand, library, config=Config(Remote(listen=[endpoint]))):
        with pytest.raises(NoHand):
            async with rtee.connect(endpoint=endpoint):
                pass


async def told(events: AsyncIterator[Event]) -> list[str]:
    """Return the kinds of the events that have arrived."""
    kinds: list[str] = []
    with anyio.move_on_after(0.1):
        async for event in events:
            kinds.append(event.kind)
    return kinds


async def test_a_client_that_is_added_to_a_running_hand_is_admitted(
    hand: Hand,
    library: ActionLibrary,
    people: People,
    soon: None,
    caplog: pytest.LogCaptureFixture,
) -> None:
    endpoint = tls()
    async with serving(hand, library, config=Config(Remote(listen=[endpoint]))) as served:
        files = {role: people.add(role.name.lower(), role) for role in Role}
        await until(lambda: len(served.server._identities._admitted.__self__.people) == len(files))
        for role, file in files.items():
            as_user(file)
            async with rtee.connect(endpoint=endpoint) as remote:
                assert (await anext(remote.states(50.0))).names
                await _tries(remote, role)
        assert "next start" not in caplog.text
        for number in range(people.authority._SPARE):
            people.add(f"operator{number}", Role.OPERATOR)
        await until(lambda: "is admitted from the next start" in caplog.text)


async def test_nobody_sees_what_is_published_for_another(
    hand: Hand, library: ActionLibrary, people: People
) -> None:
    ann, bob = people.add("ann", Role.MAINTAINER), people.add("bob", Role.OPERATOR)
    endpoint = tls()
    async with serving(hand, library, config=Config(Remote(listen=[endpoint]))):
        as_user(bob)
        async with rtee.connect(endpoint=endpoint) as remote:
            as_user(ann)
            spy = await anyio.to_thread.run_sync(open_client, [endpoint])
            seen: list[str] = []
            own, its = (credentials.common_name(name_of(file)) for file in (ann, bob))
            for key in (
                "**",
                "events",
                f"watch/{its}/**",
                f"watch/{its}/events",
                f"watch/{own}/results",
            ):
                spy.declare_subscriber(
                    f"rtee/small/{key}", direct(lambda sample: seen.append(str(sample.key_expr)))
                )
            await anext(remote.states(100.0))
            await remote.do("Trig", "index", intensity=0.1)
            await until(lambda: len(seen) > 0)
            await anyio.to_thread.run_sync(spy.close)
            assert {*seen} == {f"rtee/small/watch/{own}/results"}


def as_user(file: Path) -> None:
    """Use a certificate for the next connections."""
    os.environ[credentials.IDENTITY_VARIABLE] = str(file)


def name_of(file: Path) -> str:
    as_user(file)
    return credentials.identity().name


async def test_a_client_cannot_pass_for_the_hand(
    hand: Hand, library: ActionLibrary, people: People, monkeypatch: pytest.MonkeyPatch
) -> None:
    ann, eve = people.add("ann", Role.OPERATOR), people.add("eve", Role.OPERATOR)
    monkeypatch.setenv(credentials.IDENTITY_VARIABLE, str(eve))
    blocks = credentials.identity().blocks
    write_together({people.folder / credentials.HAND_KEY: blocks["key"]}, private=True)
    (people.folder / credentials.HAND).write_text(blocks["certificate"])
    monkeypatch.setenv(credentials.IDENTITY_VARIABLE, str(ann))
    monkeypatch.setattr("rtee.remote.session._CONNECT_WITHIN", 2)
    endpoint = tls()
    async with serving(hand, library, config=Config(Remote(listen=[endpoint]))):
        with pytest.raises(NoHand):
            async with rtee.connect(endpoint=endpoint):
                pass


async def test_an_endpoint_without_certificates_must_be_allowed(
    hand: Hand, library: ActionLibrary, caplog: pytest.LogCaptureFixture
) -> None:
    endpoint = free_endpoint().replace("127.0.0.1", "0.0.0.0")
    with pytest.raises(ConfigError, match=r"could move the hand.*insecure: true"):
        async with serving(hand, library, config=Config(Remote(listen=[endpoint]))):
            pass
    for router, why in (("tcp", "could move the hand"), ("tls", "rtee secure init")):
        config = Config(Remote(connect=[f"{router}/router:7447"]))
        with pytest.raises(ConfigError, match=why):
            async with serving(hand, library, config=config):
                pass
    config = Config(Remote(listen=[endpoint], security=SecuritySettings(insecure=True)))
    async with serving(hand, library, config=config):
        assert "can move the hand" in caplog.text
        here = endpoint.replace("0.0.0.0", "127.0.0.1")
        async with rtee.connect(endpoint=here) as remote:
            await remote.hold()


async def test_keys_that_others_can_read_are_refused(
    hand: Hand, library: ActionLibrary, people: People, monkeypatch: pytest.MonkeyPatch
) -> None:
    ann = people.add("ann", Role.OPERATOR)
    key = people.folder / credentials.HAND_KEY
    assert [p.stat().st_mode & 0o777 for p in (ann, key)] == [0o600, 0o600]
    os.chmod(ann, 0o644)
    monkeypatch.setenv(credentials.IDENTITY_VARIABLE, str(ann))
    with pytest.raises(ConfigError, match="chmod 600"):
        credentials.identity()
    os.chmod(key, 0o640)
    with pytest.raises(ConfigError, match="chmod 600"):
        async with serving(hand, library, config=Config(Remote(listen=[tls()]))):
            pass


@pytest.mark.parametrize("place", [".", "..", "people.json", "hand.key"])
@pytest.mark.parametrize("wrong", ["open", "foreign"])
def test_certificates_that_somebody_else_could_have_made_are_refused(
    people: People, place: str, wrong: str
) -> None:
    """Made under a umask of 000, or by another user, they would admit whomever that user likes."""
    if wrong == "open":
        (people.folder / place).chmod(0o777)
    elif os.getuid() == 0:
        os.chown(people.folder / place, 12345, -1)
    else:
        pytest.skip("only root makes files of other users")
    with pytest.raises(ConfigError, match="must belong to you or root"):
        credentials.Credentials(people.folder).files()


def test_no_folder_of_certificates_is_open_to_others(tmp_path: Path) -> None:
    from rtee.remote import authority

    before = os.umask(0)
    try:
        authority.make_authority(tmp_path / "new" / "secure" / "small", "small")
        authority.add_client(tmp_path / "new" / "secure" / "small", "one", Role.OPERATOR)
    finally:
        os.umask(before)
    credentials.Credentials(tmp_path / "new" / "secure" / "small").files()
    assert (tmp_path / "new").stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize(
    ("endpoint", "safe"),
    [
        ("tcp/127.0.0.1:1", True),
        ("tcp/127.8.0.1:1", True),
        ("tcp/[::1]:1", True),
        ("tcp/localhost:1", True),
        ("tls/0.0.0.0:7447", True),
        ("unixsock-stream//run/x.sock", True),
        ("tcp/0.0.0.0:1", False),
        ("tcp/[::]:1", False),
        ("tcp/192.168.1.10:7447", False),
        ("tcp/robot:7447", False),
        ("udp/127.0.0.1:7447", False),
        ("quic/robot:7447", False),
    ],
)
def test_which_endpoints_are_safe(endpoint: str, safe: bool) -> None:
    assert is_safe(endpoint) == safe


def test_the_command_makes_lists_and_revokes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(credentials.FOLDER_VARIABLE, str(tmp_path / "secure"))
    monkeypatch.chdir(tmp_path)
    secure.init("small")
    said = capsys.readouterr().out
    assert "rtee secure add-hand small HAND" in said, "there is no such hand: it is a site"
    assert "hand.yaml" not in said
    secure.add_client("small", "ann", role="observer")
    secure.add_client("small", "bob", role="maintainer", days=3)
    assert (tmp_path / "ann@small.pem").stat().st_mode & 0o777 == 0o600
    secure.revoke("small", "ann")
    capsys.readouterr()
    secure.list_("small")
    said = capsys.readouterr().out
    assert "refused" in said
    assert "maintainer" in said
    with pytest.raises(ConfigError, match="exists already"):
        secure.init("small")
    with pytest.raises(ConfigError, match="no client 'eve'"):
        secure.revoke("small", "eve")
    with pytest.raises(ConfigError, match="unknown role 'king'"):
        secure.add_client("small", "eve", role="king")
    for name in ("", "../x", "a.b", "x" * 40):
        with pytest.raises(ConfigError, match="valid name for a client"):
            secure.add_client("small", name, out=tmp_path / "other.pem")


def test_files_that_cannot_be_used_are_named(people: People, tmp_path: Path) -> None:
    good = {
        name: (people.folder / name).read_bytes() for name in ("authority.key", "authority.crt")
    }
    for name, whole in good.items():
        for bad in (b"", b"junk", whole[:-60]):
            (people.folder / name).write_bytes(bad)
            with pytest.raises(ConfigError, match=f"{name}: is not the file that 'rtee"):
                secure.add_client("small", "ann", out=tmp_path / "ann.pem")
        (people.folder / name).write_bytes(whole)
    (people.folder / "authority.crt").unlink()
    with pytest.raises(ConfigError, match=r"authority\.crt: cannot be read"):
        secure.renew("small")
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="cannot be created"):
        people.authority.make_authority(tmp_path / "file" / "small", "small")


def test_on_a_full_disk_no_certificate_is_made_or_changed(
    people: People, tmp_path: Path, largest_file: Callable[[int | None], None]
) -> None:
    def content() -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in people.folder.iterdir()}

    before = content()
    largest_file(700)  # enough for each key and certificate, but not for the list of people
    with pytest.raises(ConfigError, match="cannot be written: file too large"):
        people.authority.make_authority(tmp_path / "other" / "small", "small")
    with pytest.raises(ConfigError, match="cannot be written: file too large"):
        secure.renew("small")
    with pytest.raises(ConfigError, match="cannot be written: file too large"):
        people.authority.add_hand(people.folder, "small", tmp_path / "small@site")
    largest_file(None)
    assert not (tmp_path / "other").exists()
    assert not (tmp_path / "small@site").exists()
    assert content() == before


def test_a_certificate_that_cannot_be_stored_is_not_admitted(
    people: People, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match="cannot be written: no such file"):
        secure.add_client("small", "ann", out=tmp_path / "nowhere" / "ann.pem")
    known = credentials.Credentials(people.folder)
    known.read()
    assert not known.admitted


def test_doctor_tells_what_expires(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    repository: Path,
) -> None:
    monkeypatch.setenv(credentials.FOLDER_VARIABLE, str(tmp_path / "secure"))
    folder = tmp_path / "robotiq_2f_85"
    shutil.copytree(repository / "config" / "robotiq_2f_85", folder)
    assert secure.checks(str(folder)) == [], "a hand on this computer alone needs none"
    text = (folder / "hand.yaml").read_text()
    (folder / "hand.yaml").write_text(f"{text}\nremote:\n  listen: [tls/0.0.0.0:7447]\n")
    (missing,) = secure.checks(str(folder))
    assert missing.verdict is Verdict.WRONG
    assert missing.remedy == "rtee secure init robotiq_2f_85"
    capsys.readouterr()
    secure.init("robotiq_2f_85")
    assert "Add to its hand.yaml" in capsys.readouterr().out
    secure.add_client("robotiq_2f_85", "ann", role="operator", days=3, out=tmp_path / "ann.pem")
    hand, ann = secure.checks(str(folder))
    assert hand.verdict is Verdict.OK
    assert ann.verdict is Verdict.WARNING
    assert ann.remedy.startswith("rtee secure add-client robotiq_2f_85 ann")
    secure.renew("robotiq_2f_85", days=1)
    assert secure.checks(str(folder))[0].remedy == "rtee secure renew robotiq_2f_85"


@pytest.mark.parametrize("file", [credentials.PEOPLE, credentials.HAND_KEY])
def test_a_missing_certificate_names_the_command_for_this_hand(tmp_path: Path, file: str) -> None:
    from rtee.remote import authority

    folder = tmp_path / "left_jaw"
    with pytest.raises(ConfigError, match="'rtee secure init left_jaw' makes it"):
        authority.add_client(folder, "anna", Role.OPERATOR)
    authority.make_authority(folder, "left_jaw")
    (folder / file).unlink()
    with pytest.raises(ConfigError, match="'rtee secure init left_jaw' makes it"):
        credentials.Credentials(folder).files()
