"""The runtime folder under attack: other users, named pipes, links, and cleaners of files."""

from __future__ import annotations

import asyncio
import json
import multiprocessing
import os
import shutil
import signal
import socket
import stat
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rtee.errors import ConfigError, NoHand
from rtee.remote import directory, find
from rtee.remote.directory import about_to_run, claimed, hands_running, starting

from .serving import announced, until

NOBODY = 65534
"""The user that owns nothing."""

ENTRY = json.dumps({"pid": 1, "endpoints": ["tcp/127.0.0.1:1"]})

root_only = pytest.mark.skipif(os.getuid() != 0, reason="only root can act as another user")


@pytest.fixture
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setenv(directory.VARIABLE, str(tmp_path / "run"))
    return tmp_path / "run"


def as_nobody(work: Callable[[], None]) -> None:
    """Do something as another user, in a process of its own."""

    def act() -> None:
        os.setgid(NOBODY)
        os.setuid(NOBODY)
        work()

    process = multiprocessing.get_context("fork").Process(target=act)
    process.start()
    process.join()
    assert process.exitcode == 0


def keep_locked(path: Path) -> threading.Event:
    """Lock a file, as the server of a living hand does, until the event is set."""
    import fcntl

    ready, end = threading.Event(), threading.Event()

    def keep() -> None:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        ready.set()
        end.wait()
        os.close(descriptor)

    threading.Thread(target=keep, daemon=True).start()
    assert ready.wait(300)
    return end


