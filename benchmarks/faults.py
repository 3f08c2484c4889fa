"""Cause a fault every few seconds while a hand moves, and count what did not hold; print Markdown.

    python benchmarks/faults.py [--seconds 1800] [--kills 50] [--hand inspire_rh56] [--rate 500]
                                [--realtime]

`rtee run` drives an emulated device, a process of its own (`rtee emulate`), and records. A client
opens and closes the hand without end, and every two seconds a stop is sent as `rtee stop` does.
First the hand is killed (`kill -9`) so many times while it moves, and started again. Then, one
after the other and in random order: it, or the device, stands still (SIGSTOP) for a while; the
device loses its supply and comes back; every tenth of its answers gets lost; the disk is full (as
root: a small file system of its own, else the hand may write no more to its files); the hand may
open no more files; its wall clock is set back by an hour; clients flood the hand (see
`benchmarks/stop.py`); a client is killed in the middle of its goal; and, less often, the hand is
killed again.

A stop counts for all faults during which it was sent or answered. While the device stands still or
is unplugged, the right answer is that it has not confirmed; while the hand does, there is none.
What the hand uses is noted after each fault. Afterwards the recordings are read: whether they are
whole but for what a killed process had not written yet, where references began, and whether any was
beyond a limit, or further from the last one than the velocity allows, without being a position that
was measured. With --realtime the hand, its device and what stops it have precedence over all
others, so that other programs of a busy computer count for less.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import random
import re
import resource
import shutil
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import anyio
import anyio.to_thread
import numpy as np
from common import Table, command_line, own
from endurance import count
from gui_common import MEGA

import rtee
from rtee.errors import NoHand, RteeError
from rtee.hand.load import hand_folder, load_hand
from rtee.hand.model import Hand as Model
from rtee.log import Recording, read
from rtee.log.recover import recover
from rtee.remote.client import stop_hand

PAUSE = (1.5, 3.5)
"""Time between two faults [s]."""

LASTS = 1.5
"""Time for which most faults last [s]: longer than a device is waited for (0.5 s)."""

FLOODS = 3.0
"""Time for which clients flood the hand, or answers are lost [s]."""

STOP_EVERY = (1.5, 2.5)
"""Time between two stops [s]."""

SMALL = 4096
"""Size to which the hand's files may grow while the disk is full [bytes]: less than they have."""

DISK = 2**30
"""Size of the file system for the recordings [bytes]: several times what they need."""

LONG = 8
"""Rounds of the other faults between two kills, so that a process lives for minutes."""

WARM = 75.0
"""Time after which a process is compared [s]: the flight recorder's minute is full."""

SLACK = 1.01
"""Steps of a reference count as within the velocity up to this factor: rounding, and ticks of
which the recording has the time to the nanosecond only."""

READY = re.compile(r"actuators, .*; network ")
"""What a hand says when it runs, whether its device was found at once or not."""

SILENT = ("killed", "hand stands still")
"""Faults during which no answer is the right one."""

BUSY = 0.05
"""Time for which a device gets no processor that counts [s]: a third of what it has to confirm."""

MUTE = ("device stands still", "unplugged", "computer too busy for the device")
"""Faults during which the right answer is that the device has not confirmed."""

SHIFTED = """
import signal, time
now, back = time.time_ns, [0]
time.time_ns = lambda: now() - back[0]
time.time = lambda: time.time_ns() * 1e-9
def hour(*_): back[0] += 3600 * 10**9
signal.signal(signal.SIGUSR1, hour)
from rtee.cli import main; main()
"""
"""A hand whose wall clock goes back by an hour at a signal: the computer's own stays as it is."""

MET = 1e-5
"""Distance within which a reference counts as begun at a measurement [rad]: it may have moved on in
the same tick."""

