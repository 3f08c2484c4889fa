"""The real hands load with the facts known about them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from rtee.hand.load import load_model
from rtee.hand.model import Hand, JointRole


@pytest.fixture
def expected(real: Path) -> Any:
    return json.loads((real.parent / "expected_kinematic.json").read_text())[real.name]


def test_counts(real_hand: Hand, expected: Any) -> None:
    counts = expected["counts"]
    roles = [joint.role for joint in real_hand.joints]
    assert len(real_hand.urdf.links) == counts["links"]
    assert len(real_hand.urdf.joints) == counts["joints"]
    assert len(real_hand.joints) == counts["movable"] == expected["nq"]
    assert roles.count(JointRole.ACTUATOR) == counts["actuated"]
    assert roles.count(JointRole.MIMIC) == counts["mimic"]
    collisions = sum(len(link.collisions) for link in real_hand.urdf.links.values())
    assert collisions == expected["collision_geometries"]


def test_fingertips(real_hand: Hand, expected: Any) -> None:
    assert {f.name: f.tip for f in real_hand.fingers} == expected["fingertips"]


def test_actuators_and_their_limits(real_hand: Hand, expected: Any) -> None:
    found = {a.name: [a.lower, a.upper] for a in real_hand.actuators}
    assert found.keys() == expected["actuators"].keys()
    for name, limits in expected["actuators"].items():
        assert found[name] == pytest.approx(limits, abs=1e-4)
    for actuator in real_hand.actuators:
        assert actuator.lower <= actuator.rest <= actuator.upper
        assert actuator.velocity > 0
        assert actuator.effort > 0


def test_what_moves_what(real_hand: Hand, expected: Any) -> None:
    found = {a.name: list(a.fingers) for a in real_hand.actuators if a.fingers}
    assert found == expected["moves"]


def test_actuators_of_one_finger_only_in_order(real_hand: Hand, expected: Any) -> None:
    assert {f.name: list(f.own) for f in real_hand.fingers if f.own} == expected["trig"]
    several = {f.name: f.own for f in real_hand.fingers if len(f.own) > 1}
    assert {name: own[-1] for name, own in several.items()} == expected["tipFlex"]
    assert {name: own[0] for name, own in several.items()} == expected["fingFlex"]


def test_joints_stand_in_the_order_of_the_tree(real_hand: Hand) -> None:
    seen = {real_hand.base}
    for joint in real_hand.urdf.joints.values():
        assert joint.parent in seen
        seen.add(joint.child)


def test_rest_is_zero_clamped(shared: Path) -> None:
    folder = shared / "hands" / "robotiq_3f"
    hand = load_model(folder / "robotiq_3f.urdf", folder / "robotiq_3f.srdf")
    assert hand.rest[hand.actuator_index("finger_1_joint_1")] == 0.0495
    assert hand.rest[hand.actuator_index("palm_finger_1_joint")] == 0.0
    assert any("0 lies outside its limits" in note for note in hand.notes)


def test_loading_needs_neither_pydantic_nor_pinocchio(shared: Path) -> None:
    script = (
        "import sys; from rtee.hand.load import load_model\n"
        f"load_model({str(shared / 'hands' / 'schunk' / 'schunk.urdf')!r})\n"
        "heavy = {'pydantic', 'ruamel', 'pinocchio', 'coal', 'scipy', 'rich', 'typer'}\n"
        "print(sorted(heavy & {name.partition('.')[0] for name in sys.modules}))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"
