"""Modules in the working folder are never imported, whatever starts a process."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import anyio
import pytest

from rtee import child
from rtee.exchange.xacro_expand import expand
from rtee.loop.shutdown_signals import beside_this_run, companion
from rtee.trials.job import command

TAKEN = """
import pathlib, sys
pathlib.Path({place!r}).joinpath(f"ran-{{__name__}}").touch()
raise ImportError("a module of the working folder")
"""

MODULES = ("typer", "xacro", "anyio", "numpy", "zenoh", "json", "runpy", "multiprocessing", "yaml")
"""Modules that rtee or Python itself imports at once."""


@pytest.fixture
def downloads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with modules that take the place of others."""
    place = tmp_path / "downloads"
    place.mkdir()
    for name in MODULES:
        (place / f"{name}.py").write_text(TAKEN.format(place=str(tmp_path)))
    monkeypatch.chdir(place)
    # An empty entry means the working folder, too.
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(["", *filter(None, sys.path[:0])]))
    return tmp_path


def check(place: Path) -> None:
    assert sorted(place.glob("ran-*")) == []


def test_commands_and_their_companions(downloads: Path) -> None:
    words = child.python("-m", "rtee", "--help")
    done = subprocess.run(words, env=child.environment(), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    check(downloads)

    async def help_of(*words: str) -> None:
        await companion((*beside_this_run(*words)[:-2], "--help"))

    anyio.run(help_of, "gui")
    check(downloads)
    words, environment = command()
    done = subprocess.run(words, env=environment, input="", capture_output=True, text=True)
    check(downloads)


def test_the_module_of_the_command_line(downloads: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Python itself imports some modules before rtee can tell it not to."""
    monkeypatch.delenv("PYTHONPATH")
    for name in ("runpy", "json", "multiprocessing"):
        (downloads / "downloads" / f"{name}.py").unlink()
    words = [sys.executable, "-m", "rtee", "hands"]
    done = subprocess.run(words, capture_output=True, text=True)
    assert "Traceback" not in done.stderr
    check(downloads)


def test_xacro(downloads: Path) -> None:
    pytest.importorskip("xacro")
    (downloads / "x.urdf.xacro").write_text(
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="x">'
        '<link name="${1 + 1}"/></robot>'
    )
    expand(downloads / "x.urdf.xacro", downloads / "x.urdf", {})
    assert 'name="2"' in (downloads / "x.urdf").read_text()
    check(downloads)


def test_workers(downloads: Path) -> None:
    with child.spawning(), ProcessPoolExecutor(1, get_context("spawn")) as pool:
        assert pool.submit(abs, -1).result() == 1
    check(downloads)
    assert "PYTHONSAFEPATH" not in os.environ
