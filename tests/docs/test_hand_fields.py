"""The tables of fields say what hand.yaml may contain."""

from __future__ import annotations


def test_the_tables_are_current() -> None:
    from hand_fields import PAGE, page

    assert PAGE.read_text() == page(), "run: python docs/hand_fields.py"
