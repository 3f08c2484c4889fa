"""Measure the speed of simulated hands: headless, and in lockstep with the loop.

Run: ``python benchmarks/simulation.py [--seconds S]``; prints Markdown.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from pathlib import Path

import anyio
from common import Table, command_line

from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import make_simulation
from rtee.running.run import RunOptions, run_hands
from rtee.trials.bench import bench
from rtee.trials.headless import HeadlessHand
from rtee.types import Goal, Named

HEADLESS = (
    ("robotiq_2f_85", "Grasp", "sphere:0.03"),
    ("robotiq_3f", "Grasp", "cylinder:0.025x0.12"),
    ("heri_ii", "Grasp", "sphere:0.03"),
    ("schunk_svh", "Grasp", "sphere:0.03"),
)
ROUNDS = 5  # of each grasp; the median counts


def headless(name: str, action: str, shape: str) -> float:
    """Return the seconds simulated per second of one processor, controller included (median)."""
    ready = bench(name)
    factors = []
    for _ in range(ROUNDS):
        simulation = make_simulation(
            ready.hand, SimOptions(object=shape), ready.hand.actuator_names, ready.settings.period
        )
        hand = HeadlessHand(ready.hand, ready.library, ready.settings, simulation)
        # Processor time: the figure must not depend on what else the computer does.
        began = time.process_time()
        hand.do(Goal(Named(action)))
        hand.wait(1.0)
        factors.append(hand.time / (time.process_time() - began))
    return statistics.median(factors)


def lockstep(driver: str, seconds: float) -> tuple[str, float]:
    """Run the SVH at 500 Hz with loop and log.

    Returns:
        The loop's own statistics, and the processor time used per second of the run [s].
    """
    lines: list[str] = []
    began = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        options = RunOptions(driver=driver, rate=500.0, duration=seconds, log=Path(folder))
        anyio.run(lambda: run_hands(["schunk_svh"], options, serve=None, say=lines.append))
    used = (time.process_time() - began) / seconds
    return next(line for line in lines if " ticks at " in line), used


def main() -> None:
    """Print the figures as Markdown."""
    arguments = command_line(__doc__, seconds=20.0, pairs=2).parse_args()
    table = Table("hand", "grasp", "simulated seconds per second of one processor")
    for name, action, shape in HEADLESS:
        factor = headless(name, action, shape)
        table.row(name, f"{action} on {shape}", f"{factor:.1f}")
    print("\nSVH at 500 Hz with loop and log, the two drivers in turns:\n")
    for _ in range(arguments.pairs):
        for driver in ("kinematic", "mujoco"):
            line, used = lockstep(driver, arguments.seconds)
            print(f"    {driver:<9} {line}; {used:.2f} s of processor time per second", flush=True)


if __name__ == "__main__":
    main()