LOSSY = """
import random, signal, sys, threading, time
from rtee.drivers import emulator_server
def watch(path, most):
    while True:
        begun = time.monotonic()
        time.sleep(0.005)
        if time.monotonic() - begun > most:
            with open(path, "a") as file:
                print(begun, time.monotonic(), file=file)
threading.Thread(target=watch, args=(sys.argv.pop(1), float(sys.argv.pop(1))), daemon=True).start()
lossy = [False]
class Player(emulator_server.Player):
    def __init__(self, *given, **named):
        super().__init__(*given, **named)
        feed = self.emulator.feed
        def sometimes(data, now):
            answers = feed(data, now)
            return [] if lossy[0] and random.random() < 0.1 else answers
        self.emulator.feed = sometimes
emulator_server.Player = Player
def turn(*_): lossy[0] = not lossy[0]
signal.signal(signal.SIGUSR1, turn)
from rtee.cli import main; main()
"""
"""A device of which every tenth answer gets lost, from one signal to the next.

It notes in a file when the computer had no time for it (or it stood still): a real one has a
processor of its own."""

DYING = """
import anyio, rtee, sys
from rtee.errors import RteeError
async def main():
    async with rtee.connect(sys.argv[1]) as remote:
        while True:
            try:
                await remote.do("Grasp", speed=0.05)
            except RteeError:
                await anyio.sleep(0.02)
anyio.run(main)
"""


_CHILDREN: list[subprocess.Popen[str]] = []


def child(words: list[str], **options: Any) -> subprocess.Popen[str]:
    """Start a program that `main` kills at the end.

    Unlike that of `witness`, it may be started in a thread that ends before it.
    """
    process = subprocess.Popen(words, text=True, **options)
    _CHILDREN.append(process)
    return process


def without_precedence(process: subprocess.Popen[str]) -> subprocess.Popen[str]:
    """Take the precedence from a program that it has inherited."""
    os.sched_setscheduler(process.pid, os.SCHED_OTHER, os.sched_param(0))
    return process


@contextlib.contextmanager
def small_disk(folder: Path) -> Iterator[bool]:
    """Put a folder on a small file system of its own, while the context lasts; whether it is."""
    folder.mkdir()
    image = folder.with_suffix(".img")
    image.touch()
    os.truncate(image, DISK)
    made = ["mkfs.ext4", "-q", str(image)], ["mount", "-o", "loop", str(image), str(folder)]
    try:
        mounted = all(
            subprocess.run(one, stderr=subprocess.DEVNULL).returncode == 0 for one in made
        )
    except FileNotFoundError:
        mounted = False
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "--lazy", str(folder)])


@dataclass(frozen=True)
class Size:
    """What a process uses."""

    memory: float
    threads: float
    files: float

    @classmethod
    def of(cls, pid: int) -> Size:
        return cls(own(pid) / MEGA, count(pid, "task"), count(pid, "fd"))


SIZES = {"memory": "memory [MB]", "threads": "threads", "files": "open files"}


@dataclass
class Life:
    """A process of the hand, from its start to its end.

    Attributes:
        sizes: What it used, each with the time [s], CLOCK_MONOTONIC, while there was no fault.
        ended: When it was killed, CLOCK_MONOTONIC [s]; ``None``: it ended by itself.
        files: Its recordings.
        gaps: Spans in which it could not record [s].
    """

    begun: float
    sizes: list[tuple[float, Size]] = field(default_factory=list)
    ended: float | None = None
    files: list[Path] = field(default_factory=list)
    gaps: list[tuple[float, float]] = field(default_factory=list)


