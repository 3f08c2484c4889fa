"""Measure the GUI's cost to a loop of 1 kHz, in one run; print Markdown tables.

    python benchmarks/gui.py [--rounds 3] [--seconds 6] [--hand schunk_svh] [--nice 19] [--realtime]

The hand is `rtee run` as users run it: kinematic driver, everything logged at every tick, opening
and closing all the time; `--realtime` asks for real-time scheduling, as on a robot PC. Its process
also notes how late each tick was. Every round has four parts, one after the other, the first second
of which does not count: the loop without a GUI; with `rtee gui` and no window; with a window on
another computer; with Chromium.

The window on another computer is `gui_onlooker`, which connects as the page does and
receives all that it does, at full rate, but draws nothing. Chromium renders in software here and
would keep a CPU busy, which where the operator sits costs the robot PC nothing: it runs at the
lowest priority (`--nice 0` for the same as all others). Afterwards each of the two looks through
a relay that counts what it is sent, to show that it is the same.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from common import Table, command_line
from gui_common import chromium, gui_of, mover, program, remote_window, shown, used
from gui_onlooker import kinds
from gui_relay import Relay

if TYPE_CHECKING:
    from playwright.sync_api import Page

PROBE = """
import array, sys
from rtee.cli import main
from rtee.loop import handloop

kept = array.array("q")

class Kept(handloop.TickStatistics):
    def add(self, woken_ns, lateness_ns, busy_ns, missed):
        kept.extend((woken_ns, lateness_ns, missed))
        super().add(woken_ns, lateness_ns, busy_ns, missed)

handloop.TickStatistics = Kept
try:
    main()
finally:
    with open("ticks.bin", "wb") as file:
        kept.tofile(file)
"""
RATE = 1000.0  # of the loop [Hz]
WARM = 1.0  # time before each part counts [s]
COUNTED = 5.0  # time for which frames are counted [s]
PARTS = ("alone", "GUI, no window", "GUI, window on another computer", "GUI, Chromium here")


@dataclass
class Part:
    """The measurements of one part in all rounds.

    Attributes:
        spans: Begin and end of each round, CLOCK_MONOTONIC [s].
        cpu: Processor time of the GUI in each as a share of one processor.
    """

    spans: list[tuple[float, float]] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)

    def measure(self, seconds: float, gui: int | None) -> None:
        """Wait for a round to pass."""
        time.sleep(WARM)
        begin, before = time.monotonic(), 0.0 if gui is None else used(gui)
        time.sleep(seconds)
        end = time.monotonic()
        self.spans.append((begin, end))
        if gui is not None:
            self.cpu.append((used(gui) - before) / (end - begin))


def row(name: str, part: Part, ticks: np.ndarray) -> list[str]:
    """Return the cells of a row: statistics of the ticks in all rounds of a part."""
    woken = ticks[:, 0] * 1e-9
    rounds = [ticks[(woken >= begin) & (woken < end)] for begin, end in part.spans]
    late = np.concatenate(rounds)[:, 1] * 1e-3
    each = " ".join(f"{np.percentile(r[:, 1] * 1e-3, 99):.0f}" for r in rounds)
    missed = [int(r[:, 2].sum()) for r in rounds]
    cells = [name, f"{len(late)}", f"{sum(missed)}", " ".join(map(str, missed))]
    cells += [f"{np.percentile(late, share):.0f}" for share in (50, 99, 99.9)]
    return [*cells, each, f"{100 * statistics.median(part.cpu):.1f} %" if part.cpu else "–"]


def one_round(parts: dict[str, Part], folder: Path, given: argparse.Namespace, page: Page) -> None:
    """Measure all parts once, one after the other."""
    alone, closed, remote, opened = (parts[name] for name in PARTS)
    alone.measure(given.seconds, None)
    with gui_of(folder, given.hand) as (gui, visit):
        # Starting the GUI loads the computer for a moment, which no part is about.
        time.sleep(2.0)
        closed.measure(given.seconds, gui)
        with remote_window(visit, folder):
            time.sleep(1.0)
            remote.measure(given.seconds, gui)
        with shown(page, visit):
            opened.measure(given.seconds, gui)


def counted(folder: Path, hand: str, page: Page) -> list[list[str]]:
    """Return the rows of the table of messages sent to each kind of window."""
    rows = []
    windows = {
        PARTS[2]: lambda visit: remote_window(visit, folder),
        PARTS[3]: lambda visit: shown(page, visit),
    }
    with gui_of(folder, hand) as (_, visit):
        time.sleep(2.0)
        for name, window in windows.items():
            with Relay(visit) as relay, window(relay.visit):
                # What a window is sent at its beginning, such as meshes, is not counted.
                time.sleep(2.0 * WARM)
                relay.take()
                time.sleep(COUNTED)
                frames = relay.take()
            size = sum(map(len, frames)) / COUNTED / 1e3
            often = [f"{kind} {n / COUNTED:.0f}" for kind, n in kinds(frames).most_common(6)]
            rows.append([name, f"{len(frames) / COUNTED:.0f}", f"{size:.0f}", ", ".join(often)])
    return rows


def measured(folder: Path, given: argparse.Namespace) -> None:
    """Run everything in a folder, and print."""
    parts = {name: Part() for name in PARTS}
    run = [sys.executable, "-c", PROBE, "run", given.hand, "--driver", "kinematic"]
    run += ["--log", str(folder), *(["--realtime"] if given.realtime else [])]
    with (
        chromium(folder, given.nice) as page,
        program(folder, rf"{given.hand}: .* active", *run) as (loop, _),
        mover(given.hand),
    ):
        for _ in range(given.rounds):
            one_round(parts, folder, given, page)
        fifo = os.sched_getscheduler(loop) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
        sent = counted(folder, given.hand, page)
    ticks = np.fromfile(folder / "ticks.bin", dtype=np.int64).reshape(-1, 3)
    print(f"`{given.hand}` at {RATE:.0f} Hz, ", end="")
    print(f"{'SCHED_FIFO' if fifo else 'an ordinary process'}, {given.rounds} rounds of ", end="")
    print(f"{given.seconds:.0f} s, Chromium at nice {given.nice}\n")
    head = ["part", "ticks", "missed", "in each round", "lateness p50 [µs]", "p99 [µs]"]
    table = Table(*head, "p99.9 [µs]", "p99 of each round [µs]", "the GUI's CPU")
    for name, part in parts.items():
        table.row(*row(name, part, ticks))
    print(f"\nWhat the windows were sent in {COUNTED:.0f} s:\n")
    table = Table("window", "frames/s", "kB/s", "messages/s, most frequent first")
    for cells in sent:
        table.row(*cells)


def main() -> None:
    """Run and print."""
    given = command_line(
        __doc__, rounds=3, seconds=6.0, hand="schunk_svh", nice=19, realtime=False
    ).parse_args()
    with tempfile.TemporaryDirectory(prefix="rtee-") as place:
        measured(Path(place), given)


if __name__ == "__main__":
    main()
