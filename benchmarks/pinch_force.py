"""Measure the force that pinches give on a plate between the fingertips, in MuJoCo; print Markdown.

    python benchmarks/pinch_force.py [--hands schunk_svh …] [--before CONFIG]

A plate of 5 mm stands where the tips of each pinch of two fingers meet, across the contact normal.
The pinch is executed at full intensity; the force is that with which each side presses on the plate
at the end. With `--before`, the stored pinches of another folder of hands, such as `config/` of an
earlier version, are tried, too, in the same run.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from common import HELP, Table, command_line
from grasp_force import CONFIG, RATE, squeeze

from rtee.actions.library import ActionLibrary
from rtee.actions.types import Primitive
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import make_simulation
from rtee.drivers.mujoco.simulation import Simulation
from rtee.extract.scene import Scene
from rtee.hand.load import load_configured
from rtee.loop.settings import loop_settings
from rtee.sample import FloatArray
from rtee.trials.headless import HeadlessHand
from rtee.types import Goal, Named, from_rest

HANDS = ("robotiq_2f_85", "heri_ii", "schunk_svh", "ability_hand", "leap_hand", "allegro")
PLATE = "box:0.005x0.02x0.02"
SETTLE = 0.5  # time in which the force comes to rest [s]


def pinches(name: str, config: Path) -> dict[frozenset[str], Primitive]:
    """Return the stored pinches of two fingers by their fingers."""
    hand, _ = load_configured(CONFIG / name)
    library = ActionLibrary.load(hand, config / name / "actions")
    found = (a for a in library if isinstance(a, Primitive) and a.name == "PinchTight")
    return {frozenset(pinch.elements): pinch for pinch in found}


def across(normal: FloatArray) -> FloatArray:
    """Return a rotation ``(3, 3)`` whose x axis is a normal."""
    other = np.eye(3)[int(np.argmin(np.abs(normal)))]
    second = np.cross(normal, other)
    second /= np.linalg.norm(second)
    return np.stack([normal, second, np.cross(normal, second)], axis=1)


def force(name: str, config: Path, pinch: Primitive) -> float:
    """Return the force with which a pinch presses on the plate [N]."""
    hand, settings = load_configured(CONFIG / name)
    library = ActionLibrary.load(hand, config / name / "actions")
    loop = loop_settings(settings, rate=RATE)
    options = SimOptions(object=PLATE, object_mass=0.02, support="held", gravity=0.0)
    simulation = make_simulation(hand, options, hand.actuator_names, loop.period)
    # Where the tips first meet, since deeper postures are elsewhere.
    scene, contact = Scene(hand), pinch.evidence[0].contact_at
    goal = np.array([pinch.posture.position[name] for name in hand.actuator_names])
    scene.place(from_rest(hand.rest, goal, 1.0 if contact is None else contact))
    first, second = (str(hand.finger(finger).tip) for finger in pinch.elements)
    meeting = scene.witness(scene.tips[first, second])
    pose = np.eye(4)
    pose[:3, :3] = across(meeting.normal)
    pose[:3, 3] = (meeting.first + meeting.second) / 2.0
    simulation.reset()
    headless = HeadlessHand[Simulation](hand, library, loop, simulation)
    # Kept in place, as what is pinched would slip out of some pinches and then show no force.
    place = simulation.surroundings.base_pose @ pose
    headless.before_tick(lambda _: simulation.surroundings.place(place))
    headless.do(Goal(Named(pinch.name, pinch.elements), timeout=10.0))
    headless.wait(SETTLE)
    return squeeze(simulation, hand)


def main(arguments: Sequence[str]) -> None:
    parser = command_line(__doc__, before=Path)
    parser.add_argument("--hands", nargs="+", default=list(HANDS), help=HELP["hands"])
    given = parser.parse_args(arguments)
    head = ["before: depth [mm]", "force [N]"] if given.before else []
    table = Table("hand", "pinch", *head, "depth [mm]", "force [N]")
    for name in given.hands:
        for fingers, pinch in pinches(name, CONFIG).items():
            cells = []
            for config in [given.before] * bool(given.before) + [CONFIG]:
                found = pinches(name, config).get(fingers)
                if found is None:
                    cells += ["", ""]
                    continue
                depth = f"{1e3 * found.evidence[0].depth:.2f}"
                cells += [depth, f"{force(name, config, found):.2f}"]
            table.row(name, ", ".join(pinch.elements), *cells)


if __name__ == "__main__":
    main(sys.argv[1:])
