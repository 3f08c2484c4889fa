"""Every command works without any extra, or says which one it needs; so it does on ARM."""

from __future__ import annotations

import importlib.metadata
import itertools
import json
import re
import shutil
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from rtee.cli.main import COMMANDS

from .commands import (
    EXTRACTED,
    LASTING,
    OFFLINE,
    ONLINE,
    RECORDED,
    Case,
    with_rtee,
    write_hand,
    wrong,
)

HIDDEN = Path(__file__).with_name("hidden.py")
NOTHING = ("",)
"""No package is hidden."""

UNLISTED = {"pinocchio": "pin", "coal": "coal", "hppfcl": "coal", "eigenpy": "eigenpy"}
"""Modules and their distributions that lie where importlib.metadata does not look for modules."""

SHOW = """
import sys
sys.path.insert(0, sys.argv[1])
from hidden import Hider
sys.meta_path.insert(0, Hider(sys.argv[2].split(",")))
import viser
from rtee.gui.scene import HandScene
from rtee.hand.load import load_hand
server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
for name in ("schunk_svh", "leap_hand", "robotiq_2f_85"):
    scene = HandScene(server, load_hand(name))
    scene.show_preview(scene.hand.upper)
    scene.show_pressure({finger.name: 0.5 for finger in scene.hand.fingers})
    scene.remove()
server.stop()
print("shown")
"""

IMPORT = """
import importlib, pkgutil, sys
sys.path.insert(0, sys.argv[1])
from hidden import Hider
sys.meta_path.insert(0, Hider(sys.argv[2].split(",")))
import rtee
rooms = "loop remote log drivers buses actions messages gui testing running types errors"
names = [f"rtee.{room}" for room in rooms.split()]
for name in names[:]:
    module = importlib.import_module(name)
    found = pkgutil.walk_packages(getattr(module, "__path__", ()), f"{name}.")
    names += [entry.name for entry in found]
names.remove("rtee.drivers.mujoco.scene")
for name in names:
    importlib.import_module(name)
print(len(names))
"""


def project(repository: Path) -> dict[str, Any]:
    """Return what pyproject.toml says, which may be newer than what is installed."""
    found: dict[str, Any] = tomllib.loads((repository / "pyproject.toml").read_text())["project"]
    return found


def distributions(repository: Path, *extras: str) -> set[str]:
    """Return the distributions that come with rtee and some of its extras."""
    asked = project(repository)
    own = {extra: asked["optional-dependencies"][extra] for extra in extras}
    found: set[str] = set()
    seen: set[tuple[str, frozenset[str]]] = set()
    waiting = [
        Requirement(text) for text in [*asked["dependencies"], *itertools.chain(*own.values())]
    ]
    while waiting:
        requirement = waiting.pop()
        name, wanted = canonicalize_name(requirement.name), frozenset(requirement.extras)
        marker = requirement.marker
        if (name, wanted) in seen or not (marker is None or marker.evaluate({"extra": ""})):
            continue
        seen.add((name, wanted))
        try:
            required = importlib.metadata.requires(name) or []
        except importlib.metadata.PackageNotFoundError:  # for another system or Python
            continue
        found.add(name)
        for further in map(Requirement, required):
            here = further.marker
            if here is None or any(here.evaluate({"extra": extra}) for extra in (*wanted, "")):
                further.marker = None
                waiting.append(further)
    return found


def beyond(repository: Path, *extras: str) -> list[str]:
    """Return the modules that are installed here, but not with rtee and some of its extras."""
    own = distributions(repository, *extras)
    assert {"anyio", "numpy", "typer"} <= own
    unlisted = [module for module, name in UNLISTED.items() if name not in own]
    return unlisted + [
        module
        for module, names in importlib.metadata.packages_distributions().items()
        if not own.intersection(canonicalize_name(name) for name in names)
    ]


class Shell:
    """Commands, each in a fork of one process that does not see some packages."""

    def __init__(self, hidden: Sequence[str], folder: Path, home: Path) -> None:
        self.hidden = ",".join(hidden)
        self.folder = folder
        self.environment = {**with_rtee(), "XDG_RUNTIME_DIR": str(home)}
        self._process = self._start()

    def _start(self, *words: str, **more: Any) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, str(HIDDEN), self.hidden, *words],
            cwd=self.folder,
            env=self.environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            **more,
        )

    def run(self, words: Sequence[str]) -> tuple[int, str]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(words) + "\n")
        self._process.stdin.flush()
        status, said = json.loads(self._process.stdout.readline())
        return status, said

    def check(self, cases: Sequence[Case]) -> None:
        problems = [wrong(case, *self.run(case.words)) for case in cases]
        assert not any(problems), "\n".join(filter(None, problems))

    @contextmanager
    def lasting(self, line: str, until: str) -> Iterator[list[str]]:
        """Run a command beside until the context ends; it begins when the command says a word."""
        process = self._start(*line.split(), stderr=subprocess.STDOUT)
        assert process.stdout is not None
        said: list[str] = []
        with process:
            try:
                for text in process.stdout:
                    said.append(text)
                    if until in text:
                        break
                assert said, f"rtee {line} said nothing"
                assert until in said[-1], "".join(said)
                yield said
            finally:
                process.send_signal(signal.SIGINT)
                said.extend(process.stdout)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()


