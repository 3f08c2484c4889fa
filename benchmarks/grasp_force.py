"""Measure the force with which hands hold, beside the requested one, in MuJoCo.

Each hand grasps an object that floats between its fingertips, by width and force, as `rtee grasp`
does. The measured force is that between the tips (`grasp_cases.Seen`) half a second later; the peak
is the strongest force at any tick before the result. With --vary, widths and shapes vary, and the
result is the share of forces within 15 %. Run: python benchmarks/grasp_force.py
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from grasp_cases import Contacts

from rtee.actions.library import ActionLibrary
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import make_simulation
from rtee.drivers.mujoco.simulation import Simulation
from rtee.errors import GoalRejected
from rtee.hand.load import load_configured
from rtee.loop.measured import Measured
from rtee.loop.planning import make_plan
from rtee.loop.settings import loop_settings
from rtee.sample import FloatArray
from rtee.trials.grasp_placement import Places
from rtee.trials.headless import HeadlessHand
from rtee.types import Around, Force, Goal, Named, TipSpeed

CONFIG = Path(__file__).resolve().parents[1] / "config"
RATE = 500.0  # of the loop [Hz], as hands are simulated
SETTLE = 0.5  # time in which the force comes to rest [s]
NEAR = 0.15  # share by which a force may be off
WIDTHS = (0.02, 0.03, 0.04)  # with --vary [m]
SHAPES = ("box:{w}x{w}x0.05", "cylinder:{r}x0.05", "sphere:{r}")  # with --vary
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


class Numb(HeadlessHand[Simulation]):
    """A hand without sensors at its fingertips."""

    def _measured(self, position: FloatArray, effort: FloatArray, forces: FloatArray) -> Measured:
        return super()._measured(position, effort, np.full_like(forces, np.nan))


@dataclass(frozen=True)
class Came:
    """What one grasp came to: forces [N], the opening [m], and whether it was as asked."""

    held: float
    peak: float
    opening: float
    within: bool
    grasped: bool


def grasp(case: Case, force: float, numb: bool) -> Came:
    """Grasp an object with a force [N].

    Raises:
        GoalRejected: if the hand cannot.
        LookupError: if the object fits nowhere between the fingers.
    """
    folder = CONFIG / case.hand
    hand, config = load_configured(folder)
    library, settings = (
        ActionLibrary.load(hand, folder / "actions"),
        loop_settings(config, rate=RATE),
    )
    # Without gravity, so that nothing but the grasp presses on the fingertips.
    options = SimOptions(object=case.object, object_mass=0.05, support="floating", gravity=0.0)
    simulation = make_simulation(hand, options, hand.actuator_names, settings.period)
    places = Places(simulation, hand, library.find(case.action, case.elements)).find(1)
    if not places:
        raise LookupError(f"{case.object} fits nowhere")
    simulation.reset()
    simulation.surroundings.place(simulation.surroundings.base_pose @ places[0].pose)
    kind = Numb if numb else HeadlessHand[Simulation]
    headless = kind(hand, library, settings, simulation)
    goal = Goal(
        Named(case.action, case.elements),
        Around(case.width),
        speed=TipSpeed(SPEED),
        effort=Force(force),
    )
    grip = make_plan(goal, hand, library, settings).grip
    assert grip is not None
    contacts = Contacts(simulation, hand, (grip.fingers, grip.others), grip.around)
    forces: list[float] = []
    headless.before_tick(lambda _: forces.append(contacts.seen().between))
    result = headless.do(goal)
    headless.wait(SETTLE)
    width = float("nan") if result.opening is None else result.opening
    held = contacts.seen().between
    return Came(held, max(forces), width, bool(result.within), result.grasped)


def measure(case: Case, force: float, numb: bool) -> str:
    """Return the row of one grasp."""
    try:
        came = grasp(case, force, numb)
    except GoalRejected as error:
        return f"| {case.hand} | {force:g} | refused: {error} | | | | |"
    return (
        f"| {case.hand} | {force:g} | {came.held:.2f} | {came.held / force - 1.0:+.1%} | "
        f"{came.peak:.2f} | {1e3 * came.opening:.1f} of {1e3 * case.width:g} | "
        f"{'yes' if came.within else 'no'} |"
    )


def vary(case: Case, width: float, numb: bool) -> str:
    """Return a row of the table of rates: all shapes and forces at a width [m]."""
    offs: list[float] = []
    grasped = refused = 0
    for shape in SHAPES:
        varied = replace(case, object=shape.format(w=width, r=width / 2.0), width=width)
        for force in case.forces:
            try:
                came = grasp(varied, force, numb)
            except (GoalRejected, LookupError):
                refused += 1
                continue
            grasped += came.grasped
            offs.append(came.held / force - 1.0)
    near = sum(abs(off) <= NEAR for off in offs)
    shown = f"{min(offs):+.0%} to {max(offs):+.0%}" if offs else ""
    sensors = "no" if numb else "yes"
    return (
        f"| {case.hand} | {sensors} | {1e3 * width:g} | {near} of {len(offs)} | {shown} | "
        f"{grasped} of {len(offs)} | {refused} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hand", help="this hand only")
    parser.add_argument("--quick", action="store_true", help="one force per hand")
    parser.add_argument("--numb", action="store_true", help="without sensors at the fingertips")
    parser.add_argument("--vary", action="store_true", help="rates over widths and shapes")
    arguments = parser.parse_args()
    if arguments.vary:
        print("| hand | sensors | width mm | within 15 % | off | grasped | refused |")
        print("| --- | --- | ---: | ---: | ---: | ---: | ---: |")
        for case in CASES:
            if arguments.hand in (None, case.hand):
                for numb in (False, True):
                    for width in WIDTHS:
                        print(vary(case, width, numb), flush=True)
        return
    print("| hand | asked N | held N | off | peak N | width mm | within |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | --- |")
    for case in CASES:
        if arguments.hand not in (None, case.hand):
            continue
        for force in case.forces[:1] if arguments.quick else case.forces:
            print(measure(case, force, arguments.numb), flush=True)


if __name__ == "__main__":
    main()
