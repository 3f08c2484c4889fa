from __future__ import annotations

import pytest

from rtee.actions.library import ActionLibrary
from rtee.hand.model import Hand

from .hands import make_hand, make_library


@pytest.fixture(scope="session")
def hand(tmp_path_factory: pytest.TempPathFactory) -> Hand:
    return make_hand(tmp_path_factory.mktemp("small"))


@pytest.fixture
def library(hand: Hand) -> ActionLibrary:
    return make_library(hand)
