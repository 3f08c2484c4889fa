"""Fingertips that several links form, and hands whose fingers come in another order."""

from __future__ import annotations

from pathlib import Path

import pytest
from hand.robots import JAW, PALM, Robot, box, jaws, sphere

from rtee.actions.types import PrimitiveKind
from rtee.extract.extraction import extract
from rtee.extract.openings import make_openings
from rtee.hand.load import load_model
from rtee.hand.model import Hand


def marked(radius: float, at: tuple[float, float, float], *, seen: bool = True) -> Robot:
    """Return two jaws whose distal links carry a welded sphere."""
    robot = jaws()
    for side in ("left", "right"):
        robot.link(f"{side}_tip", sphere(radius), seen=seen)
        robot.weld(f"{side}_distal", f"{side}_tip", at)
    return robot


def pinch_and_opening(hand: Hand) -> tuple[float, float, float, bool]:
    """Return contact, depth and opening at rest of the pinch, and whether it is clear."""
    found = extract(hand, jobs=1)
    pinch = next(p for p in found.primitives if p.kind is PrimitiveKind.PINCH_TIGHT)
    evidence, (opening,) = pinch.evidence[0], make_openings(hand, [pinch]).tables
    assert evidence.contact_at is not None
    assert evidence.depth is not None
    clear = evidence.clear and bool(evidence.path_clear)
    return evidence.contact_at, evidence.depth, float(opening.width[0]), clear


@pytest.mark.parametrize("radius", [0.0005, 0.002, 0.005])
@pytest.mark.parametrize("z", [0.01, 0.045, 0.049])
def test_a_marker_inside_the_tip_changes_nothing(radius: float, z: float, tmp_path: Path) -> None:
    z = min(z, 0.05 - radius)
    hand = load_model(marked(radius, (0.0, 0.0, z)).write(tmp_path))
    assert hand.finger("left").tip_links == ("left_tip", "left_distal")
    # A box of 6 mm half width touches the middle plane where 6 cos q + 50 sin q = 30 [mm].
    contact, depth, opening, clear = pinch_and_opening(hand)
    assert contact == pytest.approx(0.5765, abs=1e-3)
    assert depth == pytest.approx(0.015, abs=1e-4)
    assert opening == pytest.approx(0.048, abs=1e-6)
    assert clear


def test_a_longer_tip_counts_together_with_the_link_that_it_is_welded_to(tmp_path: Path) -> None:
    hand = load_model(marked(0.006, (0.0, 0.0, 0.055)).write(tmp_path))
    contact, _, opening, clear = pinch_and_opening(hand)
    # The sphere meets the middle plane where 55 sin q = 24 [mm], before the box does.
    assert contact == pytest.approx(0.5018, abs=1e-3)
    assert opening == pytest.approx(0.048, abs=1e-6)
    assert clear


def test_a_marker_that_stands_back_at_the_end_does_not_widen_the_opening(tmp_path: Path) -> None:
    hand = load_model(marked(0.002, (0.0, 0.0, 0.05)).write(tmp_path))
    assert pinch_and_opening(hand)[2] == pytest.approx(0.048, abs=1e-6)


def test_a_sensor_on_the_way_between_pad_and_distal_link_is_part_of_the_tip(
    tmp_path: Path,
) -> None:
    robot = jaws()
    for side, sign in (("left", 1.0), ("right", -1.0)):
        robot.link(f"{side}_sensor", box(0.002, 0.015, 0.02))
        robot.weld(f"{side}_distal", f"{side}_sensor", (0.007 * sign, 0.0, 0.04))
        robot.link(f"{side}_frame").weld(f"{side}_sensor", f"{side}_frame", (0, 0, 0.03))
        robot.link(f"{side}_pad", box(0.002, 0.015, 0.02))
        robot.weld(f"{side}_frame", f"{side}_pad", (0.002 * sign, 0.0, -0.03))
    hand = load_model(robot.write(tmp_path))
    links = ("left_pad", "left_distal", "left_sensor")
    assert hand.finger("left").tip_links == links
    assert hand.tip_links["left_sensor"] == "left"
    assert pinch_and_opening(hand)[2] == pytest.approx(0.040, abs=1e-6)


def test_the_palm_of_a_fixed_jaw_is_no_part_of_its_tip(tmp_path: Path) -> None:
    robot = Robot("claw").link("palm", PALM).link("fixed", JAW).link("moving", JAW)
    robot.weld("palm", "fixed", (0.03, 0, 0.01)).joint("jaw", "palm", "moving", (-0.03, 0, 0.01))
    srdf = tmp_path / "claw.srdf"
    groups = "".join(
        f'<group name="{n}"><chain base_link="palm" tip_link="{n}"/></group>'
        for n in ("fixed", "moving")
    )
    srdf.write_text(f'<robot name="claw">{groups}</robot>')
    hand = load_model(robot.write(tmp_path), srdf)
    assert hand.finger("fixed").tip_links == ("fixed",)


ORDERS = [
    ("index", "thumb", "middle"),
    ("index", "middle", "thumb"),
    ("thumb", "index", "middle"),
    ("middle", "thumb", "index"),
]


def test_openings_do_not_depend_on_the_order_of_the_fingers(tmp_path: Path) -> None:
    tables = []
    for number, order in enumerate(ORDERS):
        robot = Robot(f"order_{number}").link("base", box(0.08, 0.09, 0.02))
        for name in order:
            thumb, y = name == "thumb", {"index": -0.02, "middle": 0.02}.get(name, 0.0)
            x, axis = (-0.03, (0, 1, 0)) if thumb else (0.03, (0, -1, 0))
            robot.link(f"{name}_distal", box(0.012, 0.03 if thumb else 0.015, 0.05, (0, 0, 0.025)))
            robot.joint(f"{name}_joint", "base", f"{name}_distal", (x, y, 0.01), axis, (0, 1.2))
        hand = load_model(robot.write(tmp_path))
        pinches = [p for p in extract(hand, jobs=1).primitives if p.evidence]
        tables.append(
            {
                (o.action, frozenset(o.elements)): (o.width[0], o.at(0.5))
                for o in make_openings(hand, pinches).tables
            }
        )
    assert tables[0].keys() == tables[1].keys() == tables[2].keys() == tables[3].keys()
    assert len(tables[0]) == 3
    for key, widths in tables[0].items():
        for table in tables[1:]:
            assert table[key] == pytest.approx(widths, abs=1e-4), key
