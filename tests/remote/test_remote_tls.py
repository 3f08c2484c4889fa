"""A hand on a network: TLS with certificates, roles, revocation."""

from __future__ import annotations

import os
import shutil
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
from rtee.hand.model import Hand
from rtee.messages.requests import Role
from rtee.remote import credentials
from rtee.remote.client import RemoteHand
from rtee.remote.session import is_safe

from .serving import Config, Remote, free_endpoint, serving

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
        self.authority.write_private(path, text)
        return path


@pytest.fixture
def people(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> People:
    monkeypatch.setenv(credentials.FOLDER_VARIABLE, str(tmp_path / "secure"))
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
                assert remote.client.startswith(f"{role.name.lower()}-python-")
                assert (await remote.status()).hand == "small"
                assert (await anext(remote.states(50.0))).names
                assert list(await remote.stop()) == ["sim"]
                await _tries(remote, role)
        moved = {goal.client.partition("-")[0] for goal in served.watcher.goals}
        assert moved == {"operator", "maintainer"}


async def _tries(remote: RemoteHand, role: Role) -> None:
    moves = [
        lambda: remote.do("Trig", "index", intensity=0.1),
        remote.hold,
        remote.acquire,
        remote.release,
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
            with pytest.raises(RemoteError), anyio.fail_after(10.0):
                await call()


async def test_the_hand_itself_refuses_what_a_role_may_not(
    hand: Hand, library: ActionLibrary, people: People, monkeypatch: pytest.MonkeyPatch
) -> None:
    everything = people.authority.people
    file = people.add("ann", Role.MAINTAINER)
    monkeypatch.setenv(credentials.IDENTITY_VARIABLE, str(file))
    endpoint = tls()
    async with serving(hand, library, config=Config(Remote(listen=[endpoint]))) as served:
        # Zenoh's rules are still those of a maintainer.
        (name,) = [one.name for one in everything(people.folder)]
        served.server._identities._role_of = {name: Role.OBSERVER}.get
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


async def test_a_revoked_certificate_is_refused_at_once_and_at_the_next_start(
    hand: Hand, library: ActionLibrary, people: People, monkeypatch: pytest.MonkeyPatch
) -> None:
    ann, bob = people.add("ann", Role.OPERATOR), people.add("bob", Role.OPERATOR)
    monkeypatch.setattr(credentials, "_READ_AGAIN", 0.0)
    endpoint = tls()
    config = Config(Remote(listen=[endpoint]))
    async with serving(hand, library, config=config):
        monkeypatch.setenv(credentials.IDENTITY_VARIABLE, str(ann))
        async with rtee.connect(endpoint=endpoint) as remote:
            await remote.hold()
            people.authority.revoke(people.folder, "ann")
            assert "revoked" in await refused(remote.hold())
        with pytest.raises(RequestRejected, match="not admitted"):
            async with rtee.connect(endpoint=endpoint):
                pass
        monkeypatch.setenv(credentials.IDENTITY_VARIABLE, str(bob))
        async with rtee.connect(endpoint=endpoint) as remote:
            await remote.hold()
    async with serving(hand, library, config=config):
        async with rtee.connect("small", endpoint=endpoint) as remote:
            await remote.hold()
        monkeypatch.setenv(credentials.IDENTITY_VARIABLE, str(ann))
        with pytest.raises(NoHand):
            async with rtee.connect(endpoint=endpoint):
                pass


async def test_a_client_cannot_pass_for_the_hand(
    hand: Hand, library: ActionLibrary, people: People, monkeypatch: pytest.MonkeyPatch
) -> None:
    ann, eve = people.add("ann", Role.OPERATOR), people.add("eve", Role.OPERATOR)
    monkeypatch.setenv(credentials.IDENTITY_VARIABLE, str(eve))
    blocks = credentials.identity().blocks
    people.authority.write_private(people.folder / credentials.HAND_KEY, blocks["key"])
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
    with pytest.raises(ConfigError, match="could move the hand"):
        async with serving(hand, library, config=Config(Remote(connect=["tls/router:7447"]))):
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
    secure.add_client("small", "ann", role="observer")
    secure.add_client("small", "bob", role="maintainer", days=3)
    assert (tmp_path / "ann@small.pem").stat().st_mode & 0o777 == 0o600
    secure.revoke("small", "ann")
    capsys.readouterr()
    secure.list_("small")
    said = capsys.readouterr().out
    assert "refused" in said
    assert "maintainer" in said
    with pytest.raises(ConfigError, match="there already"):
        secure.init("small")
    with pytest.raises(ConfigError, match="no client 'eve'"):
        secure.revoke("small", "eve")
    with pytest.raises(ConfigError, match="unknown role 'king'"):
        secure.add_client("small", "eve", role="king")
    for name in ("", "../x", "a.b", "x" * 40):
        with pytest.raises(ConfigError, match="name of a client"):
            secure.add_client("small", name, out=tmp_path / "other.pem")


def test_doctor_tells_what_expires(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, repository: Path
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
    secure.init("robotiq_2f_85")
    secure.add_client("robotiq_2f_85", "ann", role="operator", days=3, out=tmp_path / "ann.pem")
    hand, ann = secure.checks(str(folder))
    assert hand.verdict is Verdict.OK
    assert ann.verdict is Verdict.WARNING
    assert ann.remedy.startswith("rtee secure add-client robotiq_2f_85 ann")
    secure.renew("robotiq_2f_85", days=1)
    assert secure.checks(str(folder))[0].remedy == "rtee secure renew robotiq_2f_85"
