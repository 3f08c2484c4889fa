"""A shell in the locale POSIX, with Python told not to turn to UTF-8: all text is ASCII there."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from rtee import child

ASCII = {"LC_ALL": "POSIX", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


@pytest.fixture
def folder(tmp_path: Path, repository: Path) -> Path:
    """A folder with a hand that has characters beyond ASCII in its model, and in its own name."""
    place = tmp_path / "Hände und Öl"
    hand = place / "config" / "robotiq_2f_85"
    hand.mkdir(parents=True)
    for file in (repository / "config" / "robotiq_2f_85").iterdir():
        if file.suffix in {".urdf", ".srdf", ".yaml"}:
            (hand / file.name).write_bytes(file.read_bytes())
    for file in hand.glob("*.?rdf"):
        text = file.read_text("utf-8").replace("</robot>", "<!-- Größe: 85 mm −→ 0 -->\n</robot>")
        file.write_text(text, "utf-8")
    return place


def test_a_hand_runs_and_replays_in_ascii(folder: Path) -> None:
    def rtee(*words: str) -> str:
        # Real processes: Python reads these variables when it starts.
        done = subprocess.run(
            [sys.executable, "-m", "rtee", *words],
            cwd=folder,
            env={**child.environment(), **ASCII},
            capture_output=True,
            encoding="ascii",
        )
        assert (done.returncode, done.stderr) == (0, ""), done.stdout + done.stderr
        return done.stdout

    assert r"\xb5s" in rtee("run", "robotiq_2f_85", "--duration", "0.2")
    assert "the same, bit for bit" in rtee("log", "replay", "--check", "logs")
