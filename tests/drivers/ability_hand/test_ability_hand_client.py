"""The maker's published client talks to the emulated Ability Hand.

The client writes files into its working directory when it is imported, so it runs in a process and
a folder of its own.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from drivers.peers.running import told_by

from rtee.buses.simulated import SimulatedLine
from rtee.drivers.ability_hand.codec import touch_force
from rtee.drivers.ability_hand.emulator import AbilityHandEmulator
from rtee.drivers.axis import VirtualObject

GOAL = [30.0, 40.0, 50.0, 60.0, 70.0, -80.0]  # what the client is asked for [degrees]


def by_the_client(word: int) -> float:
    """Return the force of a touch word as the client has it [N]."""
    return 121591.0 / (33000.0 / (word * 3.3 / 4096) + 10000.0) + 0.878894 if word else 0.0


@pytest.mark.parametrize("reply", [0, 1, 2])
def test_the_makers_client_moves_the_hand_and_reads_it(tmp_path: Path, reply: int) -> None:
    hand = AbilityHandEmulator()
    # Something in the way of the index finger, so that it is felt.
    hand.axes[0].obstacle = VirtualObject(0.4, 2.0)
    with SimulatedLine([hand], wire_time=False) as line:
        words = (line.address, json.dumps(GOAL), str(reply))
        position, touch, current, velocity = told_by(
            "ability-hand", "ability_peer.py", words, tmp_path
        )
    assert position[1:] == pytest.approx(GOAL[1:], abs=1.0)
    if reply != 2:
        felt = hand.reply(1).touch
        assert max(felt[:6]) > 0
        assert max(felt[6:]) == 0
        assert touch == pytest.approx([by_the_client(word) for word in felt], abs=1e-3)
        pressed = [word for word in felt if word]
        assert [touch_force(word) for word in pressed] == pytest.approx(
            [by_the_client(word) for word in pressed]
        )
    if reply != 1:
        assert current[0] == pytest.approx(hand.reply(3).currents[0] / 620.606, rel=0.01)
    if reply != 0:
        assert velocity == pytest.approx([0.0] * 6, abs=1.0)
