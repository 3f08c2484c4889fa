"""What the GUI costs: a 1 kHz loop without and with it in the same run; prints a Markdown table.

    python benchmarks/gui.py [--seconds 60] [--hand schunk_svh] [--no-browser]

The hand is `rtee run` as users run it: kinematic driver, everything logged at every tick, opening
and closing all the time. First it runs alone, then with `rtee gui` and a headless browser that has
its plots open, then alone again; the numbers are the loop's own, read back from its recordings.
The GUI's memory is its resident set after every second, extrapolated to an hour by a straight line
through the second half of the time. The time from command to motion is from asking for an action
until the first state with another position arrives, at 1000 states a second, ten times.

The browser renders in software here and keeps a CPU busy, which on an operator's own computer costs
the robot PC nothing: `--no-browser` leaves it out.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import anyio
import numpy as np

import rtee
from rtee.log import read
from rtee.messages.state import State
from rtee.remote.client import RemoteHand
from rtee.testing.browser import browser

COMMAND = (sys.executable, "-c", "from rtee.cli import main; main()")
PAGE = os.sysconf("SC_PAGE_SIZE")
RATE = 1000.0
TRIES = 10
STILL = 1e-3
MEGA = 2.0**20


@contextlib.contextmanager
def program(folder: Path, pattern: str, *arguments: str) -> Iterator[tuple[int, str]]:
    """Run a command of rtee while the context lasts; gives its process and what it said."""
    with subprocess.Popen(
        [*COMMAND, *arguments], cwd=folder, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            for line in process.stdout:
                if found := re.search(pattern, line):
                    yield process.pid, found[1] if found.groups() else line
                    return
            raise SystemExit(f"rtee {' '.join(arguments)} ended")
        finally:
            process.terminate()


def resident(pid: int) -> float:
    """Return the memory a process has [bytes]."""
    return float(Path(f"/proc/{pid}/statm").read_text().split()[1]) * PAGE


async def moving(hand: str) -> None:
    """Open and close a hand for ever."""
    async with rtee.connect(hand, wait=10.0) as remote:
        while True:
            await remote.do("Grasp")
            await remote.open()


async def command_to_motion(hand: str) -> list[float]:
    """Return the times from asking for an action to the first state that has moved [s]."""
    found = []
    async with rtee.connect(hand, wait=10.0) as remote:
        for _ in range(TRIES):
            await remote.open()
            await anyio.sleep(0.3)
            found.append(await _one(remote))
    return found


async def _one(remote: RemoteHand) -> float:
    first: State | None = None
    started = 0.0
    async for state in remote.states(RATE):
        if first is None:
            first, started = state, time.perf_counter()
            await remote.start("Grasp")
        elif np.nanmax(np.abs(state.position - first.position)) > STILL:
            return time.perf_counter() - started
    raise SystemExit("the hand has gone")


@dataclass
class Gui:
    """What the GUI took.

    Attributes:
        sizes: Its memory every second [bytes].
        growth: Extrapolated growth in an hour [bytes].
    """

    sizes: list[float]
    growth: float


def watch_memory(pid: int, seconds: float) -> Gui:
    """Watch a process's memory for a time."""
    sizes, times = [], []
    end = time.monotonic() + seconds
    while (now := time.monotonic()) < end:
        sizes.append(resident(pid))
        times.append(now)
        time.sleep(1.0)
    half = len(sizes) // 2
    slope = float(np.polyfit(times[half:], sizes[half:], 1)[0]) if len(sizes) - half > 2 else 0.0
    return Gui(sizes, 3600.0 * slope)


def shown(address: str, use: bool) -> contextlib.AbstractContextManager[object]:
    """Open the page in a browser, if that is wanted."""
    if not use:
        return contextlib.nullcontext()
    stack = contextlib.ExitStack()
    page = stack.enter_context(browser(800, 600)).pages[0]
    page.goto(address)
    page.get_by_role("button", name="Do", exact=True).first.wait_for()
    return stack


def part(name: str, given: argparse.Namespace, *, gui: bool) -> Gui | None:
    """Run the hand for a while, print its row of the table."""
    with tempfile.TemporaryDirectory(prefix="rtee-") as place:
        folder = Path(place)
        os.environ["XDG_RUNTIME_DIR"] = place
        arguments = ("run", given.hand, "--driver", "kinematic", "--log", place)
        found = None
        with contextlib.ExitStack() as stack:
            stack.enter_context(program(folder, rf"{given.hand}: .* active", *arguments))
            code = f"import anyio, {Path(__file__).stem} as b; anyio.run(b.moving, '{given.hand}')"
            mover = subprocess.Popen([sys.executable, "-c", code], cwd=Path(__file__).parent)
            stack.callback(mover.wait)
            stack.callback(mover.kill)
            if gui:
                pid, address = stack.enter_context(
                    program(folder, r"GUI at (\S+)", "gui", given.hand, "--port", "0")
                )
                stack.enter_context(shown(address, not given.no_browser))
                found = watch_memory(pid, given.seconds)
            else:
                time.sleep(given.seconds)
        last = read(folder, only=["loop_statistics"]).loop_statistics[-1].value
    late = (last.lateness_p50, last.lateness_p99, last.lateness_p999)
    cells = [name, str(last.ticks), str(last.missed), *(f"{1e6 * v:.0f}" for v in late)]
    print(f"| {' | '.join(cells)} |", flush=True)
    return found


def waiting(given: argparse.Namespace) -> list[float]:
    """Run the hand and return the times from command to motion [s]."""
    with tempfile.TemporaryDirectory(prefix="rtee-") as place:
        os.environ["XDG_RUNTIME_DIR"] = place
        arguments = ("run", given.hand, "--driver", "kinematic", "--log", place)
        with program(Path(place), rf"{given.hand}: .* active", *arguments):
            return anyio.run(command_to_motion, given.hand)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--hand", default="schunk_svh")
    parser.add_argument("--no-browser", action="store_true")
    given = parser.parse_args()
    print(f"`{given.hand}` at {RATE:.0f} Hz, {given.seconds:.0f} s each\n")
    print("| part | ticks | missed | lateness p50 [µs] | p99 [µs] | p99.9 [µs] |")
    print("| --- | --- | --- | --- | --- | --- |")
    part("alone", given, gui=False)
    seen = part("with the GUI", given, gui=True)
    part("alone again", given, gui=False)
    waited = waiting(given)
    middle, worst = 1e3 * statistics.median(waited), 1e3 * max(waited)
    print(f"\nCommand to motion: {middle:.0f} ms (median of {TRIES}), at most {worst:.0f} ms.")
    if seen is not None:
        first, end = seen.sizes[0] / MEGA, seen.sizes[-1] / MEGA
        print(f"GUI memory: {first:.0f} MB at first, {end:.0f} MB at the end, ", end="")
        print(f"extrapolated growth {seen.growth / MEGA:+.0f} MB in an hour.")


if __name__ == "__main__":
    main()
