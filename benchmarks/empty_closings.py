"""Close simulated hands on nothing, by each of their actions, and count what they say.

With the fingers' forces measured ("sensors") and by effort alone, in simulated time.
Run: python benchmarks/empty_closings.py
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

from common import Table
from grasp_cases import NumbHand

from rtee.actions.types import Timed
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import make_simulation
from rtee.drivers.mujoco.simulation import Simulation
from rtee.trials.bench import bench
from rtee.trials.headless import HeadlessHand
from rtee.types import Goal, Named, Outcome

CONFIG = Path(__file__).resolve().parents[1] / "config"
SAID = (Outcome.REACHED, Outcome.CLOSED, Outcome.STALLED, Outcome.HELD)


def main() -> None:
    """Close the hands, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hand", nargs="+", help="these hands only")
    hands = parser.parse_args().hand or sorted(
        p.parent.name for p in CONFIG.glob("*/openings.yaml")
    )
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


if __name__ == "__main__":
    main()
