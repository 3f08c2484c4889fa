"""How well the loop keeps its time, beside `cyclictest` in the same run; prints a Markdown table.

    python benchmarks/loop.py [--seconds 60] [--hand schunk_svh] [--only ordinary realtime …]

Every row is `rtee run` as users run it: kinematic driver, everything logged at every tick, on the
network with a client that takes 100 states a second and has the hand close and open all the time.
The numbers are the loop's own, read back from its recording. `cyclictest` (Debian: rt-tests), the
kernel's own C program for this, runs before and after with the same period and priority.

Sets: `ordinary` and `realtime` are one hand at 1000 Hz; `helpers` has the recorder's and the
network's threads under real-time scheduling, too; `four` is four hands in one process at 500 Hz
with real-time set-up. `--hogs` starts programs that keep CPUs busy meanwhile.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from rtee.hand.catalog import find_hand
from rtee.log import read
from rtee.types import LoopStatistics

PAGE = os.sysconf("SC_PAGE_SIZE")
SETS = ("ordinary", "realtime", "helpers", "four")

HOG = "while True: pass"
CLIENT = """
import sys, anyio, rtee
from rtee.errors import RemoteError

async def watch(hand):
    async for _ in hand.states(rate=100):
        pass

async def move(hand):
    while True:
        await hand.do("Grasp")
        await hand.do("open")

async def main(name):
    async with rtee.connect(name) as hand, anyio.create_task_group() as group:
        group.start_soon(watch, hand)
        group.start_soon(move, hand)

try:
    anyio.run(main, sys.argv[1])
except* RemoteError:
    pass
"""


@dataclass
class Row:
    name: str
    statistics: LoopStatistics
    memory: list[float]
    log_rate: float


def memory_of(pid: int) -> float:
    """Return the resident memory of a process [MB]."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * PAGE / 1e6


def copies(hand: str, count: int, folder: Path, extra: str = "") -> list[str]:
    """Return copies of a hand under other names, with more in their hand.yaml."""
    names = []
    for _ in range(count):
        name = f"{hand}_{len(list(folder.iterdir()))}"
        shutil.copytree(find_hand(hand), folder / name)
        file = folder / name / "hand.yaml"
        text = re.sub(r"(?m)^name: .*$", f"name: {name}", file.read_text())
        file.write_text(text + extra)
        names.append(name)
    return names


def run(name: str, hands: list[str], seconds: float, folder: Path, *more: str) -> Row:
    """Run hands as users do, with a client each, and read what the loop recorded of itself."""
    logs = folder / "logs" / name
    environment = os.environ | {"RTEE_CONFIG_PATH": str(folder)}
    program = [sys.executable, "-c", "from rtee.cli import main; main()"]
    process = subprocess.Popen(
        [*program, "run", *hands, "--driver", "kinematic", "--log", str(logs), *more],
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
    )
    assert process.stdout is not None
    for _ in hands:
        print(f"  {process.stdout.readline().strip()[:100]}", file=sys.stderr)
    # From a thread, because its output must be drained.
    drain = threading.Thread(target=process.stdout.read, daemon=True)
    drain.start()
    clients = [subprocess.Popen([sys.executable, "-c", CLIENT, hand]) for hand in hands]
    memory: list[float] = []
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(min(10.0, max(0.0, end - time.monotonic())))
        memory.append(memory_of(process.pid))
    process.send_signal(signal.SIGTERM)
    process.wait(timeout=30)
    for client in clients:
        client.wait(timeout=30)
    files = sorted(logs.glob(f"{hands[0]}*_0*.mcap"))
    recording = read(files, only=["loop_statistics"])
    size = sum(file.stat().st_size for file in logs.glob("*_0*.mcap")) / 1e6
    last = recording.loop_statistics[-1].value
    return Row(name, last, memory, size / recording.duration * 60)


def cyclictest(seconds: float, period_us: int = 1000) -> str | None:
    """Return cyclictest's latencies as cells of the table, or ``None`` where it isn't installed."""
    if shutil.which("cyclictest") is None:
        return None
    loops = max(1000, int(seconds * 1e6 / period_us))
    command = ["cyclictest", "-q", "-m", "-p80", f"-i{period_us}", f"-l{loops}", "-h2000"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        return None
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
    cells = " | ".join(str(found.get(percent, ">2000")) for percent in (50, 99, 99.9))
    return f"{loops} | – | {cells} | {worst} | – | – | – | –"


def cells(row: Row) -> str:
    s = row.statistics
    lateness = [s.lateness_p50, s.lateness_p99, s.lateness_p999, s.lateness_max]
    micro = " | ".join(f"{value * 1e6:.0f}" for value in lateness)
    busy = " | ".join(f"{value * 1e6:.0f}" for value in (s.busy_p50, s.busy_p99))
    share = 100 * s.missed / (s.ticks + s.missed)
    memory = f"{row.memory[0]:.0f} → {row.memory[-1]:.0f}"
    missed = f"{s.missed} ({share:.3f} %)"
    return f"{s.ticks} | {missed} | {micro} | {busy} | {memory} | {row.log_rate:.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="length of every run [s]")
    parser.add_argument("--hand", default="schunk_svh")
    parser.add_argument("--hogs", type=int, default=0, help="programs that keep CPUs busy")
    parser.add_argument("--only", nargs="+", choices=SETS, default=list(SETS))
    arguments = parser.parse_args()
    load = os.getloadavg()[0]
    print(f"{os.cpu_count()} CPUs, load {load:.1f} before, {os.uname().release},", end=" ")
    print(f"Python {sys.version.split()[0]}; {arguments.hand}; {arguments.seconds:g} s each;")
    print("lateness and busy time in µs, memory in MB, log in MB a minute (all hands)\n")
    head = "ticks | missed | lateness p50 | p99 | p99.9 | max | busy p50 | p99 | memory | log"
    print(f"| | {head} |")
    print("|" + " --- |" * 11, flush=True)

    def reference(when: str) -> None:
        found = cyclictest(min(arguments.seconds, 60.0))
        text = found or "not installed" + " |" * 9
        print(f"| cyclictest, SCHED_FIFO 80, {when} | {text} |", flush=True)

    hogs = [subprocess.Popen([sys.executable, "-c", HOG]) for _ in range(arguments.hogs)]
    reference("before")
    with tempfile.TemporaryDirectory(prefix="rtee-loop-") as text:
        folder = Path(text)
        for name in arguments.only:
            extra = "\nrealtime: {helper_priority: 10}\n" if name == "helpers" else ""
            hands = copies(arguments.hand, 4 if name == "four" else 1, folder, extra)
            rate = "500" if name == "four" else "1000"
            more = [] if name == "ordinary" else ["--realtime"]
            row = run(name, hands, arguments.seconds, folder, "--rate", rate, *more)
            label = f"{len(hands)} hand{'s' * (len(hands) > 1)} at {rate} Hz, "
            label += "ordinary" if name == "ordinary" else "real-time set-up"
            label += ", helpers too" if name == "helpers" else ""
            print(f"| rtee, {label} | {cells(row)} |", flush=True)
    reference("after")
    for hog in hogs:
        hog.kill()


if __name__ == "__main__":
    main()
