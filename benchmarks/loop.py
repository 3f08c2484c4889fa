"""Measure the timing of the loop, beside `cyclictest`; print a Markdown table.

    python benchmarks/loop.py [--seconds 60] [--hand schunk_svh] [--only ordinary realtime …]
                              [--beside alone bare junk …]

Every row is `rtee run` as users run it: kinematic driver, everything logged at every tick, on the
network with a client that takes 100 states a second and has the hand close and open all the time.
The numbers are those that the loop prints at its end. `cyclictest` (Debian: rt-tests), the kernel
developers' C program for this, runs before and after with the same period and priority; wake-ups
that are a whole period late count as missed: these are the computer's own.

Sets: `ordinary` and `realtime` are one hand at 1000 Hz; `helpers` has the recorder's and the
network's threads under real-time scheduling, too; `four` is four hands in one process at 500 Hz
with real-time set-up, `four-fast` at 1000 Hz; `four-processes` is four hands at 1000 Hz, each in
a process of its own, of which the table has the sums of ticks, memory and log, and the worst of
the other figures. `--beside` measures the first set in other circumstances, right after it:

- `alone`: no client;
- `unrecorded`: no recorder, neither on the disk nor in memory;
- `bare`: neither of both;
- `junk`: the client also has 50 bad goals refused a second (unknown action, wrong elements, NaN,
  intensity 1.2, effort for an unknown actuator) and sends a megabyte of junk ten times a second, to
  every key in turn;
- `idle-junk`: as many megabytes to another hand's keys, without a receiver: what the sender
  alone costs the computer.

`--witness` runs `cyclictest` beside the loop, too, above its priority, and attributes every missed
tick: to the computer, if a witness was late at that moment, or to the loop itself.
The witness takes one to two per cent of every CPU.

Memory is given after 10 s, after 2 minutes (when the flight recorder has long been full) and at the
end; with `--flight 10` the flight recorder keeps 10 s, so that shorter runs show it, too. `--hogs`
starts programs that keep CPUs busy meanwhile.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path

from common import Table, command_line
from witness import Missed, StoodStill, Witness, child, judged

from rtee.hand.catalog import find_hand

PAGE = os.sysconf("SC_PAGE_SIZE")
SETS = ("ordinary", "realtime", "helpers", "four", "four-fast", "four-processes")
BESIDE = ("alone", "unrecorded", "bare", "junk", "idle-junk")

PRINTED = re.compile(
    r"(?P<ticks>\d+) ticks at [0-9.]+ Hz, (?P<missed>\d+) missed.*?; lateness p50 (?P<p50>\d+),"
    r" p99 (?P<p99>\d+), p99\.9 (?P<p999>\d+), max (?P<worst>\d+) µs;"
    r" busy p50 (?P<busy50>\d+), p99 (?P<busy99>\d+)"
)
"""The line that the loop prints at its end."""

HOG = "while True: pass"
SHOWN = 10
"""Most missed ticks that are shown one by one."""

RUN = """
import json, os, resource
from rtee.cli import main
from rtee.loop.clock import TickStatistics

add, found, last = TickStatistics.add, [], [0, 0]

def usage():
    used = resource.getrusage(resource.RUSAGE_THREAD)
    return used.ru_nivcsw, used.ru_majflt + used.ru_minflt

def noted(self, woken_ns, lateness_ns, busy_ns, missed):
    add(self, woken_ns, lateness_ns, busy_ns, missed)
    now = usage()
    if missed:
        since = woken_ns - lateness_ns - (missed + 1) * 1e9 / self.rate
        changed = [a - b for a, b in zip(now, last)]
        found.append([woken_ns * 1e-9, since * 1e-9, missed, busy_ns * 1e-9, *changed])
    last[:] = now

TickStatistics.add = noted
try:
    main()
finally:
    with open(os.environ["RTEE_MISSED"], "w") as file:
        json.dump(found, file)
"""
"""`rtee run`, which also notes when it missed ticks."""

WATCH_AND_MOVE = """
async def watch(hand):
    async for _ in hand.states(rate=100):
        pass

async def move(hand):
    while True:
        await hand.do("Grasp")
        await hand.do("open")
"""
"""The program of a client, which receives the hand's states, and opens and closes the hand."""

CLIENT = (
    """
import sys, anyio, rtee
from rtee.errors import RemoteError

"""
    + WATCH_AND_MOVE
    + """
async def main(name):
    async with rtee.connect(name) as hand, anyio.create_task_group() as group:
        group.start_soon(watch, hand)
        group.start_soon(move, hand)

try:
    anyio.run(main, sys.argv[1])
except* RemoteError:
    pass
"""
)