@pytest.fixture
def everybodys(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A temporary folder of everybody, as /tmp is."""
    import tempfile

    with tempfile.TemporaryDirectory(dir="/tmp") as name:
        folder = Path(name)
        folder.chmod(0o1777)
        monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
        monkeypatch.delenv(directory.VARIABLE, raising=False)
        monkeypatch.setattr(tempfile, "tempdir", str(folder))
        yield folder


@root_only
def test_clients_use_no_folder_that_another_user_has_made(everybodys: Path) -> None:
    trap = everybodys / f"rtee-{os.getuid()}"

    def make() -> None:
        trap.mkdir(mode=0o755)
        (trap / "svh.json").write_text(ENTRY)

    as_nobody(make)
    end = keep_locked(trap / "svh.json")
    try:
        with pytest.raises(ConfigError, match="only you can write to"):
            hands_running()
    finally:
        end.set()


@root_only
def test_clients_use_no_file_that_another_user_has_made(runtime: Path) -> None:
    with announced("gripper", ["a"]):
        path = runtime / "svh.json"
        path.write_text(ENTRY)
        end = keep_locked(path)
        try:
            assert set(hands_running()) == {"gripper", "svh"}
            os.chown(path, NOBODY, NOBODY)
            assert set(hands_running()) == {"gripper"}
            with pytest.raises(ConfigError, match="only you can write to"), announced("svh", []):
                pass
        finally:
            end.set()


@pytest.mark.parametrize("mode", [0o777, 0o775, 0o1777])
def test_clients_use_no_folder_that_others_may_write_to(runtime: Path, mode: int) -> None:
    runtime.mkdir()
    runtime.chmod(mode)
    with pytest.raises(ConfigError, match="only you can write to"):
        hands_running()


def test_clients_use_no_file_that_others_may_write_to(runtime: Path) -> None:
    with announced("svh", ["a"]) as path:
        path.chmod(0o666)
        assert hands_running() == {}


def test_clients_follow_no_links(runtime: Path, tmp_path: Path) -> None:
    with announced("svh", ["a"]):
        runtime.rename(tmp_path / "moved")
        runtime.symlink_to(tmp_path / "moved")
        with pytest.raises(ConfigError, match="only you can write to"):
            hands_running()


def test_a_named_pipe_keeps_nobody_waiting(runtime: Path) -> None:
    runtime.mkdir(mode=0o700)
    os.mkfifo(runtime / "svh.json", 0o600)
    assert hands_running() == {}
    with pytest.raises(ConfigError, match="must be a file"), announced("svh", []):
        pass


def test_services_in_a_folder_of_everybody_do_not_count(
    runtime: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    services = tmp_path / "services"
    monkeypatch.setenv(directory.VARIABLE, str(services))
    monkeypatch.setattr(directory, "SERVICES", services)
    with announced("svh", ["a"]):
        monkeypatch.delenv(directory.VARIABLE)
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "own"))
        assert set(hands_running()) == {"svh"}
        services.chmod(0o777)
        assert hands_running() == {}


# --- cleaners of temporary files


def _remove_file(path: Path) -> None:
    path.unlink()


def _remove_folder(path: Path) -> None:
    shutil.rmtree(path.parent)


@pytest.mark.parametrize("remove", [_remove_file, _remove_folder])
def test_a_hand_runs_once_though_its_file_was_removed(
    runtime: Path, remove: Callable[[Path], None]
) -> None:
    with claimed("svh") as place:
        place.write(["tcp/127.0.0.1:1"])
        for _ in range(2):  # the second time its file is one that was written again
            remove(place.path)
            refused = pytest.raises(
                ConfigError, match=f"is already running, in process {os.getpid()}"
            )
            with refused, claimed("svh"):
                pass
            while "svh" not in hands_running():
                time.sleep(0.05)
            assert hands_running()["svh"].endpoints == ("tcp/127.0.0.1:1",)
        assert stat.S_IMODE(place.path.stat().st_mode) == 0o640
    assert hands_running() == {}
    with claimed("svh"):
        pass


@pytest.mark.anyio
@pytest.mark.parametrize("name", ["svh", None])
async def test_a_client_waits_for_a_hand_that_starts(
    runtime: Path, name: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[str] = []
    monkeypatch.setattr(find, "hands_running", lambda: looked.append("") or hands_running())
    with claimed("svh"):
        opening = asyncio.ensure_future(find.open_hand(name, None, 0.0))
        await until(lambda: len(looked) > 1 or opening.done())
        assert not opening.done()
    with pytest.raises(NoHand, match="running on this computer"):  # it has ended instead
        await opening


@pytest.mark.anyio
async def test_a_client_does_not_wait_for_a_hand_that_ends(runtime: Path) -> None:
    with claimed("svh") as place:
        place.write(["tcp/127.0.0.1:1"])
        place.withdraw()
        assert starting() == []
        with pytest.raises(NoHand, match="'svh' is not running on this computer"):
            await find.open_hand("svh", None, 0.0)


def test_clients_know_what_is_about_to_run_until_it_does(runtime: Path) -> None:
    with about_to_run(["svh", "jaw"]):
        assert starting() == ["svh", "jaw"]
        with claimed("svh") as svh, claimed("jaw"):
            assert sorted(starting()) == ["jaw", "svh"]
            svh.write(["tcp/127.0.0.1:1"])
            assert starting() == ["jaw"]
        assert starting() == []
    with about_to_run(["svh"]):  # and is refused, for example because of a mistake in its files
        assert starting() == ["svh"]
    assert os.listdir(runtime) == []


def test_nobody_waits_for_a_start_that_was_killed(runtime: Path) -> None:
    def be_killed() -> None:
        with about_to_run(["svh"]):
            os.kill(os.getpid(), signal.SIGKILL)

    process = multiprocessing.get_context("fork").Process(target=be_killed)
    process.start()
    process.join()
    left = [f"{process.pid}.starts"]
    assert os.listdir(runtime) == left
    assert starting() == []
    with about_to_run(["jaw"]):
        assert os.listdir(runtime) != left
        assert starting() == ["jaw"]
    assert os.listdir(runtime) == []


def test_who_is_asked_often_still_says_who_it_is(runtime: Path) -> None:
    with claimed("svh") as place:
        place.path.unlink()
        for _ in range(5):
            refused = pytest.raises(
                ConfigError, match=f"is already running, in process {os.getpid()}"
            )
            with refused, claimed("svh"):
                pass


def test_the_same_hand_may_run_in_another_folder(
    runtime: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with claimed("svh"):
        monkeypatch.setenv(directory.VARIABLE, str(tmp_path / "other"))
        with claimed("svh"):
            assert directory.runtime_folder() == tmp_path / "other"


@root_only
@pytest.mark.skipif(not hasattr(socket, "SO_PEERCRED"), reason="Linux only")
def test_a_name_that_another_user_keeps_prevents_nothing(
    runtime: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept: list[str] = []
    bind = socket.socket.bind

    with claimed("svh"):  # to learn the name that it has in the kernel
        names = Path("/proc/net/unix").read_text().split()
        kept = [name for name in names if name.startswith(f"@rtee-{os.getuid()}-")]
    assert kept
    ready, end = multiprocessing.Event(), multiprocessing.Event()

    def squat() -> None:
        os.setuid(NOBODY)
        held = []
        for name in kept:
            one = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            try:
                bind(one, "\0" + name[1:])
            except OSError:
                continue
            one.listen(1)
            held.append(one)
        ready.set()
        end.wait()

    process = multiprocessing.get_context("fork").Process(target=squat)
    process.start()
    try:
        assert ready.wait(300)
        with announced("svh", ["a"]):
            assert set(hands_running()) == {"svh"}
    finally:
        end.set()
        process.join()


@root_only
def test_the_folder_of_a_session_of_somebody_else_is_named_with_what_helps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """After `su`, XDG_RUNTIME_DIR is still that of the first user."""
    monkeypatch.delenv(directory.VARIABLE, raising=False)

    def work() -> None:
        with tempfile.TemporaryDirectory() as folder:
            os.chmod(folder, 0o500)
            os.environ["XDG_RUNTIME_DIR"] = folder
            with pytest.raises(ConfigError, match="permission denied; set RTEE_RUNTIME_DIR"):
                directory.own_folder()

    as_nobody(work)
