from __future__ import annotations

from pathlib import Path

import pytest

from log.samples import Log, make_hand, recorded, settings
from rtee.hand.model import Hand


@pytest.fixture(scope="session")
def claw(tmp_path_factory: pytest.TempPathFactory) -> Hand:
    """A small hand with a linear and a non-linear mimic joint."""
    return make_hand(tmp_path_factory.mktemp("claw"))


@pytest.fixture(scope="session")
def story(claw: Hand, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of two seconds with one of everything; not to be changed."""
    folder = tmp_path_factory.mktemp("story")
    Log(claw, settings(folder)).story()
    (path,) = recorded(folder)
    return path
