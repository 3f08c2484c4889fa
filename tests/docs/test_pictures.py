"""Each hand that comes with rtee is shown on its page, and each picture on a page."""

from __future__ import annotations

import re
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


def test_each_picture_is_shown_and_made_by_a_script(repository: Path) -> None:
    docs = repository / "docs"
    pages = [repository / "README.md", *docs.rglob("*.md")]
    shown = {
        (page.parent / path).resolve()
        for page in pages
        for path in re.findall(r"!\[[^]]*\]\((?!http)([^)]+)\)", page.read_text())
    }
    assert shown == set((docs / "assets").rglob("*.png"))
    scripts = "".join((docs / name).read_text() for name in ("pictures.py", "screenshots.py"))
    # Those of a hand have its name; those of experiments are the files of an experiment.
    experiments = (docs / "experiment_pictures.py").read_text()
    for picture in shown:
        name = picture.stem.removesuffix("_plot")
        if picture.parent.name == "experiments":
            assert name in experiments, picture
        elif picture.parent.name != "hands":
            assert f'"{name}' in scripts, picture
