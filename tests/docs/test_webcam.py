"""The tutorial on retargeting does what it says."""

from __future__ import annotations

import contextlib
import io
import re
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rtee.cli._common import app_of
from rtee.cli.retarget import retarget


@pytest.fixture
def page(repository: Path) -> str:
    return (repository / "docs" / "tutorials" / "webcam.md").read_text()


def test_the_table_and_the_code_are_as_written(page: str) -> None:
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    shown = [text for _, text in blocks]
    output = CliRunner().invoke(app_of(retarget), ["leap_hand"]).output
    written = shown[shown.index("rtee retarget leap_hand\n") + 1]
    assert [line.split() for line in output.splitlines()] == [
        line.split() for line in written.splitlines()
    ]
    code = next(text for kind, text in blocks if kind == "python")
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        exec(code, {})
    assert said.getvalue() == shown[shown.index(code) + 1]


def test_the_example_says_what_is_missing(repository: Path) -> None:
    script = repository / "examples" / "webcam_hand.py"
    # Without site-packages there is no MediaPipe, wherever this runs.
    command = [sys.executable, "-I", "-S", str(script), "hand_landmarker.task"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.strip() == "this needs MediaPipe: pip install mediapipe"
