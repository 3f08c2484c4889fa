from __future__ import annotations

import json
from pathlib import Path

import pytest
from hand.conftest import MODELS
from hand.models import anthropomorphic

from extract.models import Model, box
from rtee.actions.action_files import read_actions
from rtee.actions.describe import abduction_sentence
from rtee.actions.types import Primitive, PrimitiveKind
from rtee.extract.kinematic import kinematic_primitives
from rtee.hand.abduction import abduction
from rtee.hand.load import load_hand, load_model

TIP = box((0.01, 0.01, 0.01))


def by_kind(found: list[Primitive], kind: PrimitiveKind) -> dict[str, list[str]]:
    return {p.elements[0]: list(p.posture.involved) for p in found if p.kind is kind}


@pytest.mark.parametrize("name", MODELS)
def test_primitives_of_real_hands_are_as_expected(name: str, shared: Path) -> None:
    folder = shared / "hands"
    expected = json.loads((folder / "expected_kinematic.json").read_text())[name]
    hand = load_model(folder / name / f"{name}.urdf", folder / name / f"{name}.srdf")
    found = kinematic_primitives(hand)
    order = list(hand.actuator_names)
    assert by_kind(found, PrimitiveKind.TRIG) == {
        finger: sorted(actuators, key=order.index) for finger, actuators in expected["trig"].items()
    }
    assert by_kind(found, PrimitiveKind.TIP_FLEX) == {
        finger: [actuator] for finger, actuator in expected["tipFlex"].items()
    }
    assert by_kind(found, PrimitiveKind.FING_FLEX) == {
        finger: [actuator] for finger, actuator in expected["fingFlex"].items()
    }
    several = {
        p.elements[0]: (p.tips, set(p.fingers))
        for p in found
        if p.kind is PrimitiveKind.SINGLE_JOINT_MULTIPLE_TIPS
    }
    assert several == {
        actuator: (int(count), set(fingers))
        for count, actuators in expected["singleJointMultipleTips"].items()
        for actuator, fingers in actuators.items()
    }


def finger(*limits: tuple[float, float], kind: str = "revolute") -> Model:
    model, parent = Model(), "base"
    for i, bounds in enumerate(limits):
        model.link(f"link_{i}", TIP).joint(
            f"joint_{i}", parent, f"link_{i}", kind=kind, limits=bounds
        )
        parent = f"link_{i}"
    return model.finger("finger", parent)


def test_actuators_go_to_the_bound_farthest_from_rest(tmp_path: Path) -> None:
    found = kinematic_primitives(finger((-0.5, 0.2), (-0.2, 0.5), (0.3, 0.9)).load(tmp_path))
    trig = next(p for p in found if p.kind is PrimitiveKind.TRIG)
    assert dict(trig.posture.position) == {"joint_0": -0.5, "joint_1": 0.5, "joint_2": 0.9}


def test_of_two_equally_far_bounds_the_upper_one_is_taken(tmp_path: Path) -> None:
    found = kinematic_primitives(finger((-0.3, 0.3)).load(tmp_path))
    assert found[0].posture.position["joint_0"] == 0.3


def test_flexes_move_one_actuator_and_leave_the_others_at_rest(tmp_path: Path) -> None:
    found = kinematic_primitives(finger((0.1, 1), (0, 1), (0, 1)).load(tmp_path))
    tip, base = (
        next(p for p in found if p.kind is kind)
        for kind in (PrimitiveKind.TIP_FLEX, PrimitiveKind.FING_FLEX)
    )
    assert dict(tip.posture.position) == {"joint_0": 0.1, "joint_1": 0, "joint_2": 1}
    assert tip.posture.involved == ("joint_2",)
    assert dict(base.posture.position) == {"joint_0": 1, "joint_1": 0, "joint_2": 0}
    assert base.posture.involved == ("joint_0",)


def test_continuous_actuators_take_no_part(tmp_path: Path) -> None:
    assert kinematic_primitives(finger((0, 0), kind="continuous").load(tmp_path)) == []