JUNK = (
    """
import random, sys, anyio, rtee
from rtee.errors import RequestRejected, RteeError
from rtee.messages import network_key
from rtee.messages.requests import REQUESTS
from rtee.messages.topics import TYPES
from rtee.remote.find import open_hand
from rtee.remote.session import direct

BAD = (
    (("Grip",), {}),
    (("Trig", "nose"), {}),
    (("PinchTight", "index"), {}),
    (("Grasp",), {"intensity": 1.2}),
    (("Grasp",), {"intensity": float("nan")}),
    (("Grasp",), {"speed": float("nan")}),
    (("Grasp",), {"tolerance": -1.0}),
    (("Grasp",), {"timeout": float("inf")}),
    (("Grasp",), {"effort": {"elbow": 1.0}}),
)

"""
    + WATCH_AND_MOVE
    + """
async def refused(hand):
    for k in range(10**9):
        action, options = BAD[k % len(BAD)]
        try:
            await hand.start(*action, **options)
        except RequestRejected:
            pass
        else:
            raise AssertionError(action)
        await anyio.sleep(0.02)

async def rubbish(name, target):
    session, _ = await open_hand(name, None, 20.0)
    megabyte = random.Random(1).randbytes(1_000_000)
    keys = [network_key(target, topic) for topic in TYPES]
    asked = [request.key(target) for request in REQUESTS.values()]
    for k in range(10**9):
        if k % 2:
            session.put(keys[k // 2 % len(keys)], megabyte)
        else:
            session.get(asked[k // 2 % len(asked)], direct(lambda _: None), payload=megabyte)
        await anyio.sleep(0.1)

async def main(name, target):
    async with rtee.connect(name) as hand, anyio.create_task_group() as group:
        if target == name:
            group.start_soon(watch, hand)
            group.start_soon(move, hand)
            group.start_soon(refused, hand)
        group.start_soon(rubbish, name, target)

try:
    anyio.run(main, *sys.argv[1:])
except* RteeError:
    pass
"""
)


@dataclass(frozen=True)
class How:
    """The circumstances of a run.

    Attributes:
        label: In words.
        count: Number of hands.
        processes: Number of processes that the hands are divided among.
        rate: Ticks per second [Hz].
        realtime: With real-time set-up.
        helpers: The helper threads, too.
        client: With a client.
        record: With the recorder.
        junk: Whose keys get junk: the hand's (``hand``), or another's (``other``).
    """

    label: str
    count: int = 1
    processes: int = 1
    rate: int = 1000
    realtime: bool = True
    helpers: bool = False
    client: bool = True
    record: bool = True
    junk: str = ""


@dataclass
class Row:
    """The results of a run.

    Attributes:
        printed: What the loop printed, by name; times in µs.
        memory: Resident memory every 10 s [MB].
        log_rate: Recordings of all hands [MB per minute].
        missed: The ticks that were missed.
    """

    printed: dict[str, int]
    memory: list[float]
    log_rate: float
    missed: list[Missed]


def how_of(name: str) -> How:
    """Return the circumstances that a set's name stands for."""
    if name == "four":
        return How("4 hands at 500 Hz, real-time set-up", count=4, rate=500)
    if name == "four-fast":
        return How("4 hands at 1000 Hz, real-time set-up", count=4)
    if name == "four-processes":
        return How("4 hands at 1000 Hz, a process each, real-time set-up", count=4, processes=4)
    if name == "ordinary":
        return How("1 hand at 1000 Hz, ordinary", realtime=False)
    if name == "helpers":
        return How("1 hand at 1000 Hz, real-time set-up, helpers too", helpers=True)
    return How("1 hand at 1000 Hz, real-time set-up")


def beside(how: How, name: str) -> How:
    """Return circumstances that differ only in what the name says."""
    changes: dict[str, dict[str, object]] = {
        "alone": {"client": False},
        "unrecorded": {"record": False},
        "bare": {"client": False, "record": False},
        "junk": {"junk": "hand"},
        "idle-junk": {"junk": "other"},
    }
    words = {
        "alone": "no client",
        "unrecorded": "no recorder",
        "bare": "no client, no recorder",
        "junk": "and junk",
        "idle-junk": "and junk for another hand",
    }
    label = f"… {words[name]}"
    return replace(how, label=label, **changes[name])  # type: ignore[arg-type]


