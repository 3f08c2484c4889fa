"""Measure how processor time and memory grow with the size of what is worked on.

    python benchmarks/growth.py [--minutes 1] [--only plot] [--hand schunk_svh]

Each quantity is measured at three sizes, each four times the one before, in a process of its own.
Prints Markdown: processor time [s] and peak memory [MB] at each size, and the exponents of their
growth from the middle size to the largest: 0 does not grow, 1 is linear. Memory that stays below
that of a fresh interpreter with its libraries counts, too, so that small exponents mean little
alone.
"""

from __future__ import annotations

import math
import os
import random
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import anyio
import numpy as np
import trimesh
from common import Table, command_line

from rtee.actions.library import ActionLibrary
from rtee.buses.pool import BusPool
from rtee.drivers.kinematic.driver import KinematicDriver
from rtee.hand.load import hand_folder, load_hand
from rtee.log.dataclass_json import to_json
from rtee.log.layout import REPLAY, Contents, Replayable
from rtee.log.settings import RecorderSettings
from rtee.log.writer import LogWriter
from rtee.loop import contact_rules
from rtee.loop.clock import ManualClock
from rtee.loop.controller import Controller
from rtee.loop.handloop import HandLoop
from rtee.loop.observer import Observer
from rtee.loop.settings import DeviceSettings, LoopSettings
from rtee.loop.snapshot import capture
from rtee.types import DeviceSpec, Goal, Intensity, Named

STEP = 4  # each size is so many times the one before


@dataclass(frozen=True)
class Quantity:
    """Something whose growth is measured.

    Attributes:
        name: What is done.
        sizes: Its three sizes, as printed.
        prepare: Called with the index of a size and an empty folder; returns the words of the
            command that is measured, for this Python.
    """

    name: str
    sizes: tuple[str, str, str]
    prepare: Callable[[int, Path], list[str]]


class Writing(Observer):
    """Hands the loop's reports to a writer at once, on simulated time."""

    def __init__(self, writer: LogWriter, controller: Controller) -> None:
        self.writer = writer
        self.controller = controller
        self.stamp = 0.0
        self.ended = 0

    def on_tick(self, record) -> None:
        self.stamp = record.stamp
        self.writer.tick(record)
        self.writer.poll()
        if self.writer.sink.begun:
            self.writer.sink.begun = False
            self.writer.state(capture(self.controller), record.tick, record.stamp)

    def on_goal(self, goal, stamp) -> None:
        self.writer.item(goal, stamp)

    def on_plan(self, plan, stamp) -> None:
        self.writer.item(plan, stamp)

    def on_command(self, record) -> None:
        self.writer.item(record, record.stamp)

    def on_feedback(self, feedback) -> None:
        self.writer.item(feedback, feedback.stamp)

    def on_result(self, result) -> None:
        self.ended += 1
        self.writer.item(result, self.stamp)

    def on_event(self, event) -> None:
        self.writer.item(event, event.stamp)

    def on_status(self, statuses, statistics) -> None:
        for each in (*statuses, statistics):
            self.writer.item(each, self.stamp)


async def record(name: str, folder: Path, seconds: float, **changes: object) -> Path:
    """Record a hand at work, one goal right after the other, faster than real time."""
    hand = load_hand(name)
    library = ActionLibrary.load(hand, hand_folder(name)[0] / "actions")
    settings = LoopSettings()
    clock = ManualClock(settings.rate, turns=4)  # the kinematic driver answers at once
    spec = DeviceSpec("kinematic", hand.name, "kinematic", hand.actuators, rate=settings.rate)
    driver = KinematicDriver(spec, BusPool())
    driver.now = clock.now
    loop = HandLoop(hand, library, settings, [(DeviceSettings(spec), driver)], now=clock.now)
    replay = to_json(Replayable(settings, hand.actuators, contact_rules.VERSION)).encode()
    recorder = RecorderSettings(
        **{"directory": folder, "sync": False, "flight_recorder": 0.0, "max_file_size": 1e12}
        | {"max_file_time": 1e9, "max_total_size": 1e13} | changes
    )  # fmt: skip
    contents = Contents(hand, settings.rate, {REPLAY: replay}, {"decimation": "1"})
    writer = LogWriter(contents, recorder, monotonic=clock.now, simulated=True)
    writing = Writing(writer, loop.controller)
    loop.add_observer(writing)
    writing.writer.start()
    source = random.Random(1)
    primitives = library.all("primitive")
    async with loop:
        await loop.ready()
        begun = 0
        for number in range(round(seconds * settings.rate)):
            await clock.settle()
            if number > 10 and writing.ended == begun:
                begun += 1
                action = source.choice(primitives)
                intensity = source.uniform(0.2, 1.0)
                loop.submit(Goal(Named(action.name, action.elements), Intensity(intensity)))
            loop.tick(clock.next())
    writing.writer.close()
    return sorted(folder.glob("*.mcap"))[0]