def test_a_single_joint_keeps_its_near_bound_as_second_posture(tmp_path: Path) -> None:
    # Beside each other along their axis: one behind the other would be a linkage, and one finger.
    model = Model().link("a", TIP).joint("spread", "base", "a", limits=(-0.2, 0.7)).finger("a", "a")
    model.link("b", TIP).joint(
        "b", "base", "b", xyz=(0, 0.05, 0), limits=(-0.2, 0.7), mimic='<mimic joint="spread"/>'
    )
    model.finger("b", "b")
    (found,) = kinematic_primitives(model.load(tmp_path))
    assert found.name == "SingleJointMultipleTips_2"
    assert found.elements == ("spread",)
    assert found.fingers == ("a", "b")
    assert [posture.position["spread"] for posture in found.postures] == [0.7, -0.2]


PAPERS = (
    "dagana",
    "heri_ii",
    "onrobot_3fg15",
    "qb_softhand",
    "robotiq_2f_140",
    "robotiq_2f_85",
    "robotiq_3f",
    "schunk_svh",
)
KINEMATIC = ("Trig", "TipFlex", "FingFlex")


@pytest.mark.parametrize("name", PAPERS)
def test_the_papers_rule_stays_for_the_papers_hands(name: str, repository: Path) -> None:
    folder = repository / "config" / name
    hand = load_hand(folder)
    assert [abduction(hand, finger) for finger in hand.fingers] == [()] * len(hand.fingers)
    stored = [a for a in read_actions(hand, folder / "actions") if isinstance(a, Primitive)]
    found = {(p.kind, p.elements): p.posture for p in kinematic_primitives(hand)}
    assert found == {
        (p.kind, p.elements): p.posture
        for p in stored
        if p.kind in KINEMATIC or p.kind is PrimitiveKind.SINGLE_JOINT_MULTIPLE_TIPS
    }
    for finger in hand.fingers:
        flexes = [found.get((kind, (finger.name,))) for kind in list(PrimitiveKind)[1:3]]
        ends = [finger.own[-1:], finger.own[:1]] if len(finger.own) >= 2 else [None, None]
        assert [flex and flex.involved for flex in flexes] == ends


@pytest.mark.parametrize("coupled", [False, True])
def test_abduction_is_no_fing_flex(tmp_path: Path, *, coupled: bool) -> None:
    (tmp_path / "h.urdf").write_text(anthropomorphic(coupled=coupled))
    hand = load_model(tmp_path / "h.urdf", ignore=["rh_WRJ1", "rh_WRJ2"])
    found = kinematic_primitives(hand)
    assert by_kind(found, PrimitiveKind.FING_FLEX) == {
        "index": ["rh_FFJ3"],
        "middle": ["rh_MFJ3"],
        "ring": ["rh_RFJ3"],
        "little": ["rh_LFJ5"],
        "thumb": ["rh_THJ4"],
    }
    last = "J2" if coupled else "J1"
    assert by_kind(found, PrimitiveKind.TIP_FLEX)["index"] == [f"rh_FF{last}"]
    trig = next(p for p in found if p.kind is PrimitiveKind.TRIG and p.elements == ("index",))
    assert "rh_FFJ4" in trig.posture.involved
    words = abduction_sentence(hand, trig, "rh_")
    assert words == "also swings sideways (abduction): FFJ4"
    assert all(not abduction_sentence(hand, p) for p in found if p.kind is not PrimitiveKind.TRIG)


def test_what_rests_at_an_end_of_its_range_is_no_abduction(tmp_path: Path) -> None:
    (tmp_path / "h.urdf").write_text(anthropomorphic())
    hand = load_model(tmp_path / "h.urdf", rest={"rh_FFJ4": -0.35})
    assert abduction(hand, hand.finger("index")) == ()
    assert abduction(hand, hand.finger("middle")) == ("rh_MFJ4",)


def test_the_leap_hand_has_its_flexion_first(repository: Path) -> None:
    hand = load_hand(repository / "config" / "leap_hand")
    assert abduction(hand, hand.finger("index")) == ("index_mcp_side",)
    flexes = by_kind(kinematic_primitives(hand), PrimitiveKind.FING_FLEX)
    assert flexes == {
        **{name: [f"{name}_mcp_forward"] for name in ("index", "middle", "ring")},
        "thumb": ["thumb_cmc"],
    }


def test_the_allegro_hand_bends_by_its_second_joints(repository: Path) -> None:
    hand = load_hand(repository / "config" / "allegro")
    flexes = by_kind(kinematic_primitives(hand), PrimitiveKind.FING_FLEX)
    assert flexes == {
        "index": ["joint_1"],
        "middle": ["joint_5"],
        "ring": ["joint_9"],
        "thumb": ["joint_12"],
    }
