"""Tips that a joint joins to each other, as the jaws of Dagana."""

from __future__ import annotations

from pathlib import Path

import pytest
from hand.models import GRIPPER

from extract.models import Model, box
from rtee.actions.types import Primitive
from rtee.extract.extraction import extract
from rtee.hand.load import load_hand, load_model
from rtee.hand.model import Hand


def jaws(closed: float) -> Model:
    """Return a jaw and a claw, 0.1 m long, that turn about one end; closed the claw is at it."""
    model = Model().link("jaw", box((0.02, 0.02, 0.11), (0, 0, 0.045)))
    model.joint("mount", "base", "jaw", kind="fixed")
    model.link("claw", box((0.02, 0.02, 0.11), (0, 0, 0.045)))
    model.joint("close", "jaw", "claw", rpy=(0, 1.2, 0), axis=(0, -1, 0), limits=(0, closed))
    return model.finger("jaw", "jaw").finger("claw", "claw", base="jaw")


def pinches(hand: Hand) -> list[Primitive]:
    return [p for p in extract(hand).primitives if "Pinch" in p.name]


def test_a_closing_claw_pinches(tmp_path: Path) -> None:
    (pinch,) = pinches(jaws(1.1).load(tmp_path))
    evidence = pinch.evidence[0]
    assert pinch.name == "PinchTight"
    assert pinch.elements == ("jaw", "claw")
    assert pinch.posture.position["close"] == pytest.approx(1.1, abs=1e-5)
    assert evidence.depth > 0.001
    assert evidence.contact_at is not None
    assert 0.6 < evidence.contact_at < 1.0
    assert evidence.opposition is not None
    assert evidence.opposition.force_closure


def test_contact_at_the_hinge_alone_is_no_pinch(tmp_path: Path) -> None:
    kinds = {pinch.name for pinch in pinches(jaws(0.3).load(tmp_path))}
    assert "PinchTight" not in kinds


def test_joined_tips_with_a_gap_are_taken_whole(tmp_path: Path) -> None:
    model = Model().link("jaw", box((0.02, 0.02, 0.08), (0, 0, 0.07)))
    model.joint("mount", "base", "jaw", kind="fixed")
    model.link("claw", box((0.02, 0.02, 0.08), (0, 0, 0.07)))
    model.joint("close", "jaw", "claw", rpy=(0, 1.2, 0), axis=(0, -1, 0), limits=(0, 1.1))
    (pinch,) = pinches(model.finger("jaw", "jaw").finger("claw", "claw", "jaw").load(tmp_path))
    assert pinch.name == "PinchTight"
    assert pinch.evidence[0].depth > 0.005


def check_dagana(hand: Hand) -> None:
    (pinch,) = pinches(hand)
    evidence = pinch.evidence[0]
    assert pinch.name == "PinchTight"
    assert pinch.posture.position["dagana_gripper_claw_joint"] == pytest.approx(1.0)
    assert evidence.contact_at is not None
    assert 0.7 < evidence.contact_at < 0.95
    assert evidence.clear
    assert evidence.opposition is not None
    assert evidence.opposition.force_closure


def test_dagana_pinches_when_it_closes() -> None:
    check_dagana(load_hand("dagana"))


@pytest.mark.heavy
def test_the_real_dagana_does_too(shared: Path) -> None:
    folder = shared / "hands" / "dagana"
    check_dagana(load_model(folder / "dagana.urdf", folder / "dagana.srdf"))


@pytest.mark.heavy
def test_meshes_without_their_scale_are_noted_and_cost_no_more(
    shared: Path, tmp_path: Path
) -> None:
    folder = shared / "hands" / "dagana"
    text = (folder / "dagana.urdf").read_text()
    assert 'scale="0.001 0.001 0.001"' in text
    (tmp_path / "dagana.urdf").write_text(text.replace('scale="0.001 0.001 0.001"', ""))
    hand = load_model(tmp_path / "dagana.urdf", folder / "dagana.srdf", package_dirs=[folder])
    found = extract(hand)
    assert 'is 105 m large; meshes drawn in millimetres need scale="0.001' in found.notes[0]
    assert {p.name for p in found.primitives} == {"Trig", "PinchTight"}


def test_boxes_in_millimetres_are_noted_as_boxes(tmp_path: Path) -> None:
    """They were said to be meshes that lack a scale."""
    file = tmp_path / "gripper.urdf"
    file.write_text(GRIPPER.replace('"0.01 0.02 0.06"', '"10 20 60"'))
    notes = extract(load_model(file)).notes
    assert "link 'left_jaw' is 60 m large; are its sizes in millimetres? URDFs have metres" in notes


def test_links_in_the_way_are_named_with_what_to_do() -> None:
    hand = load_model("config/onrobot_rg2/onrobot_rg2.urdf", rest={"finger_joint": 1.2873})
    found = extract(hand)
    (pinch,) = (p for p in found.primitives if "Pinch" in p.name)
    assert pinch.evidence[0].clear
    assert not pinch.evidence[0].path_clear
    (note,) = (note for note in found.notes if "is not clear" in note)
    assert note.startswith("the way to PinchTight (right, left) is not clear: right_inner_knuckle")
    assert note.endswith(
        '<disable_collisions link1="right_inner_knuckle" link2="right_outer_knuckle" '
        'reason="Never"/>'
    )
