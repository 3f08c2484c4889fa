"""Measure whether the GUI's memory grows while it plots; print Markdown.

    python benchmarks/gui_memory.py [--seconds 270] [--warm 60] [--hand schunk_svh] [--chromium]

The hand opens and closes all the time; a window on another computer (see `benchmarks/gui.py`), or
Chromium, shows all quantities of all actuators. After the warm-up the resident memory is noted
every second, and a straight line is fitted by least squares: its slope is the growth in an hour.
The error is twice the standard error of the slope, from the means of ten-second pieces.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from common import command_line
from gui_common import (
    COMMAND,
    MEGA,
    chromium,
    family,
    gui_of,
    mover,
    program,
    remote_window,
    resident,
    shown,
)
from gui_onlooker import Visit, controls, use, window

HOUR = 3600.0  # seconds
PIECE = 10  # sizes in a mean: memory goes up and down with each collection


def slope(times: Sequence[float], sizes: Sequence[float]) -> tuple[float, float]:
    """Return the slope of a line through sizes and twice its standard error [1/s]."""
    count = len(times) // PIECE
    t = np.array(times[: count * PIECE]).reshape(count, PIECE).mean(axis=1)
    y = np.array(sizes[: count * PIECE]).reshape(count, PIECE).mean(axis=1)
    (rise, start) = np.polyfit(t, y, 1)
    rest = y - (rise * t + start)
    spread = np.sqrt(rest @ rest / max(count - 2, 1) / ((t - t.mean()) ** 2).sum())
    return float(rise), 2.0 * float(spread)


def line(name: str, times: Sequence[float], sizes: Sequence[float]) -> str:
    """Return the sentence about a process's memory."""
    rise, error = slope(times, sizes)
    return (
        f"{name}: {sizes[0] / MEGA:.1f} MB after the warm-up, {sizes[-1] / MEGA:.1f} MB "
        f"{times[-1] - times[0]:.0f} s later, {max(sizes) / MEGA:.1f} MB at most; "
        f"in an hour {HOUR * rise / MEGA:+.1f} ± {HOUR * error / MEGA:.1f} MB."
    )


def plot_everything(visit: Visit) -> None:
    """Tick all quantities and actuators in the plots."""
    with window(visit) as connection:
        for control in controls(connection):
            if str(control["props"].get("hint", "")).startswith(("Plot the", "Show all actuators")):
                use(connection, control, "All" if "options" in control["props"] else True)
        time.sleep(1.0)


def watched(gui: int, others: Sequence[int], given: argparse.Namespace) -> None:
    """Note the sizes of processes, and print."""
    time.sleep(given.warm)
    times: list[float] = []
    own: list[float] = []
    browser: list[float] = []
    end = time.monotonic() + given.seconds - given.warm
    while time.monotonic() < end:
        time.sleep(1.0)
        times.append(time.monotonic())
        own.append(resident(gui))
        browser.append(sum(map(resident, others)))
    print(line("GUI", times, own))
    if others:
        print(line("Chromium, all processes, shared pages counted in each", times, browser))


def measured(folder: Path, given: argparse.Namespace) -> None:
    """Run everything in a folder, and print."""
    hand = given.hand
    run = [*COMMAND, "run", hand, "--driver", "kinematic", "--rate", "200", "--no-log"]
    with (
        program(folder, rf"{hand}: .* active", *run),
        mover(hand),
        gui_of(folder, hand) as (gui, visit),
        contextlib.ExitStack() as stack,
    ):
        time.sleep(2.0)
        others: list[int] = []
        if given.chromium:
            page = stack.enter_context(chromium(folder, 19))
            stack.enter_context(shown(page, visit))
            others = [pid for pid in family(os.getpid()) if _is_browser(pid)]
        plot_everything(visit)
        if not given.chromium:
            stack.enter_context(remote_window(visit, folder))
        watched(gui, others, given)


def _is_browser(pid: int) -> bool:
    return "chrom" in Path(f"/proc/{pid}/comm").read_text()


def main() -> None:
    """Run and print."""
    given = command_line(
        __doc__, seconds=270.0, warm=60.0, hand="schunk_svh", chromium=False
    ).parse_args()
    with tempfile.TemporaryDirectory(prefix="rtee-") as place:
        measured(Path(place), given)


if __name__ == "__main__":
    main()
