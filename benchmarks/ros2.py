"""Measure the cost of a message of a hand's ROS 2 node; print a Markdown table.

    python benchmarks/ros2.py [--hand schunk_svh] [--seconds 10] [--rate 100]

A node publishes joint states of all the hand's joints through a router, which is a process of its
own and subscribes, too. Each step is timed at each tick, at the rate given: so far apart that the
processor's caches are as cold as in use.

- asked: the check whether anybody listens;
- encoded: from a state to the bytes of the message;
- put: from the bytes to their being Zenoh's, attachment with number, time and identifier included;
- bare put: as many bytes by Zenoh itself, on another key that is subscribed to, by turns with it.
"""

from __future__ import annotations

import math
import os
import socket
import subprocess
import sys
import time

import anyio
import numpy as np
from common import Table, command_line

from rtee.hand.config_schema import Ros2Settings
from rtee.hand.load import load_hand
from rtee.hand.model import Hand
from rtee.messages.state import State
from rtee.ros2 import Context
from rtee.ros2.topics import JointStates
from rtee.sample import COLUMNS

ROUTER = """
import json, sys, time, zenoh
config = zenoh.Config()
for key, value in {
    "mode": "router", "listen/endpoints": [sys.argv[1]], "scouting/multicast/enabled": False
}.items():
    config.insert_json5(key, json.dumps(value))
with zenoh.open(config) as session:
    got = 0
    def count(_):
        global got
        got += 1
    session.declare_subscriber("0/joint_states/**", count)
    session.declare_subscriber("bare", lambda _: None)
    print("ready", flush=True)
    sys.stdin.read()
    time.sleep(0.5)
    print(got)
"""
"""A router that counts the joint states."""


def state_of(hand: Hand) -> State:
    """Return a state of a hand at rest."""
    n = len(hand.actuators)
    columns = {name: np.zeros(n, quantity.dtype) for name, quantity in COLUMNS.items()}
    return State(
        tick=0,
        stamp=0.0,
        wall_ns=time.time_ns(),
        channels={},
        names=hand.actuator_names,
        joint_names=hand.joint_names,
        joint_position=hand.transmission.joints(hand.rest),
        **columns,
    )


def free_endpoint() -> str:
    """Return a loopback endpoint with a free port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


async def measure(hand: Hand, router: str, seconds: float, rate: float) -> np.ndarray:
    """Return the times of the steps ``(ticks, 4)`` [s]."""
    messages, state, taken = JointStates(hand), state_of(hand), []
    data = messages.encode(state)
    async with Context.open(Ros2Settings(router=router), {}) as context:
        node = context.node("bench")
        publisher = node.publisher("joint_states", "sensor_msgs/msg/JointState")
        bare = context.participant.session.declare_publisher("bare")
        while not (publisher.heard and bare.matching_status.matching):
            await anyio.sleep(0.01)
        for _ in range(math.ceil(seconds * rate)):
            begin = time.perf_counter()
            bare.put(data)
            alone = time.perf_counter() - begin
            await anyio.sleep(0.5 / rate)
            begin = time.perf_counter()
            _ = publisher.heard
            asked = time.perf_counter()
            data = messages.encode(state)
            encoded = time.perf_counter()
            publisher.publish(data)
            put = time.perf_counter()
            taken.append((asked - begin, encoded - asked, put - encoded, alone))
            await anyio.sleep(0.5 / rate)
        await anyio.sleep(0.2)
    return np.array(taken)


def main() -> None:
    """Measure and print."""
    options = command_line(__doc__, hand="schunk_svh", seconds=10.0, rate=100.0).parse_args()
    hand, endpoint = load_hand(options.hand), free_endpoint()
    command = [sys.executable, "-c", ROUTER, endpoint]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as router:
        assert router.stdout is not None
        router.stdout.readline()
        times = anyio.run(measure, hand, endpoint, options.seconds, options.rate)
        heard = router.communicate()[0].strip()
    print(f"{hand.name}, {len(hand.joints)} joints, {options.rate:g} Hz; load of the computer:")
    print(f"{os.getloadavg()[0]:.1f} on {os.cpu_count()} processors\n")
    table = Table("step", "median [µs]", "p95 [µs]", "worst [µs]")
    rows = {"asked": times[:, 0], "encoded": times[:, 1], "put": times[:, 2]}
    rows |= {"bare put": times[:, 3]}
    rows["encoded and put"] = times[:, 1] + times[:, 2]
    for name, row in rows.items():
        figures = (np.median(row), np.percentile(row, 95), row.max())
        table.row(name, *(f"{1e6 * value:.1f}" for value in figures))
    print(f"\n{len(times)} published, {heard} received")


if __name__ == "__main__":
    main()
