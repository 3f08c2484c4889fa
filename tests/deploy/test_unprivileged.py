"""Somebody without any rights and without any set-up uses a hand."""

from __future__ import annotations

import os
import pwd
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from patient import HAND, patient_gripper

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="only root may become somebody else")


class Somebody:
    """Runs commands as the user ``nobody``, in a folder of theirs."""

    def __init__(self, python: str, folder: Path, environment: dict[str, str]) -> None:
        self.python = python
        self.folder = folder
        self.environment = environment

    def start(self, *words: str) -> subprocess.Popen[str]:
        entry = pwd.getpwnam("nobody")
        return subprocess.Popen(
            [self.python, "-m", "rtee", *words],
            cwd=self.folder,
            env=self.environment,
            user=entry.pw_uid,
            group=entry.pw_gid,
            extra_groups=[],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def rtee(self, *words: str) -> tuple[int, str, str]:
        with self.start(*words) as process:
            output, errors = process.communicate()
        assert "Traceback" not in errors, f"rtee {' '.join(words)}\n{errors}"
        return process.returncode, output, errors


@pytest.fixture(scope="module")
def nobody(repository: Path) -> Iterator[Somebody]:
    entry = pwd.getpwnam("nobody")
    packages = [path for path in sys.path if path.endswith("site-packages")]
    # Folders of pytest are root's alone.
    with tempfile.TemporaryDirectory(prefix="rtee-", dir="/tmp") as place:
        folder = Path(place)
        os.chown(folder, entry.pw_uid, entry.pw_gid)
        environment = {
            "HOME": str(folder),
            "PATH": os.environ["PATH"],
            "TMPDIR": str(folder),
            "RTEE_CONFIG_PATH": str(folder / "config"),
            "PYTHONPATH": os.pathsep.join([str(repository), *packages]),
        }
        version = f"python{sys.version_info.major}.{sys.version_info.minor}"
        # The interpreter of the tests may be in a home that others can't enter.
        for python in (sys.executable, shutil.which(version, path="/usr/bin:/usr/local/bin")):
            somebody = Somebody(python or "/nonexistent", folder, environment)
            try:
                if somebody.rtee("--version")[0] == 0:
                    break
            except (OSError, AssertionError):
                continue
        else:
            pytest.skip("the user nobody can run none of the interpreters here")
        yield somebody


@pytest.mark.heavy
def test_a_hand_without_rights_or_set_up(nobody: Somebody, repository: Path) -> None:
    patient_gripper(nobody.folder / "config", repository)
    with nobody.start(
        "run", HAND, "--driver", "devices", "--emulated", "--home", "--realtime"
    ) as run:
        try:
            assert run.stdout is not None
            assert re.match(rf"{HAND}: 1 actuator", run.stdout.readline())
            # It homes before it is ready.
            pinch = ("do", "PinchTight", "--intensity", "0.3", "--wait", "30")
            status, output, errors = nobody.rtee(*pinch)
            assert (status, "reached" in output) == (0, True), output + errors
            status, output, _ = nobody.rtee("status")
            assert (status, HAND in output) == (0, True)
            for command in (("state", "--once"), ("open",)):
                status, output, errors = nobody.rtee(*command)
                assert status == 0, output + errors
            # Whether the gripper confirms it in time is up to a busy computer.
            assert "gripper" in nobody.rtee("stop")[1]
            run.send_signal(signal.SIGINT)
            _, errors = run.communicate()
        finally:
            run.kill()
    assert run.returncode == 0, errors
    # Each line of a log; what is not permitted says what to type.
    refused = [line for line in errors.splitlines() if "not permitted" in line]
    assert all("limits.d/rtee.conf" in line for line in refused), errors
    recording = next((nobody.folder / "logs").glob("*_000.mcap"))
    assert recording.stat().st_uid == pwd.getpwnam("nobody").pw_uid
    status, output, _ = nobody.rtee("log", "info", "logs")
    assert (status, "PinchTight" in output) == (0, True)
    assert nobody.rtee("log", "replay", "--check", "logs")[0] == 0


@pytest.mark.samples("words1-*", "words5-*")
@pytest.mark.parametrize(
    ("words", "status", "says"),
    [
        (["hands"], 0, "schunk_svh"),
        (["actions", "robotiq_2f_85"], 0, "PinchTight"),
        (["gui", "--help"], 0, "--port"),
        (["doctor"], 0, "processors"),
        (["deploy", "plan", "robotiq_2f_85", "--program", "/opt/rtee/bin/rtee"], 0, "Type=notify"),
        (["deploy", "install", "robotiq_2f_85"], 2, "sudo rtee deploy install robotiq_2f_85"),
        (["deploy", "uninstall", "robotiq_2f_85"], 2, "sudo rtee deploy uninstall robotiq_2f_85"),
    ],
)
def test_other_commands(nobody: Somebody, words: list[str], status: int, says: str) -> None:
    found, output, errors = nobody.rtee(*words)
    assert (found, says in output + errors) == (status, True), output + errors


@pytest.mark.heavy
@pytest.mark.parametrize("home", [None, "", "/proc"], ids=["unset", "empty", "read-only"])
def test_a_hand_without_a_home(nobody: Somebody, home: str | None) -> None:
    """As in a container, or for the user of a service."""
    environment = {name: value for name, value in nobody.environment.items() if name != "HOME"}
    environment |= {} if home is None else {"HOME": home}
    homeless = Somebody(nobody.python, nobody.folder, environment)
    for words in (["run", "robotiq_2f_85", "--duration", "0.2", "--no-log"], ["hands"]):
        status, output, errors = homeless.rtee(*words)
        assert (status, "robotiq_2f_85" in output) == (0, True), errors


def test_an_image_of_ones_own_needs_no_root(nobody: Somebody) -> None:
    root = nobody.folder / "image"
    for name in ("etc", "etc/passwd", "etc/group"):
        path = root / name
        if name == "etc":
            path.mkdir(parents=True)
        else:
            path.write_text("root:x:0:\n")
    for path in (root, *root.rglob("*")):
        os.chown(path, *[pwd.getpwnam("nobody").pw_uid] * 2)
    place = ["robotiq_2f_85", "--root", str(root)]
    status, output, errors = nobody.rtee("deploy", "install", *place, "--program", "/opt/rtee/rtee")
    assert status == 0, errors
    assert (root / "etc/systemd/system/rtee@.service").exists()
    status, output, errors = nobody.rtee("deploy", "uninstall", *place)
    assert status == 0, output + errors
    assert not (root / "etc/systemd").exists()
