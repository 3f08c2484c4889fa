"""Adapters that return what the host sends, as some on two-wire lines do, for every line."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from rtee import monotonic
from rtee.buses.emulator import Emulator
from rtee.buses.pool import BusPool
from rtee.buses.simulated import SimulatedLine
from rtee.drivers.diagnosis.scan import Address, ScanPlan, scan, serial_probes
from rtee.drivers.emulators import make_emulator
from rtee.drivers.schunk_svh.codec import BAUDRATE
from rtee.drivers.schunk_svh.link import SvhLink
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


async def scanned(*, echo: bool) -> tuple[Address, float]:
    """Scan a line on which nothing answers; return how long that takes, too [s]."""
    options = {"emulator": {"echo": echo, "unit": 99}, "port": "/dev/emulated"}
    silent = make_emulator("robotiq_2f", options)
    begin = monotonic.now()
    with SimulatedLine([silent]) as line:
        async with BusPool() as pool:
            [found] = await scan([ScanPlan(line.address, probes=serial_probes([9]))], pool)
    return found, monotonic.now() - begin


async def test_a_scan_of_a_line_that_only_echoes_finds_nothing_and_takes_echoes_for_silence() -> (
    None
):
    found, took = await scanned(echo=True)
    assert found.found == ()
    # In simulated time. If anything but silence, every number of every family is asked again.
    assert took < 3.0 * (await scanned(echo=False))[1]


async def test_a_gripper_without_function_23_is_driven_behind_an_echo() -> None:
    case = suite_of("robotiq_2f").case
    emulated = {**case.options.get("emulator", {}), "echo": True, "functions": (3, 6, 16)}
    async with Session(replace(case, options={**case.options, "emulator": emulated})) as session:
        await session.start()
        goal = list(case.between()[1])
        assert session.near(await session.reach(goal), goal)


async def test_noise_at_the_first_answer_makes_no_echo_of_the_answers_after_it() -> None:
    """An SVH's answer equals its request where all data are zero."""
    hand = make_emulator("schunk_svh", {"emulator": {}, "port": "/dev/emulated"})
    feed, noise = hand.feed, [b"\0"]

    def noisy(data: bytes, now: float) -> list[bytes]:
        return [(noise.pop() if noise else b"") + answer for answer in feed(data, now)]

    hand.feed = noisy  # type: ignore[method-assign]
    with SimulatedLine([hand]) as line:
        async with BusPool() as pool:
            bus = await pool.serial(line.address, owner="x", baudrate=BAUDRATE, fresh=True)
            link = SvhLink(bus, 0.05, 2)
            await link.firmware()
            assert not noise
            await link.state()
            await link.feedback(3)
            await bus.detach("x")


def test_an_echo_is_there_or_not() -> None:
    with pytest.raises(ConfigError, match="echo is 'loud'; write true or false"):
        make_emulator("robotiq_2f", {"emulator": {"echo": "loud"}, "port": "/dev/emulated"})
