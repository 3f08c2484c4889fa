from __future__ import annotations

from pathlib import Path

import pytest
from rtee_process import python

from rtee.actions.library import ActionLibrary
from rtee.hand.model import Hand

from .serving import make_hand, make_library


@pytest.fixture(scope="session")
def hand(tmp_path_factory: pytest.TempPathFactory) -> Hand:
    return make_hand(tmp_path_factory.mktemp("small"))


@pytest.fixture
def library(hand: Hand, tmp_path: Path) -> ActionLibrary:
    return make_library(hand, tmp_path / "actions")


@pytest.fixture(autouse=True)
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of running hands of this test's own."""
    monkeypatch.setenv("RTEE_RUNTIME_DIR", str(tmp_path / "run"))
    monkeypatch.delenv("RTEE_CONNECT", raising=False)
    monkeypatch.delenv("RTEE_HAND", raising=False)
    return tmp_path / "run"


@pytest.fixture(autouse=True)
def warm(monkeypatch: pytest.MonkeyPatch) -> None:
    """Doors and planners start in no time."""
    monkeypatch.setattr("rtee.child.python", python)
