"""The four hands of the paper's figure 3."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from extract.models import figure_3
from rtee.extract.extraction import extract

EXPECTED = {
    1: {"SingleJointMultipleTips_2": 1, "PinchTight": 1},
    2: {"Trig": 2, "PinchTight": 1},
    3: {"Trig": 3},
    4: {"Trig": 3, "TipFlex": 1, "FingFlex": 1, "PinchTight": 2},
}


@pytest.mark.parametrize("variant", EXPECTED)
def test_variant_gives_exactly_the_stated_primitives(variant: int, tmp_path: Path) -> None:
    found = extract(figure_3(variant).load(tmp_path)).primitives
    assert Counter(primitive.name for primitive in found) == EXPECTED[variant]


def test_the_opposing_finger_pinches_each_of_the_two_others(tmp_path: Path) -> None:
    found = extract(figure_3(4).load(tmp_path)).primitives
    pinches = {p.elements: p for p in found if p.name == "PinchTight"}
    assert set(pinches) == {("first", "thumb"), ("second", "thumb")}
    for pinch in pinches.values():
        assert pinch.evidence[0].depth > 0.002
        assert {"thumb_swivel", "thumb_flexion"} < set(pinch.posture.involved)


def test_one_actuator_and_two_pinch_in_the_same_place(tmp_path: Path) -> None:
    one, two = (
        next(p for p in extract(figure_3(v).load(tmp_path)).primitives if p.name == "PinchTight")
        for v in (1, 2)
    )
    assert one.posture.involved == ("thumb_flexion",)
    assert two.posture.involved == ("thumb_flexion", "first_flexion")
    assert two.evidence[0].depth >= one.evidence[0].depth - 1e-6
