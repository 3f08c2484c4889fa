"""Measure the forces that pinches give in MuJoCo; print Markdown.

    python benchmarks/pinch_force.py [--hands schunk_svh …] [--before CONFIG]

Each pinch is executed at full intensity, and its force is measured at the end as the mean over a
quarter of a second. *On each other*: with nothing between the fingertips, the sum over all pairs of
the force with which the tips of one finger press on those of another; *half as far* is the same at
the intensity that goes half as far beyond the first contact. *On a plate*, for pinches of two
fingers: the force with which each side presses on a plate of 5 mm, which begins where the tips
first meet on the way, across the contact normal there. Nothing but a drag holds it, as if a
yielding hand presented it, so that what slips out shows no force. Whether it does may depend on a
millimetre; the force is the median of three, with the plate moved by 2 mm to either side, too.

The *angle* is the greater of the stored angles between a tip's line of closing and the contact
normal. With `--before`, the stored pinches of another folder of hands, such as `config/` of an
earlier version, are tried, too, on the same hands in the same run.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from common import HELP, Table, command_line
from grasp_cases import Contacts
from grasp_force import CONFIG, RATE

from rtee.actions.library import ActionLibrary
from rtee.actions.types import Primitive
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.pairs import LINK
from rtee.drivers.mujoco.scene import make_simulation
from rtee.drivers.mujoco.simulation import Simulation
from rtee.extract.scene import Scene
from rtee.hand.load import load_configured
from rtee.hand.model import Hand
from rtee.loop.settings import loop_settings
from rtee.sample import FloatArray
from rtee.trials.headless import HeadlessHand
from rtee.types import Goal, Intensity, Named, from_rest

HANDS = ("robotiq_2f_85", "heri_ii", "schunk_svh", "ability_hand", "leap_hand", "allegro")
PLATE = "box:0.005x0.02x0.02"
SETTLE = 0.25  # time in which the force comes to rest, and then in which it is measured [s]
ASIDE = (0.0, -0.002, 0.002)  # where the plate begins, along itself [m]


def pinches(name: str, config: Path) -> dict[frozenset[str], Primitive]:
    """Return the stored tight pinches of a hand by their fingers."""
    hand, _ = load_configured(CONFIG / name)
    library = ActionLibrary.load(hand, config / name / "actions")
    found = (a for a in library if isinstance(a, Primitive) and "PinchTight" in a.name)
    return {frozenset(pinch.elements): pinch for pinch in found}


def across(normal: FloatArray) -> FloatArray:
    """Return a rotation ``(3, 3)`` whose x axis is a normal."""
    other = np.eye(3)[int(np.argmin(np.abs(normal)))]
    second = np.cross(normal, other)
    second /= np.linalg.norm(second)
    return np.stack([normal, second, np.cross(normal, second)], axis=1)


def on_each_other(simulation: Simulation, hand: Hand, fingers: Sequence[str]) -> float:
    """Return the sum over pairs of fingers of the force between their tips [N]."""
    model, data = simulation.model, simulation.data
    finger_of = {
        model.body(LINK + link).id: number
        for number, finger in enumerate(fingers)
        for link in hand.finger(finger).tip_links
    }
    force, found = np.zeros(6), np.zeros((len(fingers), len(fingers), 3))
    for number in range(data.ncon):
        contact = data.contact[number]
        first, second = (finger_of.get(int(model.geom_bodyid[geom])) for geom in contact.geom)
        if first is None or second is None or first == second:
            continue
        mujoco.mj_contactForce(model, data, number, force)
        sign = 1.0 if first < second else -1.0
        pair = min(first, second), max(first, second)
        found[pair] += sign * (contact.frame.reshape(3, 3).T @ force[:3])
    return float(np.linalg.norm(found, axis=2).sum())


def meeting(hand: Hand, pinch: Primitive) -> FloatArray:
    """Return the pose ``(4, 4)`` of the plate in the base frame: where the tips first meet."""
    # Deeper postures are elsewhere.
    scene, contact = Scene(hand), pinch.evidence[0].contact_at
    goal = np.array([pinch.posture.position[name] for name in hand.actuator_names])
    scene.place(from_rest(hand.rest, goal, 1.0 if contact is None else contact))
    first, second = (str(hand.finger(finger).tip) for finger in pinch.elements)
    witness = scene.witness(scene.tips[first, second])
    pose = np.eye(4)
    pose[:3, :3] = across(witness.normal)
    pose[:3, 3] = (witness.first + witness.second) / 2.0
    return pose


def force(
    name: str, config: Path, pinch: Primitive, plate: float | None = None, intensity: float = 1.0
) -> float:
    """Return the force that a pinch gives [N]: on each other, or on a plate that is moved [m]."""
    hand, settings = load_configured(CONFIG / name)
    library = ActionLibrary.load(hand, config / name / "actions")
    loop = loop_settings(settings, rate=RATE)
    options = SimOptions(
        object="" if plate is None else PLATE,
        object_mass=0.02,
        support="floating",
        gravity=0.0,
    )
    simulation = make_simulation(hand, options, hand.actuator_names, loop.period)
    simulation.reset()
    if plate is not None:
        pose = meeting(hand, pinch)
        pose[:3, 3] += plate * pose[:3, 1]
        simulation.surroundings.place(simulation.surroundings.base_pose @ pose)
    headless = HeadlessHand[Simulation](hand, library, loop, simulation)
    goal = Goal(Named(pinch.name, pinch.elements), to=Intensity(intensity), timeout=10.0)
    headless.do(goal)
    headless.wait(SETTLE)
    found: list[float] = []
    fingers = [[hand.finger_names.index(finger)] for finger in pinch.elements[:2]]
    contacts = Contacts(simulation, hand, (fingers[0], fingers[1]))
    headless.before_tick(
        lambda _: found.append(
            on_each_other(simulation, hand, pinch.elements)
            if plate is None
            else contacts.seen().between
        )
    )
    headless.wait(SETTLE)
    return float(np.mean(found))


def cells(name: str, config: Path, pinch: Primitive | None) -> list[str]:
    """Return the depth, the angle and the forces of a pinch."""
    if pinch is None:
        return [""] * 5
    evidence = pinch.evidence[0]
    opposed = evidence.opposition
    contact = evidence.contact_at
    half = 1.0 if contact is None else (contact + 1.0) / 2.0
    places = ASIDE if len(pinch.elements) == 2 else ()
    pressed = [force(name, config, pinch, aside) for aside in places]
    return [
        f"{1e3 * evidence.depth:.2f}",
        "" if opposed is None else f"{np.degrees(max(opposed.angles)):.0f}",
        f"{force(name, config, pinch):.2f}",
        f"{force(name, config, pinch, intensity=half):.2f}",
        f"{np.median(pressed):.2f}" if pressed else "",
    ]


def main(arguments: Sequence[str]) -> None:
    parser = command_line(__doc__, before=Path)
    parser.add_argument("--hands", nargs="+", default=list(HANDS), help=HELP["hands"])
    given = parser.parse_args(arguments)
    head = ["depth [mm]", "angle [°]", "on each other [N]", "half as far [N]", "on a plate [N]"]
    configs = [*([given.before] if given.before else []), CONFIG]
    before = [f"before: {title}" for title in head] if given.before else []
    table = Table("hand", "pinch", *before, *head)
    for name in given.hands:
        stored = [pinches(name, config) for config in configs]
        for fingers, pinch in stored[-1].items():
            found = (
                cell
                for config, each in zip(configs, stored, strict=True)
                for cell in cells(name, config, each.get(fingers))
            )
            table.row(name, ", ".join(pinch.elements), *found)


if __name__ == "__main__":
    main(sys.argv[1:])
