"""Measure whether memory, threads and files of a running hand grow; print Markdown.

    python benchmarks/endurance.py [--minutes 120] [--warm 300] [--hand schunk_svh]

`rtee run` at 1 kHz records into files of 20 s, of which 20 MB are kept, while a client opens and
closes the hand and a window on another computer (see `benchmarks/gui.py`) shows all of it in the
GUI. Every two seconds the processes' own memory (not the pages of files, which other programs share
or not), threads and open files are noted, and the size of the recordings on disk. After the
warm-up, in which the flight recorder fills, a straight line is fitted to each by least squares: its
slope is the growth in an hour. The error is twice the slope's standard error, from the means of ten
notes each.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

from common import Table, command_line, own
from gui_common import COMMAND, MEGA, gui_of, mover, program, remote_window
from gui_memory import HOUR, plot_everything, slope

EVERY = 2.0
"""Time between notes [s]."""

LOG = "\nlog: {max_file_time: 20.0, max_total_size: 2.0e7}\n"
"""Recordings that rotate fast: as often in an hour or two as usually in a week."""


def count(pid: int, what: str) -> float:
    """Return the number of threads (``task``) or open files (``fd``) of a process."""
    return float(len(list(Path(f"/proc/{pid}/{what}").iterdir())))


def note(processes: Mapping[str, int], logs: Path) -> dict[str, float]:
    """Return the present sizes [MB] and numbers."""
    found: dict[str, float] = {}
    for name, pid in processes.items():
        found[f"{name}: own memory [MB]"] = own(pid) / MEGA
        found[f"{name}: threads"] = count(pid, "task")
        found[f"{name}: open files"] = count(pid, "fd")
    files = [path.stat().st_size for path in logs.glob("*.mcap") if path.exists()]
    found["recordings [MB]"] = sum(files) / MEGA
    found["recordings: files"] = float(len(files))
    return found


def report(times: list[float], notes: list[dict[str, float]], ever: int) -> None:
    """Print the slope of each quantity."""
    print(f"{(times[-1] - times[0]) / 60:.0f} min after the warm-up, {ever} files were begun:\n")
    table = Table("", "first", "last", "most", "in an hour", widths=(24,))
    for name in notes[0]:
        values = [each[name] for each in notes]
        rise, error = slope(times, values)
        grown = f"{HOUR * rise:+.2f} ± {HOUR * error:.2f}"
        cells = (f"{value:.1f}" for value in (values[0], values[-1], max(values)))
        table.row(name, *cells, grown)


def configured(folder: Path, hand: str) -> None:
    """Copy a hand and make its recordings rotate fast."""
    source = Path(__file__).parents[1] / "config" / hand
    copy = folder / "config" / hand
    shutil.copytree(source, copy)
    file = copy / "hand.yaml"
    file.write_text(file.read_text() + LOG)


def main() -> None:
    """Run and print."""
    given = command_line(__doc__, minutes=120.0, warm=300.0, hand="schunk_svh").parse_args()
    with tempfile.TemporaryDirectory(prefix="rtee-") as place:
        folder = Path(place)
        configured(folder, given.hand)
        run = [*COMMAND, "run", given.hand, "--driver", "kinematic", "--rate", "1000"]
        with (
            program(folder, rf"{given.hand}: .* active", *run) as (loop, _),
            mover(given.hand),
            gui_of(folder, given.hand) as (gui, visit),
        ):
            time.sleep(2.0)
            plot_everything(visit)
            with remote_window(visit, folder):
                times: list[float] = []
                notes: list[dict[str, float]] = []
                seen: set[str] = set()
                begin = time.monotonic()
                while time.monotonic() - begin < given.minutes * 60.0 + given.warm:
                    time.sleep(EVERY)
                    seen |= {path.name for path in (folder / "logs").glob("*.mcap")}
                    if time.monotonic() - begin > given.warm:
                        times.append(time.monotonic())
                        notes.append(note({"loop": loop, "GUI": gui}, folder / "logs"))
        report(times, notes, len(seen))


if __name__ == "__main__":
    main()
