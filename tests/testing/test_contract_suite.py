"""The contract suite of drivers finds what it is for."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from rtee.drivers.robotiq_2f.driver import Robotiq2FDriver
from rtee.testing import DriverContract, simulated_time
from tests.drivers.robotiq_2f.test_robotiq_2f_contract import HAND_E, RTU


@pytest.fixture
def anyio_backend() -> tuple[str, dict[str, Any]]:
    return simulated_time()


async def nothing(*_: object) -> None:
    """Do nothing."""


@pytest.mark.anyio
@pytest.mark.parametrize(
    ("broken", "test"),
    [
        ("move", "test_a_posture_is_reached_and_measured"),
        ("move", "test_stop_stops"),
        ("move", "test_stop_stops_though_answers_get_lost"),
        ("stop", "test_stop_stops"),
    ],
)
async def test_a_bad_driver_fails(broken: str, test: str, monkeypatch: pytest.MonkeyPatch) -> None:
    class Suite(DriverContract):
        case = replace(RTU, within=1.0)

    monkeypatch.setattr(Robotiq2FDriver, broken, nothing)
    with pytest.raises(AssertionError):
        await getattr(Suite(), test)()


def test_postures_that_a_tolerance_cannot_tell_apart_are_refused() -> None:
    with pytest.raises(ValueError, match=r"'left_finger_joint' are 0.0125 apart, .* as 0.0006"):
        replace(HAND_E, tolerance=0.02)
