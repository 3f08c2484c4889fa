"""Measure the extraction beside random sampling and a search of many starts; print Markdown.

    python benchmarks/extract.py [--hands schunk_svh some/hand.urdf …] [--runs 3] [--jobs 0]
                                 [--starts 256] [--no-sampling]

A hand is given by its name or its URDF; an SRDF of the same name beside the URDF is used, too.

Extraction: the whole process `rtee extract HAND --json`, cold, with rtee compiled to bytecode as an
installation does; median wall and processor time and peak memory. Beside it the reference
implementation's procedure, in this process: 5,000 uniformly random postures for tight pinches,
5,000 with widened limits, 5,000 for distances and 3,000 per number of fingers, with the signed
distance of the tips' convex parts. A pair counts as found where it is negative.

With `--starts N`, a second table: per pinch, those of several fingers too, the depth that is stored
as a share of the depth that descents from the first N points of a low-discrepancy sequence find on
the same geometry, the best eight of them polished.
"""

from __future__ import annotations

import compileall
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from common import HELP, Table, command_line

import rtee
from rtee.extract.descent import Minimum, descend
from rtee.extract.evidence import Inspector
from rtee.extract.goals import GoalFunction, MultiPinchGoal, PinchGoal, SearchGoal, TipEdge
from rtee.extract.pairs import LinkPair
from rtee.extract.polish import polish
from rtee.extract.resolution import FINE
from rtee.extract.scene import Scene
from rtee.extract.search import distinct
from rtee.extract.space import Space, make_space, real_limits, widened_limits
from rtee.hand.halton import halton
from rtee.hand.load import load_hand, load_model
from rtee.hand.model import Hand

HANDS = ("robotiq_2f_85", "robotiq_3f", "dagana", "qb_softhand", "heri_ii", "schunk_svh")
# Samples and polished minima as in the reference implementation; see above.
TIGHT = WIDE = DISTANCE = 5000
SEVERAL = 3000
POLISHED = 8
NOTHING = 1e-7
"""A smaller depth is a bare contact [m]."""

Fingers = frozenset[str]


@dataclass
class Measured:
    """The cost of runs of the extraction, and the depths of the pinches they found [m]."""

    wall: float
    cpu: float
    peak: float
    depths: dict[Fingers, float]


def files(hand: str) -> tuple[Path, Path | None] | None:
    """Return the URDF and the SRDF of a hand that is given by its URDF."""
    if not hand.endswith(".urdf"):
        return None
    srdf = Path(hand).with_suffix(".srdf")
    return Path(hand), srdf if srdf.exists() else None


def loaded(hand: str) -> Hand:
    """Return a hand."""
    given = files(hand)
    return load_hand(hand) if given is None else load_model(*given)


