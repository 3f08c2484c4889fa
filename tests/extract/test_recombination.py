"""Starts put together from minima."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Any, cast

import numpy as np
import pytest

from rtee.extract.descent import Minimum, Slope
from rtee.extract.search import (
    Combining,
    Moving,
    SearchEffort,
    minima,
    moved_blocks,
    recombined,
)
from rtee.extract.space import Space
from rtee.sample import FloatArray

BLOCKS = [np.array([0, 1]), np.array([2, 3])]


def minimum(*y: float) -> Minimum:
    return Minimum(np.array(y), 0.0, 1)


def test_one_block_at_a_time_comes_from_another_minimum() -> None:
    found = [minimum(0.1, 0.1, 0.2, 0.2), minimum(0.8, 0.9, 0.6, 0.5)]
    new = {tuple(y.tolist()) for y in recombined(found, BLOCKS, set())}
    assert new == {(0.8, 0.9, 0.2, 0.2), (0.1, 0.1, 0.6, 0.5)}


def test_blocks_that_hardly_differ_are_left_and_nothing_is_returned_again() -> None:
    found = [minimum(0.1, 0.1, 0.2, 0.2), minimum(0.11, 0.1, 0.6, 0.5)]
    seen: set[bytes] = set()
    assert len(recombined(found, BLOCKS, seen)) == 2
    assert recombined(found, BLOCKS, seen) == []


class Valleys:
    """Two terms that depend on two coordinates each; either has a deep valley and a flat one."""

    space = Space(np.zeros(4), np.arange(4), np.zeros(4), np.ones(4))
    deep, flat = np.array([0.2, 0.3, 0.9, 0.8]), np.array([0.8, 0.9, 0.2, 0.1])

    def __call__(self, y: FloatArray) -> tuple[float, Slope]:
        value, slope = 0.0, np.zeros(4)
        for block in BLOCKS:
            pits = [(self.deep, 2.0), (self.flat, 1.0)]
            for pit, depth in pits:
                step = y[block] - pit[block]
                here = -depth * np.exp(-20.0 * step @ step)
                value += float(here)
                slope[block] -= 40.0 * here * step
        return value, lambda: slope

    def value(self, y: FloatArray) -> float:
        return self(y)[0]

    def fine(self) -> AbstractContextManager[None]:
        return nullcontext()


@pytest.mark.parametrize(("rounds", "depth"), [(0, -3.0), (1, -4.0)])
def test_a_sum_is_as_deep_as_the_deepest_of_its_terms_that_were_found(
    rounds: int, depth: float
) -> None:
    valleys = Valleys()
    starts = []
    for block in BLOCKS:
        y = valleys.flat.copy()
        y[block] = valleys.deep[block]
        starts.append(y + 0.02)
    effort = SearchEffort(screened=1, starts=0, rounds=((Combining(6, 4),),) * rounds)
    found = minima(cast("Any", valleys), starts, effort, BLOCKS).polished
    assert found[0].value == pytest.approx(depth, abs=1e-3)


def test_minima_of_one_block_need_no_other() -> None:
    assert recombined([minimum(0.5, 0.5, 0.5, 0.5)], BLOCKS, set()) == []


def test_a_block_is_tried_elsewhere_while_the_rest_stays() -> None:
    new = moved_blocks(minimum(0.1, 0.2, 0.3, 0.4), BLOCKS, 5)
    assert len(new) == 10
    assert all(y[2:].tolist() == [0.3, 0.4] for y in new[:5])
    assert all(y[:2].tolist() == [0.1, 0.2] for y in new[5:])
    assert len({y.tobytes() for y in new}) == 10


@pytest.mark.parametrize(("places", "depth"), [(0, -3.0), (16, -4.0)])
def test_a_valley_that_no_start_met_is_found_from_the_deepest_minimum(
    places: int, depth: float
) -> None:
    valleys = Valleys()
    start = valleys.flat.copy()
    start[BLOCKS[0]] = valleys.deep[BLOCKS[0]]
    rounds = ((Moving(places, 2),),) if places else ()
    effort = SearchEffort(screened=1, starts=0, rounds=rounds)
    found = minima(cast("Any", valleys), [start + 0.02], effort, BLOCKS).polished
    assert found[0].value == pytest.approx(depth, abs=1e-3)


@pytest.mark.parametrize(("elsewhere", "depth"), [(0, -2.0), (3, -4.0)])
def test_a_valley_far_from_the_known_minima_is_found(elsewhere: int, depth: float) -> None:
    valleys = Valleys()
    effort = SearchEffort(screened=1, starts=0, elsewhere=elsewhere)
    found = minima(cast("Any", valleys), [valleys.flat], effort, BLOCKS).polished
    assert found[0].value == pytest.approx(depth, abs=1e-3)
