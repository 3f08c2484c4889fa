"""Try grasps with and without reflexes in MuJoCo: eggs, a cup that is filled, and a tug.

An egg of 60 g breaks when a finger presses on it with more than 8 N. A cup of 50 g is filled with
500 g within 5 s while it is held. A part of 50 g is tugged at with 5 N for half a second. Each is
tried with the object a little off the middle, lighter or heavier, and more or less slippery; it
succeeds if the object is still held afterwards, and whole. The trials are those of `rtee try
--task`. Run: python benchmarks/reflexes.py
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace
from pathlib import Path

from rtee.trials.bench import bench
from rtee.trials.tasks import RATE, End, GraspMode, Task, TaskTrial, run_task

CONFIG = Path(__file__).resolve().parents[1] / "config"

PINCH = ("index", "thumb")
HANDS = {
    "robotiq_2f_85": TaskTrial(Task.EGG, "Grasp", (), "sphere:0.02"),
    "robotiq_3f": TaskTrial(Task.EGG, "Grasp", (), "sphere:0.03"),
    "schunk_svh": TaskTrial(Task.EGG, "PinchTight", PINCH, "sphere:0.015", force=2.0, most=4.5),
}
"""The task of each hand, with the force to begin with and the largest force."""


def cell(hand: str, task: Task, mode: GraspMode, tries: int) -> str:
    """Return how many of so many variations succeeded, and how the others ended."""
    ready = bench(str(CONFIG / hand), RATE)
    trial = replace(HANDS[hand], task=task, mode=mode)
    ends = Counter(run_task(ready, trial, number).end for number in range(tries))
    others = ", ".join(f"{count} {end}" for end, count in ends.items() if end is not End.HELD)
    return f"{ends[End.HELD]} of {tries}" + (f" ({others})" if others else "")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hand", help="this hand only")
    parser.add_argument("--trials", type=int, default=6, help="variations of each")
    arguments = parser.parse_args()
    print("| hand | grasp | " + " | ".join(Task) + " |")
    print("| --- | --- |" + " ---: |" * len(Task))
    for hand in HANDS:
        if arguments.hand not in (None, hand):
            continue
        for mode in GraspMode:
            shown = " | ".join(cell(hand, task, mode, arguments.trials) for task in Task)
            print(f"| {hand} | {mode} | {shown} |", flush=True)


if __name__ == "__main__":
    main()
