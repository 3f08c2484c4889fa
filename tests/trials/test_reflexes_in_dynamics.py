"""Reflexes on simulated hands: a light object stays where it is, and a squeeze gives its force."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco")

from rtee.actions.library import ActionLibrary
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import make_simulation
from rtee.drivers.mujoco.simulation import Simulation
from rtee.hand.load import hand_folder, load_configured
from rtee.loop.measured import MET, Measured
from rtee.loop.settings import loop_settings
from rtee.sample import FloatArray
from rtee.trials.grasp_placement import Places
from rtee.trials.headless import HeadlessHand
from rtee.types import (
    Around,
    Fingers,
    FirstContact,
    Force,
    Goal,
    Intensity,
    Named,
    OnContact,
    Outcome,
    TipSpeed,
)

RATE = 500.0
BOX = "box:0.03x0.03x0.08"


def gripper(options: SimOptions, *, beside: float = 0.0) -> HeadlessHand[Simulation]:
    """Return a 2F-85 around a box, off its middle by a distance [m]."""
    hand, config = load_configured("robotiq_2f_85")
    library = ActionLibrary.load(hand, hand_folder(hand.name)[0] / "actions")
    settings = loop_settings(config, rate=RATE)
    simulation = make_simulation(hand, options, hand.actuator_names, settings.period)
    around = simulation.surroundings
    place = Places(simulation, hand, library.find("Grasp")).find(1)[0]
    simulation.reset()
    world = around.base_pose @ place.pose
    if options.support == "table":
        # Upright on the table, 1 cm above which the fingertips end.
        pose = around.object_frame
        move = pose[:3, 3] - world[:3, 3] + [beside, beside, 0.01]
        around.jump(np.concatenate([move, np.zeros(3)]))
        around.place(pose)
    else:
        around.place(world)
    return HeadlessHand(hand, library, settings, simulation)


def test_a_touch_moves_a_light_object_by_less_than_two_millimetres() -> None:
    options = SimOptions(object=BOX, object_mass=0.02, support="table", carrier="arm")
    headless = gripper(options, beside=0.003)
    headless.wait(0.5)
    forces: list[float] = []
    headless.before_tick(lambda _: forces.append(headless.simulation.contact_forces.max()))
    before = headless.simulation.surroundings.object_frame[:3, 3]
    result = headless.do(Goal(Fingers(), FirstContact(), timeout=30.0))
    headless.wait(0.5)
    moved = np.linalg.norm(headless.simulation.surroundings.object_frame[:3, 3] - before)
    assert len(result.touched) == 1
    assert not result.timed_out
    assert 0.0 < max(forces) < 1.0
    assert moved < 0.002


@pytest.mark.parametrize("word", list(OnContact))
def test_a_gripper_does_on_contact_what_it_is_to_do(word: OnContact) -> None:
    headless = gripper(SimOptions(object=BOX, object_mass=0.05, support="floating", gravity=0.0))
    goal = Goal(
        Named("Grasp"),
        Around(0.03),
        speed=TipSpeed(0.02),
        effort=Force(5.0, 20.0),
        on_contact={"": word},
    )
    result = headless.do(goal)
    headless.wait(1.0)
    held = headless.simulation.contact_forces.sum() / 2.0
    assert set(result.touched) == {"finger_1", "finger_2"}
    assert result.grasped is (word is not OnContact.STOP)
    if word is OnContact.SQUEEZE:
        assert held == pytest.approx(5.0, rel=0.15)
    else:
        assert held < 4.0


class Numb(HeadlessHand[Simulation]):
    """A hand without sensors at its fingertips."""

    def _measured(self, position: FloatArray, effort: FloatArray, forces: FloatArray) -> Measured:
        return super()._measured(position, effort, np.full_like(forces, np.nan))


def numb(name: str, action: str, elements: tuple[str, ...], thing: str) -> Numb:
    """Return a hand without sensors around a floating object."""
    hand, config = load_configured(name)
    library = ActionLibrary.load(hand, hand_folder(name)[0] / "actions")
    settings = loop_settings(config, rate=RATE)
    options = SimOptions(object=thing, object_mass=0.05, support="floating", gravity=0.0)
    simulation = make_simulation(hand, options, hand.actuator_names, settings.period)
    place = Places(simulation, hand, library.find(action, elements)).find(1)[0]
    simulation.reset()
    simulation.surroundings.place(simulation.surroundings.base_pose @ place.pose)
    return Numb(hand, library, settings, simulation)


@pytest.mark.parametrize(
    ("name", "action", "elements", "thing", "width", "force", "off"),
    [
        ("robotiq_3f", "Grasp", (), "box:0.05x0.05x0.05", 0.05, 3.0, 0.05),
        ("robotiq_3f", "Grasp", (), "box:0.05x0.05x0.05", 0.05, 5.0, 0.10),
        # The fingers bend more and more; from 10 N on, the third touches with its second link, too.
        ("robotiq_3f", "Grasp", (), "box:0.05x0.05x0.05", 0.05, 8.0, 0.25),
        ("schunk_svh", "PinchTight", ("index", "thumb"), "sphere:0.015", 0.03, 4.0, 0.15),
    ],
)
def test_the_levers_alone_give_the_force(
    name: str,
    action: str,
    elements: tuple[str, ...],
    thing: str,
    width: float,
    force: float,
    off: float,
) -> None:
    headless = numb(name, action, elements, thing)
    goal = Goal(Named(action, elements), Around(width), speed=TipSpeed(0.05), effort=Force(force))
    result = headless.do(goal)
    assert result.outcome is Outcome.HELD
    headless.wait(0.5)
    # Each side presses as much as the other: half of the sum is the force.
    held = headless.simulation.contact_forces.sum() / 2.0
    assert held == pytest.approx(force, rel=off)
    assert result.force == pytest.approx(held, abs=result.force_error)


def test_fingers_that_have_bent_keep_the_width_and_give_no_force() -> None:
    headless = numb("robotiq_3f", "Grasp", (), "box:0.05x0.05x0.05")
    met: list[bool] = []
    headless.before_tick(lambda _: met.append(MET in headless.controller.channels))
    light, firm = (
        headless.do(Goal(Named("Grasp"), Around(0.05), TipSpeed(0.05), Force(force)))
        for force in (5.0, 15.0)
    )
    assert (light.outcome, firm.outcome) == (Outcome.HELD, Outcome.HELD)
    assert light.opening == firm.opening == pytest.approx(0.05, abs=light.opening_error)
    assert light.force is not None
    assert firm.position["finger_1_joint_1"] > light.position["finger_1_joint_1"] + 0.1
    assert (firm.force, firm.force_error, firm.force_source) == (None, None, "")
    assert met[-1], "states say so, too"
    headless.do(Goal(Named("Grasp"), Intensity(0.0)))
    assert not met[-1]
