"""The table of events, beside the kinds that the code reports."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path

from rtee.types import DeviceStatus, EventKind

REPORTED = re.compile(
    r'(?:\bEvent\(|_report\(|_warn\(|\bwarn\()\s*"(\w+)",|^(?:STREAM_ENDED|RUN_BEGINS) = "(\w+)"',
    re.M,
)


def test_the_page_has_every_kind_of_event_and_every_field_of_a_device(repository: Path) -> None:
    page = (repository / "docs" / "reference" / "events.md").read_text()
    kinds, _, status = page.partition("## Kinds")[2].partition("## Device status")
    first = "".join(line.split("|")[1] for line in kinds.splitlines() if line.startswith("| `"))
    listed = set(re.findall(r"`(\w+)`", first))
    code = [path.read_text() for path in (repository / "rtee").rglob("*.py")]
    reported = {a or b for text in code for a, b in REPORTED.findall(text)}
    assert reported == listed == set(EventKind)
    named = "".join(line.split("|")[1] for line in status.splitlines() if line.startswith("| `"))
    assert set(re.findall(r"`(\w+)`", named)) == {field.name for field in fields(DeviceStatus)}
