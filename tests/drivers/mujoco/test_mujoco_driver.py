"""The driver steps in lockstep, takes gains and limits, and ends where the kinematic one does."""

from __future__ import annotations

import asyncio
import os
import threading
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")

from rtee import monotonic
from rtee.buses.pool import BusPool
from rtee.drivers.mujoco.driver import MujocoDriver
from rtee.drivers.mujoco.simulation import Simulation
from rtee.drivers.registry import find_driver
from rtee.errors import CommandRejected, ConfigError, DeviceFault, NotConnected
from rtee.hand.load import hand_folder, load_hand
from rtee.sample import ActuatorState
from rtee.types import DeviceSpec, Reference

pytestmark = pytest.mark.anyio

GRIPPER = "robotiq_2f_85"


def make(name: str = GRIPPER, rate: float = 200.0, **options: object) -> MujocoDriver:
    hand = load_hand(name)
    folder = str(hand_folder(name)[0])
    spec = DeviceSpec("sim", name, "mujoco", hand.actuators, options, rate, folder=folder)
    return MujocoDriver(spec, BusPool())


async def active(**options: object) -> MujocoDriver:
    driver = make(**options)
    await driver.configure()
    await driver.activate()
    return driver


async def run(driver: MujocoDriver, reference: Reference, exchanges: int) -> np.ndarray:
    for _ in range(exchanges):
        state = await driver.sense()
        await driver.move(reference)
    return state.position


def test_it_is_found_by_name() -> None:
    assert find_driver("mujoco") is MujocoDriver


async def test_before_configure_there_is_nothing_to_measure() -> None:
    with pytest.raises(NotConnected):
        await make().sense()


