"""Measure how fast hands are as environments of Gymnasium, on one core.

Each does episodes of random targets with a sphere of 60 mm; the time is the processor's of the
calling thread, without that of building. Run: python benchmarks/gym.py
"""

from __future__ import annotations

import argparse
import time

from rtee.gym import RATE, HandEnv
from rtee.hand.catalog import hand_names


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("hands", nargs="*", help="all unless given")
    parser.add_argument("--steps", type=int, default=300)
    options = parser.parse_args()
    print("| hand | times real time |\n| --- | --- |")
    for name in options.hands or hand_names():
        env = HandEnv(name)
        env.action_space.seed(0)
        env.reset(seed=0)
        begin = time.thread_time()
        for _ in range(options.steps):
            _, _, lost, _, _ = env.step(env.action_space.sample())
            if lost:
                env.reset()
        took = time.thread_time() - begin
        print(f"| {name} | {options.steps / RATE / took:.0f} |", flush=True)


if __name__ == "__main__":
    main()
