"""Whether memory comes back after an overload; prints Markdown.

    python benchmarks/overload.py [--seconds 60] [--rounds 2] [--warm 30] [--hogs 8] [--slow 4.5]

A hand runs at 1 kHz and records, while a client opens and closes it and a window on another
computer (see `benchmarks/gui.py`) shows all of it in the GUI. In every round, so many programs that
only spin keep the processors busy, and then nothing else runs for as long. Meanwhile each time that
the recording is flushed to the disk takes so much longer (``--slow``), as on a disk that is busy
with something else: the recorder's backlog fills. Told is the processes' own memory, not the pages
of files: the mean of the last five seconds of each time.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

from common import Table, command_line, own
from endurance import configured
from gui_common import MEGA, gui_of, mover, program, remote_window
from gui_memory import plot_everything
from witness import child

SLOW_DISK = """
import os, sys, time
from pathlib import Path

flush, busy = os.fsync, Path(sys.argv.pop(1))

def slow(file):
    if busy.exists():
        time.sleep(float(busy.read_text()))
    flush(file)

os.fsync = slow
from rtee.cli import main
main()
"""
"""Runs `rtee` on a disk that is slow while a file exists, by the time [s] that it holds."""


def settled(processes: dict[str, int], seconds: float) -> dict[str, float]:
    """Wait; return the mean of the processes' own memory in the last five seconds [MB]."""
    time.sleep(max(0.0, seconds - 5.0))
    sums = dict.fromkeys(processes, 0.0)
    for _ in range(5):
        time.sleep(1.0)
        for name, pid in processes.items():
            sums[name] += own(pid) / MEGA / 5
    return sums


def main() -> None:
    """Run and print."""
    given = command_line(
        __doc__, seconds=60.0, rounds=2, warm=30.0, hogs=8, slow=4.5, hand="schunk_svh"
    ).parse_args()
    table = Table("", "loop: own [MB]", "GUI: own [MB]", widths=(24,))
    with tempfile.TemporaryDirectory(prefix="rtee-") as place:
        folder = Path(place)
        configured(folder, given.hand)
        busy = folder / "busy"
        run = [sys.executable, "-c", SLOW_DISK, str(busy), "run", given.hand]
        with (
            program(folder, rf"{given.hand}: .* active", *run) as (loop, _),
            mover(given.hand),
            gui_of(folder, given.hand) as (gui, visit),
        ):
            time.sleep(2.0)
            plot_everything(visit)
            processes = {"loop": loop, "GUI": gui}
            with remote_window(visit, folder):
                sizes = settled(processes, given.warm)
                table.row("before", *(f"{size:.1f}" for size in sizes.values()))
                for number in range(1, given.rounds + 1):
                    busy.write_text(str(given.slow))
                    spin = [sys.executable, "-c", "while True: pass"]
                    hogs = [child(spin) for _ in range(given.hogs)]
                    sizes = settled(processes, given.seconds)
                    table.row(f"in overload {number}", *(f"{size:.1f}" for size in sizes.values()))
                    for hog in hogs:
                        hog.kill()
                        hog.wait()
                    busy.unlink()
                    sizes = settled(processes, given.seconds)
                    table.row(f"after it {number}", *(f"{size:.1f}" for size in sizes.values()))


if __name__ == "__main__":
    main()