@pytest.fixture
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    folder.chmod(0o700)
    return folder


def test_the_table_holds_every_command() -> None:
    tried = {case.command for case in (*OFFLINE, *EXTRACTED, *ONLINE, *RECORDED, *LASTING)}
    assert set(COMMANDS) <= tried


@pytest.mark.heavy
def test_every_command_without_extras(tmp_path: Path, home: Path, repository: Path) -> None:
    write_hand(tmp_path)
    hidden = beyond(repository)
    assert {"pinocchio", "coal", "rosbags", "viser", "mujoco", "matplotlib", "PIL"} <= set(hidden)
    with Shell(hidden, tmp_path, home) as shell:
        shell.check(OFFLINE)
        service = (tmp_path / "pc" / "rtee@.service").read_text()
        assert f"ExecStart={Path(sys.executable).parent}/rtee run" in service
        with shell.lasting("run claw", "network"):
            shell.check(ONLINE)
        [*_, recording] = sorted((tmp_path / "logs").glob("claw_*.mcap"))
        shutil.copy(recording, tmp_path / "claw.mcap")
        shell.check(RECORDED)
        for case in LASTING:
            with shell.lasting(case.line, case.says):
                pass


@pytest.mark.heavy
def test_the_commands_of_the_extraction(tmp_path: Path, home: Path, repository: Path) -> None:
    write_hand(tmp_path)
    with Shell(beyond(repository, "extract"), tmp_path, home) as shell:
        shell.check(EXTRACTED)


@pytest.mark.heavy
def test_the_gui_shows_a_hand_without_the_extraction(tmp_path: Path, repository: Path) -> None:
    pytest.importorskip("viser")
    hidden = beyond(repository, "gui")
    assert {"pinocchio", "coal", "mujoco"} <= set(hidden)
    done = subprocess.run(
        [sys.executable, "-c", SHOW, str(HIDDEN.parent), ",".join(hidden)],
        cwd=tmp_path,
        env=with_rtee(),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("shown\n")


@pytest.mark.heavy  # a contract of import-linter says so of the code, test_online_modules of a hand
def test_the_online_half_imports_neither_pinocchio_nor_coal() -> None:
    done = subprocess.run(
        [sys.executable, "-c", IMPORT, str(HIDDEN.parent), ",".join(UNLISTED)],
        env=with_rtee(),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 200, "few modules were found"


@pytest.mark.heavy
def test_a_hand_moves_and_replays_without_ruckig(tmp_path: Path, home: Path) -> None:
    write_hand(tmp_path)
    replay = Case("log replay --check logs", "the same, bit for bit")
    instead = "s_curve instead of jerk_limited: ruckig is not installed"
    with Shell(["ruckig", "embreex"], tmp_path, home) as shell:
        with shell.lasting("run claw", "network") as said:
            shell.check([Case("do PinchTight left right", "reached")])
            shell.check([Case("status", f"profile:  {instead}")])
        assert sum(instead in line for line in said) == 1, "".join(said)
        shell.check([replay])
        info = json.loads(shell.run(["log", "info", "logs", "--json"])[1])
        assert info["metadata"]["profile"] == "s_curve"
    # Where ruckig is there, the recording is recomputed by the profile that it names.
    with Shell(NOTHING, tmp_path, home) as shell:
        shell.check([replay])


@pytest.mark.heavy
def test_a_recording_of_ruckig_says_what_it_needs(tmp_path: Path, home: Path) -> None:
    pytest.importorskip("ruckig")
    write_hand(tmp_path)
    with Shell(NOTHING, tmp_path, home) as shell:
        shell.check([Case("run claw --duration 0.3", "0 goals")])
    with Shell(["ruckig"], tmp_path, home) as shell:
        shell.check([Case("log replay --check logs", "'jerk_limited' needs ruckig", 2)])


def test_pyproject_asks_for_no_ruckig_on_arm(repository: Path) -> None:
    given = project(repository)
    asked = [*given["dependencies"], *given["optional-dependencies"]["plot"]]
    on_arm = {"platform_machine": "aarch64"}
    for name in ("ruckig", "embreex"):
        [line] = [line for line in asked if re.match(rf"{name}\b", line)]
        marker = Requirement(line).marker
        assert marker is not None
        assert not marker.evaluate(on_arm)
        assert marker.evaluate({"platform_machine": "x86_64"})
