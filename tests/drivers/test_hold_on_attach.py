"""What was found active is left alone until it is asked to move."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rtee.drivers.hold_on_attach import HoldOnAttach
from rtee.testing import actuator
from rtee.types import Reference

HERE = np.array([0.5, 1.0])


def attached() -> HoldOnAttach:
    made = HoldOnAttach([actuator("a", 0.0, 1.0), actuator("b", 0.0, 2.0)])
    made.begin([0, 1])
    assert set(made.holding(Reference.at([0.501, 1.0]), HERE)) == {0, 1}
    return made


@pytest.mark.parametrize("asked", [0.501, 0.50101])
def test_staying_where_it_is_asks_for_nothing(asked: float) -> None:
    assert 0 in attached().holding(Reference.at([asked, 1.0]), HERE)


@pytest.mark.parametrize("asked", [0.52, 0.503, 0.49])
def test_each_actuator_is_driven_once_it_is_asked_to_move(asked: float) -> None:
    made = attached()
    assert set(made.holding(Reference.at([asked, 1.0]), HERE)) == {1}
    assert set(made.holding(Reference.at([0.501, 1.0]), HERE)) == {1}, "for good"


def test_one_that_moves_by_itself_is_driven() -> None:
    assert set(attached().holding(Reference.at([0.501, 1.0]), HERE + np.array([0.0, 0.1]))) == {0}


def test_one_that_is_not_measured_is_driven() -> None:
    assert set(attached().holding(Reference.at([0.501, 1.0]), np.array([math.nan, 1.0]))) == {1}


def test_what_a_reference_leaves_out_stays() -> None:
    reference = Reference.at([0.9, 1.9], mask=[False, True])
    assert set(attached().holding(reference, HERE)) == {0}
