"""Runs device makers' own software, which `make device-peers` and `make test` install."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

SCRIPTS = Path(__file__).parent
PEERS = Path(__file__).parents[3] / ".device-peers"

installed = pytest.mark.skipif(
    not (PEERS / ".ready").exists(),
    reason="device makers' software is not installed: make device-peers",
)


def told_by(script: str, words: Sequence[str], folder: Path) -> Any:
    """Return what a script prints last, from JSON; it runs in a folder of its own."""
    done = subprocess.run(
        [sys.executable, str(SCRIPTS / script), *words],
        env={"PYTHONPATH": str(PEERS)},
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=90,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])
