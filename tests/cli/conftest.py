"""Commands that run in the tests' own process."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def same_priority(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave its priority to the process, in which other tests follow."""
    for command in ("gui", "mcp"):
        monkeypatch.setattr(f"rtee.cli.{command}.lower_priority", lambda: None)
