"""Record a stream from Python and play it again.  Run `rtee run schunk_svh` first.

python examples/record_and_play.py record wave.csv
python examples/record_and_play.py play wave.csv
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
import time
from pathlib import Path

import rtee
from rtee.errors import RteeError
from rtee.teleop.drive import rate_of, recorded

RATE = 50.0
"""Samples per second [Hz]."""

ACTION = "PinchTight index thumb"


def record(path: Path) -> None:
    """Stream a sine, and write it into a table."""
    rows = [("t", ACTION)]
    with rtee.connect_blocking() as hand, hand.stream(rate=RATE) as stream:
        begin = time.monotonic()
        for k in range(round(5 * RATE)):
            stamp = begin + k / RATE
            time.sleep(max(0.0, stamp - time.monotonic()))
            value = 0.5 - 0.5 * math.cos(2.0 * math.pi * 0.4 * k / RATE)
            stream.send({ACTION: value}, stamp=stamp)
            rows.append((f"{k / RATE:.3f}", f"{value:.4f}"))
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows)


def play(path: Path) -> None:
    """Stream the table, or the newest stream of a recording."""
    samples = recorded(path)
    with rtee.connect_blocking() as hand, hand.stream(rate=rate_of(samples)) as stream:
        begin = time.monotonic()
        for sample in samples:
            stamp = begin + sample.time
            time.sleep(max(0.0, stamp - time.monotonic()))
            stream.send(sample.targets, sample.velocity, stamp)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Record a stream from Python and play it again.")
    parser.add_argument("what", choices=["record", "play"])
    parser.add_argument("file", type=Path, help="the table; for play also a recording")
    args = parser.parse_args()
    try:
        {"record": record, "play": play}[args.what](args.file)
    except (RteeError, OSError) as error:
        sys.exit(f"record_and_play: {error}")
