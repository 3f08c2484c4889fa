"""Simulated taxels lie on the pads, and their sum is the force on the fingertip."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")

from rtee.buses.pool import BusPool
from rtee.drivers.mujoco.driver import MujocoDriver
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import make_simulation
from rtee.drivers.mujoco.simulation import Simulation
from rtee.hand.load import hand_folder, load_hand
from rtee.types import DeviceSpec

pytestmark = pytest.mark.anyio

GRIPPER = "robotiq_2f_85"


async def active(**options: object) -> MujocoDriver:
    actuators = load_hand(GRIPPER).actuators
    folder = str(hand_folder(GRIPPER)[0])
    spec = DeviceSpec("sim", GRIPPER, "mujoco", actuators, options, 200.0, folder=folder)
    driver = MujocoDriver(spec, BusPool())
    await driver.configure()
    await driver.activate()
    return driver


def gripping(touch: str, name: str | Path = GRIPPER) -> Simulation:
    hand = load_hand(name)
    options = SimOptions(touch=touch, object="sphere:0.03", support="floating")
    simulation = make_simulation(hand, options, hand.actuator_names, 0.002)
    everything = np.ones(len(hand.actuators), dtype=bool)
    far = np.array([actuator.farthest for actuator in hand.actuators])
    simulation.command(far, np.full(len(far), np.inf), everything)
    for _ in range(700):
        simulation.advance()
    return simulation


@pytest.mark.parametrize("touch", ["1x1", "4x4"])
def test_the_taxels_of_a_tip_add_up_to_the_force_on_it(touch: str) -> None:
    simulation = gripping(touch)
    left, right = simulation.taxels.sensors
    values = simulation.taxels.read(simulation.data)
    assert left.taxels == right.taxels == len(values) / 2
    forces = values.reshape(2, -1).sum(axis=1)
    assert simulation.contact_forces.min() > 10.0
    # The rest of the contact's force is friction along the pad.
    assert forces == pytest.approx(simulation.contact_forces, rel=0.05)
    if touch == "4x4":
        pressed = values.reshape(2, 4, 4)
        assert pressed[:, 1:3, 1:3].sum() > 0.5 * pressed.sum(), "a sphere presses on the middle"


@pytest.mark.parametrize("name", [GRIPPER, "schunk_svh", "robotiq_3f"])
def test_taxels_lie_on_the_tips_surface_and_look_outwards(name: str) -> None:
    hand = load_hand(name)
    simulation = make_simulation(hand, SimOptions(touch="3x2"), hand.actuator_names, 0.002)
    assert [sensor.finger for sensor in simulation.taxels.sensors] == list(hand.finger_names)
    for sensor in simulation.taxels.sensors:
        assert sensor.placed
        assert np.linalg.norm(sensor.normal, axis=1) == pytest.approx(np.ones(6))
        # All on one side: a plane through the tip's middle has none behind it.
        facing = sensor.normal.mean(axis=0)
        assert (sensor.normal @ facing > 0.0).all()
        assert len(np.unique(sensor.position.round(6), axis=0)) == 6


async def test_readings_come_at_their_own_rate() -> None:
    driver = await active(touch="2x2", touch_rate=50.0)
    readings = [(await driver.sense()).touch for _ in range(20)]
    assert len({id(reading) for reading in readings}) == 5, "every fourth exchange of 200 Hz"
    state = await driver.sense()
    assert "contact_force" not in state.extras, "it feels with its taxels"
    assert [s.name for s in driver.capabilities.touch] == ["finger_1_tip", "finger_2_tip"]


async def test_without_taxels_all_contacts_are_felt() -> None:
    driver = await active()
    state = await driver.sense()
    assert state.touch is None
    assert "contact_force" in state.extras


def test_sensors_of_hand_yaml_are_simulated_in_newtons(tmp_path: Path) -> None:
    home = tmp_path / GRIPPER
    shutil.copytree(hand_folder(GRIPPER)[0], home)
    file = home / "hand.yaml"
    place = "link: left_inner_finger_pad, xyz: [0, -0.0032, 0], rpy: [1.5708, 0, 0]"
    text = f"\ntouch:\n  left: {{{place}, grid: [2, 2], pitch: [0.01, 0.01], scale: 0.01}}\n"
    file.write_text(file.read_text() + text)
    simulation = gripping("hand", home)
    values = simulation.taxels.read(simulation.data)
    assert values.sum() == pytest.approx(simulation.contact_forces[0], rel=0.05)
