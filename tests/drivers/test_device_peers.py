"""Device makers' own software drives rtee's emulators, in processes of its own.

`make device-peers` installs it, as `make test` does.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from rtee.buses.emulator import Emulator
from rtee.buses.simulated import SimulatedLine
from rtee.drivers.ability_hand.emulator import AbilityHandEmulator
from rtee.drivers.feetech.emulator import FeetechEmulator, LineProperties

SCRIPTS = Path(__file__).with_name("peers")
PEERS = Path(__file__).parents[2] / ".device-peers"

pytestmark = pytest.mark.skipif(
    not (PEERS / ".ready").exists(),
    reason="device makers' software is not installed: make device-peers",
)


def driven(script: str, emulator: Emulator, folder: Path) -> dict[str, Any]:
    """Let a script drive an emulator on a pseudo-terminal; returns what it has printed last."""
    with SimulatedLine([emulator]) as line:
        done = subprocess.run(
            [sys.executable, str(SCRIPTS / script), line.address],
            env={"PYTHONPATH": str(PEERS)},
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=90,
        )
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def test_feetechs_library_moves_two_servos(tmp_path: Path) -> None:
    found = driven("feetech_peer.py", FeetechEmulator(LineProperties(ids=(1, 2))), tmp_path)
    assert found["models"] == [777, 777]  # STS3215
    assert found["results"] == [0, 0, -6]  # two answer; the third is not there
    assert found["sent"] == 0
    assert found["positions"] == pytest.approx([2500, 1500], abs=10)
    for position, (value, result, error) in zip(found["positions"], found["single"], strict=True):
        assert (result, error) == (0, 0)
        assert value == pytest.approx(position, abs=5)


def test_psyonics_library_moves_the_ability_hand(tmp_path: Path) -> None:
    found = driven("ability_peer.py", AbilityHandEmulator(), tmp_path)
    assert found["position"] == pytest.approx([20.0, 30.0, 40.0, 50.0, 25.0, -35.0], abs=2.0)
    assert len(found["current"]) == len(found["velocity"]) == 6
    assert found["touch"] == 30
    assert found["read"] > 5
