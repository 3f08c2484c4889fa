from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from hand.models import GRIPPER, SRDF
from rtee.hand.geometry import ADJACENT, ALWAYS, AT_REST, LINKAGE, allowed_collisions
from rtee.hand.load import load_model
from rtee.hand.model import Hand

BUTTON = """
  <link name="button">
    <collision><geometry><sphere radius="{radius}"/></geometry></collision>
  </link>
  <joint name="push" type="prismatic">
    <parent link="middle"/><child link="button"/>
    <origin xyz="-0.04 0 0.02"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="0.03" velocity="1" effort="1"/>
  </joint>
  <link name="middle"/>
  <joint name="slide" type="prismatic">
    <parent link="palm"/><child link="middle"/>
    <axis xyz="0 1 0"/><limit lower="0" upper="0.001" velocity="1" effort="1"/>
  </joint>
</robot>"""


def pairs_of(hand: Hand) -> dict[frozenset[str], str]:
    return {frozenset((p.link1, p.link2)): p.reason for p in allowed_collisions(hand)}


def test_reasons(load: Callable[..., Hand]) -> None:
    adjacent = {
        frozenset(("palm", "left_jaw")): ADJACENT,
        frozenset(("palm", "right_jaw")): ADJACENT,
    }
    assert pairs_of(load()) == adjacent
    # The button is two joints away from the palm and sticks in it at rest, always if it is large.
    text = GRIPPER.replace("</robot>", BUTTON)
    button = frozenset(("palm", "button"))
    assert pairs_of(load(text.format(radius=0.012)))[button] == ALWAYS
    jaw = frozenset(("left_jaw", "button"))
    # Outside the SRDF's groups of the hand it stands still; in them it moves away from the jaw.
    inside = SRDF.replace('<group name="fingers">', '<group name="fingers"><joint name="push"/>')
    for srdf, reason in ((SRDF, ALWAYS), (inside, AT_REST)):
        found = pairs_of(load(text.format(radius=0.005), srdf))
        assert button not in found
        assert found[jaw] == reason


def test_the_bars_of_a_linkage() -> None:
    hand = load_model("config/onrobot_rg2/onrobot_rg2.urdf")
    found = {pair for pair, why in pairs_of(hand).items() if why == LINKAGE}
    assert found == {
        frozenset((f"{side}_inner_knuckle", f"{side}_{bar}"))
        for side in ("left", "right")
        for bar in ("outer_knuckle", "finger")
    }


def test_known_contacts_at_rest(shared: Path) -> None:
    folder = shared / "hands" / "schunk"
    hand = load_model(folder / "schunk.urdf", folder / "schunk.srdf")
    others = {pair for pair, why in pairs_of(hand).items() if why != ADJACENT}
    assert others == {
        frozenset(("left_hand_a", "left_hand_e1")),
        frozenset(("left_hand_e1", "left_hand_l")),
        frozenset(("left_hand_e2", "left_hand_i")),
        frozenset(("left_hand_e2", "left_hand_j")),
    }
