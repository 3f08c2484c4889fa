"""Try grasps with and without reflexes in MuJoCo: eggs, a cup that is filled, and a tug.

An egg of 60 g breaks when a finger presses on it with more than 8 N. A cup of 50 g is filled with
500 g within 5 s while it is held. A part of 50 g is tugged at with 5 N for half a second. Each is
tried with the object a little off the middle, lighter or heavier, and more or less slippery; it
succeeds if the object is still held afterwards, and whole. Run: python benchmarks/reflexes.py
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rtee.actions.library import ActionLibrary
from rtee.drivers.mujoco.objects import OBJECT
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import make_simulation
from rtee.drivers.mujoco.simulation import Simulation
from rtee.hand.load import load_configured
from rtee.loop.configure import loop_settings
from rtee.trials.grasp_placement import Places
from rtee.trials.headless import HeadlessHand
from rtee.types import Goal, OnContact

CONFIG = Path(__file__).resolve().parents[1] / "config"
RATE = 500.0  # of the loop [Hz], as hands are simulated
SPEED = 0.02  # of the fingertips [m/s]
SETTLE = 1.0  # time in which a grip, or what disturbed it, settles [s]
BREAKS = 8.0  # force of a finger that breaks the egg [N]
LOST = 0.02
"""What has moved further than this in the hand is lost [m]."""


@dataclass(frozen=True)
class Grasped:
    """A hand, how it grasps, an object of a width [m], and forces to begin with and at most [N]."""

    hand: str
    action: str
    elements: tuple[str, ...]
    object: str
    width: float
    force: float
    most: float


HANDS = (
    Grasped("robotiq_2f_85", "Grasp", (), "sphere:0.02", 0.04, 3.0, 7.0),
    Grasped("robotiq_3f", "Grasp", (), "sphere:0.03", 0.06, 3.0, 7.0),
    Grasped("schunk_svh", "PinchTight", ("index", "thumb"), "sphere:0.015", 0.03, 2.0, 4.5),
)


@dataclass(frozen=True)
class How:
    """A way to grasp: with a force or the hand's own, and with reflexes or without."""

    name: str
    force: bool
    reflexes: bool


WAYS = (
    How("hand's effort", force=False, reflexes=False),
    How("force", force=True, reflexes=False),
    How("force and reflexes", force=True, reflexes=True),
)


class Trial:
    """One object in one hand.

    Args:
        grasped: The hand and how it grasps.
        mass: Mass of the object [kg].
        number: Number of the variation.
    """

    def __init__(self, grasped: Grasped, mass: float, number: int) -> None:
        folder = CONFIG / grasped.hand
        hand, config = load_configured(folder)
        library = ActionLibrary.load(hand, folder / "actions")
        settings = loop_settings(config, rate=RATE)
        varied = np.random.default_rng(number)
        options = SimOptions(
            object=grasped.object,
            object_mass=mass * varied.uniform(0.8, 1.2),
            friction=varied.uniform(0.6, 1.0),
        )
        simulation = make_simulation(hand, options, hand.actuator_names, settings.period)
        action = library.find(grasped.action, grasped.elements)
        pose = Places(simulation, hand, action).find(1)[0].pose.copy()
        # Up to 3 mm off the middle, as a camera or a person puts it.
        pose[:3, 3] += varied.uniform(-0.003, 0.003, 3)
        simulation.reset()
        around = simulation.surroundings
        around.place(around.base_pose @ pose)
        self.grasped, self.simulation = grasped, simulation
        self.headless: HeadlessHand[Simulation] = HeadlessHand(hand, library, settings, simulation)
        self.body = simulation.model.body(OBJECT).id
        self.broken = False
        self.headless.before_tick(self._watch)

    def _watch(self, _: float) -> None:
        self.broken |= bool(self.simulation.contact_forces.max() > BREAKS)

    def grasp(self, how: How) -> bool:
        """Grasp the object; return whether it is held after a second."""
        grasped = self.grasped
        goal = Goal(
            grasped.action,
            grasped.elements,
            opening=grasped.width,
            force=grasped.force if how.force else None,
            max_force=grasped.most if how.reflexes else None,
            grasp=True,
            tip_speed=SPEED,
            on_contact={"": OnContact.SQUEEZE} if how.reflexes else {},
        )
        result = self.headless.do(goal)
        self.headless.wait(SETTLE)
        self.simulation.surroundings.remove_support()
        self.start = self.simulation.surroundings.position_in_hand.copy()
        self.headless.wait(SETTLE)
        return result.grasped and self.held

    @property
    def held(self) -> bool:
        """Whether the object is where it was grasped."""
        moved = self.simulation.surroundings.position_in_hand - self.start
        return math.sqrt(float(moved @ moved)) < LOST

    def during(self, seconds: float, act: Callable[[float], None]) -> None:
        """Let time pass [s], doing something at every tick with the share of it that is over."""
        begin = self.headless.time
        while self.headless.time < begin + seconds:
            act((self.headless.time - begin) / seconds)
            self.headless.tick()


def egg(grasped: Grasped, how: How, number: int) -> bool:
    """Hold an egg; return whether it is held and whole."""
    trial = Trial(grasped, 0.06, number)
    return trial.grasp(how) and not trial.broken


def cup(grasped: Grasped, how: How, number: int) -> bool:
    """Hold a cup while it is filled; return whether it is still held."""
    trial = Trial(grasped, 0.05, number)
    if not trial.grasp(how):
        return False
    model, body = trial.simulation.model, trial.body
    empty, inertia = float(model.body_mass[body]), model.body_inertia[body].copy()

    def fill(share: float) -> None:
        model.body_mass[body] = empty + 0.5 * share
        # The water is where the cup is: its inertia grows with the mass.
        model.body_inertia[body] = inertia * model.body_mass[body] / empty

    trial.during(5.0, fill)
    trial.headless.wait(SETTLE)
    return trial.held


def tug(grasped: Grasped, how: How, number: int) -> bool:
    """Hold a part that is tugged at; return whether it is still held."""
    trial = Trial(grasped, 0.05, number)
    if not trial.grasp(how):
        return False

    def pull(share: float) -> None:
        # Down, rising within 0.1 s: a tug, not a blow.
        trial.simulation.data.xfrc_applied[trial.body, 2] = -5.0 * min(5.0 * share, 1.0)

    trial.during(0.5, pull)
    trial.simulation.data.xfrc_applied[trial.body] = 0.0
    trial.headless.wait(SETTLE)
    return trial.held


TRIALS = (egg, cup, tug)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hand", help="this hand only")
    parser.add_argument("--trials", type=int, default=6, help="variations of each")
    arguments = parser.parse_args()
    print("| hand | grasp | " + " | ".join(trial.__name__ for trial in TRIALS) + " |")
    print("| --- | --- |" + " ---: |" * len(TRIALS))
    for grasped in HANDS:
        if arguments.hand not in (None, grasped.hand):
            continue
        for how in WAYS:
            counts = [
                sum(trial(grasped, how, number) for number in range(arguments.trials))
                for trial in TRIALS
            ]
            shown = " | ".join(f"{count} of {arguments.trials}" for count in counts)
            print(f"| {grasped.hand} | {how.name} | {shown} |", flush=True)


if __name__ == "__main__":
    main()
