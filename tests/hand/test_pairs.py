"""Values of unordered pairs."""

from __future__ import annotations

import pytest

from rtee.hand.pairs import Pairs


def test_either_order_finds_the_value() -> None:
    gaps = Pairs([(("a", "b"), 1.0)])
    gaps["c", "d"] = 2.0
    assert gaps["a", "b"] == gaps["b", "a"] == 1.0
    assert ("d", "c") in gaps
    assert gaps.get(("d", "c")) == 2.0
    assert list(gaps) == [("a", "b"), ("c", "d")]


def test_a_value_turns_with_its_pair() -> None:
    normals = Pairs([(("a", "b"), 3)], turned=lambda value: -value)
    assert (normals["a", "b"], normals["b", "a"]) == (3, -3)


def test_a_pair_that_is_not_there_is_missing_in_both_orders() -> None:
    pairs: Pairs[str, int] = Pairs([(("a", "b"), 1)])
    assert pairs.get(("a", "c"), 7) == 7
    assert ("a", "c") not in pairs
    with pytest.raises(KeyError):
        pairs["a", "c"]
