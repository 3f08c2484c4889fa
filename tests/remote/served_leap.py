"""A LEAP Hand that runs in a thread beside a test, found by commands as any other."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import anyio.from_thread
import pytest

from rtee.actions.library import ActionLibrary
from rtee.hand.catalog import find_hand
from rtee.hand.load import load_hand

from .serving import Served, serving


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Served]:
    monkeypatch.setenv("RTEE_RUNTIME_DIR", str(tmp_path / "run"))
    monkeypatch.delenv("RTEE_CONNECT", raising=False)
    monkeypatch.delenv("RTEE_HAND", raising=False)
    hand = load_hand("leap_hand")
    library = ActionLibrary.load(hand, find_hand("leap_hand") / "actions")
    with (
        anyio.from_thread.start_blocking_portal() as portal,
        portal.wrap_async_context_manager(serving(hand, library)) as served,
    ):
        yield served
