"""The tutorial's code is complete and does what it says."""

from __future__ import annotations

import importlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import anyio
import pytest
from rtee_process import RTEE

import rtee
from rtee.running.run import RunOptions, run_hands

_BLOCK = re.compile(r'^```\w+ title="([^"]+)"\n(.*?)^```$', re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def package(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package put together from the blocks of the page, in their order."""
    folder = tmp_path_factory.mktemp("six") / "hexa_hand"
    files: dict[str, list[str]] = {}
    page = (repository / "docs" / "tutorials" / "six-motors.md").read_text()
    for name, text in _BLOCK.findall(page):
        files.setdefault(name, []).append(text)
    for name, texts in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        # A block that goes on within a class is apart from the one before by one empty line.
        path.write_text(
            "".join(("\n" if t.startswith("    ") else "\n\n") + t for t in texts).lstrip()
        )
    return folder


def run(package: Path, *arguments: str, **environment: str) -> str:
    path = os.pathsep.join([str(package), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        arguments,
        cwd=package,
        env={**os.environ, "PYTHONPATH": path, **environment},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_all_files_of_the_layout_are_there(package: Path) -> None:
    found = {str(path.relative_to(package)) for path in package.rglob("*") if path.is_file()}
    assert found == {
        "pyproject.toml",
        "hexa_hand/__init__.py",
        "hexa_hand/codec.py",
        "hexa_hand/emulator.py",
        "hexa_hand/driver.py",
        "tests/test_codec.py",
        "tests/test_contract.py",
        "config/hexa_hand/hand.yaml",
        "config/hexa_hand/hexa_hand.urdf",
    }


@pytest.mark.heavy
def test_it_passes_the_contract_suite(package: Path) -> None:
    options = ("-q", "-W", "error", "-p", "no:cacheprovider", "tests")
    said = run(package, sys.executable, "-m", "pytest", *options, RTEE_CONTRACT_CYCLES="100")
    assert "skipped" not in said
    assert int(re.findall(r"(\d+) passed", said)[0]) > 25


def test_its_code_is_tidy(package: Path, repository: Path) -> None:
    """As the house has it: what people copy is an example in every respect."""
    settings = str(repository / "pyproject.toml")
    ruff = (sys.executable, "-m", "ruff")
    rules = "--extend-ignore=INP001,D104"
    run(package, *ruff, "check", "--config", settings, "--no-cache", rules, "hexa_hand")
    run(
        package,
        *ruff,
        "format",
        "--check",
        "--config",
        settings,
        "--no-cache",
        "hexa_hand",
        "tests",
    )


def test_the_hand_runs_on_its_emulator(
    package: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    package = Path(shutil.copytree(package, tmp_path / "hexa_hand"))
    run(package, *RTEE, "extract", "hexa_hand", "--save")
    monkeypatch.syspath_prepend(str(package))
    monkeypatch.chdir(package)
    # The 20 ms that a request may take pass on a busy computer before a thread runs.
    ask = importlib.import_module("hexa_hand.driver").HexaHandDriver._ask
    monkeypatch.setattr(ask, "__defaults__", (b"", 60.0))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("RTEE_RUNTIME_DIR", raising=False)

    async def main() -> None:
        end = anyio.Event()
        options = RunOptions(emulated=True, ideal=True, object_in_hand="0.5", record=False)
        async with anyio.create_task_group() as group:
            group.start_soon(
                lambda: run_hands(["hexa_hand"], options, say=lambda _: None, until=end)
            )
            async with rtee.connect("hexa_hand", wait=300.0) as hand:
                (device,) = (await hand.status()).devices
                assert device.identity == {"model": "600", "firmware": "1.4"}
                result = await hand.do("Trig", "index")
                assert result.grasped, result
                assert result.grasped_fingers == ("index",)
                assert 0.7 < result.position["index"] < 0.9
                assert (await hand.open()).reached
            end.set()

    anyio.run(main)
