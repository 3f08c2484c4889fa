"""The tables of hands and devices say what is in config/ and what the drivers tell."""

from __future__ import annotations

import re
from pathlib import Path


def test_the_tables_are_current() -> None:
    from hands_table import PAGE, page

    assert PAGE.read_text() == page(), "run: python docs/hands_table.py"


def test_every_hand_and_every_driver_has_its_row_and_its_page(repository: Path) -> None:
    from hands_table import PAGE

    text = PAGE.read_text()
    hands = {path.parent.name for path in (repository / "config").glob("*/hand.yaml")}
    assert len(hands) > 10
    rows = re.findall(r"^\| \[[^]]+\]\((\w+)\.md\) \|", text, re.MULTILINE)
    assert sorted(rows) == sorted([*hands] * 3), "of the hand, its device, and what judged it"
    linked = set(re.findall(r"\]\((?!http)([^)#]+\.md)", text))
    assert [link for link in linked if not (PAGE.parent / link).is_file()] == []


def test_what_a_device_can_do_comes_from_its_driver(repository: Path) -> None:
    """One that the suite of its driver tells apart: effort limits, currents, rates."""
    from hands_table import connected, hands

    found = {one.hand.name: one for one in hands()}
    (svh,) = connected(found["schunk_svh"])
    assert "max_effort" in svh.capabilities.accepts
    assert svh.capabilities.homing
    (leap,) = connected(found["leap_hand"])
    assert leap.bus == "Dynamixel"
    assert "temperature" in leap.capabilities.measures
