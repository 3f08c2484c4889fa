"""Every command works without any extra, or says which one it needs; so it does on ARM."""

from __future__ import annotations

import importlib.metadata
import json
import os
import re
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

from .commands import LASTING, OFFLINE, ONLINE, RECORDED, Case, write_model, wrong

HIDDEN = Path(__file__).with_name("hidden.py")
NOTHING = ("",)
"""No package is hidden."""


def core() -> set[str]:
    """Return the distributions that come with rtee when no extra is asked for."""
    found: set[str] = set()
    waiting = [("rtee", frozenset[str]())]
    seen = set()
    while waiting:
        name, extras = waiting.pop()
        if (name, extras) in seen:
            continue
        seen.add((name, extras))
        try:
            required = importlib.metadata.requires(name) or []
        except importlib.metadata.PackageNotFoundError:  # for another system or Python
            continue
        found.add(name)
        for text in required:
            requirement = Requirement(text)
            marker = requirement.marker
            if marker is None or any(marker.evaluate({"extra": extra}) for extra in (*extras, "")):
                wanted = canonicalize_name(requirement.name)
                waiting.append((wanted, frozenset(requirement.extras)))
    return found


def beyond_core() -> list[str]:
    """Return the modules that are installed here, but not with rtee alone."""
    own = core()
    assert {"anyio", "numpy", "typer"} <= own
    return [
        module
        for module, names in importlib.metadata.packages_distributions().items()
        if not own.intersection(canonicalize_name(name) for name in names)
    ]


class Shell:
    """Commands, each in a fork of one process that does not see some packages."""

    def __init__(self, hidden: Sequence[str], folder: Path, home: Path) -> None:
        self.hidden = ",".join(hidden)
        self.folder = folder
        repository = HIDDEN.parents[2]
        inherited = os.environ.get("PYTHONPATH", "")
        self.environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(filter(None, (str(repository), inherited))),
            "XDG_RUNTIME_DIR": str(home),
            "COLUMNS": "200",
        }
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
    tried = {case.command for case in (*OFFLINE, *ONLINE, *RECORDED, *LASTING)}
    assert set(COMMANDS) <= tried


@pytest.mark.timeout(180)
def test_every_command_without_extras(tmp_path: Path, home: Path) -> None:
    write_model(tmp_path)
    hidden = beyond_core()
    assert {"pytest", "viser", "mujoco", "matplotlib", "PIL"} <= set(hidden)
    with Shell(hidden, tmp_path, home) as shell:
        shell.check(OFFLINE)
        service = (tmp_path / "pc" / "rtee@.service").read_text()
        assert f"ExecStart={Path(sys.executable).parent}/rtee run" in service
        with shell.lasting("run claw", "network"):
            shell.check(ONLINE)
        shell.check(RECORDED)
        for case in LASTING:
            with shell.lasting(case.line, case.says):
                pass


@pytest.mark.timeout(120)
def test_a_hand_moves_and_replays_without_ruckig(tmp_path: Path, home: Path) -> None:
    write_model(tmp_path)
    replay = Case("log replay --check logs", "the same, bit for bit")
    instead = "s_curve instead of jerk_limited: ruckig is not installed"
    with Shell(["ruckig", "embreex"], tmp_path, home) as shell:
        shell.check([Case("new claw --urdf claw.urdf"), Case("extract claw --save", "PinchTight")])
        with shell.lasting("run claw", "network") as said:
            shell.check([Case("do PinchTight left right", "reached")])
            shell.check([Case("status", f"profile:  {instead}")])
        assert sum(instead in line for line in said) == 1, "".join(said)
        shell.check([replay])
        info = json.loads(shell.run(["log", "info", "logs", "--json"])[1])
        assert info["metadata"]["profile"] == "s_curve"
    # Where ruckig is there, the recording is computed anew by the profile that it names.
    with Shell(NOTHING, tmp_path, home) as shell:
        shell.check([replay])


@pytest.mark.timeout(120)
def test_a_recording_of_ruckig_says_what_it_needs(tmp_path: Path, home: Path) -> None:
    pytest.importorskip("ruckig")
    write_model(tmp_path)
    with Shell(NOTHING, tmp_path, home) as shell:
        shell.check([Case("new claw --urdf claw.urdf"), Case("run claw --duration 0.3", "0 goals")])
    with Shell(["ruckig"], tmp_path, home) as shell:
        shell.check([Case("log replay --check logs", "'jerk_limited' needs ruckig", 2)])


def test_pyproject_asks_for_no_ruckig_on_arm(repository: Path) -> None:
    project = tomllib.loads((repository / "pyproject.toml").read_text())["project"]
    asked = [*project["dependencies"], *project["optional-dependencies"]["plot"]]
    on_arm = {"platform_machine": "aarch64"}
    for name in ("ruckig", "embreex"):
        [line] = [line for line in asked if re.match(rf"{name}\b", line)]
        marker = Requirement(line).marker
        assert marker is not None
        assert not marker.evaluate(on_arm)
        assert marker.evaluate({"platform_machine": "x86_64"})
