"""Quantities as people write them."""

from __future__ import annotations

import math

import pytest

from rtee.errors import GoalRejected
from rtee.units import FORCE, LENGTH, SHARE, SPEED, TIME, quantity


@pytest.mark.parametrize(
    ("text", "metres"),
    [
        ("30mm", 0.03),
        ("3cm", 0.03),
        ("0.03", 0.03),
        ("3e-2m", 0.03),
        (" 30 mm ", 0.03),
        (0.03, 0.03),
    ],
)
def test_lengths_are_read_with_and_without_units(text: str | float, metres: float) -> None:
    assert quantity(text, LENGTH, "width") == pytest.approx(metres)


def test_forces_and_speeds_have_units_of_their_own() -> None:
    assert quantity("10N", FORCE, "force") == 10.0
    assert quantity("50mm/s", SPEED, "speed") == pytest.approx(0.05)
    assert quantity("60%", SHARE, "intensity") == pytest.approx(0.6)
    assert quantity("0.6", SHARE, "intensity") == 0.6
    assert quantity("250ms", TIME, "timeout") == 0.25


@pytest.mark.parametrize(
    ("text", "units", "sentence"),
    [
        ("30N", LENGTH, "the width must be a length, such as 30mm, and 'N' is not a unit"),
        ("10mm", FORCE, "and 'mm' is not a unit of one; "),
        ("50mm", SPEED, "and 'mm' is not a unit of one; "),
        ("-3mm", LENGTH, "must not be negative"),
        (-0.03, LENGTH, "must not be negative"),
        ("nan", LENGTH, "must be a length, such as"),
        ("", LENGTH, "must be a length, such as"),
        ("1e999", LENGTH, "not inf"),
        (math.nan, FORCE, "must be a force, such as 10N, not nan"),
        ("10 N N", FORCE, "must be a force, such as 10N"),
        ("3,5mm", LENGTH, "not '3,5mm'; write a decimal point, not a comma"),
        ("30", LENGTH, "the width would be 30 m; write 30mm"),
        (None, FORCE, "must be a force, such as 10N, not None"),
    ],
)
def test_what_does_not_fit_is_one_clear_sentence(
    text: str | float | None, units: dict[str, float], sentence: str
) -> None:
    with pytest.raises(GoalRejected, match=sentence):
        quantity(text, units, "width")  # type: ignore[arg-type]
