"""A small hand, what its loop would tell, and recordings of that."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rtee.commands import CommandRecord, Jog
from rtee.hand.load import load_model
from rtee.hand.model import Hand
from rtee.log.layout import Contents
from rtee.log.settings import RecorderSettings
from rtee.log.writer import LogWriter
from rtee.sample import TickRecord
from rtee.types import (
    DeviceStatus,
    Event,
    Feedback,
    Goal,
    Intensity,
    Lifecycle,
    LoopStatistics,
    Named,
    Result,
)

URDF = """<?xml version="1.0"?>
<robot name="claw">
  <link name="palm"/><link name="a"/><link name="a2"/><link name="b"/><link name="b2"/>
  <joint name="first" type="revolute">
    <parent link="palm"/><child link="a"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="1" velocity="2" effort="5"/>
  </joint>
  <joint name="first_far" type="revolute">
    <parent link="a"/><child link="a2"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="2" velocity="4" effort="5"/>
    <mimic joint="first" multiplier="1.5" offset="0.25"/>
  </joint>
  <joint name="second_far" type="revolute">
    <parent link="b"/><child link="b2"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="2" velocity="4" effort="5"/>
    <mimic joint="second" nlFunPos="x^2"/>
  </joint>
  <joint name="second" type="revolute">
    <parent link="palm"/><child link="b"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="1" velocity="2" effort="5"/>
  </joint>
</robot>
"""
SRDF = """<?xml version="1.0"?>
<robot name="claw">
  <group name="one"><chain base_link="palm" tip_link="a2"/></group>
  <group name="two"><chain base_link="palm" tip_link="b2"/></group>
  <group name="fingers"><group name="one"/><group name="two"/></group>
</robot>
"""

RATE = 100.0
WALL = 1_700_000_000_000_000_000
BEGIN = 50.0

GOAL = Goal(
    Named("Trig", ("one",)), Intensity(0.5), effort={"first": 1.5}, goal_id="g1", client="tests"
)
TIMED = Goal(Named("drill", kind="timed"), timeout=4.0, goal_id="g2")
RESULT = Result("g1", "Trig", reached=True, duration=0.5, position={"first": 0.5, "second": 0.0})
COMMAND = CommandRecord(70, BEGIN + 0.7, Jog({"first": 0.25}, 0.5))
STATUS = DeviceStatus("motor", "kinematic", Lifecycle.ACTIVE, counters={"frames": 3})
STATISTICS = LoopStatistics(RATE, RATE, 100)


def make_hand(folder: Path) -> Hand:
    urdf, srdf = folder / "claw.urdf", folder / "claw.srdf"
    urdf.write_text(URDF)
    srdf.write_text(SRDF)
    return load_model(urdf, srdf)


def tick(number: int, *, begin: float = BEGIN, wall: int = WALL) -> TickRecord:
    """What is known at a tick: a different number in every place."""
    at = number / RATE
    first = 0.5 + 0.4 * np.sin(at)
    second = 0.5 + 0.4 * np.cos(at)
    return TickRecord(
        tick=number,
        stamp=begin + at,
        wall_ns=wall + round(at * 1e9),
        position=np.array([first, second]),
        velocity=np.array([0.4 * np.cos(at), -0.4 * np.sin(at)]),
        effort=np.array([first + 10, np.nan]),
        current=np.array([first + 20, second + 20]),
        temperature=np.array([30.0 + at, 31.0]),
        fresh=np.array([True, number % 2 == 0]),
        reference_position=np.array([first + 0.01, second + 0.01]),
        reference_velocity=np.array([first + 1, second + 1]),
        reference_effort=np.array([np.inf, 2.0]),
        grasped=np.array([1, -1], dtype=np.int8),
        channels={"motor/pressure": np.array([float(number // 50), 1.0])},
    )


class Time:
    """A clock that is put forward by hand."""

    def __init__(self, now: float = BEGIN) -> None:
        self.now = now

    def monotonic(self) -> float:
        return self.now

    def wall(self) -> int:
        return WALL + round((self.now - BEGIN) * 1e9)


class Log:
    """A writer with a clock of its own, fed as the recorder would."""

    def __init__(self, hand: Hand, settings: RecorderSettings, *, start: bool = True) -> None:
        self.time = Time()
        self.told: list[Event] = []
        contents = Contents(hand, RATE, {"hand.yaml": b"name: claw\n"}, {"driver": "kinematic"})
        self.writer = LogWriter(
            contents, settings, self.told.append, self.time.monotonic, self.time.wall
        )
        if start:
            self.writer.start()

    def ticks(self, first: int, last: int) -> Iterator[int]:
        """Record ticks one by one, and give each number away once it is recorded."""
        for number in range(first, last):
            record = tick(number)
            self.time.now = record.stamp
            self.writer.tick(record)
            self.writer.poll()
            yield number

    def run(self, first: int, last: int) -> None:
        for _ in self.ticks(first, last):
            pass

    def story(self) -> None:
        """Two seconds with one of everything."""
        for number in self.ticks(0, 200):
            now = self.time.now
            match number:
                case 20:
                    self.writer.item(GOAL, now)
                case 45:
                    self.writer.item(Feedback("g1", 0.5, stamp=now), now)
                case 69:
                    self.writer.item(RESULT, now)
                case 70:
                    self.writer.item(COMMAND, now)
                case 80:
                    self.writer.item(TIMED, now)
                case 90:
                    self.writer.item(Feedback("g2", 0.1, "close", {"close": 0.2}, now), now)
                case 120:
                    self.writer.item(Feedback("g2", 0.6, "pull", {"close": 1.0}, now), now)
                case 150:
                    self.writer.item(Result("g2", "drill", stalled=True, grasped=True), now)
                case 160:
                    self.writer.item(Event("mark", "user", "look here", now), now)
                case 170:
                    self.writer.item(STATUS, now)
                    self.writer.item(STATISTICS, now)
        self.writer.close()


def settings(folder: Path, **changes: object) -> RecorderSettings:
    # Simulated time passes faster than a busy computer writes: what waits is not dropped.
    values: dict[str, object] = {
        "directory": folder,
        "sync": False,
        "queue_time": 600.0,
        "reserve": 0.0,
    }
    return RecorderSettings(**(values | changes))  # type: ignore[arg-type]


def recorded(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.mcap"))
