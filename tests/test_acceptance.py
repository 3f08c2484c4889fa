"""The page about what users ask for names tests that there are."""

from __future__ import annotations

import re
from pathlib import Path

CONTRACT = "rtee/testing/contract.py"


def named_tests(page: str) -> list[tuple[str, str]]:
    """Return the places and the names of tests in the page's tables."""
    found = []
    for row in re.findall(r"^\| .* \| (.*) \|$", page, re.MULTILINE):
        place = ""
        for part in re.split(r"; |, (?=`)", row):
            match = re.match(r"(?:`([\w/.]+)`|(contract))(?:: (.*))?$", part)
            if match:
                place = CONTRACT if match[2] else f"tests/{match[1]}"
            said = part if match is None else match[3] or ""
            found.append((place, re.sub(r"\W+", "_", said.split(",")[0].lower()).strip("_")))
    return [(place, name) for place, name in found if place]


def source_at(repository: Path, place: str) -> str:
    at = repository / place
    if at.is_dir():
        return "\n".join(file.read_text() for file in sorted(at.glob("*.py")))
    file = at if at.suffix else at.with_suffix(".py")
    assert file.is_file(), f"there is no {place}"
    return file.read_text()


def test_every_test_that_the_page_names_is_there(repository: Path) -> None:
    named = named_tests((repository / "docs" / "acceptance.md").read_text())
    assert len(named) > 50
    missing = [
        (place, name)
        for place, name in named
        if name not in ("", "the_same") and f"def test_{name}" not in source_at(repository, place)
    ]
    assert not missing
