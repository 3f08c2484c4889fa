"""Runs software by others, which `make device-peers` installs, in processes of their own."""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

SCRIPTS = Path(__file__).parent
PEERS = Path(__file__).parents[3] / ".device-peers"


def environment(package: str) -> Path:
    """Return the folder in which a package is installed; skips the test where it is not."""
    folder = PEERS / package
    if not (PEERS / ".ready").exists() or not folder.exists():
        pytest.skip(f"{package} is not installed: make device-peers")
    failed = folder / "FAILED"
    if failed.exists():
        pytest.skip(f"{package} could not be installed: {failed.read_text('utf-8')}")
    return folder


def peers() -> list[dict[str, Any]]:
    """Return the table of the software by others."""
    text = (SCRIPTS / "peers.toml").read_text("utf-8")
    table: list[dict[str, Any]] = tomllib.loads(text)["peers"]
    return table


def started(package: str, script: str, words: Sequence[str], folder: Path) -> subprocess.Popen[str]:
    """Start a script with a package, in a folder of its own; it is spoken to by lines."""
    return subprocess.Popen(
        [sys.executable, str(SCRIPTS / script), *words],
        env={"PYTHONPATH": str(environment(package))},
        cwd=folder,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def told_by(package: str, script: str, words: Sequence[str], folder: Path) -> Any:
    """Return what a script prints last, from JSON."""
    with started(package, script, words, folder) as program:
        out, error = program.communicate(timeout=90)
    assert program.returncode == 0, error
    return json.loads(out.splitlines()[-1])
