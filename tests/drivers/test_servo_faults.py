"""What a servo's fault tells people to do."""

from __future__ import annotations

from enum import IntFlag

import pytest

from rtee.drivers.dynamixel.codec import Hardware
from rtee.drivers.feetech.codec import Status
from rtee.drivers.servo_lines import fault_of


@pytest.mark.parametrize(
    ("error", "hint"),
    [
        (Hardware.OVERHEATING, "let it cool down, then it reboots"),
        (Status.OVERHEATING, "let it cool down, then it reboots"),
        (Hardware.INPUT_VOLTAGE, "check its supply, then it reboots"),
        (Status.VOLTAGE, "check its supply, then it reboots"),
        (Hardware.OVERLOAD, "free the hand, then it reboots"),
        (
            Status.VOLTAGE | Status.OVERLOAD,
            "check its supply and free the hand, then it reboots",
        ),
        (Status(0), "free the hand and check its supply, then it reboots"),
    ],
)
def test_it_names_the_cure_of_the_error(error: IntFlag, hint: str) -> None:
    assert fault_of("hand", {1: "a"}, {1: error}, "it reboots").hint == hint