def memory_of(pid: int) -> float:
    """Return the resident memory of a process [MB]."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * PAGE / 1e6


def copies(hand: str, count: int, folder: Path, extra: str = "") -> list[str]:
    """Return copies of a hand under other names, with additions to hand.yaml."""
    # Copies under other names: hands that run on this computer already stay out of it.
    names = []
    for _ in range(count):
        name = f"{hand}_{len(list(folder.iterdir()))}"
        shutil.copytree(find_hand(hand), folder / name)
        file = folder / name / "hand.yaml"
        text = re.sub(r"(?m)^name: .*$", f"name: {name}", file.read_text())
        file.write_text(text + extra)
        names.append(name)
    return names


class Program:
    """`rtee run` of some of the hands, with its notes of missed ticks.

    Args:
        how: The circumstances.
        hands: Names of its hands.
        folder: Where their configurations are.
        logs: Where their recordings go.
    """

    def __init__(self, how: How, hands: list[str], folder: Path, logs: Path) -> None:
        self._notes = folder / f"missed_{hands[0]}.json"
        environment = os.environ | {
            "RTEE_CONFIG_PATH": str(folder),
            "RTEE_MISSED": str(self._notes),
        }
        words = [sys.executable, "-c", RUN, "run", *hands]
        words += ["--driver", "kinematic", "--rate", str(how.rate)]
        words += ["--realtime"] if how.realtime else []
        words += ["--log", str(logs)] if how.record else ["--no-log"]
        self.process = child(words, stdout=subprocess.PIPE, env=environment)
        output = self.process.stdout
        assert output is not None
        for _ in hands:
            print(f"  {output.readline().strip()[:100]}", file=sys.stderr)
        self._lines: list[str] = []
        # From a thread, because its output must be drained.
        self._drain = threading.Thread(target=lambda: self._lines.extend(output), daemon=True)
        self._drain.start()

    def end(self) -> tuple[dict[str, int], list[Missed]]:
        """Wait for its end; return what the loop printed, by name, and the ticks it missed."""
        self.process.wait(timeout=30)
        self._drain.join(10.0)
        found = PRINTED.search("".join(self._lines))
        assert found is not None, "".join(self._lines)
        printed = {name: int(value) for name, value in found.groupdict().items()}
        return printed, [Missed(*values) for values in json.loads(self._notes.read_text())]


def run(
    how: How, hand: str, seconds: float, folder: Path, flight: float | None, witness: bool
) -> Row:
    """Run hands as users do, with a client each, and read the loop's own statistics."""
    extra = "\nrealtime: {helper_priority: 10}\n" if how.helpers else ""
    kept = flight if how.record else 0.0
    extra += "" if kept is None else f"\nlog: {{flight_recorder: {kept:g}}}\n"
    hands = copies(hand, how.count, folder, extra)
    logs = folder / "logs" / hands[0]
    programs = [Program(how, hands[k :: how.processes], folder, logs) for k in range(how.processes)]
    others = [[CLIENT, name] for name in hands if how.client and how.junk != "hand"]
    if how.junk:
        others.append([JUNK, hands[0], hands[0] if how.junk == "hand" else "somebody_else"])
    clients = [child([sys.executable, "-c", *other]) for other in others]
    watching = Witness() if witness else None
    memory: list[float] = []
    begin = time.monotonic()
    while (passed := time.monotonic() - begin) < seconds:
        time.sleep(min(10.0, seconds - passed))
        memory.append(sum(memory_of(program.process.pid) for program in programs))
    # A client that crashed would make the loop look better than it is.
    failed = [client.args for client in clients if client.poll() is not None]
    assert not failed, f"a client ended early: {failed}"
    stood_still = StoodStill(watching.stop() if watching else None)
    until = time.monotonic()
    # All at once, before it is waited for: the last ones would have more of the computer.
    for program in programs:
        program.process.send_signal(signal.SIGTERM)
    ended = [program.end() for program in programs]
    for client, other in zip(clients, others, strict=True):
        # It never ends by itself.
        if other[0] is JUNK:
            client.kill()
        client.wait(timeout=30)
    printed = {name: max(values[name] for values, _ in ended) for name in ended[0][0]}
    printed |= {name: sum(values[name] for values, _ in ended) for name in ("ticks", "missed")}
    # Only the parts of the recordings; their folder also has other files.
    size = sum(file.stat().st_size for file in logs.glob("*_0*.mcap")) / 1e6
    missed = [judged(one, stood_still) for _, ticks in ended for one in ticks]
    # While programs start or end, the witness does not run.
    unseen = [one for one in missed if one.woken > until or one.woken < begin]
    missed = [replace(one, computer=None) if one in unseen else one for one in missed]
    return Row(printed, memory, size / seconds * 60, missed)


