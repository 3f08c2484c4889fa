"""Measure recordings: size, reading, losses of a killed process, and the cost to the loop.

    python benchmarks/log.py [--minutes 10] [--kills 30] [--hand schunk_svh] [--rate 1000]

Prints Markdown. rtee's reader is compared with `rosbags` and `mcap` on the same file, its recorder
with `mcap`'s writer and rosbags' serialisation of the same messages.
"""

from __future__ import annotations

import dataclasses
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import anyio
import numpy as np
from common import Table, command_line

from rtee.actions.library import ActionLibrary
from rtee.buses.pool import BusPool
from rtee.drivers.kinematic.driver import KinematicDriver
from rtee.hand.load import hand_folder, load_hand
from rtee.hand.model import Hand
from rtee.log import Recorder, RecorderSettings, read
from rtee.log.layout import Contents
from rtee.log.recover import recover
from rtee.log.writer import LogWriter
from rtee.loop.clock import ManualClock
from rtee.loop.handloop import HandLoop
from rtee.loop.observer import Observer
from rtee.loop.settings import DeviceSettings, LoopSettings
from rtee.sample import TickRecord
from rtee.types import DeviceSpec, Goal, Intensity, Named, Result


class Keeper(Observer):
    """Keeps the loop's reports."""

    def __init__(self) -> None:
        self.records: list[object] = []
        self.results: list[Result] = []

    def on_tick(self, record: TickRecord) -> None:
        self.records.append(record)

    def on_goal(self, goal: Goal, stamp: float) -> None:
        self.records.append((goal, stamp))

    def on_feedback(self, feedback) -> None:
        self.records.append((feedback, feedback.stamp))

    def on_result(self, result: Result) -> None:
        self.results.append(result)

    def on_status(self, statuses, statistics) -> None:
        self.records += [(status, -1.0) for status in (*statuses, statistics)]


async def working_hand(name: str, rate: float, seconds: float) -> tuple[Hand, list[object]]:
    """Run a hand on the kinematic driver, one goal right after the other, faster than real time."""
    hand = load_hand(name)
    library = ActionLibrary.load(hand, hand_folder(name)[0] / "actions")
    settings = LoopSettings(rate=rate)
    clock = ManualClock(rate)
    spec = DeviceSpec("kinematic", hand.name, "kinematic", hand.actuators, rate=rate)
    driver = KinematicDriver(spec, BusPool())
    driver.now = clock.now
    loop = HandLoop(hand, library, settings, [(DeviceSettings(spec), driver)], now=clock.now)
    keeper = Keeper()
    loop.add_observer(keeper)
    source = random.Random(1)
    primitives = library.all("primitive")
    async with loop:
        await loop.ready()
        ended = 0
        for number in range(round(seconds * rate)):
            await clock.settle()
            if number > 10 and (number == 11 or len(keeper.results) > ended):
                ended = len(keeper.results)
                action = source.choice(primitives)
                intensity = source.uniform(0.2, 1.0)
                loop.submit(Goal(Named(action.name, action.elements), Intensity(intensity)))
            loop.tick(clock.next())
    return hand, keeper.records


def restless(hand: Hand, rate: float, seconds: float) -> Iterator[TickRecord]:
    """Make states in which every actuator moves at every tick, with noise in every number."""
    source = np.random.default_rng(1)
    n = len(hand.actuators)
    phases = source.uniform(0, 6, n)
    middle, half = (hand.lower + hand.upper) / 2, (hand.upper - hand.lower) / 2
    none, fresh = np.full(n, -1, dtype=np.int8), np.ones(n, dtype=bool)
    limits, warm = np.full(n, np.inf), np.full(n, 30.0)
    for number in range(round(seconds * rate)):
        t = number / rate
        sent = middle + half * np.sin(t + phases)
        noise = 1e-4 * source.normal(size=(4, n))
        position, velocity = sent + noise[0], half * np.cos(t + phases) + noise[1]
        yield TickRecord(
            position, velocity, noise[2], noise[3], warm, tick=number, stamp=1000 + t,
            wall_ns=round((1000 + t) * 1e9), grasped=none, fresh=fresh, reference_position=sent,
            reference_velocity=half * np.cos(t + phases), reference_effort=limits, channels={},
        )  # fmt: skip