async def test_an_effort_limit_that_is_assumed_is_told_once_and_stated_where_that_says(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "rod"
    folder.mkdir()
    (folder / "rod.urdf").write_text(
        '<robot name="rod"><link name="base"/><link name="rod"><inertial><mass value="0.1"/>'
        '<inertia ixx="1e-4" ixy="0" ixz="0" iyy="1e-4" iyz="0" izz="1e-4"/></inertial>'
        '<collision><geometry><sphere radius="0.01"/></geometry></collision></link>'
        '<joint name="turn" type="revolute"><parent link="base"/><child link="rod"/>'
        '<axis xyz="0 1 0"/><limit lower="-1" upper="1" velocity="2"/></joint></robot>'
    )
    told = []
    for limits in ("", "limits:\n  turn: {effort: 0.5}\n"):
        (folder / "hand.yaml").write_text(f"name: rod\nurdf: rod.urdf\n{limits}")
        caplog.clear()
        driver = make(str(folder))
        await driver.configure()
        warnings = [r.getMessage() for r in caplog.records if r.levelname == "WARNING"]
        told.append((driver.simulation.effort_limit[0], warnings))
    (limit, (warning,)), stated = told
    assert limit == 10.0
    assert "no effort limit for actuator turn; 10 N·m is assumed" in warning
    assert f"state it under limits: in {folder / 'hand.yaml'}, as turn: {{effort: …}}" in warning
    assert stated == (0.5, [])


async def test_a_simulation_that_blows_up_is_a_fault_until_it_is_begun_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    driver = await active()
    rest = (await driver.sense()).position
    moved = await run(driver, Reference.at(rest + 0.3), 60)
    driver.simulation.data.qvel[0] = 1e30
    with pytest.raises(DeviceFault, match="became unstable and was restarted"):
        await driver.sense()
    assert "The simulation is unstable" in caplog.text
    assert os.listdir(tmp_path) == [], "MuJoCo's own log"
    await driver.recover()
    await driver.activate()
    again = (await driver.sense()).position
    assert np.abs(moved - rest).max() > 0.1
    assert again == pytest.approx(rest, abs=0.02)
    assert (await run(driver, Reference.at(rest + 0.3), 60)) == pytest.approx(moved, abs=0.02)


async def test_an_exchange_takes_one_period_of_simulated_time() -> None:
    driver = await active(rate=150.0)
    for _ in range(30):
        await driver.sense()
    assert driver.simulation.time == pytest.approx(30 / 150.0)


async def test_missed_exchanges_are_made_up_for() -> None:
    driver = await active(rate=100.0)

    def due(*times: float) -> list[int]:
        """Return by how many periods exchanges at some times [periods] advance."""
        return [driver._due(0.01 * time) for time in times]

    assert due(0, 1, 2, 4, 5) == [1, 1, 1, 2, 1]
    assert due(6.4, 7, 7.6, 9) == [1, 1, 1, 1], "only late"
    assert due(10, 12.5, 13.5, 15) == [1, 2, 1, 2], "half a period late each time"
    assert due(1000, 1001) == [4, 1], "a freeze of the computer is no motion"
    driver._cost = 0.008
    assert due(1005, 1006) == [1, 1], "a slow simulation would only be later still"
    driver._cost = 0.0
    await driver.activate()
    assert due(5000, 5001) == [1, 1]


async def test_exchanges_that_were_given_up_never_overlap_with_another() -> None:
    driver = await active()
    simulation, inside, overlaps = driver.simulation, threading.Event(), 0
    advance = simulation.advance

    def slow_advance() -> None:
        nonlocal overlaps
        overlaps += inside.is_set()
        inside.set()
        time.sleep(0.05)
        advance()
        inside.clear()

    simulation.advance = slow_advance  # type: ignore[method-assign]
    driver._cost = 1.0  # a step that takes so long runs in a thread
    for _ in range(3):
        given_up = asyncio.ensure_future(driver.sense())
        await asyncio.sleep(0.01)
        given_up.cancel()
        await asyncio.wait([given_up])
    measured = driver._measured

    def measuring(of: Simulation) -> ActuatorState:
        nonlocal overlaps
        overlaps += inside.is_set()
        time.sleep(0.03)
        overlaps += inside.is_set()
        return measured(of)

    driver._measured = measuring  # type: ignore[method-assign]
    await driver.sense()
    assert not overlaps


async def test_a_late_exchange_advances_further(monkeypatch: pytest.MonkeyPatch) -> None:
    driver, now = await active(rate=100.0), [50.0]
    # Undone before the event loop ends, which gives the clock back itself.
    with monkeypatch.context() as patch:
        patch.setattr(monotonic, "now", lambda: now[0])
        await driver.sense()
        for _ in range(10):
            now[0] += 0.03
            await driver.sense()
    assert driver.simulation.time == pytest.approx(0.31)


async def test_a_reference_is_reached_and_measured() -> None:
    driver = await active()
    assert (await run(driver, Reference.at([0.4]), 200))[0] == pytest.approx(0.4, abs=0.01)
    state = await driver.sense()
    assert abs(state.velocity[0]) < 0.05
    assert np.isfinite(state.effort[0])
    assert np.isnan(state.current[0])
    assert state.extras["contact_force"] == pytest.approx([0.0, 0.0], abs=1e-9)


async def test_effort_limits_hold() -> None:
    driver = await active()
    reference = Reference.at([0.8], max_effort=[0.3])
    for _ in range(50):
        state = await driver.sense()
        assert abs(state.effort[0]) <= 0.3 + 1e-9
        await driver.move(reference)


async def test_actuators_outside_the_mask_keep_their_reference() -> None:
    driver = await active()
    await driver.move(Reference.at([0.5], mask=[False]))
    assert (await run(driver, Reference.at([0.5], mask=[False]), 100))[0] == pytest.approx(
        0.0, abs=0.01
    )


async def test_stop_holds_and_release_lets_go() -> None:
    driver = await active()
    await run(driver, Reference.at([0.8]), 20)
    await driver.stop()
    stopped = (await driver.sense()).position[0]
    for _ in range(100):
        held = (await driver.sense()).position[0]
    assert 0.0 < held < 0.7
    assert held == pytest.approx(stopped, abs=0.1)
    await driver.disable()
    for _ in range(5):
        assert (await driver.sense()).effort[0] == 0.0


async def test_gains_are_tuned_while_it_runs() -> None:
    driver = await active()
    stiff = await run(driver, Reference.at([0.2]), 10)
    assert driver.capabilities.gains == ("kp.finger_joint", "ki.finger_joint", "kd.finger_joint")
    weak = await active()
    await weak.set_gains({"kp.finger_joint": 0.5, "kd.finger_joint": 1.0})
    assert (await run(weak, Reference.at([0.2]), 10))[0] < stiff[0]


async def test_a_gain_does_not_power_a_limp_hand() -> None:
    driver = await active()
    await driver.disable()
    await driver.set_gains({"kp.finger_joint": 100.0})
    await driver.move(Reference.at([0.5]))
    assert (await driver.sense()).effort[0] == 0.0
    await driver.activate()
    assert (await run(driver, Reference.at([0.5]), 300))[0] == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize(("name", "value"), [("kp.nothing", 1.0), ("kp.finger_joint", -1.0)])
async def test_a_wrong_gain_is_rejected(name: str, value: float) -> None:
    driver = await active()
    with pytest.raises(CommandRejected, match=name):
        await driver.set_gains({name: value})


async def test_an_object_is_held_until_it_is_gripped() -> None:
    driver = await active(object="sphere:0.025")
    before = (await driver.sense()).extras["object_pose"]
    for _ in range(100):
        waiting = (await driver.sense()).extras["object_pose"]
    assert waiting[:3] == pytest.approx(before[:3], abs=1e-3)
    assert not driver.simulation.surroundings.unsupported
    await run(driver, Reference.at([0.8], max_effort=[5.0]), 400)
    state = await driver.sense()
    assert driver.simulation.surroundings.unsupported
    assert state.extras["contact_force"].min() > 1.0
    assert state.position[0] < 0.75
    assert np.linalg.norm(state.extras["object_pose"][:3] - before[:3]) < 0.03


async def test_without_gripping_it_falls_when_released() -> None:
    driver = await active(object="box:0.02x0.02x0.02")
    before = (await driver.sense()).extras["object_pose"]
    driver.simulation.surroundings.remove_support()
    for _ in range(20):
        state = await driver.sense()
    assert state.extras["object_pose"][2] < before[2] - 0.02


async def test_what_is_no_object_is_refused() -> None:
    with pytest.raises(ConfigError, match="'banana' is not an object"):
        await make(object="banana").configure()


async def test_an_object_for_which_the_hand_has_no_room_is_told(
    caplog: pytest.LogCaptureFixture,
) -> None:
    await make(object="sphere:0.03").configure()
    assert "overlaps" not in caplog.text
    await make(object="sphere:0.1").configure()
    assert "'sphere:0.1' overlaps the open hand wherever it is put" in caplog.text


async def test_two_runs_are_equal_bit_for_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    # As where the loop keeps its rate: a late exchange would make up for what it missed.
    monkeypatch.setattr(MujocoDriver, "_due", lambda *_: 1)
    ends = []
    for _ in range(2):
        driver = await active(object="sphere:0.02")
        await run(driver, Reference.at([0.8]), 150)
        ends.append(driver.simulation.data.qpos.tobytes())
    assert ends[0] == ends[1]


async def test_close_forgets_and_configure_starts_anew() -> None:
    driver = await active()
    await run(driver, Reference.at([0.5]), 100)
    await driver.close()
    await driver.close()
    await driver.configure()
    await driver.activate()
    assert (await driver.sense()).position[0] == pytest.approx(0.0, abs=1e-3)


async def test_an_object_stands_on_the_table_and_is_lifted_by_the_carrier() -> None:
    driver = await active(object="box:0.04x0.04x0.12", support="table", carrier="lift")
    simulation, around = driver.simulation, driver.simulation.surroundings
    start = around.pose
    for _ in range(100):
        await driver.sense()
    assert around.unsupported
    assert around.pose[:3] == pytest.approx(start[:3], abs=2e-3)
    await run(driver, Reference.at([0.8], max_effort=[5.0]), 300)
    assert around.touching()
    for step in range(200):
        around.carry(np.array([0.0, 0.0, 0.1 * step / 200, 0.0, 0.0, 0.0]))
        await driver.sense()
    assert around.pose[2] > start[2] + 0.07
    assert simulation.surroundings.base_pose[2, 3] == pytest.approx(0.1, abs=0.01)
