"""Measure the force with which hands hold, beside the requested one, in MuJoCo.

Each hand grasps an object that floats between its fingertips, by width and force, as `rtee grasp`
does. The force that counts is that of the contacts half a second later; the peak is the strongest
at any tick before the result. Run: python benchmarks/grasp_force.py
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from rtee.actions.library import ActionLibrary
from rtee.drivers.mujoco.objects import OBJECT
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.pairs import LINK
from rtee.drivers.mujoco.scene import make_simulation
from rtee.drivers.mujoco.simulation import Simulation
from rtee.errors import GoalRejected
from rtee.hand.load import load_configured
from rtee.hand.model import Hand
from rtee.loop.configure import loop_settings
from rtee.loop.contact import Measured
from rtee.sample import FloatArray
from rtee.trials.grasp_placement import Places
from rtee.trials.headless import HeadlessHand
from rtee.types import Goal

CONFIG = Path(__file__).resolve().parents[1] / "config"
RATE = 500.0  # of the loop [Hz], as hands are simulated
SETTLE = 0.5  # time in which the force comes to rest [s]
SPEED = 0.05  # of the fingertips [m/s]: slow enough that the impact does not count


@dataclass(frozen=True)
class Case:
    """A hand, the action it closes with, an object of a width [m], and forces asked for [N]."""

    hand: str
    action: str
    elements: tuple[str, ...]
    object: str
    width: float
    forces: tuple[float, ...]


CASES = (
    Case("robotiq_2f_85", "Grasp", (), "box:0.03x0.03x0.03", 0.03, (5.0, 10.0, 20.0, 60.0, 150.0)),
    Case("robotiq_3f", "Grasp", (), "box:0.05x0.05x0.05", 0.05, (5.0, 10.0, 15.0, 20.0)),
    Case(
        "schunk_svh", "PinchTight", ("index", "thumb"), "sphere:0.015", 0.03, (1.0, 2.0, 3.0, 4.0)
    ),
    Case(
        "heri_ii", "PinchTight", ("finger_2", "thumb"), "sphere:0.02", 0.04, (2.0, 5.0, 10.0, 20.0)
    ),
)


def squeeze(simulation: Simulation, hand: Hand) -> float:
    """Return the force with which one side presses on the object, and the other side back [N].

    That is half the sum over the fingers of the size of what each exerts on the object, all of its
    links together: links of one finger that press against each other add nothing.
    """
    model, data = simulation.model, simulation.data
    thing = model.body(OBJECT).id
    finger_of = {
        model.body(LINK + link).id: number
        for number, finger in enumerate(hand.fingers)
        for link in finger.links
    }
    force, found = np.zeros(6), np.zeros((len(hand.fingers), 3))
    for number in range(data.ncon):
        contact = data.contact[number]
        first, second = (int(model.geom_bodyid[geom]) for geom in contact.geom)
        finger = finger_of.get(first if second == thing else second)
        if thing not in (first, second) or finger is None:
            continue
        mujoco.mj_contactForce(model, data, number, force)
        found[finger] += contact.frame.reshape(3, 3).T @ force[:3]
    return float(np.linalg.norm(found, axis=1).sum()) / 2.0


class Numb(HeadlessHand[Simulation]):
    """A hand without sensors at its fingertips."""

    def _measured(self, position: FloatArray, effort: FloatArray, forces: FloatArray) -> Measured:
        return super()._measured(position, effort, np.full_like(forces, np.nan))


def measure(case: Case, force: float, numb: bool) -> str:
    """Return a row of the table: what one grasp came to."""
    folder = CONFIG / case.hand
    hand, config = load_configured(folder)
    library, settings = (
        ActionLibrary.load(hand, folder / "actions"),
        loop_settings(config, rate=RATE),
    )
    # Without gravity, so that nothing but the grasp presses on the fingertips.
    options = SimOptions(object=case.object, object_mass=0.05, support="floating", gravity=0.0)
    simulation = make_simulation(hand, options, hand.actuator_names, settings.period)
    place = Places(simulation, hand, library.find(case.action, case.elements)).find(1)[0]
    simulation.reset()
    simulation.surroundings.place(simulation.surroundings.base_pose @ place.pose)
    kind = Numb if numb else HeadlessHand[Simulation]
    headless = kind(hand, library, settings, simulation)
    goal = Goal(
        case.action,
        case.elements,
        opening=case.width,
        force=force,
        grasp=True,
        tip_speed=SPEED,
    )
    forces: list[float] = []
    headless.before_tick(lambda _: forces.append(squeeze(simulation, hand)))
    try:
        result = headless.do(goal)
    except GoalRejected as error:
        return f"| {case.hand} | {force:g} | refused: {error} | | | | |"
    headless.wait(SETTLE)
    held = squeeze(simulation, hand)
    width = float("nan") if result.opening is None else 1e3 * result.opening
    return (
        f"| {case.hand} | {force:g} | {held:.2f} | {held / force - 1.0:+.1%} | {max(forces):.2f} | "
        f"{width:.1f} of {1e3 * case.width:g} | {'yes' if result.within else 'no'} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hand", help="this hand only")
    parser.add_argument("--quick", action="store_true", help="one force per hand")
    parser.add_argument("--numb", action="store_true", help="without sensors at the fingertips")
    arguments = parser.parse_args()
    print("| hand | asked N | held N | off | peak N | width mm | within |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | --- |")
    for case in CASES:
        if arguments.hand not in (None, case.hand):
            continue
        for force in case.forces[:1] if arguments.quick else case.forces:
            print(measure(case, force, arguments.numb), flush=True)


if __name__ == "__main__":
    main()