class Device:
    """The emulated device.

    The bytes of its serial line go through a socket: those of a pseudo-terminal pass through
    threads of the kernel that have no precedence, and come up to half a second late on a busy
    computer.
    """

    def __init__(self, folder: Path, driver: str) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        self.port = f"socket://127.0.0.1:{port}"
        self._late = folder / "late.txt"
        self._words = [sys.executable, "-c", LOSSY, str(self._late), str(BUSY)]
        self._words += ["emulate", driver, "--tcp", str(port), "--raw"]
        self.plug()

    def plug(self) -> None:
        """Start it, and wait for its port."""
        self.process = child(self._words, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        if os.sched_getscheduler(0) == os.SCHED_FIFO:
            # Among equals it would wait while the hand compresses a chunk.
            os.sched_setscheduler(self.process.pid, os.SCHED_FIFO, os.sched_param(2))
        assert self.process.stdout is not None
        self.process.stdout.readline()

    def unplug(self) -> None:
        """Take its supply away."""
        self.process.kill()
        self.process.wait()

    def late(self) -> list[tuple[float, float]]:
        """Return when the computer had no time for it, from and until [s], CLOCK_MONOTONIC."""
        lines = self._late.read_text().splitlines() if self._late.exists() else []
        return [(float(begun), float(ended)) for begun, ended in map(str.split, lines)]


class Hand:
    """The hand, as `rtee run` runs it."""

    def __init__(self, folder: Path, name: str, port: str, rate: float, *, disk: bool) -> None:
        self.name, self.logs, self._folder, self._disk = name, folder / "logs", folder, disk
        self._words = [
            sys.executable,
            "-c",
            SHIFTED,
            "run",
            name,
            "--driver",
            "devices",
            "--option",
            f"port={port}",
        ]
        self._words += ["--rate", str(rate), "--log", str(self.logs)]
        self.lives: list[Life] = []
        self.start()

    def start(self) -> None:
        """Start it, and wait until it is ready."""
        said = (self._folder / "said.txt").open("a")
        place = said.tell()
        self.life = Life(time.monotonic())
        self.lives.append(self.life)
        self.process = child(self._words, cwd=self._folder, stdout=said, stderr=said)
        said.close()
        while not READY.search(self._said(place)):
            if self.process.poll() is not None:
                raise SystemExit(f"the hand has ended: {self._said(place)}")
            time.sleep(0.05)
        time.sleep(1.0)  # the network and the recorder start, too
        self.note()

    def _said(self, place: int) -> str:
        with (self._folder / "said.txt").open() as file:
            file.seek(place)
            return file.read()

    def note(self) -> None:
        """Note what it uses now."""
        self.life.sizes.append((time.monotonic(), Size.of(self.process.pid)))

    def end(self, how: signal.Signals) -> None:
        """End it."""
        if how is signal.SIGKILL:
            self.life.ended = time.monotonic()
        self.process.send_signal(how)
        self.process.wait()
        known = {path for life in self.lives for path in life.files}
        # The flight recorder's files are copies of what was recorded.
        found = {path for path in self.logs.glob("*.mcap") if "flight" not in path.name}
        self.life.files = sorted(found - known)

    @contextlib.contextmanager
    def limited(self, what: int, most: int) -> Iterator[None]:
        """Limit what it may use of the system, while the context lasts."""
        before = resource.prlimit(self.process.pid, what)
        resource.prlimit(self.process.pid, what, (most, before[1]))
        try:
            yield
        finally:
            resource.prlimit(self.process.pid, what, before)

    @contextlib.contextmanager
    def disk_full(self) -> Iterator[None]:
        """Let nothing more be written to the recordings, while the context lasts."""
        if not self._disk:
            with self.limited(resource.RLIMIT_FSIZE, SMALL):
                yield
            return
        rest = self.logs / "rest"
        try:
            with rest.open("wb") as file, contextlib.suppress(OSError):
                for piece in (2**20, 2**12):
                    with contextlib.suppress(OSError):
                        while True:
                            os.posix_fallocate(
                                file.fileno(), os.fstat(file.fileno()).st_size, piece
                            )
            yield
        finally:
            rest.unlink()


@dataclass
class Stop:
    """A stop, sent at a time [s], and what was answered: ``None`` without an answer."""

    at: float
    during: frozenset[str]
    confirmed: bool | None
    took: float


class Trouble:
    """Causes faults, and sends stops meanwhile."""

    def __init__(self, hand: Hand, device: Device, seed: int = 1) -> None:
        self.hand, self.device = hand, device
        self.random = random.Random(seed)
        self.stops: list[Stop] = []
        self._begun = time.monotonic()
        self.caused: Counter[str] = Counter()
        self.goals: Counter[str] = Counter()
        self._now: set[str] = set()
        self._lately: set[str] = set()
        self._faults: dict[str, Callable[[], object]] = {
            "killed": self._killed,
            "hand stands still": self._hand_stands_still,
            "device stands still": lambda: self._stand_still(device.process),
            "unplugged": self._unplugged,
            "answers lost": self._answers_lost,
            "disk full": self._disk_full,
            "no more files": self._no_more_files,
            "wall clock set back": self._clock_back,
            **{f"flood of {kind}": self._flood_of(kind) for kind in FLOODS_OF},
            "client killed": self._client_killed,
        }

    async def cause(self, seconds: float, kills: int) -> None:
        """Kill the hand so many times, then cause faults for a time [s], each as often."""
        for _ in range(kills):
            await self._cause("killed")
        until = time.monotonic() + seconds
        for lap in itertools.count(1):
            names = [each for each in self._faults if each != "killed" or lap % LONG == 0]
            self.random.shuffle(names)
            for name in names:
                if time.monotonic() > until:
                    return
                await self._cause(name)

    async def _cause(self, name: str) -> None:
        with self._during(name):
            await anyio.to_thread.run_sync(self._faults[name])
        self.caused[name] += 1
        await anyio.sleep(self.random.uniform(*PAUSE))
        self.hand.note()

    @contextlib.contextmanager
    def _during(self, name: str) -> Iterator[None]:
        self._now.add(name)
        self._lately.add(name)
        try:
            yield
        finally:
            self._now.discard(name)

    def _killed(self) -> None:
        self.hand.end(signal.SIGKILL)
        time.sleep(0.3)
        self.hand.start()

    def _stand_still(self, process: subprocess.Popen[str]) -> None:
        process.send_signal(signal.SIGSTOP)
        time.sleep(LASTS)
        process.send_signal(signal.SIGCONT)
        time.sleep(0.5)  # the device is found again

    def _hand_stands_still(self) -> None:
        begun = time.monotonic()
        self._stand_still(self.hand.process)
        self.hand.life.gaps.append((begun, time.monotonic()))

    def _unplugged(self) -> None:
        self.device.unplug()
        time.sleep(LASTS)
        self.device.plug()
        time.sleep(2.0)  # it is found again, at the latest after one and a half seconds

    def _answers_lost(self) -> None:
        self.device.process.send_signal(signal.SIGUSR1)
        time.sleep(FLOODS)
        self.device.process.send_signal(signal.SIGUSR1)

    def _clock_back(self) -> None:
        self.hand.process.send_signal(signal.SIGUSR1)
        time.sleep(LASTS)

    def _disk_full(self) -> None:
        begun = time.monotonic()
        with self.hand.disk_full():
            time.sleep(LASTS)
        time.sleep(LASTS)
        self.hand.life.gaps.append((begun, time.monotonic()))

    def _no_more_files(self) -> None:
        known = Path(f"/proc/{self.hand.process.pid}/fd").iterdir()
        most = max(int(each.name) for each in known) + 1
        with self.hand.limited(resource.RLIMIT_NOFILE, most):
            time.sleep(LASTS)

    def _flood_of(self, kind: str) -> Callable[[], None]:
        def flood() -> None:
            stop = str(Path(__file__).with_name("stop.py"))
            words = [sys.executable, stop, "--role", kind, "--name", self.hand.name]
            attacker = without_precedence(child(words, stderr=subprocess.DEVNULL))
            time.sleep(FLOODS)
            attacker.kill()
            attacker.wait()

        return flood

    def _client_killed(self) -> None:
        words = [sys.executable, "-c", DYING, self.hand.name]
        client = without_precedence(child(words, stderr=subprocess.DEVNULL))
        time.sleep(LASTS)
        client.kill()
        client.wait()

    async def move(self) -> None:
        """Open and close the hand, whatever happens."""
        while True:
            with contextlib.suppress(RteeError):
                async with rtee.connect(self.hand.name) as remote:
                    while True:
                        for action in ("Grasp", "open"):
                            await self._do(remote, action)
            await anyio.sleep(0.1)

    async def _do(self, remote: rtee.RemoteHand, action: str) -> None:
        try:
            result = await remote.do(action, speed=0.3)
        except NoHand:
            raise
        except RteeError:
            self.goals["refused"] += 1
            await anyio.sleep(0.1)
        else:
            self.goals["reached" if result.reached else "cancelled or aborted"] += 1

    async def stop(self) -> None:
        """Send stops."""
        while True:
            await anyio.sleep(self.random.uniform(*STOP_EVERY))
            self._lately = set(self._now)
            began = time.monotonic()
            confirmed = await self._stop()
            during = frozenset(self._lately)
            took = time.monotonic() - began
            self.stops.append(Stop(began - self._begun, during, confirmed, took))

    async def _stop(self) -> bool | None:
        try:
            return all((await stop_hand(self.hand.name, client="benchmark"))[1].values())
        except RteeError:
            return None

    def find_late(self) -> None:
        """Add to the faults during stops that the computer had no time for the device."""
        late = self.device.late()
        for stop in self.stops:
            begun = stop.at + self._begun
            if any(a < begun + stop.took and begun < b for a, b in late):
                stop.during |= {MUTE[-1]}


FLOODS_OF = ("samples", "requests", "clients")
"""Attacks of `benchmarks/stop.py` that go on here."""


@dataclass
class Judged:
    """What the recordings of one life show.

    Attributes:
        ticks: Ticks in them.
        lost: Time before the kill that is missing [s]; ``None``: it was not killed.
        holes: Times without ticks, though it ran and could record.
        damage: Sentences about damage.
        odd: Sentences about holes and steps.
        back: Ticks whose recorded wall-clock time is before that of the one before.
        beyond: References beyond a limit that were not measured either.
        fast: Steps of references beyond the velocity that do not end at a measurement.
        jump: Largest distance from the first reference to the measurement, as a share of the range.
    """

    ticks: int
    lost: float | None
    holes: int
    damage: list[str]
    odd: list[str]
    back: int
    beyond: int
    fast: int
    jump: float


def judged(life: Life, model: Model) -> Judged:
    """Read the recordings of a life."""
    lower = np.array([a.lower for a in model.actuators])
    upper = np.array([a.upper for a in model.actuators])
    fastest = np.array([a.velocity for a in model.actuators])
    recordings: list[Recording] = []
    damage: list[str] = []
    for path in life.files:
        if life.ended is not None:
            recover(path, in_place=True)
        recordings.append(read(path))
        damage += recordings[-1].damage
    odd: list[str] = []
    back, beyond, fast, jump = 0, 0, 0, 0.0
    for number, recording in enumerate(recordings):
        measured, sent = recording.actuator_states.position, recording.reference.position
        back += int((np.diff(recording.actuator_states.wall) < 0).sum())
        seconds = np.diff(recording.reference.t)[:, None]
        steps = np.abs(np.diff(sent, axis=0)) > SLACK * fastest * seconds + 1e-9
        for i, name in enumerate(recording.reference.names):
            landed = np.flatnonzero(steps[:, i])
            known = np.array(
                [np.nanmin(np.abs(measured[:, i] - end)) < MET for end in sent[landed + 1, i]],
                dtype=bool,
            )
            fast += int((~known).sum())
            odd += [
                f"{name} steps from {sent[at, i]:.6f} to {sent[at + 1, i]:.6f}, measured at"
                f" {measured[at + 1, i]:.6f}, within {seconds[at, 0]:.4f} s, at"
                f" {recording.actuator_states.time[at + 1] - life.begun:.3f} s of {life.begun:.0f}"
                for at in landed[~known]
            ]
            outside = sent[:, i][(sent[:, i] < lower[i] - 1e-9) | (sent[:, i] > upper[i] + 1e-9)]
            # It stays where it began, at a measurement, until somebody moves it.
            beyond += int((~np.isin(np.round(outside, 6), np.round(measured[:, i], 6))).sum())
        if number == 0:
            rows = min(len(measured), len(sent))
            known = np.isfinite(measured[:rows]).all(axis=1) & np.isfinite(sent[:rows]).all(axis=1)
            if known.any():
                row = int(np.argmax(known))
                jump = float((np.abs(sent[row] - measured[row]) / (upper - lower)).max())
    times = np.concatenate([r.actuator_states.time for r in recordings]) if recordings else []
    holes = 0
    for at in np.flatnonzero(np.diff(times) > 1.0):
        begin, end = float(times[at]), float(times[at + 1])
        if not any(a - 1.0 <= begin and end <= b + 1.0 for a, b in life.gaps):
            holes += 1
            odd.append(f"no ticks for {end - begin:.3f} s, at {begin - life.begun:.3f} s of a life")
    last = float(times[-1]) if len(times) else life.begun
    lost = None if life.ended is None else life.ended - last
    return Judged(len(times), lost, holes, damage, odd, back, beyond, fast, jump)


def print_stops(trouble: Trouble) -> None:
    """Print how stops were answered, by the faults meanwhile."""
    by_fault: dict[str, list[Stop]] = defaultdict(list)
    for stop in trouble.stops:
        for name in stop.during or ("nothing",):
            by_fault[name].append(stop)
    table = Table("during", "faults", "stops", "confirmed", "not", "no answer", "median, most [ms]")
    for name in ("nothing", *trouble.caused, MUTE[-1]):
        stops = by_fault[name]
        said = Counter(stop.confirmed for stop in stops)
        times = [1e3 * stop.took for stop in stops if stop.confirmed] or [float("nan")]
        took = f"{statistics.median(times):.0f}, {max(times):.0f}"
        cells = (trouble.caused[name], len(stops), said[True], said[False], said[None], took)
        table.row(name, *cells)
    possible = [s for s in trouble.stops if not s.during & {*SILENT, *MUTE}]
    done = sum(stop.confirmed is True for stop in possible)
    print(f"\nStops that could be confirmed: **{done} of {len(possible)}**.\n")
    for stop in possible:
        if stop.confirmed is not True:
            answer = "no answer" if stop.confirmed is None else "not confirmed"
            during = ", ".join(sorted(stop.during)) or "nothing"
            print(f"- {answer}, {1e3 * stop.took:.0f} ms, {stop.at:.0f} s, during: {during}")


def print_lives(lives: list[Life], model: Model) -> None:
    """Print what each process has used, and what its recordings show."""
    ends = [life.sizes[-1][0] - life.begun for life in lives]
    print(f"{len(lives)} processes of the hand, the longest {max(ends):.0f} s. Those that lived ")
    print(f"for longer than {2 * WARM:.0f} s, from {WARM:.0f} s after their start on:\n")
    table = Table("", "first, median", "last, median", "largest growth", "in an hour", "processes")
    late = [[(t, s) for t, s in life.sizes if t - life.begun > WARM] for life in lives]
    late = [notes for notes in late if notes and notes[-1][0] - notes[0][0] > WARM]
    for name, title in SIZES.items():
        rows = [np.array([(t, getattr(s, name)) for t, s in notes]) for notes in late]
        if not rows:
            continue
        rises = [row[-1, 1] - row[0, 1] for row in rows]
        centred = np.concatenate([row - row.mean(axis=0) for row in rows])
        slope = 3600.0 * (centred[:, 0] @ centred[:, 1]) / (centred[:, 0] @ centred[:, 0])
        means = [f"{statistics.median(row[at, 1] for row in rows):.1f}" for at in (0, -1)]
        table.row(title, *means, f"{max(rises):+.1f}", f"{slope:+.1f}", len(rows))
    found = [judged(life, model) for life in lives]
    lost = [each.lost for each in found if each.lost is not None]
    most = f"{max(lost):.2f} s" if lost else "–"
    print(f"\nRecordings, {sum(each.ticks for each in found)} ticks:\n")
    table = Table("what", "found")
    table.row("missing before a kill, most", most)
    table.row("processes with more than 1 s missing", sum(each > 1.0 for each in lost))
    table.row("holes of more than 1 s that have no such reason", sum(f.holes for f in found))
    table.row("sentences about damage", sum(len(each.damage) for each in found))
    table.row("recorded times that go back", sum(f.back for f in found))
    table.row("references beyond a limit that were not measured", sum(f.beyond for f in found))
    table.row("steps beyond the velocity, not to a measurement", sum(f.fast for f in found))
    jump = max(each.jump for each in found)
    table.row("first reference of a process to the measurement, most", f"{100 * jump:.2f} %")
    for sentence in sorted({text for each in found for text in [*each.damage, *each.odd]})[:20]:
        print(f"\n- {sentence}")


@contextlib.asynccontextmanager
async def troubled(hand: Hand, device: Device) -> AsyncIterator[Trouble]:
    """Move and stop the hand for as long as the context lasts."""
    trouble = Trouble(hand, device)
    async with anyio.create_task_group() as group:
        group.start_soon(trouble.move)
        group.start_soon(trouble.stop)
        yield trouble
        group.cancel_scope.cancel()


def prepared(folder: Path, name: str) -> str:
    """Copy a hand that is driven again as soon as its device is back; return the driver.

    Its old recordings stay, however full the disk: they are read at the end.
    """
    place = folder / "config" / name
    shutil.copytree(hand_folder(name)[0], place)
    file = place / "hand.yaml"
    text = file.read_text()
    again = re.sub(r"(?m)^(    driver: (\w+))$", r"\1\n    reconnect: active", text, count=1)
    file.write_text(again + "\nlog: {reserve: 0.0}\n")
    found = re.search(r"(?m)^    driver: (\w+)$", text)
    if found is None:
        raise SystemExit(f"{name} has no device")
    return found[1]


async def measure(folder: Path, name: str, seconds: float, kills: int, rate: float) -> None:
    """Run everything in a folder, and print."""
    with small_disk(folder / "logs") as disk:
        await measure_on(folder, name, seconds, kills, rate, disk=disk)


async def measure_on(
    folder: Path, name: str, seconds: float, kills: int, rate: float, *, disk: bool
) -> None:
    """Run everything in a folder, and print."""
    model = load_hand(name)
    device = Device(folder, prepared(folder, name))
    hand = Hand(folder, name, device.port, rate, disk=disk)
    own_first = Size.of(device.process.pid)
    async with troubled(hand, device) as trouble:
        await trouble.cause(seconds, kills)
    hand.note()
    hand.end(signal.SIGTERM)
    trouble.find_late()
    own_last = Size.of(device.process.pid)
    load = ", ".join(f"{each:.1f}" for each in os.getloadavg())
    print(f"Load of the computer at the end: {load}. Disk of its own: {'yes' if disk else 'no'}.\n")
    print(f"`{name}`, {seconds:.0f} s at {rate:g} Hz, {sum(trouble.caused.values())} faults, ")
    print(f"goals: {', '.join(f'{n} {how}' for how, n in trouble.goals.items())}.\n")
    print_stops(trouble)
    print_lives(hand.lives, model)
    print(f"\nThe emulated device at the start and end: {own_first}, {own_last}.")
    said = (folder / "said.txt").read_text()
    print(f"\nTracebacks of the hand: {said.count('Traceback')}. Why stops were not confirmed:\n")
    for why, times in Counter(re.findall(r"did not confirm 'stop': (.*)", said)).items():
        print(f"- {times} times: {why}")
    if "Traceback" in said:
        print(said[said.index("Traceback") :][:3000], file=sys.stderr)
    device.unplug()


def main() -> None:
    """Run and print."""
    options = {"seconds": 1800.0, "kills": 50, "hand": "inspire_rh56", "rate": 500.0}
    given = command_line(__doc__, **options, realtime=False).parse_args()
    if given.realtime:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    with tempfile.TemporaryDirectory(prefix="rtee-") as place:
        os.chdir(place)
        try:
            sizes = (given.seconds, given.kills, given.rate)
            anyio.run(measure, Path(place), given.hand, *sizes)
        finally:
            for process in _CHILDREN:
                process.kill()


if __name__ == "__main__":
    main()