def extracted(hand: str, runs: int, jobs: int) -> Measured:
    """Run the extraction several times; medians of times [s], the peak memory [MB]."""
    rtee = str(Path(sys.executable).with_name("rtee"))
    given = files(hand)
    if given is None:
        source = [hand]
    else:
        source = ["--urdf", str(given[0]), *(["--srdf", str(given[1])] if given[1] else [])]
    walls, cpus, peaks, output = [], [], [], b""
    for _ in range(runs):
        start = time.perf_counter()
        process = subprocess.Popen(
            [rtee, "extract", *source, "--json", "--jobs", str(jobs)],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        assert process.stdout is not None
        # Read to the end before waiting: a full pipe would stop the process.
        output = process.stdout.read()
        # With the processes that it started: `resource` would only count those of this one.
        _, status, usage = os.wait4(process.pid, 0)
        walls.append(time.perf_counter() - start)
        cpus.append(usage.ru_utime + usage.ru_stime)
        # Linux counts in KiB.
        peaks.append(usage.ru_maxrss / 1024)
        assert status == 0
    depths = {
        frozenset(p["elements"]): max(
            e["evidence"].get("depth", 0.0) for e in (p, *p.get("alternatives", ()))
        )
        for p in json.loads(output)["primitives"]
        if "PinchTight" in p["kind"]
    }
    return Measured(statistics.median(walls), statistics.median(cpus), max(peaks), depths)


def tip_pairs(scene: Scene) -> dict[Fingers, LinkPair]:
    """Return the pairs of fingertips by the names of their fingers."""
    tipped = [f for f in scene.hand.fingers if f.tip]
    return {
        frozenset((a.name, b.name)): scene.tips[str(a.tip), str(b.tip)]
        for a, b in combinations(tipped, 2)
        if (str(a.tip), str(b.tip)) in scene.tips
    }


def sampled(hand: Hand, seed: int = 0) -> tuple[float, dict[Fingers, float]]:
    """Return the time [s] random sampling takes and the depths of the pairs it finds [m]."""
    scene = Inspector.of(hand).scene
    random = np.random.default_rng(seed)
    start = time.perf_counter()
    depths: dict[Fingers, float] = {}
    pairs = tip_pairs(scene)
    tips = sum(finger.tip is not None for finger in hand.fingers)
    rounds = [(real_limits(hand), TIGHT + DISTANCE), (widened_limits(hand), WIDE)]
    # Groups of three fingers up to all: two are the pairs above.
    rounds += [(real_limits(hand), SEVERAL)] * max(0, tips - 2)
    for index, ((lower, upper), count) in enumerate(rounds):
        for u in random.uniform(lower, upper, (count, len(lower))):
            scene.place(u)
            with scene.fine():
                gaps = scene.distances(list(pairs.values()))
            for names, gap in zip(pairs, gaps, strict=True):
                if index == 0 and gap < 0.0:
                    depths[names] = max(depths.get(names, 0.0), -gap)
    return time.perf_counter() - start, depths


def goals(scene: Scene, found: Iterable[Fingers]) -> Iterator[tuple[Fingers, SearchGoal, Space]]:
    """Yield the tips to press together and the search's bounds: all pairs, and the groups found."""
    limits, pairs = real_limits(scene.hand), tip_pairs(scene)
    for names, tips in pairs.items():
        yield names, PinchGoal(scene, tips), make_space(scene.hand, sorted(tips.actuators), limits)
    pinching = [names for names in pairs if names in found]
    for group in sorted((names for names in found if len(names) > 2), key=sorted):
        order = [f.name for f in scene.hand.fingers if f.name in group]
        links = [
            TipEdge((order.index(a), order.index(b)), pairs[frozenset((a, b))])
            for a, b in combinations(order, 2)
            if frozenset((a, b)) in pinching
        ]
        moving = sorted(frozenset().union(*(link.tips.actuators for link in links)))
        bystanders = [
            tips
            for names, tips in pairs.items()
            if not names <= group and tips.actuators & set(moving)
        ]
        goal = MultiPinchGoal(scene, len(order), links, bystanders)
        yield group, goal, make_space(scene.hand, moving, limits)


def meets_bystanders(
    scene: Scene, goal: MultiPinchGoal, space: Space, found: Sequence[Minimum]
) -> bool:
    """Return whether minima overlap tips that take no part, which the goal then pushes away."""
    met = False
    for minimum in found:
        scene.place(space.posture(minimum.y))
        met |= goal.learn_bystanders()
    return met


def deepest(scene: Scene, goal: SearchGoal, space: Space, starts: int) -> float:
    """Return the depth [m] at which tips touch that descents from many starts find."""
    function = GoalFunction(scene, goal, space)
    while True:
        found = [
            descend(function, y, evaluations=60, resolution=FINE)
            for y in halton(space.size, starts)
        ]
        best = distinct(found)[:POLISHED]
        if not (isinstance(goal, MultiPinchGoal) and meets_bystanders(scene, goal, space, best)):
            break
    ends = [*best, *(polish(function, m.y, evaluations=60) for m in best)]
    for end in sorted(ends, key=lambda m: m.value):
        scene.place(space.posture(end.y))
        if end.value < 0.0 and goal.touching():
            return -end.value
    return 0.0


def compare_speed(hands: Sequence[str], runs: int, jobs: int, *, sampling: bool) -> None:
    head = ["hand", "wall [s]", "CPU [s]", "memory [MB]", "pairs", "deepest, sum [mm]"]
    table = Table(*head, *(["sampling [s]", "pairs", "deepest, sum [mm]"] if sampling else []))
    for hand in hands:
        measured = extracted(hand, runs, jobs)
        pairs = [depth for names, depth in measured.depths.items() if len(names) == 2]
        cells = [Path(hand).stem, f"{measured.wall:.2f}", f"{measured.cpu:.2f}"]
        cells += [f"{measured.peak:.0f}", str(len(pairs)), f"{1e3 * sum(pairs):.1f}"]
        if sampling:
            seconds, found = sampled(loaded(hand))
            cells += [f"{seconds:.2f}", str(len(found)), f"{1e3 * sum(found.values()):.1f}"]
        table.row(*cells)


def compare_depth(hands: Sequence[str], jobs: int, starts: int) -> None:
    table = Table("hand", "pinch", "stored [mm]", f"{starts} starts [mm]", "share")
    for hand in hands:
        name, depths = Path(hand).stem, extracted(hand, 1, jobs).depths
        scene = Scene(loaded(hand))
        shares = []
        for names, goal, space in goals(scene, depths):
            with scene.fine():
                known = deepest(scene, goal, space, starts)
            depth = depths.get(names, 0.0)
            if known or depth:
                # Shares of a bare contact would be quotients of rounding errors.
                shares.append(depth / known if known > NOTHING else 1.0)
                fingers = ", ".join(sorted(names))
                table.row(
                    name, fingers, f"{1e3 * depth:.3f}", f"{1e3 * known:.3f}", f"{shares[-1]:.2%}"
                )
        worst = f"{min(shares):.2%}" if shares else "no pinch"
        table.row(name, "**worst**", "", "", f"**{worst}**")


def main() -> None:
    parser = command_line(__doc__, runs=3, jobs=0, starts=0, no_sampling=False)
    parser.add_argument("--hands", nargs="+", default=list(HANDS), help=HELP["hands"])
    arguments = parser.parse_args()
    # Otherwise the first run alone would pay for the compilation.
    compileall.compile_dir(str(Path(rtee.__file__).parent), quiet=1)
    compare_speed(
        arguments.hands, arguments.runs, arguments.jobs, sampling=not arguments.no_sampling
    )
    if arguments.starts:
        print()
        compare_depth(arguments.hands, arguments.jobs, arguments.starts)


if __name__ == "__main__":
    main()
