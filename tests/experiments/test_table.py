"""The table of conditions: what it says, and that the page keeps the rows of other experiments."""

from __future__ import annotations

import pytest

pytest.importorskip("mujoco")

from experiments.__main__ import BEGIN, END, EXPERIMENTS, PAGE, rows_of, written
from experiments.common import Outcome


def outcome_of(value: float) -> Outcome:
    outcome = Outcome("small")
    outcome.below("the error", value, 1.0, "mm")
    return outcome


def test_a_value_at_its_limit_does_not_pass() -> None:
    assert outcome_of(0.9).passed
    assert not outcome_of(1.0).passed
    assert not outcome_of(float("nan")).passed


def test_only_the_rows_of_what_was_run_are_replaced() -> None:
    page = written(
        f"before\n{BEGIN}\n{END}\nafter\n",
        {"svh": rows_of("svh", outcome_of(0.1)), "drill": rows_of("drill", outcome_of(0.2))},
    )
    again = written(page, {"svh": rows_of("svh", outcome_of(2.0))})
    assert again.startswith("before\n")
    assert again.endswith("after\n")
    assert "| svh | the error | 2.0 mm | < 1 mm | NO |" in again
    assert "| svh | the error | 0.1 mm" not in again
    assert "| drill | the error | 0.2 mm | < 1 mm | yes |" in again
    assert written(again, {}) == again


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_the_page_names_every_experiment(name: str) -> None:
    assert f"python -m experiments.{name}" in PAGE.read_text()
