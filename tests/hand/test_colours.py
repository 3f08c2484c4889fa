from __future__ import annotations

from pathlib import Path

from rtee.hand.colours import finger_of_link
from rtee.hand.load import load_model


def test_links_belong_to_the_finger_they_hang_on(shared: Path) -> None:
    folder = shared / "hands" / "schunk"
    hand = load_model(folder / "schunk.urdf", folder / "schunk.srdf")
    owner = finger_of_link(hand)
    assert all(owner[f.tip] == f.name for f in hand.fingers if f.tip)
    assert hand.base not in owner
