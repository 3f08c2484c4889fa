"""Measure the cost of touch sensors to the loop, with and without readings by turns; print a table.

    python benchmarks/touch.py [--hand schunk_svh] [--rounds 20] [--seconds 2]

A hand with the kinematic driver at 1 kHz, recorded and on the network. In every second stretch its
fingertips have taxels, as many on each, and give a new reading 100 times a second, which a client
in a process of its own subscribes to. The lateness is that of another clock of 1 kHz in the same
event loop, as another hand would have; the processor's time is that of the loop's thread and of the
whole process, recorder and network included.
"""

from __future__ import annotations

import multiprocessing
import os
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import anyio
import numpy as np
from common import Table, command_line
from devices import as_the_loop
from lateness import Beside, Lateness, verdict

import rtee
from rtee.actions.library import ActionLibrary
from rtee.buses.pool import BusPool
from rtee.drivers.kinematic.driver import KinematicDriver
from rtee.hand.config_schema import RemoteSettings
from rtee.hand.load import load_hand
from rtee.hand.model import Hand
from rtee.log import Recorder
from rtee.log.settings import RecorderSettings
from rtee.loop.clock import Clock
from rtee.loop.handloop import HandLoop, drive
from rtee.loop.settings import DeviceSettings, LoopSettings
from rtee.remote.server import Server
from rtee.sample import ActuatorState
from rtee.touch import TouchReading, TouchSensor
from rtee.types import DeviceSpec

RATE = 1000.0
READINGS = 100.0
TAXELS = 500
"""Taxels of all fingertips together: those of a hand with 10 x 10 on each of five."""


class Skin(KinematicDriver):
    """A kinematic driver that returns touch readings while they are switched on."""

    feeling = False

    def __init__(self, spec: DeviceSpec, buses: BusPool, hand: Hand) -> None:
        super().__init__(spec, buses)
        tips = [(finger.name, finger.tip) for finger in hand.fingers if finger.tip is not None]
        each = TAXELS // len(tips)
        sensors = tuple(TouchSensor(f"{name}_tip", each, link=tip) for name, tip in tips)
        self.capabilities = replace(self.capabilities, touch=sensors)
        self._values = np.random.default_rng(0).random((100, each * len(tips)))
        self._turn = 0
        self._reading: TouchReading | None = None

    async def sense(self) -> ActuatorState:
        """Measure, with a touch reading now and then."""
        state = await super().sense()
        self._turn += 1
        if self.feeling and self._turn % round(RATE / READINGS) == 0:
            values = self._values[self._turn // 10 % len(self._values)].copy()
            self._reading = TouchReading(values, state.stamp)
        # Also without readings: the benchmark measures the loop, not this driver.
        return replace(state, touch=self._reading if self.feeling else None)


def follow(hand: str) -> None:
    """Subscribe to the readings, as a client does."""
    with rtee.connect_blocking(hand, wait=10.0) as remote:
        for _ in remote.touch_states():
            pass


async def measure(hand: Hand, rounds: int, seconds: float) -> None:
    """Run by turns and print."""
    settings = LoopSettings(rate=RATE)
    spec = DeviceSpec("skin", hand.name, "kinematic", hand.actuators, rate=RATE)
    driver = Skin(spec, BusPool(), hand)
    loop = HandLoop(hand, ActionLibrary(hand, ()), settings, [(DeviceSettings(spec), driver)])
    used: dict[bool, list[tuple[float, float]]] = {False: [], True: []}
    with tempfile.TemporaryDirectory() as folder:
        recorder = Recorder(hand, RecorderSettings(directory=Path(folder)), rate=RATE)
        async with recorder, loop, Server.open(loop, RemoteSettings()), Lateness() as clock:
            loop.add_observer(recorder)
            await loop.ready()
            async with anyio.create_task_group() as group:
                group.start_soon(drive, [loop], Clock(RATE))
                client = multiprocessing.get_context("spawn").Process(
                    target=follow, args=(hand.name,), daemon=True
                )
                client.start()
                await anyio.sleep(5.0)  # until it has connected
                beside = Beside(clock)
                for turn in range(2 * rounds):
                    driver.feeling = bool(turn % 2)
                    await anyio.sleep(0.3)
                    beside.begin()
                    began = time.thread_time(), time.process_time()
                    await anyio.sleep(seconds)
                    thread, process = time.thread_time(), time.process_time()
                    used[driver.feeling].append((thread - began[0], process - began[1]))
                    beside.end(fault=driver.feeling)
                client.terminate()
                group.cancel_scope.cancel()
        differences = beside.differences()
    load = f"{os.getloadavg()[0]:.1f} on {os.cpu_count()} processors"
    pairs = f"{rounds} pairs of stretches of {seconds:g} s"
    print(f"{hand.name}, {TAXELS} taxels at {READINGS:g} Hz; {pairs}; load {load}\n")
    table = Table("", "without", "with", "change, 95 %")
    for name, difference in zip(("p50", "p99"), differences, strict=True):
        table.row(f"lateness {name} [µs]", *difference.cells())
    for which, name in enumerate(("the loop's thread", "the process")):
        shares = [[100.0 * row[which] / seconds for row in used[on]] for on in (False, True)]
        medians = [statistics.median(each) for each in shares]
        change = f"{medians[1] - medians[0]:+.1f}"
        table.row(f"processor, {name} [%]", *(f"{m:.1f}" for m in medians), change)
    print(f"\nlateness: {verdict(differences)}")


def main() -> None:
    """Measure and print."""
    options = command_line(__doc__, hand="schunk_svh", rounds=20, seconds=2.0).parse_args()
    as_the_loop()
    anyio.run(measure, load_hand(options.hand), options.rounds, options.seconds)


if __name__ == "__main__":
    main()
