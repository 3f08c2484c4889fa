"""Test whether rounding changes the results of the extraction; print Markdown.

    python benchmarks/perturbed.py [--hands schunk_svh …] [--times 20] [--jobs 0] [--every]

The origins of all joints are moved by 1e-12 to 1e-9 m, at random with a fixed seed, and the hand is
extracted again, several times. Per pinch, those of several fingers too: the least depth of its best
posture and of its deepest one as shares of the greatest of all runs, and in how many runs the best
posture is clear, way included.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import large_hand
import numpy as np
from common import HELP, Table, command_line

from rtee.actions.types import Primitive
from rtee.extract.extraction import extract
from rtee.hand.config import HandConfig
from rtee.hand.limits import Overrides
from rtee.hand.load import build_hand, load_hand
from rtee.hand.model import Hand
from rtee.hand.srdf import read_srdf
from rtee.hand.urdfread import read_urdf

HANDS = ("schunk_svh", "leap_hand", "large_hand")
SMALLEST, LARGEST = -12.0, -9.0
"""Decimal logarithms of the displacements of the origins [m]."""

Fingers = tuple[str, ...]


def moved(hand: Hand, random: np.random.Generator) -> Hand:
    """Return the hand with all joint origins moved."""
    joints = {}
    for name, joint in hand.urdf.joints.items():
        # Evenly over the orders of magnitude: each may meet another rounding boundary.
        step = 10.0 ** random.uniform(SMALLEST, LARGEST) * random.choice((-1.0, 1.0), 3)
        x, y, z = (a + float(b) for a, b in zip(joint.xyz, step, strict=True))
        joints[name] = replace(joint, xyz=(x, y, z))
    return replace(hand, urdf=replace(hand.urdf, joints=joints))


def pinches(hand: Hand, jobs: int) -> dict[Fingers, Primitive]:
    """Return the pinches that the extraction finds, by their fingers."""
    found = extract(hand, jobs=jobs).primitives
    return {p.elements: p for p in found if "PinchTight" in p.kind.value}


def compare(table: Table, hand: Hand, times: int, jobs: int, *, every: bool) -> None:
    """Print the results of the extraction for a hand with moved joints, beside the original."""
    # The same seed for all hands, so that runs can be compared.
    random = np.random.default_rng(0)
    runs = [pinches(moved(hand, random), jobs) for _ in range(times)]
    worst_best, worst_deepest, unequal = 1.0, 1.0, 0
    for fingers in sorted({key for run in runs for key in run}, key=lambda key: (len(key), key)):
        found = [run[fingers] for run in runs if fingers in run]
        first = np.array([p.evidence[0].depth for p in found])
        deepest = np.array([max(e.depth for e in p.evidence) for p in found])
        clear = sum(p.evidence[0].clear and p.evidence[0].path_clear for p in found)
        best = float(first.min() / first.max()) if len(found) == times else 0.0
        deep = float(deepest.min() / deepest.max()) if len(found) == times else 0.0
        worst_best, worst_deepest = min(worst_best, best), min(worst_deepest, deep)
        unequal += clear not in (0, times)
        if every or best < 0.98 or deep < 0.98 or clear not in (0, times):
            names = ", ".join(fingers)
            greatest = f"{1e3 * first.max():.2f}", f"{1e3 * deepest.max():.2f}"
            shares = f"{best:.1%}", f"{deep:.1%}"
            cells = (greatest[0], shares[0], greatest[1], shares[1], f"{clear} of {times}")
            table.row(hand.name, names, *cells)
    worst = f"**{worst_best:.1%}**", f"**{worst_deepest:.1%}**"
    table.row(hand.name, "**worst**", "", worst[0], "", worst[1], f"**{unequal} differ**")


def loaded(name: str) -> Hand:
    """Return a hand by its name or its URDF, or the one of 24 actuators."""
    if name != "large_hand" and not name.endswith(".urdf"):
        return load_hand(name)
    with tempfile.TemporaryDirectory() as folder:
        path = large_hand.write(Path(folder)) if name == "large_hand" else Path(name)
        srdf = path.with_suffix(".srdf")
        return build_hand(
            read_urdf(path),
            read_srdf(srdf) if srdf.exists() else None,
            Overrides(HandConfig(name=path.stem, urdf=path.name), name=path.stem),
        )


def main(arguments: Sequence[str]) -> None:
    parser = command_line(__doc__, times=20, jobs=0, every=False)
    parser.add_argument("--hands", nargs="+", default=list(HANDS), help=HELP["hands"])
    given = parser.parse_args(arguments)
    head = "best [mm]", "least share", "deepest [mm]", "least share", "clear"
    table = Table("hand", "fingers", *head)
    for name in given.hands:
        compare(table, loaded(name), given.times, given.jobs, every=given.every)


if __name__ == "__main__":
    main(sys.argv[1:])
