"""Adapters that return what the host sends, as some on two-wire lines do, for every line."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from rtee.buses.emulator import Emulator
from rtee.buses.pool import BusPool
from rtee.buses.simulated import SimulatedLine
from rtee.drivers.diagnosis.scan import ScanPlan, scan, serial_probes
from rtee.drivers.emulators import make_emulator
from rtee.errors import ConfigError
from rtee.testing import Session
from tests.drivers.test_worn_contract import suite_of

pytestmark = pytest.mark.anyio

LINES = [
    "ability_hand", "dynamixel", "feetech", "inspire_rh56", "linkerhand", "onrobot_rg",
    "qb_softhand", "robotiq_2f", "robotiq_3f", "schunk_egu", "schunk_svh",
]  # fmt: skip
"""The families on serial lines whose devices move."""


def echoing(name: str, **properties: Any) -> Emulator:
    return make_emulator(name, {"emulator": {"echo": True, **properties}, "port": "/dev/emulated"})


@pytest.mark.parametrize("family", LINES)
@pytest.mark.parametrize("wear", ["ideal", "worn"])
async def test_a_driver_takes_no_echo_for_an_answer(family: str, wear: str) -> None:
    case = suite_of(family).case
    emulated = {"echo": True, "wear": wear, **case.options.get("emulator", {})}
    async with Session(replace(case, options={**case.options, "emulator": emulated})) as session:
        await session.start()
        near, far = case.between()
        for goal in (far, near):
            state = await session.reach(list(goal))
            # A worn device stops at some distance, but nowhere near the other posture.
            for at, a, b in zip(
                state.position.tolist(), goal, far if goal == near else near, strict=True
            ):
                assert abs(at - a) <= max(2.0 * case.tolerance, 0.1 * abs(a - b))


@pytest.mark.parametrize(
    ("name", "properties", "what"),
    [
        ("schunk_svh", {}, "SCHUNK SVH, firmware"),
        ("qb_softhand", {"device": 3}, "qb SoftHand, device 3"),
        ("robotiq_2f", {}, "Robotiq 2-finger gripper, unit 9"),
        ("feetech", {"family": "scs", "ids": [4]}, "SCS0009, id 4"),
        ("dynamixel", {"ids": [4]}, "XL330-M288, id 4"),
    ],
)
async def test_a_scan_finds_the_device_behind_an_echo(
    name: str, properties: dict[str, Any], what: str
) -> None:
    with SimulatedLine([echoing(name, **properties)], strict=True) as line:
        async with BusPool() as pool:
            [found] = await scan([ScanPlan(line.address, probes=serial_probes([9]))], pool)
    assert len(found.found) == 1, found
    assert found.found[0].what.startswith(what)


async def test_a_scan_finds_nothing_on_a_line_that_only_echoes() -> None:
    silent = echoing("robotiq_2f", unit=99)
    with SimulatedLine([silent]) as line:
        async with BusPool() as pool:
            [found] = await scan([ScanPlan(line.address, probes=serial_probes([9]))], pool)
    assert found.found == ()


def test_an_echo_is_there_or_not() -> None:
    with pytest.raises(ConfigError, match="echo is 'loud'; write true or false"):
        make_emulator("robotiq_2f", {"emulator": {"echo": "loud"}, "port": "/dev/emulated"})
