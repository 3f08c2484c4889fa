from __future__ import annotations

from typing import Any

import pytest

from rtee.actions.library import ActionLibrary
from rtee.hand.model import Hand
from rtee.testing import simulated_time

from .hands import make_hand, make_library


@pytest.fixture(scope="session")
def hand(tmp_path_factory: pytest.TempPathFactory) -> Hand:
    return make_hand(tmp_path_factory.mktemp("small"))


@pytest.fixture
def library(hand: Hand) -> ActionLibrary:
    return make_library(hand)


@pytest.fixture(scope="session")
def anyio_backend() -> tuple[str, dict[str, Any]]:
    """Run on simulated time: what waits costs nothing, and every deadline is exact."""
    return simulated_time()
