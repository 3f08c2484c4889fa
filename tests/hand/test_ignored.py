"""Actuators that hand.yaml ignores: they stand like fixed joints."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hand.models import anthropomorphic, line_of
from rtee.actions.types import PrimitiveKind
from rtee.errors import ConfigError, ModelError
from rtee.extract.kinematic import kinematic_primitives
from rtee.hand.kinematics import Kinematics
from rtee.hand.load import load_hand, load_model
from rtee.hand.model import Hand, JointRole

WRIST = ("rh_WRJ2", "rh_WRJ1")
HEAD = "name: shadow\nurdf: shadow.urdf\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "shadow"
    folder.mkdir()
    (folder / "shadow.urdf").write_text(anthropomorphic())
    return folder


def load(folder: Path, text: str) -> Hand:
    (folder / "hand.yaml").write_text(HEAD + text)
    return load_hand(folder)


def test_they_take_no_part(folder: Path) -> None:
    whole, hand = load(folder, ""), load(folder, "ignore: [rh_WRJ2, rh_WRJ1]\n")
    assert set(whole.actuator_names) - set(hand.actuator_names) == set(WRIST)
    assert hand.finger("index").actuators == ("rh_FFJ4", "rh_FFJ3", "rh_FFJ2", "rh_FFJ1")
    assert hand.joint_names == whole.joint_names
    roles = {joint.name: joint.role for joint in hand.joints}
    assert {name for name, role in roles.items() if role is JointRole.IGNORED} == set(WRIST)
    several = PrimitiveKind.SINGLE_JOINT_MULTIPLE_TIPS
    assert {p.elements[0] for p in kinematic_primitives(whole) if p.kind is several} == set(WRIST)
    assert [p for p in kinematic_primitives(hand) if p.kind is several] == []
    for primitive in kinematic_primitives(hand):
        assert not set(WRIST) & set(primitive.posture.position)


def test_they_stand_at_rest_like_fixed_joints(folder: Path) -> None:
    hand = load(folder, "ignore: [rh_WRJ2, rh_WRJ1]\nrest: {rh_WRJ1: 0.3, rh_FFJ3: 0.1}\n")
    rows = [hand.joint_index(name) for name in WRIST]
    for u in (hand.lower, hand.upper, hand.rest):
        assert list(hand.transmission.joints(u)[rows]) == [0.0, 0.3]
    assert not hand.transmission.jacobian(hand.rest)[rows].any()
    whole = load(folder, "rest: {rh_WRJ1: 0.3, rh_FFJ3: 0.1}\n")
    tip = "rh_ffdistal"
    poses = [Kinematics(h).link_pose(tip, h.rest) for h in (hand, whole)]
    assert np.allclose(*poses, atol=1e-12)


def test_what_mimics_them_stands_as_well(tmp_path: Path) -> None:
    mimic = '<mimic joint="rh_WRJ2" multiplier="2" offset="0.1"/></joint>'
    head, _, tail = anthropomorphic().partition('<joint name="rh_WRJ1"')
    (tmp_path / "h.urdf").write_text(
        head + '<joint name="rh_WRJ1"' + tail.replace("</joint>", mimic, 1)
    )
    hand = load_model(tmp_path / "h.urdf", ignore=["rh_WRJ2"], rest={"rh_WRJ2": 0.05})
    assert hand.transmission.joints(hand.rest)[hand.joint_index("rh_WRJ1")] == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("text", "at", "message"),
    [
        ("ignore: [rh_WRJ3]\n", "rh_WRJ3", "ignore.0: unknown actuator 'rh_WRJ3'; did you mean"),
        ("ignore: [rh_palm]\n", "rh_palm", "unknown actuator 'rh_palm'"),
        (
            "ignore: [rh_WRJ1]\nlimits:\n  rh_WRJ1: {velocity: 1.0}\n",
            "  rh_WRJ1",
            "limits.rh_WRJ1: the actuator is ignored",
        ),
        ("ignore: [rh_WRJ1]\nrest: {rh_WRJ1: 3.0}\n", "rest", "rest position 3 lies outside"),
        (
            "ignore: [rh_WRJ1]\ndevices:\n  hand: {driver: kinematic, actuators: [rh_WRJ1]}\n",
            "  hand",
            "actuator 'rh_WRJ1' is ignored; no device drives it",
        ),
    ],
)
def test_mistakes_name_their_line(folder: Path, text: str, at: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load(folder, text)
    assert message in str(caught.value)
    assert caught.value.line == line_of(HEAD + text, at)


def test_mimic_joints_cannot_be_ignored_nor_all(tmp_path: Path, folder: Path) -> None:
    (folder / "shadow.urdf").write_text(anthropomorphic(coupled=True))
    with pytest.raises(ConfigError, match="joint 'rh_FFJ1' is mimic, no actuator"):
        load(folder, "ignore: [rh_FFJ1]\n")
    whole = load(folder, "")
    with pytest.raises(ModelError, match="no joint is an actuator"):
        load(folder, f"ignore: [{', '.join(whole.actuator_names)}]\n")


def test_no_device_has_to_drive_them(folder: Path) -> None:
    text = "ignore: [rh_WRJ2, rh_WRJ1]\ndevices:\n  hand: {driver: kinematic, actuators: all}\n"
    assert len(load(folder, text).actuators) == 22
    names = [name for name in load(folder, "").actuator_names if name not in WRIST]
    text = text.replace("all", str(names).replace("'", ""))
    assert len(load(folder, text).actuators) == 22


def test_a_hand_is_known_by_its_actuators_alone(folder: Path) -> None:
    hand = load(folder, "ignore: [rh_WRJ2, rh_WRJ1]\n")
    again = load_model(folder / "shadow.urdf", actuators=hand.actuator_names)
    assert again.actuator_names == hand.actuator_names
    assert again.joint_names == hand.joint_names


def test_the_simulation_locks_them(folder: Path) -> None:
    pytest.importorskip("mujoco")
    from rtee.drivers.mujoco.options import SimOptions
    from rtee.drivers.mujoco.scene import build_hand
    from rtee.drivers.mujoco.simulation import Simulation

    hand = load(folder, "ignore: [rh_WRJ2, rh_WRJ1]\nrest: {rh_WRJ1: 0.3}\n")
    options = SimOptions()
    built = build_hand(hand, options)
    model = built.spec.compile()
    simulation = Simulation(model, hand, options, hand.actuator_names, 0.01, built.servos)
    for _ in range(50):
        simulation.advance()
    joints = dict(zip(hand.joint_names, simulation.joints, strict=True))
    assert joints["rh_WRJ1"] == pytest.approx(0.3, abs=0.005)
    assert joints["rh_WRJ2"] == pytest.approx(0.0, abs=0.005)
