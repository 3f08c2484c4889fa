"""Close simulated hands on nothing, and on objects, and count what they say.

On nothing by each of their actions, with the fingers' forces measured ("sensors") and by effort
alone; on two balls and a box by every second pinch, with sensors. Or touch nothing by effort alone
with hands that have never moved, with emulated devices and in MuJoCo. In simulated time.
Run: python benchmarks/empty_closings.py
"""

from __future__ import annotations

import argparse
import zlib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from common import Table
from grasp_cases import RATE, Case, CaseObject, NumbHand, Unfit, try_case

from rtee.actions.types import Primitive, PrimitiveKind, Timed
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import make_simulation
from rtee.drivers.mujoco.simulation import Simulation
from rtee.drivers.objects import grasping
from rtee.loop.observer import Observer
from rtee.remote.goal_values import touch_goal
from rtee.sample import TickRecord
from rtee.testing.simulated import SimulatedHand, simulated
from rtee.trials.bench import bench
from rtee.trials.headless import HeadlessHand
from rtee.types import Goal, Named, Outcome, Result

CONFIG = Path(__file__).resolve().parents[1] / "config"
PINCHES = (PrimitiveKind.PINCH_TIGHT, PrimitiveKind.PINCH_LOOSE, PrimitiveKind.MULTI_PINCH_TIGHT)
SAID = (Outcome.REACHED, Outcome.CLOSED, Outcome.STALLED, Outcome.HELD)


THINGS = ((CaseObject.SPHERE, 0.02), (CaseObject.SPHERE, 0.04), (CaseObject.BOX, 0.03))
SPEEDS = (0.01, 0.02, 0.04)  # of the opening in a touch [m/s]
WEIGHT = 1.0  # force for which the objects are made [N]: 20 g


def empty(hands: Sequence[str]) -> None:
    """Close hands on nothing, and print the table."""
    table = Table("hand", "sensors", *SAID, "other")
    for hand in hands:
        ready = bench(str(CONFIG / hand))
        names, period = ready.hand.actuator_names, ready.settings.period
        for kind in (HeadlessHand[Simulation], NumbHand):
            said: Counter[Outcome] = Counter()
            for action in ready.library:
                if isinstance(action, Timed):
                    continue
                simulation = make_simulation(ready.hand, SimOptions(), names, period)
                headless = kind(ready.hand, ready.library, ready.settings, simulation)
                said[headless.do(Goal(Named(action.name, action.elements))).outcome] += 1
            other = said.total() - sum(said[outcome] for outcome in SAID)
            table.row(hand, "no" if kind is NumbHand else "yes", *(said[o] for o in SAID), other)


def objects(hands: Sequence[str]) -> None:
    """Close hands on objects by their pinches, and print the table."""
    told = (*SAID, None)  # None: held, and later told to be lost
    words = [o or "told lost" for o in told]
    table = Table("hand", "stays", *words, "falls", *words)
    for hand in hands:
        ready = bench(str(CONFIG / hand), RATE)
        said: Counter[tuple[bool, Outcome | None]] = Counter()
        pinches = [a for a in ready.library if isinstance(a, Primitive) and a.kind in PINCHES]
        for action in pinches[::2]:
            for thing, width in THINGS:
                seed = zlib.crc32(f"{hand}/{action.name}/{action.elements}/{thing}".encode())
                case = Case(
                    thing, width, WEIGHT, seed=seed, elements=action.elements, action=action.name
                )
                try:
                    truth = try_case(ready, case)
                except Unfit:
                    continue
                said[truth.held, None if truth.lost else truth.result.outcome] += 1
        if said:
            tries = Counter(held for held, _ in said.elements())
            counts = [(tries[held], *(said[held, o] for o in told)) for held in (True, False)]
            table.row(hand, *counts[0], *counts[1])


def what(result: Result, itself: bool = False) -> str:
    """Return in a word what a closing on nothing touched."""
    return "" if not result.touched else "itself" if itself else "**air**"


def touches(hands: Sequence[str]) -> None:
    """Touch nothing with hands that have never moved, and print the table."""
    speeds = [f"{speed * 1e3:g} mm/s" for speed in SPEEDS]
    table = Table("hand", *(f"{kind}, {v}" for kind in ("emulated", "MuJoCo") for v in speeds))
    for hand in hands:
        ready = bench(str(CONFIG / hand), RATE)
        emulated, dynamic = [], []
        for speed in SPEEDS:
            with simulated(hand) as made:
                emulated.append(what(made.touch(tip_speed=speed)))
            names, period = ready.hand.actuator_names, ready.settings.period
            simulation = make_simulation(ready.hand, SimOptions(), names, period)
            headless = NumbHand(ready.hand, ready.library, ready.settings, simulation)
            result = headless.do(touch_goal(tip_speed=speed))
            dynamic.append(what(result, itself=simulation.data.ncon > 0))
        table.row(hand, *emulated, *dynamic)


class Press(Observer):
    """Keeps the largest force of emulated devices on their object, as a share of their greatest."""

    def __init__(self, made: SimulatedHand) -> None:
        self.most = 0.0
        owners = [device.spec.owner for device in made._loop.devices.values()]
        emulators = [e for owner in owners for e in made._pool.simulation(owner).emulators]
        self._closings = [one for e in emulators for one in grasping(e).closings()]
        made._loop.add_observer(self)

    def on_tick(self, record: TickRecord) -> None:
        """Look at the object, which yields in proportion to the force."""
        for one in self._closings:
            if (found := one.motor.obstacle) is not None:
                deep = (one.motor.position - found.contact) * found.closing
                self.most = max(self.most, deep * found.stiffness / one.effort)


def presses(hands: Sequence[str]) -> None:
    """Touch an object at 0.4 of the way with emulated devices, and print the table."""
    table = Table("largest force", *(f"{speed * 1e3:g} mm/s" for speed in SPEEDS))
    for hand in hands:
        row = []
        for speed in SPEEDS:
            with simulated(hand, object="0.4") as made:
                press = Press(made)
                made.touch(tip_speed=speed)
                row.append(f"{100.0 * press.most:.0f} %")
        table.row(hand, *row)


def main() -> None:
    """Close the hands, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hand", nargs="+", help="these hands only")
    parser.add_argument("--objects", action="store_true", help="on objects instead of nothing")
    parser.add_argument("--touch", action="store_true", help="only slowly, until a first contact")
    parser.add_argument("--press", action="store_true", help="the same on an object: how hard")
    arguments = parser.parse_args()
    hands = arguments.hand or sorted(p.parent.name for p in CONFIG.glob("*/openings.yaml"))
    chosen = {touches: arguments.touch, presses: arguments.press, objects: arguments.objects}
    next((what for what, asked in chosen.items() if asked), empty)(hands)


if __name__ == "__main__":
    main()