def write(hand: Hand, records: list[object], folder: Path, rate: float, repeat: int = 1) -> Path:
    """Record a loop's reports, ``repeat`` times one after the other."""
    now = [0.0]
    settings = RecorderSettings(
        folder, sync=False, flight_recorder=0.0, max_file_size=1e12, max_file_time=1e9,
        max_total_size=1e13,
    )  # fmt: skip
    writer = LogWriter(Contents(hand, rate), settings, monotonic=lambda: now[0])
    writer.start()
    ticks = sum(isinstance(each, TickRecord) for each in records)
    for lap in range(repeat):
        # A long recording from a minute's ticks: only the times go on.
        later = lap * ticks / rate
        for each in records:
            if isinstance(each, TickRecord):
                now[0] = each.stamp + later
                wall = each.wall_ns + round(later * 1e9)
                tick = each.tick + lap * ticks
                writer.tick(dataclasses.replace(each, stamp=now[0], wall_ns=wall, tick=tick))
                writer.poll()
            else:
                writer.item(each[0], now[0])
    path = writer.sink.path
    writer.close()
    return path


def timed(call: Callable[[], object]) -> float:
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


def read_with_rosbags(path: Path) -> int:
    from rosbags.highlevel import AnyReader

    from rtee.messages.typestore import typestore

    with AnyReader([path], default_typestore=typestore()) as reader:
        return sum(
            reader.deserialize(raw, connection.msgtype) is not None
            for connection, _, raw in reader.messages()
        )


def read_with_mcap(path: Path) -> int:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return sum(1 for _ in reader.iter_decoded_messages())


def reading(minute: Path, long: Path, minutes: float) -> None:
    print("## Reading\n")
    table = Table("what", "how", "time [s]", "messages")
    recording = read(long)
    count = 3 * len(recording.reference)
    del recording
    seconds = timed(lambda: read(long))
    table.row(f"{minutes:g} min", "`rtee.log.read`, all topics", f"{seconds:.2f}", count)
    seconds = timed(lambda: read(minute))
    table.row("1 min", "`rtee.log.read`", f"{seconds:.2f}", "")
    for name, call in (("rosbags", read_with_rosbags), ("mcap-ros2-support", read_with_mcap)):
        found = [0]

        def run(call: Callable[[Path], int] = call, found: list[int] = found) -> None:
            found[0] = call(minute)

        table.row("1 min", f"{name}, every message decoded", f"{timed(run):.2f}", found[0])
    print()


def cost(hand: Hand, records: list[object], folder: Path, rate: float) -> None:
    """Measure processor time per tick: in the loop's thread and in the writer's."""
    ticks = [each for each in records if isinstance(each, TickRecord)][: round(10 * rate)]
    print("## What recording costs\n\nProcessor time per tick, 3 messages, in microseconds.\n")
    table = Table("what", "loop's thread", "writer's thread")
    recorder = Recorder(hand, RecorderSettings(folder / "cost"), rate=rate)
    spent = [0.0]
    recorder.open()
    in_loop = []
    for number, record in enumerate(ticks):
        begin = time.perf_counter_ns()
        recorder.on_tick(record)
        in_loop.append(time.perf_counter_ns() - begin)
        # As between ticks: the writer gets the interpreter.
        if number % 10 == 0:
            time.sleep(0.001)
    # Read in the writer's own thread, after all that was queued before.
    recorder._queue.put(lambda: spent.append(time.thread_time()))
    recorder.close()
    loop = float(np.median(in_loop)) / 1e3
    table.row("rtee's recorder", f"{loop:.1f}", f"{spent[-1] / len(ticks) * 1e6:.1f}")
    table.row("`mcap.Writer` with rosbags", "", f"{with_mcap(hand, ticks, folder):.1f}")
    print()


