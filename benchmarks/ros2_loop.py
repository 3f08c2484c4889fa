"""Measure the cost of a ROS 2 node to the hand's loop, and lost states; print Markdown tables.

    python benchmarks/ros2_loop.py [--hand schunk_svh] [--rounds 5] [--seconds 10] [--minute 60]

`rtee run` with the kinematic driver, by turns alone, with a client of rtee that takes 100 states a
second, and with ``--ros2``, whose joint states a session of its own receives at 100 Hz. What the
loop says at its end is compared. Then the joint states of a longer run are counted by the numbers
in their attachments: a gap is a message that was lost on the way.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator

import zenoh
from common import Table, command_line

from rtee.ros2 import attachments

WAYS = ("alone", "with a client at 100 Hz", "with --ros2 at 100 Hz")
MISSED = re.compile(r"(\d+) ticks at \S+ Hz, (\d+) missed")
LATENESS = re.compile(r"lateness p50 \d+, p99 (\d+)")


def free_endpoint() -> str:
    """Return a loopback endpoint with a free port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@contextlib.contextmanager
def listening(endpoint: str) -> Iterator[list[int]]:
    """Run the router, and note the numbers of all joint states."""
    config = zenoh.Config()
    settings = {
        "mode": "router",
        "listen/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    numbers: list[int] = []

    def note(sample: zenoh.Sample) -> None:
        numbers.append(attachments.decode(sample.attachment).sequence)

    with zenoh.open(config) as session:
        session.declare_subscriber("0/joint_states/**", note)
        yield numbers


def run(hand: str, way: str, seconds: float, endpoint: str, folder: str) -> str:
    """Run the hand in one of the variants; return its last output."""
    words = ["run", hand, "--driver", "kinematic", "--no-log", "--duration", str(seconds)]
    environment = {**os.environ, "RTEE_RUNTIME_DIR": folder, "ROS_DOMAIN_ID": "0"}
    environment["ZENOH_CONFIG_OVERRIDE"] = f'connect/endpoints=["{endpoint}"]'
    if way == WAYS[2]:
        words.append("--ros2")
    base = [sys.executable, "-m", "rtee"]
    with subprocess.Popen(
        [*base, *words], env=environment, stdout=subprocess.PIPE, text=True
    ) as it:
        client = None
        if way == WAYS[1]:
            time.sleep(1.0)
            follow = ["state", "--follow", "--json", "--rate", "100"]
            client = subprocess.Popen([*base, *follow], env=environment, stdout=subprocess.DEVNULL)
        said = it.communicate()[0]
        if client is not None:
            client.terminate()
            client.wait()
    return said


def main() -> None:
    """Measure and print."""
    parser = command_line(__doc__, hand="schunk_svh", seconds=10.0, rounds=5)
    parser.add_argument("--minute", type=float, default=60.0, help="time to count messages [s]")
    options = parser.parse_args()
    endpoint = free_endpoint()
    found: dict[str, list[tuple[float, float]]] = {way: [] for way in WAYS}
    with listening(endpoint) as numbers, tempfile.TemporaryDirectory() as folder:
        for _ in range(options.rounds):
            for way in WAYS:
                said = run(options.hand, way, options.seconds, endpoint, folder)
                missed, late = MISSED.search(said), LATENESS.search(said)
                if missed is None or late is None:
                    raise SystemExit(f"the run said: {said}")
                share = 100 * int(missed[2]) / int(missed[1])
                found[way].append((float(late[1]), share))
        load = f"{os.getloadavg()[0]:.1f} on {os.cpu_count()} processors"
        rounds = f"{options.rounds} rounds of {options.seconds:g} s by turns"
        print(f"{options.hand}, {rounds}; load {load}\n")
        table = Table("", "lateness p99 [µs], median", "least to most", "missed [%], median")
        for way, rows in found.items():
            late_all, share_all = zip(*rows, strict=True)
            table.row(
                way,
                f"{statistics.median(late_all):.0f}",
                f"{min(late_all):.0f} to {max(late_all):.0f}",
                f"{statistics.median(share_all):.2f}",
            )
        numbers.clear()
        run(options.hand, WAYS[2], options.minute, endpoint, folder)
        expected = numbers[-1] - numbers[0] + 1
        print(
            f"\n{len(numbers)} joint states in {options.minute:g} s,"
            f" {expected - len(numbers)} lost on the way"
        )


if __name__ == "__main__":
    main()
