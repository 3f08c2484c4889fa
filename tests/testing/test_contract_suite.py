"""The contract suite of drivers finds what it is for."""

from __future__ import annotations

import ast
import inspect
from dataclasses import replace
from typing import Any

import pytest

from rtee.drivers.robotiq_2f.driver import Robotiq2FDriver
from rtee.testing import DriverContract, contract, session, simulated_time
from tests.drivers.robotiq_2f.test_robotiq_2f_contract import HAND_E, RTU


@pytest.fixture
def anyio_backend() -> tuple[str, dict[str, Any]]:
    return simulated_time()


async def nothing(*_: object) -> None:
    """Do nothing."""


@pytest.mark.anyio
@pytest.mark.parametrize(
    ("broken", "test", "sentence"),
    [
        ("move", "test_a_posture_is_reached_and_measured", "it does not get where it is sent: "),
        ("move", "test_stop_stops", r"it does not get where it is sent: \[0.0\] is measured, not "),
        ("move", "test_stop_stops_though_answers_get_lost", "it does not get where it is sent: "),
        ("stop", "test_stop_stops", "it went on to where it was sent"),
        ("close", "test_close_is_idempotent_in_any_state", "the driver has not detached from"),
    ],
)
async def test_a_bad_driver_fails_and_is_told_why(
    broken: str, test: str, sentence: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Suite(DriverContract):
        case = replace(RTU, within=1.0)

    monkeypatch.setattr(Robotiq2FDriver, broken, nothing)
    with pytest.raises(AssertionError, match=sentence):
        await getattr(Suite(), test)()


def test_every_failure_of_the_suite_has_a_sentence() -> None:
    for module in (contract, session):
        tree = ast.parse(inspect.getsource(module))
        bare = [n.lineno for n in ast.walk(tree) if isinstance(n, ast.Assert) and n.msg is None]
        assert bare == [], f"{module.__name__} asserts without a message in these lines"


def test_postures_that_a_tolerance_cannot_tell_apart_are_refused() -> None:
    with pytest.raises(ValueError, match=r"'left_finger_joint' are 0.0125 apart, .* as 0.0006"):
        replace(HAND_E, tolerance=0.02)
