from __future__ import annotations

import re


def test_the_reference_in_the_documentation_is_current() -> None:
    from messages_page import PAGE, page

    assert PAGE.read_text() == page(), "run: python docs/messages_page.py"


def test_every_link_has_its_heading() -> None:
    from messages_page import page

    text = page()
    headings = {
        re.sub(r"[^a-z0-9_-]", "", line.lstrip("# ").lower())
        for line in text.splitlines()
        if line.startswith("#")
    }
    links = set(re.findall(r"\]\(#([^)]+)\)", text))
    assert links
    assert links <= headings
