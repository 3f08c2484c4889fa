"""Twitching and calibrating on emulated devices."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from rtee.buses.pool import BusPool
from rtee.drivers.axis import VirtualObject
from rtee.drivers.calibration import calibrate
from rtee.drivers.diagnosis.locate import twitch
from rtee.drivers.registry import find_driver
from rtee.errors import CalibrationError, ConfigError, DeviceFault
from rtee.testing import actuator
from rtee.types import DeviceSpec

pytestmark = pytest.mark.anyio


def gripper(driver: str = "robotiq_2f", **options: Any) -> DeviceSpec:
    return DeviceSpec(
        name="gripper",
        hand="hand",
        driver=driver,
        actuators=(actuator("finger_joint", 0.0, 0.8),),
        options=options,
        emulated=True,
    )


async def test_a_hand_twitches_and_ends_where_it_was() -> None:
    async with BusPool() as pool:
        driver = find_driver("robotiq_2f")(gripper(emulator={"position": 100.0}), pool)
        state = await twitch(driver, times=1, period=0.2)
        emulator = pool.played("hand/gripper")
        assert emulator.moves > 1  # type: ignore[attr-defined]
        assert float(state.position[0]) == pytest.approx(97 / 227 * 0.8, abs=0.02)
        assert not pool.buses


async def test_a_device_that_must_be_homed_is_not_twitched_unasked() -> None:
    async with BusPool() as pool:
        driver = find_driver("robotiq_2f")(gripper(emulator={"activated": False}), pool)
        with pytest.raises(DeviceFault, match="not activated"):
            await twitch(driver)
        assert pool.played("hand/gripper").moves == 0  # type: ignore[attr-defined]


async def test_end_stops_are_found_stored_and_used(tmp_path: Path) -> None:
    path = tmp_path / "cal" / "gripper.json"
    told: list[str] = []

    async def ready(text: str) -> None:
        told.append(text)

    emulator = {"open_count": 9, "closed_count": 222, "haste": 8.0}
    async with BusPool(wire_time=False) as pool:
        spec = gripper(emulator=emulator)
        await calibrate(find_driver("robotiq_2f")(spec, pool), path, ready)
    assert "Take everything out" in told[0]
    assert json.loads(path.read_text())["closed_count"] == 222
    async with BusPool(wire_time=False) as pool:
        spec = gripper(emulator={**emulator, "position": 9.0}, calibration=str(path))
        driver = find_driver("robotiq_2f")(spec, pool)
        await driver.configure()
        assert float((await driver.sense()).position[0]) == 0.0
        await driver.close()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "there is no calibration at"),
        ("{", "is not a calibration"),
        (
            '{"model": "2f_140", "unit": 9, "open_count": 3, "closed_count": 230}',
            "made with model 2f_140, not 2f_85",
        ),
        (
            '{"model": "2f_85", "unit": 9, "open_count": 100, "closed_count": 150}',
            "the gripper moved 50",
        ),
    ],
)
async def test_a_calibration_of_another_gripper_is_refused(
    tmp_path: Path, content: str | None, message: str
) -> None:
    path = tmp_path / "gripper.json"
    if content is not None:
        path.write_text(content)
    async with BusPool(wire_time=False) as pool:
        driver = find_driver("robotiq_2f")(gripper(calibration=str(path)), pool)
        with pytest.raises(CalibrationError, match=message):
            await driver.configure()


async def test_something_between_the_fingers_spoils_the_calibration(tmp_path: Path) -> None:
    async def ready(text: str) -> None:
        played = pool.played("hand/gripper")
        played.axis.obstacle = VirtualObject(60, 1e4)  # type: ignore[attr-defined]

    async with BusPool(wire_time=False) as pool:
        driver = find_driver("robotiq_2f")(gripper(emulator={"haste": 8.0}), pool)
        with pytest.raises(CalibrationError, match="is something between the fingers"):
            await calibrate(driver, tmp_path / "x.json", ready)
    assert not (tmp_path / "x.json").exists()


async def test_a_device_without_offsets_says_so(tmp_path: Path) -> None:
    async def ready(text: str) -> None:
        pytest.fail("nothing to be asked")

    async with BusPool() as pool:
        driver = find_driver("onrobot_3fg")(gripper("onrobot_3fg"), pool)
        with pytest.raises(ConfigError, match="needs no calibration"):
            await calibrate(driver, tmp_path / "x.json", ready)
