"""Check the scores of planned grasps from a table with things that a seed draws.

A score says which share of such grasps holds. Boxes, prisms, cylinders, cones, balls, mugs,
bottles, hammers and plates of drawn sizes and masses stand or lie on a table, others for each hand,
which tries its first choice for each with variations: position (5 mm), orientation (5 degrees) and
friction (0.5 to 1.0). No score was fitted to what a new seed draws.

Run: ``python benchmarks/grasp_scores.py [--seed N] [--varied N] [--only KIND] [--hands H …]``;
prints Markdown: the first choices, and how many hold in each band of scores, with the interval
that holds the rate with 95 % confidence.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from common import Table, command_line
from grasp_plan import small

from rtee.errors import RteeError
from rtee.objects.shape import Table as Plane
from rtee.planning.objects import GraspObject, hull_piece, read_object
from rtee.planning.plan import plan_grasps
from rtee.sample import FloatArray
from rtee.trials.bench import bench
from rtee.trials.planned import check_plan
from rtee.trials.variation import interval, interval_text

sys.path.insert(0, str(Path(__file__).parents[1]))

from experiments.objects.make import box, prism, revolved, turned

HANDS: Final = ("amazing_hand", "heri_ii", "robotiq_2f_85", "robotiq_3f")
BANDS: Final = (0.0, 0.2, 0.4, 0.6, 0.8, 0.9, 1.0)
MASSES: Final = (0.02, 0.4)
"""Range of masses [kg]; half of them are below 0.09 kg."""

Draw = Callable[[float, float], float]
"""Draws a number between two others."""


@dataclass(frozen=True)
class Thing:
    """What stands on the table, and which of its axes points up."""

    object: GraspObject
    up: tuple[float, float, float]


def _outline(corners: int) -> list[tuple[float, float]]:
    turn = np.arange(corners) * (2.0 * math.pi / corners)
    return [(0.5 * float(np.cos(t)), 0.5 * float(np.sin(t))) for t in turn]


def _shapes(draw: Draw) -> Iterator[tuple[str, str | Sequence[FloatArray], bool]]:
    """Yield name, parts (or the text of a shape), and whether it lies, of each kind of thing."""
    size = [draw(0.02, 0.07) for _ in range(3)]
    yield "box", f"box:{size[0]:.4f}x{size[1]:.4f}x{size[2]:.4f}", False
    radius, height = draw(0.012, 0.033), draw(0.04, 0.11)
    yield "cylinder", f"cylinder:{radius:.4f}x{height:.4f}", False
    radius, height = draw(0.012, 0.03), draw(0.05, 0.14)
    yield "roller", f"cylinder:{radius:.4f}x{height:.4f}", True
    yield "ball", f"sphere:{draw(0.018, 0.035):.4f}", False
    corners, across, height = round(draw(2.6, 8.4)), draw(0.03, 0.065), draw(0.03, 0.09)
    yield f"prism{corners}", [prism(_outline(corners), (across, across, height))], False
    low, high, height = draw(0.02, 0.035), draw(0.01, 0.02), draw(0.04, 0.08)
    yield "cone", [revolved([(low, 0.0), (high, height)])], False
    radius, height = draw(0.025, 0.035), draw(0.06, 0.1)
    bar = (0.028, 0.01, 0.01)
    yield (
        "mug",
        [
            revolved([(radius, 0.0), (radius, height)]),
            box(bar, (radius + 0.012, 0.0, 0.75 * height)),
            box((0.01, 0.0102, 0.5 * height + 0.012), (radius + 0.024, 0.0, 0.5 * height)),
            box(bar, (radius + 0.012, 0.0, 0.25 * height)),
        ],
        False,
    )
    radius, neck, height = draw(0.018, 0.03), draw(0.008, 0.013), draw(0.09, 0.16)
    yield (
        "bottle",
        [
            revolved([(radius, 0.0), (radius, 0.65 * height)]),
            revolved([(radius, 0.649 * height), (neck, 0.8 * height)]),
            revolved([(neck, 0.799 * height), (neck, height)]),
        ],
        False,
    )
    # A heavy head at one end of a handle.
    handle, length, head = draw(0.009, 0.014), draw(0.1, 0.16), draw(0.03, 0.045)
    yield (
        "hammer",
        [
            turned(revolved([(handle, 0.0), (handle, length)]), 0.5 * math.pi, (0.0, 0.0, 0.0)),
            box((head, 1.6 * head, head), (-0.4 * head, 0.0, 0.0)),
        ],
        False,
    )
    yield (
        "plate",
        [revolved([(draw(0.05, 0.08), 0.0), (draw(0.055, 0.08), draw(0.01, 0.015))])],
        (False),
    )


def things(seed: int, hand: str) -> Iterator[Thing]:
    """Yield what a seed draws for a hand, one of each kind."""
    random = np.random.default_rng([seed, *hand.encode()])

    def draw(low: float, high: float) -> float:
        return float(random.uniform(low, high))

    for kind, parts, lies in _shapes(draw):
        mass = round(math.exp(draw(*(math.log(limit) for limit in MASSES))), 3)
        up = (1.0, 0.0, 0.0) if lies else (0.0, 0.0, 1.0)
        if isinstance(parts, str):
            yield Thing(read_object(parts, mass), up)
            continue
        points = [np.unique(part.reshape(-1, 3).round(6), axis=0) for part in parts]
        yield Thing(GraspObject(kind, tuple(hull_piece(each) for each in points), mass), up)


def main() -> None:
    """Print the figures as Markdown."""
    parser = command_line(__doc__, only="", seed=101, varied=1)
    parser.add_argument("--hands", nargs="+", default=list(HANDS), help="names of hands")
    arguments = parser.parse_args()
    table = Table("hand", "object", "mass [kg]", "first choice", "score", "held", "why not")
    tries: list[tuple[float, bool]] = []
    for name in arguments.hands:
        ready = bench(name)
        for index, thing in enumerate(things(arguments.seed, name)):
            obj = thing.object
            if arguments.only not in obj.name:
                continue
            try:
                ranking = plan_grasps(ready.hand, ready.library, obj, table=Plane(thing.up))
            except RteeError as error:
                table.row(name, obj.name, obj.mass, "none", "", "", str(error))
                continue
            if not ranking.plans:
                table.row(name, obj.name, obj.mass, "none", "", "", "")
                continue
            plan = ranking.plans[0]
            numbers = range(index * arguments.varied, (index + 1) * arguments.varied)
            draws = [small(arguments.seed, number) for number in numbers]
            checks = [check_plan(ready, obj, ranking, plan, variation) for variation in draws]
            tries += [(plan.score, check.held) for check in checks]
            held = sum(check.held for check in checks)
            why = "; ".join(dict.fromkeys(check.reason for check in checks if check.reason))
            share = f"{held} of {len(checks)}"
            table.row(name, obj.name, obj.mass, plan.label, plan.score, share, why)
            sys.stdout.flush()
    print()
    bands = Table("score", "mean", "held", "share", "with 95 % confidence")
    for low, high in pairwise(BANDS):
        found = [each for each in tries if low <= each[0] < high]
        if found:
            mean = sum(score for score, _ in found) / len(found)
            count = sum(held for _, held in found)
            share, words = count / len(found), interval_text(count, len(found))
            below, above = interval(count, len(found))
            words += "" if below <= mean <= above else ", without the score"
            held_of = f"{count} of {len(found)}"
            bands.row(f"{low} to {high}", f"{mean:.2f}", held_of, f"{share:.0%}", words)


if __name__ == "__main__":
    main()
