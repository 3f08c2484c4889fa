"""Contacts are hard, friction is what is asked for, and what Coulomb holds is held."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from typer.testing import CliRunner

from rtee.cli._common import app_of
from rtee.cli.run import run
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import make_simulation
from rtee.drivers.mujoco.simulation import Simulation
from rtee.errors import ConfigError
from rtee.hand.catalog import hand_names
from rtee.hand.load import load_hand, load_model
from rtee.trials.bench import bench
from rtee.trials.grasp_placement import Places
from rtee.trials.headless import HeadlessHand
from rtee.types import Goal, Named

GRAVITY = 9.81
PADS = """<robot name="pads"><link name="base"/>
<link name="left">{body}</link><link name="right">{body}</link>
<joint name="close" type="prismatic"><parent link="base"/><child link="left"/>
<origin xyz="-0.045 0 0"/><axis xyz="1 0 0"/>
<limit lower="0" upper="0.04" velocity="1" effort="{effort}"/></joint>
<joint name="follow" type="prismatic"><parent link="base"/><child link="right"/>
<origin xyz="0.045 0 0"/><axis xyz="-1 0 0"/>
<limit lower="0" upper="0.04" velocity="1" effort="50"/>
<mimic joint="close"/></joint></robot>
"""


def pads(folder: Path, effort: float = 40.0) -> Path:
    """Write two pads that one actuator closes; its effort is shared by them."""
    body = (
        '<inertial><mass value="0.05"/></inertial>'
        '<collision><geometry><box size="0.01 0.02 0.02"/></geometry></collision>'
    )
    path = folder / "pads.urdf"
    path.write_text(PADS.format(body=body, effort=effort))
    return path


def fallen(path: Path, mass: float, friction: float | None, shape: str = "box") -> float:
    """Grip a block, let it bear its weight for a second, and return how far it fell [m]."""
    hand = load_model(path)
    size = {"box": "box:0.04x0.04x0.04", "cylinder": "cylinder:0.02x0.04", "sphere": "sphere:0.02"}
    options = SimOptions(
        object=size[shape], object_mass=mass, friction=friction, support="floating"
    )
    place = np.eye(4)
    simulation = make_simulation(hand, options, hand.actuator_names, 0.004, place=place)
    goal, everything = np.array([0.04]), np.ones(1, dtype=bool)
    for _ in range(150):
        simulation.command(goal, np.full(1, np.inf), everything)
        simulation.advance()
    simulation.surroundings.remove_support()
    before = simulation.surroundings.pose[2]
    for _ in range(250):
        simulation.advance()
    return float(before - simulation.surroundings.pose[2])


@pytest.mark.parametrize("friction", [0.3, 0.6, 1.0])
@pytest.mark.parametrize("shape", ["box", "cylinder"])
def test_a_block_between_pads_is_held_up_to_coulombs_limit(
    tmp_path: Path, friction: float, shape: str
) -> None:
    path = pads(tmp_path, effort=40.0)  # 20 N a pad
    most = 2.0 * friction * 20.0 / GRAVITY
    assert fallen(path, 0.9 * most, friction, shape) < 1e-3
    assert fallen(path, 1.1 * most, friction, shape) > 0.1


def test_twice_the_force_holds_twice_the_mass(tmp_path: Path) -> None:
    for effort in (20.0, 40.0):
        path = pads(tmp_path, effort)
        most = 0.5 * effort / GRAVITY
        assert fallen(path, 0.9 * most, 0.5) < 1e-3
        assert fallen(path, 1.1 * most, 0.5) > 0.1


def test_without_friction_a_block_slips_through(tmp_path: Path) -> None:
    assert fallen(pads(tmp_path), 0.05, 0.0) > 1.0
    assert fallen(pads(tmp_path), 0.05, None) < 1e-3


def test_friction_that_is_asked_for_counts_at_every_link() -> None:
    hand = load_hand("robotiq_3f")
    for friction in (0.0, 0.35, 2.0):
        options = SimOptions(object="drill", friction=friction)
        model = make_simulation(hand, options, hand.actuator_names, 0.004).model
        of_object = model.body_rootid[model.geom_bodyid] == model.body("object").id
        sliding = model.geom_friction[:, 0]
        # MuJoCo takes the larger one of a pair.
        assert sliding[of_object].max() == 0.0
        assert sliding[~of_object] == pytest.approx(friction)


def test_friction_needs_the_simulation() -> None:
    words = ["robotiq_2f_85", "--friction", "0.5"]
    with pytest.raises(ConfigError, match="--friction needs --driver mujoco"):
        CliRunner().invoke(app_of(run), words, catch_exceptions=False)


def depths(simulation: Simulation) -> list[tuple[float, float]]:
    """Return depth [m] and normal force [N] of every contact of the object with the hand."""
    model, data = simulation.model, simulation.data
    own = model.body("object").id
    force = np.zeros(6)
    found = []
    for number, contact in enumerate(data.contact):
        roots = model.body_rootid[model.geom_bodyid[[contact.geom1, contact.geom2]]]
        if (roots == own).sum() == 1:
            mujoco.mj_contactForce(model, data, number, force)
            found.append((-float(contact.dist), float(force[0])))
    return found


KINDS = ("robotiq_2f_85-*", "robotiq_3f-cylinder*", "dagana-box*")
"""Hands whose contacts differ in kind: parallel jaws on a linkage, three fingers that adapt, a claw
and a jaw of the body."""


@pytest.mark.samples(*KINDS)
@pytest.mark.parametrize("shape", ["sphere:0.03", "cylinder:0.02x0.12", "box:0.04x0.04x0.1"])
@pytest.mark.parametrize("name", hand_names())
def test_nothing_gets_deeper_than_a_millimetre_into_an_object(name: str, shape: str) -> None:
    ready = bench(name)
    hand = ready.hand
    grasps = [a for a in ready.library if a.name in ("Grasp", "PinchTight")]
    action = next((a for a in grasps if a.name == "Grasp"), grasps[0])
    options = SimOptions(object=shape, carrier="arm")
    names = hand.actuator_names
    simulation = make_simulation(hand, options, names, ready.settings.period)
    places = Places(simulation, hand, action).find(1)
    if not places:
        pytest.skip("it does not fit between the fingers")
    around = simulation.surroundings
    simulation.reset()
    around.place(around.base_pose @ places[0].pose)
    headless = HeadlessHand(hand, ready.library, ready.settings, simulation)
    seen: list[tuple[float, float]] = []
    headless.before_tick(lambda _: seen.extend(depths(simulation)))
    headless.do(Goal(Named(action.name, action.elements)))
    headless.wait(0.4)
    around.remove_support()
    headless.wait(0.1)  # what falls through the fingers later on meets them at any speed
    assert seen
    light = max(depth for depth, force in seen if force < 100.0)
    assert light < 1e-3, f"{light * 1e3:.2f} mm"
    assert max(depth for depth, _ in seen) < 2e-3
