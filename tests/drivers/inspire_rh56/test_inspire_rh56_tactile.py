"""The taxels of an RH56DFTP: the map of its registers, and reading them by turns."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtee.buses.pool import BusPool
from rtee.drivers.inspire_rh56.driver import InspireRh56Driver
from rtee.drivers.inspire_rh56.tactile import AREAS, FIRST, LAST, blocks
from rtee.errors import ConfigError
from rtee.hand.frames import origin
from rtee.hand.load import load_hand
from rtee.hand.touch import on_hand
from rtee.hand.urdf import UrdfLink
from rtee.sample import FloatArray
from rtee.testing import actuator
from rtee.touch import TouchReading
from rtee.types import DeviceSpec

pytestmark = pytest.mark.anyio

CONFIG = Path(__file__).resolve().parents[3] / "config"
TCP = {"port": "tcp://192.0.2.1:6000", "model": "dftp", "touch": "all"}


def spec(**options: Any) -> DeviceSpec:
    index = (actuator("index_proximal_joint", 0.0, 1.47, effort=0.7),)
    return DeviceSpec("hand", "h", "inspire_rh56", index, options, 100.0, emulated=True)


@asynccontextmanager
async def reading(**options: Any) -> AsyncIterator[tuple[InspireRh56Driver, Any]]:
    async with BusPool() as pool:
        driver = InspireRh56Driver(spec(**options), pool)
        await driver.configure()
        yield driver, pool.played(driver.spec.owner).memory
        await driver.close()


def press(memory: Any, area: str, taxel: int, value: int) -> None:
    """Let one taxel measure `value`."""
    at = next(a for a in AREAS if a.name == area).address - FIRST + 2 * taxel
    memory.taxels[at : at + 2] = value.to_bytes(2, "little")


async def a_round(driver: InspireRh56Driver) -> list[TouchReading]:
    """Sense as often as it takes to read each taxel once; return the readings."""
    count = len(blocks(driver.options.areas))
    readings = [(await driver.sense()).touch for _ in range(count)]
    return [each for each in readings if each is not None]


def test_the_map_of_registers() -> None:
    places = {area.name: (area.address, area.taxels) for area in AREAS}
    assert places["little_top"] == (3018, 96)
    assert places["little_pad"] == (3210, 80)
    assert [places[f"{f}_tip"][0] for f in ("little", "ring", "middle", "index")] == [
        3000,
        3370,
        3740,
        4110,
    ]
    assert places["index_pad"] == (4320, 80)
    assert places["thumb_middle"] == (4690, 9)
    assert places["palm"] == (4900, 112)
    ends = [area.address + 2 * area.taxels for area in AREAS]
    assert ends[-1] == LAST
    assert all(end <= area.address for end, area in zip(ends, AREAS[1:], strict=False))
    parts = blocks(AREAS)
    assert parts[:3] == ((3000, 105), (3210, 89), (3388, 96))
    assert sum(count for _, count in parts) == 1062
    assert len(parts) == 11
    assert max(count for _, count in parts) <= 125


async def test_taxels_are_read_by_turns_while_the_motors_are() -> None:
    async with reading(**TCP) as (driver, memory):
        assert sum(sensor.taxels for sensor in driver.capabilities.touch) == 1062
        assert {sensor.unit for sensor in driver.capabilities.touch} == {"counts"}
        press(memory, "index_tip", 4, 300)
        press(memory, "palm", 111, 4095)
        [first] = await a_round(driver)
        areas = [area.name for area in AREAS]
        starts = dict(zip(areas, np.cumsum([0, *(a.taxels for a in AREAS)]).tolist(), strict=False))
        assert first.values[starts["index_tip"] + 4] == 300.0
        assert first.values[-1] == 4095.0
        assert first.values.sum() == 4395.0
        press(memory, "index_tip", 4, 0xFFFF)
        later = await a_round(driver)
        assert np.isnan(later[-1].values[starts["index_tip"] + 4]), "no taxel measures that"
        assert first.values.sum() == 4395.0, "what was handed over stays"
        assert later[-1].stamp > first.stamp


async def test_the_tips_alone_take_fewer_turns() -> None:
    async with reading(**{**TCP, "touch": "tips"}) as (driver, _):
        assert len(blocks(driver.options.areas)) == 5
        assert len(driver.capabilities.touch) == 10
        assert len(await a_round(driver)) == 1


@pytest.mark.parametrize("wrong", [{"model": "dfx"}, {"port": "/dev/ttyUSB0"}])
def test_other_hands_have_no_taxels(wrong: dict[str, str]) -> None:
    with pytest.raises(ConfigError, match="touch needs model dftp and Modbus TCP"):
        InspireRh56Driver(spec(**{**TCP, **wrong}), BusPool())


def beyond(link: UrdfLink, points: FloatArray) -> FloatArray:
    """Return how far points in a link's frame are outside its boxes, balls and cylinders [m]."""
    found = np.full(len(points), np.inf)
    for shape in link.collisions:
        frame = origin(shape.xyz, shape.rpy)
        local = (points - frame[:3, 3]) @ frame[:3, :3]
        if shape.kind == "sphere":
            away = np.linalg.norm(local, axis=1) - shape.radius
        else:
            if shape.kind == "cylinder":
                around = np.hypot(local[:, 0], local[:, 1]) - shape.radius
                over = np.stack([around, np.abs(local[:, 2]) - shape.length / 2], axis=1)
            else:
                over = np.abs(local) - np.array(shape.size) / 2
            away = np.linalg.norm(np.maximum(over, 0.0), axis=1) + np.minimum(over.max(axis=1), 0.0)
        found = np.minimum(found, away)
    return found


@pytest.mark.parametrize("which", ["tips", "fingers", "all"])
def test_the_shipped_hand_places_the_taxels_that_the_driver_reads(which: str) -> None:
    hand = load_hand(CONFIG / "inspire_rh56")
    driver = InspireRh56Driver(spec(touch=which, port=TCP["port"], model="dftp"), BusPool())
    names = {"little": "pinky", "palm": ""}
    declared = driver.capabilities.touch
    assert declared
    for sensor in declared:
        placed = on_hand(sensor, hand)
        finger = sensor.name.split("_")[0]
        assert placed.placed
        assert placed.finger == names.get(finger, finger)
        # The unit is not published, so no finger may take its counts for a force.
        assert placed.unit == "counts"
        # Sections are planes; the links' shapes have steps.
        outside = beyond(hand.urdf.links[placed.link], placed.position)
        assert np.abs(outside).max() < 0.004, sensor.name
        # Their normals lead out of the link.
        link = hand.urdf.links[placed.link]
        assert (beyond(link, placed.position + 0.01 * placed.normal) > outside).all()


def test_all_places_of_the_shipped_hand_are_read() -> None:
    hand = load_hand(CONFIG / "inspire_rh56")
    assert set(hand.touch) == {area.name for area in AREAS}
