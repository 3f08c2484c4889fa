"""The pages of devices say what is assumed of them."""

from __future__ import annotations

import pytest

from rtee.drivers.assumptions import ASSUMPTIONS


@pytest.mark.parametrize("driver", sorted(ASSUMPTIONS))
def test_the_section_is_current(driver: str) -> None:
    from assumptions import DEVICES, page

    text = (DEVICES / f"{driver}.md").read_text("utf-8")
    assert text == page(driver), "run: python docs/assumptions.py"