def recordings(hand: str, minutes: float) -> Iterator[Quantity]:
    """Yield what is done with recordings; the shortest is of so many minutes."""
    known: dict[int, Path] = {}
    lengths = tuple(minutes * STEP**k for k in range(3))
    home = Path(tempfile.mkdtemp(prefix="rtee-growth-", dir=os.environ["RTEE_RUNTIME_DIR"]))

    def recording(size: int) -> Path:
        if size not in known:
            known[size] = anyio.run(record, hand, home / str(size), 60.0 * lengths[size])
        return known[size]

    commands: dict[str, Callable[[Path, Path], list[str]]] = {
        "log info": lambda file, out: ["info", str(file)],
        "log plot": lambda file, out: ["plot", str(file), "--out", str(out / "plot")],
        "log plot, 10 s of it": lambda file, out: (
            ["plot", str(file), "--out", str(out / "plot"), "--from", "10", "--to", "20"]
        ),
        "log export, Parquet": lambda file, out: (
            ["export", str(file), str(out), "--format", "parquet"]
        ),
        "log export, NumPy": lambda file, out: ["export", str(file), str(out / "all.npz")],
        "log export, goals alone": lambda file, out: (
            ["export", str(file), str(out), "--format", "csv", "--topic", "goals"]
        ),
        "log replay --check": lambda file, out: ["replay", "--check", str(file)],
        "log recover": lambda file, out: ["recover", str(file), "--out", str(out / "whole.mcap")],
    }
    sizes = tuple(f"{length:g} min" for length in lengths)
    for name, words in commands.items():
        yield Quantity(
            name,
            sizes,  # type: ignore[arg-type]
            lambda size, out, words=words: ["-m", "rtee", "log", *words(recording(size), out)],
        )


ANSWERS = """
import sys
from pathlib import Path
from rtee.trials.answers import Answers
from rtee.trials.result import Trial, TrialResult
from rtee.trials.work import MadeWith
made_with = MadeWith("model", "action", "", "settings", "versions")
for again in range(2):
    known = Answers(Path(sys.argv[2]))
    for n in range(int(sys.argv[1])):
        trial = Trial("Grasp", object=f"sphere:{n / 1e6}", variations=20)
        if known.find(trial, made_with) is None:
            known.add("hand", trial, made_with, "here", TrialResult(trial, True, survived=18))
    known.write()
"""
"""Keeps results of a sweep, and finds all of them when it begins anew."""

MESHED = """<robot name="meshed"><link name="palm">{0}</link>
<link name="a">{1}</link><link name="b">{2}</link><link name="c">{3}</link>{4}</robot>"""
SHAPE = '<collision><geometry><mesh filename="{}.stl" scale="{}"/></geometry></collision>'
JOINT = """<joint name="j{0}" type="revolute"><parent link="palm"/><child link="{0}"/>
<origin xyz="{1} {2} 0.075"/><axis xyz="0 {3} 0"/>
<limit lower="0" upper="1.2" effort="5" velocity="3"/></joint>"""


