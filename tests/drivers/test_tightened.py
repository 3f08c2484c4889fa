"""Limits of hand.yaml bound the references; they don't stretch the scales of devices' counts."""

from __future__ import annotations

import asyncio
import math
import shutil
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest
import yaml

from rtee.buses.pool import BusPool
from rtee.buses.simulated_time import SimulatedTimeLoop
from rtee.drivers.base import Driver
from rtee.drivers.heri_ethercat.codec import TORQUE_PER_AMPERE
from rtee.drivers.registry import find_driver
from rtee.running.prepare import RunOptions, prepare
from rtee.sample import ActuatorState, FloatArray
from rtee.types import DeviceSpec, Reference

pytestmark = pytest.mark.anyio
CONFIG = Path(__file__).parents[2] / "config"
HANDS = sorted(path.parent.name for path in CONFIG.glob("*/hand.yaml"))
# One of each kind: jaws, their linkage, servos, torques, tendons, fingers with motors of their own.
SAMPLES = ("schunk_egu", "robotiq_2f_85", "amazing_hand", "allegro", "heri_ii", "linkerhand_o6")


def devices(folder: Path) -> list[DeviceSpec]:
    options = RunOptions(driver="devices", emulated=True, ideal=True, rate=100.0)
    return [device.spec for device in prepare(str(folder), options).devices]


def tightened(name: str, tmp_path: Path) -> list[DeviceSpec]:
    """Return the devices of a hand with narrower limits and half the effort in its hand.yaml."""
    folder = tmp_path / name
    # Without its actions, whose set-points lie outside the narrower limits.
    shutil.copytree(CONFIG / name, folder, ignore=shutil.ignore_patterns("actions"))
    file = folder / "hand.yaml"
    text = yaml.safe_load(file.read_text("utf-8"))
    limits, rest = text.setdefault("limits", {}), text.setdefault("rest", {})
    for spec in devices(CONFIG / name):
        for actuator in spec.actuators:
            span = actuator.upper - actuator.lower
            lower, upper = actuator.lower + 0.2 * span, actuator.upper - 0.3 * span
            limits.setdefault(actuator.name, {}).update(lower=lower, upper=upper)
            if math.isfinite(actuator.effort):
                limits[actuator.name]["effort"] = actuator.effort / 2.0
            rest[actuator.name] = lower
    file.write_text(yaml.safe_dump(text), "utf-8")
    return devices(folder)


@asynccontextmanager
async def configured(spec: DeviceSpec) -> AsyncIterator[tuple[Driver, Any]]:
    """Yield a configured driver and its emulator."""
    async with BusPool() as pool:
        driver = find_driver(spec.driver)(spec, pool)
        try:
            await driver.configure()
            yield driver, pool.played(spec.owner)
        finally:
            await driver.close()


async def measured(spec: DeviceSpec) -> ActuatorState:
    async with configured(spec) as (driver, _):
        return await driver.sense()


@pytest.mark.samples(*SAMPLES)
@pytest.mark.parametrize("name", HANDS)
async def test_a_device_measures_the_same_with_tighter_limits(name: str, tmp_path: Path) -> None:
    for before, after in zip(devices(CONFIG / name), tightened(name, tmp_path), strict=True):
        assert after.actuators[0].upper < before.actuators[0].upper
        usual, tight = await measured(before), await measured(after)
        np.testing.assert_allclose(tight.position, usual.position, atol=2e-3)


async def test_half_the_effort_in_hand_yaml_is_half_the_torque_of_a_motor(tmp_path: Path) -> None:
    [spec] = tightened("linkerhand_o6", tmp_path)
    full = [actuator.effort for actuator in spec.actuators]
    async with configured(spec) as (driver, emulator):
        await driver.activate()
        upper = [actuator.upper for actuator in spec.actuators]
        await driver.move(Reference.at(upper, max_effort=full))
        # 255 is the full torque.
        assert emulator.begun == [128] * 6


async def test_boards_of_heri_are_told_the_limit_of_hand_yaml() -> None:
    options = RunOptions(driver="heri_ethercat", emulated=True, ideal=True, rate=100.0)
    [device] = prepare(str(CONFIG / "heri_ii"), options).devices
    spec = device.spec
    efforts = [actuator.effort for actuator in spec.actuators]
    assert efforts == [3.3] * 4, "the URDF has 5.3 N·m, for a moment"
    async with configured(spec) as (driver, emulator):
        await driver.activate()
        upper = [actuator.upper for actuator in spec.actuators]
        await driver.move(Reference.at(upper, max_effort=efforts))
        limits = [motor.max_effort for board in emulator.boards for motor in board.motors]
        assert limits == pytest.approx([3.3 / TORQUE_PER_AMPERE] * 4, rel=1e-3)


async def stands(driver: Driver, reference: Sequence[float]) -> FloatArray:
    """Return where actuators are [rad | m] after a second of references to a place."""
    for _ in range(100):
        await driver.sense()
        await driver.move(Reference.at(reference))
        await anyio.sleep(0.01)
    return (await driver.sense()).position


@pytest.mark.samples(*SAMPLES)
@pytest.mark.parametrize("name", HANDS)
def test_what_stands_outside_the_limits_of_hand_yaml_stays_there(name: str, tmp_path: Path) -> None:
    async def stay(spec: DeviceSpec) -> None:
        async with configured(spec) as (driver, _):
            if await driver.examine():
                await driver.recover()
            await driver.activate()
            lower, upper = np.array([(each.lower, each.upper) for each in spec.actuators]).T
            before = (await driver.sense()).position
            if ((lower <= before) & (before <= upper)).all():  # where the emulator begins
                before = await stands(driver, [spec.mechanism(a).lower for a in spec.actuators])
            assert ((before < lower) | (before > upper)).any()
            # A little further: no reference that the device has already.
            onward = before + 0.02 * (upper - lower) * np.where(before < lower, 1.0, -1.0)
            after = await stands(driver, onward)
            assert (np.abs(after - onward) < 0.1 * (upper - lower)).all()

    specs = tightened(name, tmp_path)
    if name == "heri_ii":  # over its boards' wire, too
        options = RunOptions(driver="heri_ethercat", emulated=True, ideal=True, rate=100.0)
        specs += [device.spec for device in prepare(str(tmp_path / name), options).devices]
    for spec in specs:
        with asyncio.Runner(loop_factory=SimulatedTimeLoop) as runner:
            runner.run(stay(spec))


@pytest.mark.parametrize("name", ["robotiq_2f_85", "inspire_rh56"])
async def test_hand_yaml_gives_a_continuous_joint_its_ends(name: str, tmp_path: Path) -> None:
    folder = tmp_path / name
    shutil.copytree(CONFIG / name, folder)
    file = folder / "hand.yaml"
    text = yaml.safe_load(file.read_text("utf-8"))
    [urdf] = folder.glob("*.urdf")
    model = urdf.read_text("utf-8")
    [usual] = devices(CONFIG / name)
    for actuator in usual.actuators:
        text.setdefault("limits", {}).setdefault(actuator.name, {}).update(
            lower=actuator.lower, upper=actuator.upper
        )
        before = f'<joint name="{actuator.name}" type="revolute"'
        assert before in model
        model = model.replace(before, before.replace("revolute", "continuous"))
    file.write_text(yaml.safe_dump(text), "utf-8")
    urdf.write_text(model, "utf-8")
    [turning] = devices(folder)
    np.testing.assert_allclose((await measured(turning)).position, (await measured(usual)).position)
