"""No bytes break a decoder, none make it grow, and it finds the next good frame."""

from __future__ import annotations

import pytest

from tests.testing.decoders import DECODERS
from tests.testing.fuzz import Decoder, fuzz

DEAR = {"XBot2 joint names": [pytest.mark.heavy]}
"""Decoders that take a second; this one reads its YAML as "XBot2 service" does."""


@pytest.mark.parametrize(
    "decoder", [pytest.param(one, id=one.name, marks=DEAR.get(one.name, ())) for one in DECODERS]
)
def test_random_and_mutated_frames(decoder: Decoder) -> None:
    found = fuzz(decoder, 3000, seed=1)
    assert found.failures == []
    assert found.frames >= 3000
    assert found.accepted > 0
    assert found.kept <= decoder.limit
    assert found.lost <= decoder.lost


class Greedy:
    pending = 0

    def feed(self, data: bytes) -> list[bytes]:
        self.pending += len(data)
        return [data] if data == b"good" else []


class Fragile:
    pending = 0

    def feed(self, data: bytes) -> list[int]:
        return [data[0]]


def test_a_decoder_that_grows_or_breaks_is_caught() -> None:
    greedy = fuzz(Decoder("greedy", [b"good"], parser=Greedy, limit=100), 1000)
    assert any("bytes are kept" in failure for failure in greedy.failures)
    fragile = fuzz(Decoder("fragile", [b"g"], parser=Fragile), 1000)
    assert any("IndexError" in failure for failure in fragile.failures)
    function = fuzz(Decoder("function", [b"12"], decode=int, errors=()), 1000)
    assert any("ValueError" in failure for failure in function.failures)
