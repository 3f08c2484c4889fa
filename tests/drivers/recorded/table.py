"""The table of recorded frames, for tests and for the page of hands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

_FILE = Path(__file__).with_name("frames.yaml")


@dataclass(frozen=True)
class Recorded:
    """Recorded frames of a family.

    Attributes:
        source: Where they were published.
        kind: ``manual``, ``capture``, ``issue`` or ``report``.
        frames: Hexadecimal bytes, and what they mean.
    """

    source: str
    kind: str
    frames: tuple[tuple[str, Mapping[str, Any]], ...]


def recorded() -> dict[str, Recorded]:
    """Return the recorded frames by family."""
    table = yaml.safe_load(_FILE.read_text("utf-8"))
    return {
        family: Recorded(
            one["source"], one["kind"], tuple((f["hex"], f["means"]) for f in one["frames"])
        )
        for family, one in table.items()
    }
