"""Options of devices that no device can have: other units, ends of a range that are one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from rtee.buses.pool import BusPool
from rtee.drivers.options import read_options
from rtee.drivers.registry import find_driver
from rtee.errors import ConfigError
from rtee.testing import actuator
from rtee.types import DeviceSpec

JAW = actuator("jaw", 0.0, 0.8)


def spec(driver: str, options: dict[str, Any]) -> DeviceSpec:
    return DeviceSpec("d", "h", driver, (JAW,), options, source="hand.yaml:3")


@pytest.mark.parametrize(
    ("driver", "options", "told"),
    [
        ("dynamixel", {"servos": {"jaw": {"id": 1}}, "current": 550}, "'current'"),  # mA
        ("dynamixel", {"servos": {"jaw": {"id": 1}}, "turnaround": 2}, "'turnaround'"),  # ms
        ("dynamixel", {"servos": {"jaw": {"id": 1}}, "outside": 20}, "'outside'"),  # degrees
        ("schunk_egu", {"speed": 20}, "'speed'"),  # mm/s
        ("schunk_egu", {"step": 3}, "'step'"),  # mm
        ("schunk_egu", {"settle": 100}, "'settle'"),  # ms
        ("wsg50", {"step": 5}, "'step'"),
        ("onrobot_rg", {"step": 5}, "'step'"),
        ("onrobot_3fg", {"largest": 150}, "'largest'"),
        ("inspire_rh56", {"travel_time": 300}, "'travel_time'"),
        ("inspire_rh56", {"forces": {"index": {"arm": 60}}}, "'forces.index.arm'"),
        ("linkerhand", {"ranges": {"index": [0, 26.8]}}, "'ranges.index.1'"),
        ("linkerhand", {"spacing": 30}, "'spacing'"),
        ("schunk_svh", {"channels": {"Pinky": {"current_limit": 500}}}, "current_limit'"),
        (
            "schunk_svh",
            {"channels": {"Pinky": {"min_offset": 100, "max_offset": 100}}},
            "'channels.Pinky': 'min_offset' 100 should be below 'max_offset' 100",
        ),
        ("cia402", {"nodes": {"jaw": {"id": 5, "counts": 0}}}, "'nodes.jaw.counts': should not be"),
        ("robotiq_2f", {"open_count": 50, "closed_count": 50}, "'closed_count': 50 should be"),
        ("robotiq_2f", {"open_count": 230, "closed_count": 3}, "counts rise while it closes"),
    ],
)
def test_it_is_refused(driver: str, options: dict[str, Any], told: str) -> None:
    kind = find_driver(driver).Options
    assert kind is not None
    with pytest.raises(ConfigError, match=r"hand\.yaml:3: device 'd': option") as caught:
        read_options(kind, spec(driver, options))
    assert told in str(caught.value)


def test_a_condition_on_options_from_two_places_names_both() -> None:
    given = replace(spec("ability_hand", {"mode": "current", "reply": 1}), overridden=("reply",))
    kind = find_driver("ability_hand").Options
    assert kind is not None
    with pytest.raises(ConfigError, match=r"^hand\.yaml:3 with --option reply: device 'd': opt"):
        read_options(kind, given)


def test_an_unknown_name_in_an_option_of_the_command_line() -> None:
    for option, overridden, place in (
        ("start", ("start",), "--option start"),
        ("objects", (), "hand.yaml:3"),
    ):
        given = replace(spec("kinematic", {option: {"jav": 0.5}}), overridden=overridden)
        told = (
            f"{place}: device 'd': unknown name 'jav' in its option '{option}'; did you mean 'jaw'?"
        )
        with pytest.raises(ConfigError) as caught:
            find_driver("kinematic")(given, BusPool())
        assert str(caught.value) == told


@pytest.mark.parametrize("position", [45.0, 0.0, -0.8])
def test_a_gripper_is_closed_within_the_travel_of_its_actuator(position: float) -> None:
    given = spec("robotiq_2f", {"closed_position": position})
    with pytest.raises(ConfigError, match=r"'closed_position' is .* closes to 0\.8"):
        find_driver("robotiq_2f")(given, BusPool())
    # Models round their limits.
    find_driver("robotiq_2f")(spec("robotiq_2f", {"closed_position": 0.82}), BusPool())
