"""Measure how hands follow a person's, and whether their fingertips meet where the person's do.

Sequences are made of a parametric hand in three sizes: pinches with each finger, fists, spreads,
noise of a webcam, dropouts; with --recorded FILE also a recorded one (npz, `joints` (k, 21, 3) [m]
at 30 Hz). Near are the frames in which two human tips are within 35 mm; there, the gap between the
robot's surfaces is compared with the person's own, the distance beyond 18 mm, scaled as the fingers
are; tips that cannot meet in the model do not count. With --dexi PYTHON, the interpreter of an
environment with dexi-rs, its DexPilot gets the same
URDFs, tips, scales and points in the palm's frame. Run: python benchmarks/retarget.py
"""

from __future__ import annotations

import argparse
import json
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rtee.hand.catalog import hand_names
from rtee.retarget import Retargeter
from rtee.retarget.human import FINGERS, in_palm
from rtee.retarget.layouts import Side
from rtee.sample import FloatArray
from rtee.testing.human_hand import HumanHand

HANDS = ("schunk_svh", "leap_hand", "allegro", "inspire_rh56", "ability_hand", "linkerhand_l10")
RATE = 30.0  # of a webcam [Hz]
NEAR = 0.035  # human tips that mean to meet [m]
TOUCH = 0.018  # distance of human tips that touch [m]
FINGER = 0.085  # length of a human finger [m], by which gaps are scaled
MEETS = 0.001  # gap in the extracted pinch of tips that can meet [m]
NOISE = 0.001  # standard deviation of each coordinate [m]
LOST = 0.02  # share of frames without a hand


@dataclass(frozen=True)
class Followed:
    """Positions by frame ``(k, n)``, and the time of each step [s]."""

    positions: FloatArray
    times: FloatArray


def made(size: float, seed: int = 0) -> list[FloatArray | None]:
    """Return a sequence of a person's points, with ``None`` where the hand was lost."""
    hand, random = HumanHand(size), np.random.default_rng(seed)
    frames: list[FloatArray] = []
    for _ in range(2):
        for finger in range(1, 5):
            way = np.concatenate([np.linspace(0.09, 0.014, 25), np.linspace(0.014, 0.09, 25)])
            frames += [hand.points(pinch=(finger, size * float(d))) for d in way]
        for k in range(60):
            frames.append(hand.points((0.5 - 0.5 * np.cos(k / 30 * 2 * np.pi),) * 5))
        for k in range(30):
            frames.append(hand.points(spread=0.12 * float(np.sin(k / 30 * 2 * np.pi))))
    noisy = [points + random.normal(0.0, NOISE, points.shape) for points in frames]
    return [None if random.random() < LOST else points for points in noisy]


def follow(retargeter: Retargeter, frames: list[FloatArray | None]) -> Followed:
    positions, times = [], []
    for k, points in enumerate(frames):
        begin = time.thread_time()
        answer = retargeter.step(points, k / RATE)
        times.append(time.thread_time() - begin)
        positions.append([*answer.values()])
    return Followed(np.array(positions), np.array(times))


_DEXI = """
import json, sys, time
import dexi_rs, numpy as np
given = json.load(sys.stdin)
solver = dexi_rs.load_config({"type": "dexpilot", "urdf_path": given["urdf"],
    "wrist_link_name": given["base"], "finger_tip_link_names": given["tips"],
    "target_joint_names": given["joints"], "scaling_factor": given["scale"]}).build()
n = len(given["tips"])
pairs = [(j, i) for i in range(1, n) for j in range(i + 1, n + 1)]
pairs += [(0, i) for i in range(1, n + 1)]
out, times = [], []
for points in given["frames"]:
    points = np.array(points)
    ref = np.array([points[i] - points[j] for j, i in pairs])
    begin = time.thread_time()
    q = solver.retarget(ref.ravel().tolist())
    times.append(time.thread_time() - begin)
    by_name = dict(zip(solver.joint_names, np.array(q).tolist()))
    out.append([by_name[name] for name in given["joints"]])
print(json.dumps([out, times]))
"""


