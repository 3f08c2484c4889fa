"""The extraction measured beside random sampling on the same geometry; prints Markdown.

    python benchmarks/extract.py [--hands schunk_svh robotiq_3f …] [--runs 3] [--jobs 0]

Extraction: the whole process `rtee extract HAND --json`, cold; median wall time and peak memory.
Beside it the reference implementation's procedure, in this process: 5,000 uniformly random postures
for tight pinches, 5,000 with widened limits, 5,000 for distances and 3,000 per number of fingers,
with the signed distance of the tips' convex parts. A pair counts as found where it is negative.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from itertools import combinations
from pathlib import Path

import numpy as np

from rtee.extract.evidence import Inspector
from rtee.extract.space import real_limits, widened_limits
from rtee.hand.load import load_hand

HANDS = ("robotiq_2f_85", "robotiq_3f", "dagana", "qb_softhand", "heri_ii", "schunk_svh")
TIGHT = WIDE = DISTANCE = 5000
SEVERAL = 3000


def extracted(hand: str, runs: int, jobs: int) -> tuple[float, float, dict[frozenset[str], float]]:
    """Return the median wall time [s], the peak memory [MB] and the depths of the pairs [m]."""
    rtee = str(Path(sys.executable).with_name("rtee"))
    walls, peaks, output = [], [], b""
    for _ in range(runs):
        start = time.perf_counter()
        process = subprocess.Popen(
            [rtee, "extract", hand, "--json", "--jobs", str(jobs)],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        assert process.stdout is not None
        output = process.stdout.read()
        _, status, usage = os.wait4(process.pid, 0)
        walls.append(time.perf_counter() - start)
        peaks.append(usage.ru_maxrss / 1024)
        assert status == 0
    depths = {
        frozenset(p["elements"]): max(
            e["evidence"].get("depth", 0.0) for e in (p, *p.get("alternatives", ()))
        )
        for p in json.loads(output)["primitives"]
        if p["kind"] == "PinchTight"
    }
    return statistics.median(walls), max(peaks), depths


def sampled(name: str, seed: int = 0) -> tuple[float, dict[frozenset[str], float]]:
    """Return the time [s] random sampling takes and the depths of the pairs it finds [m]."""
    hand = load_hand(name)
    scene = Inspector.of(hand).scene
    random = np.random.default_rng(seed)
    start = time.perf_counter()
    depths: dict[frozenset[str], float] = {}
    tipped = [f for f in hand.fingers if f.tip]
    pairs = {
        frozenset((a.name, b.name)): scene.tips[str(a.tip), str(b.tip)]
        for a, b in combinations(tipped, 2)
        if (str(a.tip), str(b.tip)) in scene.tips
    }
    rounds = [(real_limits(hand), TIGHT + DISTANCE), (widened_limits(hand), WIDE)]
    rounds += [(real_limits(hand), SEVERAL)] * max(0, len(tipped) - 2)
    for index, ((lower, upper), count) in enumerate(rounds):
        for u in random.uniform(lower, upper, (count, len(lower))):
            scene.place(u)
            for names, pair in pairs.items():
                gap = scene.distance(pair)
                if index == 0 and gap < 0.0:
                    depths[names] = max(depths.get(names, 0.0), -gap)
    return time.perf_counter() - start, depths


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hands", nargs="+", default=list(HANDS))
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=0)
    arguments = parser.parse_args()
    print(
        "| hand | extract [s] | memory [MB] | pairs | deepest, sum [mm] | sampling [s] | pairs "
        "| deepest, sum [mm] |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for hand in arguments.hands:
        wall, peak, depths = extracted(hand, arguments.runs, arguments.jobs)
        seconds, found = sampled(hand)
        print(
            f"| {hand} | {wall:.2f} | {peak:.0f} "
            f"| {len(depths)} | {1e3 * sum(depths.values()):.1f} "
            f"| {seconds:.2f} | {len(found)} | {1e3 * sum(found.values()):.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
