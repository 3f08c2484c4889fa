"""What a process that runs a hand does not import, since each of it takes memory of every hand."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

HAND = "robotiq_2f_85"

UNUSED = {
    # arguments of language models are checked with it
    "pydantic",
    "pydantic_core",
    # extras and what works offline
    "coal",
    "matplotlib",
    "mujoco",
    "pinocchio",
    "rtee.extract",
    "rtee.trials",
    "scipy",
    "viser",
    # tables
    "rich",
    # buses that the hand has no device on
    "can",
    "canopen",
    "dynamixel_sdk",
    "pymodbus",
    "serial",
    "serial_asyncio",
    "zmq",
    # of Python's own
    "email",
    "html",
    "importlib.metadata",
    "unittest",
    "xml.etree",
    "zipfile",
}

_CODE = """
import sys
sys.argv = "rtee run {hand} --no-log --duration 0.1".split()
from rtee.cli import main
try:
    main()
finally:
    print(*sys.modules)
"""


def test_a_running_hand_has_imported_only_what_it_uses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    done = subprocess.run(
        [sys.executable, "-c", _CODE.format(hand=HAND)], capture_output=True, text=True, check=True
    )
    started, *_, modules = done.stdout.splitlines()
    assert f"{HAND}: 1 actuator" in started
    found = set(modules.split())
    assert "rtee.loop.handloop" in found
    assert not found & UNUSED


def test_the_names_of_what_is_not_imported_are_those_of_modules() -> None:
    # A misspelt name would never be found.
    from importlib.util import find_spec

    assert not {name for name in UNUSED if find_spec(name) is None}
