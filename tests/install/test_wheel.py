"""The wheel in an empty environment: `make wheels` runs this, the ordinary tests leave it out."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement

from rtee.errors import install_line

from .commands import EXTRACTED, LASTING, OFFLINE, ONLINE, RECORDED, Case, write_hand, wrong
from .test_without_extras import HIDDEN, SHOW

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not os.environ.get("RTEE_WHEELS"),
        reason="builds and installs wheels, minutes long: make wheels",
    ),
]

LARGEST = 200 * 2**20
"""What the online half may take of the disk of a robot PC [bytes]; why: docs/dependencies.md."""

FROM_CHECKOUT = install_line("").partition("[")[0]
"""Beginning of the command by which this process says to install an extra."""

PYTHONS = ("3.11", "3.12", "3.13", "3.14")
COMPILED = ("teleop",)
"""Extras that need a compiler on every computer: evdev has no wheels."""

ON_ARM = {"platform_machine": "aarch64"}
PLATFORMS = ("manylinux2014_aarch64", *(f"manylinux_2_{n}_aarch64" for n in (17, 24, 26, 27, 28)))
"""What pip takes on a 64-bit ARM Linux with glibc 2.28 or newer."""


def interpreter(version: str) -> str:
    """Return the path of a Python, or skip the test."""
    places = sorted(Path.home().glob(f".pyenv/versions/{version}.*/bin/python"))
    for found in (*map(str, places), shutil.which(f"python{version}")):
        if (
            found
            and subprocess.run([found, "-c", "import venv"], capture_output=True).returncode == 0
        ):
            return found
    pytest.skip(f"there is no Python {version} on this computer")


def do(*words: str | Path) -> str:
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True)
    assert done.returncode == 0, f"{words}\n{done.stdout}{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory, repository: Path) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    do(sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder, repository)
    [built] = folder.glob("rtee-*.whl")
    return built


class Installed:
    """The wheel in an environment of its own."""

    def __init__(self, version: str, wheel: Path, folder: Path) -> None:
        python, self.wheel = interpreter(version), wheel
        do(python, "-m", "venv", folder / "venv")
        self.bin = folder / "venv" / "bin"
        self.folder = folder / "here"
        self.folder.mkdir()
        self.pip("install", str(wheel))
        (folder / "run").mkdir(mode=0o700)
        hidden = ("PYTHONPATH", "VIRTUAL_ENV", "RTEE_HAND")
        self.environment = {k: v for k, v in os.environ.items() if k not in hidden}
        self.environment |= {"XDG_RUNTIME_DIR": str(folder / "run"), "COLUMNS": "200"}
        write_hand(self.folder)

    def pip(self, *words: str) -> str:
        return do(self.bin / "python", "-m", "pip", "-q", "--disable-pip-version-check", *words)

    def size(self) -> int:
        """Return how much of the disk rtee and what it depends on take, without pip [bytes]."""
        [packages] = self.bin.parent.glob("lib/python*/site-packages")
        installers = ("pip", "setuptools", "pkg_resources", "_distutils_hack")
        folders = [one for one in packages.iterdir() if one.name not in installers]
        files = [file for one in folders for file in (one, *one.rglob("*"))]
        return sum(file.lstat().st_blocks for file in files) * 512  # st_blocks counts 512 bytes

    def _process(self, words: Sequence[str]) -> dict[str, Any]:
        """Return what a process of the command ``rtee`` is started with."""
        return {
            "args": [str(self.bin / "rtee"), *words],
            "cwd": self.folder,
            "env": self.environment,
            "stdin": subprocess.DEVNULL,
            "stdout": subprocess.PIPE,
            "stderr": subprocess.STDOUT,
            "text": True,
        }

    def problems(self, cases: Sequence[Case]) -> list[str]:
        found = []
        for case in cases:
            done = subprocess.run(**self._process(case.words))  # kills a command that hangs
            # An extra is installed from where rtee was: here from the wheel, not from the checkout.
            says = case.says.replace(FROM_CHECKOUT, f'pip install "{self.wheel}')
            found.append(wrong(replace(case, says=says), done.returncode, done.stdout))
        return [problem for problem in found if problem]

    def beside(self, case: Case, cases: Sequence[Case]) -> list[str]:
        """Run commands while another, which does not end by itself, runs."""
        with subprocess.Popen(**self._process(case.words)) as process:
            assert process.stdout is not None
            said, found = "", []
            try:
                for line in process.stdout:
                    said += line
                    if case.says in line:
                        break
                found = self.problems(cases)
            finally:
                process.send_signal(signal.SIGINT)
                said += process.stdout.read()
        return [*found, *([] if case.says in said else [f"rtee {case.line}:\n{said}"])]


def try_all(installed: Installed) -> list[str]:
    problems = installed.problems(OFFLINE)
    problems += installed.beside(Case("run claw", "network"), ONLINE)
    [*_, recording] = sorted((installed.folder / "logs").glob("claw_*.mcap"))
    shutil.copy(recording, installed.folder / "claw.mcap")
    problems += installed.problems(RECORDED)
    for case in LASTING:
        problems += installed.beside(case, ())
    return problems


@pytest.mark.parametrize("version", PYTHONS)
def test_every_command_of_the_wheel(version: str, wheel: Path, tmp_path: Path) -> None:
    installed = Installed(version, wheel, tmp_path)
    assert installed.size() < LARGEST, "the installation has grown"
    problems = try_all(installed)
    assert not problems, "\n".join(problems)
    # As on ARM: the wheel without ruckig.
    installed.pip("uninstall", "--yes", "ruckig")
    again = installed.problems(
        [Case("run claw --duration 0.5 --no-log", "s_curve instead of jerk_limited")]
    )
    assert not again, "\n".join(again)
    installed.pip("install", f"{wheel}[extract]")
    extracted = installed.problems(EXTRACTED)
    assert not extracted, "\n".join(extracted)
    # The GUI without the extraction.
    installed.pip("uninstall", "--yes", "pin", "coal")
    installed.pip("install", f"{wheel}[gui]")
    assert do(installed.bin / "python", "-c", SHOW, HIDDEN.parent, "").endswith("shown\n")
    installed.pip("uninstall", "--yes", "rtee")
    left = [path for path in installed.bin.parent.rglob("*") if "rtee" in path.name]
    assert not left, "uninstalling leaves files"


@pytest.mark.parametrize("version", PYTHONS)
def test_a_new_driver_passes_its_tests(version: str, wheel: Path, tmp_path: Path) -> None:
    installed = Installed(version, wheel, tmp_path)
    assert not installed.problems([Case("new-driver my_gripper", "pip install -e '.[test]'")])
    package = installed.folder / "my_gripper"
    installed.pip("install", f"{wheel}[test]", "--editable", str(package))
    done = subprocess.run(
        [str(installed.bin / "python"), "-m", "pytest", "-q", "-W", "error", "tests"],
        cwd=package,
        env={**installed.environment, "RTEE_CONTRACT_CYCLES": "100"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("version", PYTHONS)
def test_everything_installs_on_arm_without_a_compiler(
    version: str, tmp_path: Path, repository: Path
) -> None:
    project = tomllib.loads((repository / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    lines = [
        *project["dependencies"],
        *(x for name in extras if name not in COMPILED for x in extras[name]),
    ]
    wanted = [one for one in map(Requirement, lines) if one.name != "rtee"]  # its own extras
    wanted = [one for one in wanted if one.marker is None or one.marker.evaluate(ON_ARM)]
    do(
        *(sys.executable, "-m", "pip", "install", "-q", "--dry-run", "--ignore-installed"),
        *("--only-binary", ":all:", "--implementation", "cp", "--python-version", version),
        *("--target", tmp_path / "nowhere"),
        *(f"--platform={platform}" for platform in PLATFORMS),
        *(f"{one.name}{one.specifier}" for one in wanted),
    )
