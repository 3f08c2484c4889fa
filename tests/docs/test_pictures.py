"""Each hand that comes with rtee is shown on its page."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtee.hand.catalog import hand_names


@pytest.mark.parametrize("name", hand_names())
def test_the_hand_is_shown_on_its_page(name: str, repository: Path) -> None:
    """``python docs/pictures.py`` makes the pictures."""
    page = repository / "docs" / "hands" / f"{name}.md"
    assert f"](../assets/hands/{name}.png)" in page.read_text()
    picture = repository / "docs" / "assets" / "hands" / f"{name}.png"
    assert picture.read_bytes().startswith(b"\x89PNG")