def meshed(folder: Path, subdivisions: int) -> Path:
    """Write a hand of four links, each a mesh of 20 * 4 ** subdivisions triangles."""
    for number in range(4):
        mesh = trimesh.creation.icosphere(subdivisions, radius=0.02)
        waves = 0.05 * np.sin(1000.0 * mesh.vertices[:, :1] + number)
        mesh.vertices = mesh.vertices * (1.0 + waves) * [1.0, 1.0, 2.0]
        mesh.export(folder / f"{number}.stl")
    shapes = [SHAPE.format(n, "0.4 0.4 1" if n else "1.5 1.5 0.8") for n in range(4)]
    places = {"a": (0.03, 0.0, -1), "b": (-0.03, 0.015, 1), "c": (-0.03, -0.015, 1)}
    joints = "".join(JOINT.format(link, *place) for link, place in places.items())
    file = folder / "meshed.urdf"
    file.write_text(MESHED.format(*shapes, joints))
    return file


def offline(folder: Path) -> Iterator[Quantity]:
    """Yield what is done with meshes, parts and results of trials."""

    def extract(size: int, out: Path) -> list[str]:
        file = meshed(out, 5 + size)
        new = ["-m", "rtee", "new", f"meshed{size}", "--urdf", str(file)]
        subprocess.run([sys.executable, *new], cwd=folder, check=True, stdout=subprocess.DEVNULL)
        return ["-m", "rtee", "extract", str(folder / "config" / f"meshed{size}")]

    def plan(size: int, out: Path) -> list[str]:
        meshed(out, 5 + size)
        return ["-m", "rtee", "grasp-plan", "robotiq_2f_85", "--object", str(out / "1.stl")]

    def several(size: int, out: Path) -> list[str]:
        shapes = [f"--object=cylinder:{0.01 + n / 2000}x0.1" for n in range(2 * STEP**size)]
        return ["-m", "rtee", "grasp-plan", "robotiq_2f_85", *shapes, "--json"]

    triangles = tuple(f"{20 * 4 ** (5 + n):,}" for n in range(3))
    yield Quantity("extract, triangles of each of four links", triangles, extract)  # type: ignore[arg-type]
    yield Quantity("grasp-plan, triangles of the object", triangles, plan)  # type: ignore[arg-type]
    yield Quantity("grasp-plan, objects", ("2", "8", "32"), several)
    yield Quantity(
        "results of a sweep, kept and found",
        ("4,000", "16,000", "64,000"),
        lambda size, out: ["-c", ANSWERS, str(4000 * STEP**size), str(out)],
    )


def measured(words: list[str]) -> tuple[float, float]:
    """Run a command of this Python; return its processor time [s] and peak memory [MB]."""
    with silent() as null:
        child = os.posix_spawn(
            sys.executable,
            [sys.executable, *words],
            os.environ,
            file_actions=[(os.POSIX_SPAWN_DUP2, null, 1)],
        )
        _, status, used = os.wait4(child, 0)
    if status:
        raise SystemExit(f"failed: {' '.join(words)}")
    return used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


@contextmanager
def silent() -> Iterator[int]:
    with Path(os.devnull).open("wb") as null:
        yield null.fileno()


def exponent(values: list[float]) -> str:
    """Return the exponent of the growth from the middle size to the largest."""
    return f"{math.log(values[-1] / values[-2], STEP):.2f}"


def main() -> None:
    given = command_line(__doc__, minutes=1.0, only=str, hand="schunk_svh").parse_args()
    home = Path(tempfile.mkdtemp(prefix="rtee-growth-", dir=os.environ["RTEE_RUNTIME_DIR"]))
    quantities = [*recordings(given.hand, given.minutes), *offline(home)]
    table = Table("what", "sizes", "processor time [s]", "grows", "peak memory [MB]", "grows")
    for each in quantities:
        if given.only and given.only not in each.name:
            continue
        times, memories = [], []
        for size in range(3):
            with tempfile.TemporaryDirectory(dir=os.environ["RTEE_RUNTIME_DIR"]) as out:
                seconds, megabytes = measured(each.prepare(size, Path(out)))
            times.append(seconds)
            memories.append(megabytes)
        table.row(
            each.name,
            ", ".join(each.sizes),
            ", ".join(f"{each:.1f}" for each in times),
            exponent(times),
            ", ".join(f"{each:.0f}" for each in memories),
            exponent(memories),
        )


if __name__ == "__main__":
    main()