def dexi(python: str, retargeter: Retargeter, frames: list[FloatArray | None]) -> Followed:
    """Return what dexi-rs's DexPilot makes of the same points, in the robot's palm frame."""
    hand, found = retargeter.hand, retargeter.correspondence
    order = sorted(found.fingers, key=lambda name: FINGERS.index(found.fingers[name].human))
    palm = found.palm
    axes = np.array([palm.palmar, palm.radial, palm.distal])
    marks = [0, *(4 + 4 * FINGERS.index(found.fingers[name].human) for name in order)]
    given, last = [], np.zeros((21, 3))
    for points in frames:
        last = last if points is None else in_palm(points, Side.RIGHT) @ axes
        given.append(last[marks].tolist())
    asked = {
        "urdf": str(hand.urdf.path),
        "base": hand.base,
        "tips": [hand.finger(name).tip for name in order],
        "joints": list(hand.actuator_names),
        "scale": float(np.mean([found.fingers[name].reach for name in order[1:]])) / FINGER,
        "frames": given,
    }
    done = subprocess.run(
        [python, "-c", _DEXI],
        input=json.dumps(asked),
        capture_output=True,
        text=True,
        check=True,
    )
    positions, times = json.loads(done.stdout)
    return Followed(np.array(positions), np.array(times))


def measure(
    retargeter: Retargeter, frames: list[FloatArray | None], found: Followed, size: float
) -> str:
    hand, maps = retargeter.hand, retargeter.correspondence.fingers
    seen = np.array([np.full((21, 3), np.nan) if f is None else f for f in frames])
    tips = seen[:, 4::4]
    apart = np.linalg.norm(tips - tips[:, :1], axis=2) / size
    beyond, correlations, own, robot = [], [], [], []
    for pinch in retargeter.correspondence.pinches:
        human = maps[pinch.fingers[1]].human
        distance = (
            apart[:, 1:].min(axis=1) if human == "nearest" else apart[:, FINGERS.index(human)]
        )
        scale = float(np.mean([maps[name].reach for name in pinch.fingers])) / FINGER
        if pinch.widths:
            scale = pinch.widths[0] / (0.095 - TOUCH)
        if not pinch.contact or retargeter.gap(pinch.contact, *pinch.fingers) > MEETS:
            continue  # the hand's tips cannot meet
        gaps = np.array(
            [
                retargeter.gap(dict(zip(hand.actuator_names, u, strict=True)), *pinch.fingers)
                for u in found.positions.tolist()
            ]
        )
        there = ~np.isnan(distance)
        correlations.append(np.corrcoef(gaps[there], distance[there])[0, 1])
        near = np.flatnonzero(there & (distance < NEAR))
        robot += gaps[near].tolist()
        own += distance[near].tolist()
        beyond += (gaps[near] - scale * np.maximum(0.0, distance[near] - TOUCH)).tolist()
    ms, mm = 1e3 * found.times, 1e3
    moves = np.abs(np.diff(found.positions, axis=0))
    jerk = np.sqrt((np.diff(found.positions, 3, axis=0) ** 2).mean())
    words = (
        f"{np.percentile(ms, 50):.2f} / {np.percentile(ms, 99):.2f} | {moves.max():.2f} | "
        f"{jerk:.3f} | {np.mean(correlations):.2f} | "
    )
    if not beyond:
        return words + "no frames | |"
    return words + (
        f"{len(beyond)}, {np.median(own) * mm:.0f} | "
        f"{np.median(robot) * mm:.1f} / {np.percentile(robot, 90) * mm:.1f} | "
        f"{np.median(beyond) * mm:.1f} / {np.percentile(beyond, 90) * mm:.1f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("hands", nargs="*", default=list(HANDS), help="'all' for every hand")
    parser.add_argument("--recorded", type=Path, help="points of a real hand (npz)")
    parser.add_argument("--dexi", metavar="PYTHON", help="an interpreter that has dexi-rs")
    options = parser.parse_args()
    sequences: dict[str, tuple[list[FloatArray | None], float]] = {
        f"made, size {size:g}": (made(size), size) for size in (0.85, 1.0, 1.15)
    }
    if options.recorded:
        with np.load(options.recorded) as arrays:
            sequences["recorded"] = (list(arrays["joints"].astype(np.float64)), 1.0)
    print("| hand | sequence | p50 / p99 [ms] | largest step | third difference | correlation |")
    print("| near: frames, human [mm] | surface gap p50 / p90 [mm] | beyond p50 / p90 [mm] |")
    for name in hand_names() if options.hands == ["all"] else options.hands:
        for sequence, (frames, size) in sequences.items():
            retargeter = Retargeter.of(name)
            found = follow(retargeter, frames)
            print(f"| {name} | {sequence} | {measure(retargeter, frames, found, size)}", flush=True)
            if options.dexi:
                try:
                    theirs = dexi(options.dexi, retargeter, frames)
                    row = measure(retargeter, frames, theirs, size)
                except subprocess.CalledProcessError as error:
                    row = f"cannot: {error.stderr.strip().splitlines()[-1]} |"
                print(f"| {name}, dexi-rs | {sequence} | {row}", flush=True)


if __name__ == "__main__":
    main()
