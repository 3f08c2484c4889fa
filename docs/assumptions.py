"""The section *Assumptions* of the pages of devices, made from what the drivers assume.

``python docs/assumptions.py`` rewrites them; a test keeps them current.
"""

from __future__ import annotations

import sys
from pathlib import Path

from rtee.drivers.assumptions import ASSUMPTIONS

ROOT = Path(__file__).parents[1]
DEVICES = ROOT / "docs" / "devices"
BEGIN = "<!-- Made by `python docs/assumptions.py`; a test keeps it current. -->"
END = "<!-- End of what is made. -->"

sys.path.insert(0, str(ROOT))


def section(driver: str) -> str:
    """Return the section of a driver's page as Markdown."""
    from tests.drivers.recorded.table import recorded

    rows = [
        f"| {one.topic} | {one.text} | {one.source or '**none**'} |" for one in ASSUMPTIONS[driver]
    ]
    found = recorded().get(driver)
    bytes_of = (
        f"Published frames that the tests decode: {len(found.frames)} ({found.source})."
        if found is not None
        else "No public recording of such a device was found: its frames are known from documents "
        "and programs only."
    )
    return "\n".join(
        [
            "Assumptions that the authors have not confirmed on a device, by topic. "
            "`rtee doctor --first-contact HAND` "
            "[confirms or refutes them](../how-to/first-contact.md) on yours.",
            "",
            "| about | assumed | source |",
            "| --- | --- | --- |",
            *rows,
            "",
            bytes_of,
        ]
    )


def page(driver: str) -> str:
    """Return a driver's page with the section made again."""
    text = (DEVICES / f"{driver}.md").read_text("utf-8")
    head, begin, rest = text.partition(f"## Assumptions\n\n{BEGIN}")
    tail = rest.partition(END)[2] if begin else "\n"
    return f"{head.rstrip()}\n\n## Assumptions\n\n{BEGIN}\n\n{section(driver)}\n\n{END}{tail}"


if __name__ == "__main__":
    for name in ASSUMPTIONS:
        (DEVICES / f"{name}.md").write_text(page(name), "utf-8")
