"""Completion as bash asks for it."""

from __future__ import annotations

import os
import subprocess

import pytest
from rtee_process import RTEE


def completed(*words: str) -> list[str]:
    asked = {
        "_RTEE_COMPLETE": "complete_bash",
        "COMP_WORDS": " ".join(("rtee", *words)),
        "COMP_CWORD": str(len(words)),
        "RTEE_HAND": "schunk_svh",
    }
    done = subprocess.run(RTEE, env=os.environ | asked, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["extract", "schunk_s"], ["schunk_svh"]),
        (["do", "PinchTight", "index", ""], ["pinky", "ring", "thumb"]),
        (["compose", "fist", "trig:ri"], ["trig:ring"]),
        (["generic", "point", "left_hand_Pi"], ["left_hand_Pinky="]),
        # The option that --ideal needs is not typed yet.
        (["run", "schunk_svh", "--ideal", "--emu"], ["--emulated"]),
    ],
)
def test_bash(words: list[str], found: list[str]) -> None:
    assert completed(*words) == found
