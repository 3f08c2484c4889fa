"""The page that leads a newcomer through the code names what is there."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "architecture.md").read_text()
HOPS = re.findall(r"^\| \d+ \| `(rtee/[\w/]+\.py)` \| `(\w+)(?:\.(\w+))?` \|", PAGE, re.MULTILINE)
FILES = sorted(set(re.findall(r"`(rtee/[\w/]+(?:\.\w+|/))`", PAGE)))

BARE = sorted(set(re.findall(r"`(\w+\.(?:py|js|css|msg))`", PAGE)))
"""Files that the page names without their folder, behind another one of it."""


def test_the_page_names_hops_and_files() -> None:
    assert len(HOPS) == len(re.findall(r"^\| \d+ \|", PAGE, re.MULTILINE))
    assert len(HOPS) >= 20
    assert len(FILES) >= 30


@pytest.mark.parametrize(("file", "name", "method"), HOPS)
def test_every_hop_is_there(file: str, name: str, method: str) -> None:
    tree = ast.parse((ROOT / file).read_text())
    found = next(each for each in tree.body if getattr(each, "name", None) == name)
    if method:
        assert isinstance(found, ast.ClassDef)
        assert method in {getattr(each, "name", None) for each in found.body}


@pytest.mark.parametrize("file", FILES)
def test_every_file_is_there(file: str) -> None:
    assert (ROOT / file).exists()


@pytest.mark.parametrize("name", BARE)
def test_every_file_without_its_folder_is_there(name: str) -> None:
    assert any((ROOT / "rtee").rglob(name))
