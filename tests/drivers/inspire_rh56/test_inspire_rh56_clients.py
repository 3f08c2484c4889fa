"""Published clients of the RH56 drive the emulated hand, ideal and worn."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from rtee.buses.simulated import SimulatedLine
from rtee.drivers.emulators import make_emulator
from rtee.drivers.inspire_rh56.emulator import InspireRh56Emulator
from tests.drivers.peers.running import started, told_by

pytestmark = pytest.mark.heavy


def hand(port: str, wear: str, **properties: Any) -> InspireRh56Emulator:
    made = make_emulator("inspire_rh56", {"port": port, "emulator": {"wear": wear, **properties}})
    assert isinstance(made, InspireRh56Emulator)
    return made


@pytest.mark.parametrize("wear", ["ideal", "worn"])
def test_pyrh56_identifies_moves_reads_and_clears(tmp_path: Path, wear: str) -> None:
    made = hand("/dev/x", wear)
    with (
        SimulatedLine([made], wire_time=False) as line,
        started("pyrh56", "rh56_peer.py", [line.address], tmp_path) as program,
    ):
        assert program.stdin is not None
        assert program.stdout is not None
        first = program.stdout.readline()
        assert first, program.communicate(timeout=60)[1]
        line.call(lambda: made.inject("over_current"))
        program.stdin.write("\n")
        program.stdin.flush()
        second = program.stdout.readline()
        line.call(lambda: made.clear())
        out, error = program.communicate("\n", timeout=60)
        assert program.returncode == 0, error
    told, fault = json.loads(first), json.loads(second)
    assert told["before"] == [255] * 6
    assert told["angles"] == pytest.approx([900, 800, 700, 600, 500, 500], abs=20)
    assert 255 not in told["status"]
    assert 557 <= told["voltage"] <= 562
    assert fault["error"] == [0, 0, 0, 4, 0, 0]
    assert json.loads(out.splitlines()[-1]) == {"cleared": [0] * 6}


@pytest.mark.parametrize("wear", ["ideal", "worn"])
def test_the_dftps_client_moves_and_reads(tmp_path: Path, wear: str) -> None:
    made = hand("tcp://x", wear, model="dftp")
    with SimulatedLine([made], tcp=True, scheme="tcp", wire_time=False) as line:
        host, port = line.address.removeprefix("tcp://").split(":")
        told = told_by("inspire_rh56dftp", "dftp_peer.py", [host, port], tmp_path)
    assert told["sent"] is True
    assert told["angles"] == pytest.approx([900, 800, 700, 600, 500, 400], abs=20)
    assert told["errors"] == [0, 0, 0]
    assert told["taxels"] == [0] * 9