def with_mcap(hand: Hand, ticks: list[TickRecord], folder: Path) -> float:
    from mcap.writer import Writer

    from rtee.messages import message_type
    from rtee.messages.typestore import typestore

    store = typestore()
    joint = store.types["sensor_msgs/msg/JointState"]
    header = store.types["std_msgs/msg/Header"]
    stamp = store.types["builtin_interfaces/msg/Time"]
    kind = message_type("sensor_msgs/msg/JointState")
    joints, actuators = list(hand.joint_names), list(hand.actuator_names)
    with (folder / "mcap.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        schema = writer.register_schema(kind.name, "ros2msg", kind.schema.encode())
        topics = ("joint_states", "actuator_states", "reference")
        channels = [writer.register_channel(f"/hand/{name}", "cdr", schema) for name in topics]
        begin = time.thread_time()
        for record in ticks:
            seconds, nanoseconds = divmod(record.wall_ns, 10**9)
            q = hand.transmission.joints(record.position)
            rows = (
                (joints, q, q, q),
                (actuators, record.position, record.velocity, record.effort),
                (actuators, record.reference_position, record.reference_velocity, record.effort),
            )
            for channel, row in zip(channels, rows, strict=True):
                message = joint(header(stamp(seconds, nanoseconds), ""), *row)
                data = bytes(store.serialize_cdr(message, kind.name))
                writer.add_message(channel, record.wall_ns, data, record.wall_ns)
        spent = time.thread_time() - begin
        writer.finish()
    return spent / len(ticks) * 1e6


CHILD = """
import dataclasses, sys, time
from pathlib import Path
from rtee.hand.load import load_hand
from rtee.log import Recorder, RecorderSettings
sys.path.insert(0, sys.argv[4])
from log import restless
hand, rate = load_hand(sys.argv[1]), float(sys.argv[3])
ticks = list(restless(hand, rate, 2.0))
begin, number = time.monotonic(), 0
with Recorder(hand, RecorderSettings(Path(sys.argv[2])), rate=rate) as recorder:
    while True:
        stamp = begin + number / rate
        recorder.on_tick(dataclasses.replace(ticks[number % len(ticks)], tick=number, stamp=stamp))
        print(number, flush=True)
        number += 1
        time.sleep(max(0.0, begin + number / rate - time.monotonic()))
"""


def kills(hand: str, count: int, rate: float) -> None:
    """Kill a recording process at random moments, recover the file, and measure the loss."""
    lost, failed = [], 0
    source = random.Random(7)
    here = str(Path(__file__).parent)
    for _ in range(count):
        with tempfile.TemporaryDirectory() as folder:
            child = subprocess.Popen(
                [sys.executable, "-c", CHILD, hand, folder, str(rate), here],
                stdout=subprocess.PIPE,
            )
            seen = bytearray()
            reader = threading.Thread(target=lambda c=child, s=seen: s.extend(c.stdout.read()))
            reader.start()
            while not seen and child.poll() is None and not list(Path(folder).glob("*.mcap")):
                time.sleep(0.01)
            time.sleep(source.uniform(0.2, 4.0))
            # Without a chance to clean up, as when the power fails.
            os.kill(child.pid, signal.SIGKILL)
            child.wait()
            reader.join()
            numbers = seen.rpartition(b"\n")[0].split()
            (path,) = Path(folder).glob("*.mcap")
            recover(path, in_place=True)
            recording = read(path)
            if not recording.finished:
                failed += 1
            lost.append(
                (int(numbers[-1]) + 1 - len(recording.reference)) / rate if numbers else 0.0
            )
    print(f"## `kill -9` at {count} random moments\n")
    table = Table("recovered whole", "lost, median [s]", "lost, most [s]")
    table.row(f"{count - failed} of {count}", f"{np.median(lost):.2f}", f"{max(lost):.2f}")


def main() -> None:
    given = command_line(
        __doc__, hand="schunk_svh", rate=1000.0, minutes=10.0, kills=30
    ).parse_args()
    rate = given.rate
    with tempfile.TemporaryDirectory(prefix="rtee-log-") as name:
        folder = Path(name)
        hand, records = anyio.run(working_hand, given.hand, rate, 60.0)
        minute = write(hand, records, folder / "minute", rate)
        busy = write(hand, list(restless(hand, rate, 20.0)), folder / "restless", rate)
        print(f"# Recordings of {hand.name}, {rate:g} Hz\n")
        print(f"{len(hand.actuators)} actuators, {len(hand.joints)} joints, every tick.\n")
        print("## Size\n")
        table = Table("what", "MB a minute")
        table.row("goals one after the other, kinematic", f"{minute.stat().st_size / 1e6:.1f}")
        table.row("every number changes at every tick", f"{3 * busy.stat().st_size / 1e6:.1f}")
        print()
        long = write(hand, records, folder / "long", rate, repeat=max(1, round(given.minutes)))
        reading(minute, long, max(1, round(given.minutes)))
        long.unlink()
        cost(hand, records, folder, rate)
        kills(given.hand, given.kills, rate)


if __name__ == "__main__":
    main()