def cyclictest(seconds: float, period_us: int = 1000) -> list[str]:
    """Return cyclictest's latencies as cells of the table."""
    nothing = ["not installed", *"–––––––––"]
    if shutil.which("cyclictest") is None:
        return nothing
    # At least a thousand, or there is no 99.9th percentile.
    loops = max(1000, int(seconds * 1e6 / period_us))
    command = ["cyclictest", "-q", "-m", "-p80", f"-i{period_us}", f"-l{loops}", "-h2000"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        return nothing
    counts = [
        (int(match[1]), int(match[2])) for match in re.finditer(r"(?m)^(\d+)\s+(\d+)", done.stdout)
    ]
    total = sum(count for _, count in counts)
    found = {}
    for percent in (50, 99, 99.9):
        seen = 0
        for latency, count in counts:
            seen += count
            if seen >= percent / 100 * total:
                found[percent] = latency
                break
    worst = max(int(x) for x in re.findall(r"# Max Latencies: (\d+)", done.stdout) or ["0"])
    beyond = sum(int(x) for x in re.findall(r"# Histogram Overflows: (\d+)", done.stdout))
    missed = beyond + sum(count for latency, count in counts if latency >= period_us)
    share = f"{missed} ({100 * missed / loops:.3f} %)"
    latencies = [str(found.get(percent, ">2000")) for percent in (50, 99, 99.9)]
    return [f"{loops}", share, *latencies, f"{worst}", *"––––"]


def cells(row: Row) -> list[str]:
    """Return the cells of a row."""
    s = row.printed
    share = 100 * s["missed"] / max(1, s["ticks"] + s["missed"])
    micro = [f"{s[name]}" for name in ("p50", "p99", "p999", "worst", "busy50", "busy99")]
    points = [row.memory[0], *row.memory[11:12], row.memory[-1]]
    memory = " → ".join(f"{value:.1f}" for value in points)
    missed = f"{s['missed']} ({share:.3f} %)"
    if any(one.computer is not None for one in row.missed):
        whose = {
            words: sum(one.count for one in row.missed if one.computer is computer)
            for words, computer in (("the computer's", True), ("own", False), ("unseen", None))
        }
        missed += ": " + ", ".join(f"{count} {words}" for words, count in whose.items() if count)
    return [f"{s['ticks']}", missed, *micro, memory, f"{row.log_rate:.1f}"]


def main() -> None:
    """Measure and print."""
    parser = command_line(
        __doc__,
        seconds=60.0,
        hand="schunk_svh",
        hogs=0,
        witness=False,
        reference=60.0,
        flight=float,
    )
    parser.add_argument("--only", nargs="+", choices=SETS, default=list(SETS))
    parser.add_argument("--beside", nargs="*", choices=BESIDE, default=[])
    arguments = parser.parse_args()
    load = os.getloadavg()[0]
    print(f"{os.cpu_count()} CPUs, load {load:.1f} before, {os.uname().release},", end=" ")
    print(f"Python {sys.version.split()[0]}; {arguments.hand}; {arguments.seconds:g} s each;")
    print("lateness and busy time in µs, memory in MB, log in MB a minute (all hands)\n")
    lateness = ("lateness p50", "p99", "p99.9", "max")
    table = Table(
        "", "ticks", "missed", *lateness, "busy p50", "p99", "memory", "log", widths=(37,)
    )

    def reference(when: str) -> None:
        found = cyclictest(min(arguments.seconds, arguments.reference))
        table.row(f"cyclictest, SCHED_FIFO 80, {when}", *found)

    hogs = [child([sys.executable, "-c", HOG]) for _ in range(arguments.hogs)]
    reference("before")
    with tempfile.TemporaryDirectory(prefix="rtee-loop-") as text:
        folder = Path(text)
        chosen = [how_of(name) for name in arguments.only]
        # Right after the first set, so that the computer is the same.
        chosen[1:1] = [beside(chosen[0], name) for name in arguments.beside]
        for how in chosen:
            seconds, flight = arguments.seconds, arguments.flight
            row = run(how, arguments.hand, seconds, folder, flight, arguments.witness)
            table.row(f"rtee, {how.label}", *cells(row))
            print("  memory every 10 s:", *(f"{m:.1f}" for m in row.memory), file=sys.stderr)
            own = [one for one in row.missed if one.computer is not True]
            for one in own[:SHOWN]:
                print(f"  not the computer's: {one}", file=sys.stderr)
    reference("after")
    for hog in hogs:
        hog.kill()


if __name__ == "__main__":
    main()
