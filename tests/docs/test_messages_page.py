from __future__ import annotations

import re
from pathlib import Path

from rtee.messages.reference import page


def test_the_reference_in_the_documentation_is_current(repository: Path) -> None:
    text = (repository / "docs" / "reference" / "messages.md").read_text()
    assert text == page(), "run: python -m rtee.messages.reference > docs/reference/messages.md"


def test_every_link_has_its_heading() -> None:
    text = page()
    headings = {
        re.sub(r"[^a-z0-9_-]", "", line.lstrip("# ").lower())
        for line in text.splitlines()
        if line.startswith("#")
    }
    links = set(re.findall(r"\]\(#([^)]+)\)", text))
    assert links
    assert links <= headings
