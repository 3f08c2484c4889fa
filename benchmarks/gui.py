"""What the GUI costs a loop of 1 kHz, with a real browser, in one run; prints Markdown tables.

    python benchmarks/gui.py [--rounds 4] [--seconds 20] [--hand schunk_svh] [--nice 19]

The hand is `rtee run` as users run it: kinematic driver, everything logged at every tick, opening
and closing all the time. Its process also notes how late each tick was. It runs alone for a round,
then beside `rtee gui` with the page closed and open by turns, then alone again, without ever being
started anew. The first second of every round does not count.

The browser renders in software here and would keep a CPU busy, which on an operator's own computer
costs the robot PC nothing: it runs at the lowest priority (`--nice 0` for the same as all others).

Memory is the GUI's resident set every second while the page is open, with a straight line through
it after the warm-up of the first open round. The time from command to motion is from asking for an
action, by a client or by a click on *Do* in the page, until the first state with another position
arrives, at 1000 states a second.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import contextlib
import os
import re
import stat
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import anyio
import numpy as np

import rtee
from rtee.messages.state import State
from rtee.remote.client import RemoteHand
from rtee.testing.browser import browser, find_browser

if TYPE_CHECKING:
    from playwright.sync_api import Page

COMMAND = (sys.executable, "-c", "from rtee.cli import main; main()")
PROBE = """
import array, sys
from rtee.cli import main
from rtee.loop import ticker

kept = array.array("q")

class Kept(ticker.TickStatistics):
    def add(self, woken_ns, lateness_ns, busy_ns, missed):
        kept.extend((woken_ns, lateness_ns, missed))
        super().add(woken_ns, lateness_ns, busy_ns, missed)

ticker.TickStatistics = Kept
try:
    main()
finally:
    with open("ticks.bin", "wb") as file:
        kept.tofile(file)
"""
PAGE = os.sysconf("SC_PAGE_SIZE")
TICK = os.sysconf("SC_CLK_TCK")
RATE = 1000.0
TRIES = 10
STILL = 1e-3
WARM = 1.0
MEGA = 2.0**20


@contextlib.contextmanager
def program(folder: Path, pattern: str, *command: str) -> Iterator[tuple[int, str]]:
    """Run a command while the context lasts; gives its process and what it said."""
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            for line in process.stdout:
                if found := re.search(pattern, line):
                    threading.Thread(target=process.stdout.read, daemon=True).start()
                    yield process.pid, found[1] if found.groups() else line
                    return
            raise SystemExit(f"{' '.join(command[3:])} ended")
        finally:
            process.terminate()
            process.wait(30)


def resident(pid: int) -> float:
    """Return the memory a process has [bytes]."""
    return float(Path(f"/proc/{pid}/statm").read_text().split()[1]) * PAGE


def used(pid: int) -> float:
    """Return the processor time a process has used [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICK


async def moving(hand: str) -> None:
    """Open and close a hand for ever."""
    async with rtee.connect(hand, wait=10.0) as remote:
        while True:
            await remote.do("Grasp")
            await remote.open()


@dataclass
class Rounds:
    """The rounds of one kind.

    Attributes:
        spans: Begin and end of each, CLOCK_MONOTONIC [s].
        cpu: Processor time of the GUI in each as a share of one processor.
        sizes: Times [s] and sizes [bytes] of its memory.
    """

    spans: list[tuple[float, float]] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)
    sizes: list[tuple[float, float]] = field(default_factory=list)


def one_round(rounds: Rounds, seconds: float, gui: int | None) -> None:
    """Wait for a round to pass, and note what it was like."""
    time.sleep(WARM)
    begin, before = time.monotonic(), 0.0 if gui is None else used(gui)
    while time.monotonic() < begin + seconds:
        time.sleep(1.0)
        if gui is not None:
            rounds.sizes.append((time.monotonic(), resident(gui)))
    end = time.monotonic()
    rounds.spans.append((begin, end))
    if gui is not None:
        rounds.cpu.append((used(gui) - before) / (end - begin))


def row(name: str, rounds: Rounds, ticks: np.ndarray) -> str:
    """Return a row of the table: what the ticks in some rounds were like."""
    woken = ticks[:, 0] * 1e-9
    inside = np.zeros(len(ticks), dtype=bool)
    for begin, end in rounds.spans:
        inside |= (woken >= begin) & (woken < end)
    late, missed = ticks[inside, 1] * 1e-3, int(ticks[inside, 2].sum())
    each = [np.percentile(ticks[(woken >= b) & (woken < e), 1] * 1e-3, 99) for b, e in rounds.spans]
    cells = [name, f"{len(late)}", f"{missed}"]
    cells += [f"{np.percentile(late, share):.0f}" for share in (50, 99, 99.9)]
    cells.append(" ".join(f"{value:.0f}" for value in each))
    cells.append(f"{100 * statistics.median(rounds.cpu):.0f} %" if rounds.cpu else "–")
    return f"| {' | '.join(cells)} |"


async def _moved(remote: RemoteHand, begin: Callable[[], object]) -> float:
    """Return how long it took until the hand moved after something was begun [s]."""
    first: State | None = None
    started = 0.0
    async for state in remote.states(RATE):
        if first is None:
            first, started = state, time.perf_counter()
            done = begin()
            if done is not None:
                await done  # type: ignore[misc]
        elif np.nanmax(np.abs(state.position - first.position)) > STILL:
            return time.perf_counter() - started
    raise SystemExit("the hand has gone")


async def by_client(hand: str) -> list[float]:
    """Return the times from asking for an action to the first state that has moved [s]."""
    found = []
    async with rtee.connect(hand, wait=10.0) as remote:
        for _ in range(TRIES):
            await remote.open()
            await anyio.sleep(0.3)
            found.append(await _moved(remote, lambda: remote.start("Grasp")))
    return found


def by_click(hand: str, page: Page) -> list[float]:
    """Return the times from a click on Do to the first state that has moved [s]."""
    page.get_by_role("textbox", name="Search").or_(page.locator("input[type=text]")).first.fill(
        "Grasp"
    )
    page.wait_for_timeout(2000)
    found = []
    for _ in range(TRIES):
        page.get_by_role("button", name="Open", exact=True).click()
        page.wait_for_timeout(3000)
        clicked: list[float] = []
        moved: list[float] = []
        ready = threading.Event()

        async def watch(ready: threading.Event = ready, moved: list[float] = moved) -> None:
            async with rtee.connect(hand) as remote:
                await _moved(remote, ready.set)
                moved.append(time.perf_counter())

        thread = threading.Thread(target=lambda run=watch: anyio.run(run))
        thread.start()
        ready.wait(20)
        button = page.get_by_role("button", name="Do", exact=True).first.element_handle()
        clicked.append(time.perf_counter())
        button.evaluate("button => button.click()")
        thread.join(20)
        found.append(moved[0] - clicked[0])
    return found


def in_thread(work: Callable[[], list[float]]) -> list[float]:
    """Call something in a thread of its own: Playwright keeps an event loop in this one."""
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        return pool.submit(work).result()


@contextlib.contextmanager
def window(folder: Path, nice: int) -> Iterator[Page]:
    """Open a browser's window, at a priority of its own."""
    wrapper = folder / "browser"
    wrapper.write_text(f'#!/bin/sh\nexec nice -n {nice} {find_browser()} "$@"\n')
    wrapper.chmod(wrapper.stat().st_mode | stat.S_IXUSR)
    os.environ["RTEE_BROWSER"] = str(wrapper)
    with browser(1280, 800) as context:
        yield context.pages[0]


def show(page: Page, address: str) -> None:
    """Open the GUI and wait until it is there."""
    page.goto(address)
    page.get_by_role("button", name="Do", exact=True).first.wait_for()


@contextlib.contextmanager
def mover(hand: str) -> Iterator[None]:
    """Keep a hand moving while the context lasts."""
    code = f"import anyio, {Path(__file__).stem} as b; anyio.run(b.moving, '{hand}')"
    process = subprocess.Popen(
        [sys.executable, "-c", code], cwd=Path(__file__).parent, stderr=subprocess.DEVNULL
    )
    try:
        yield
    finally:
        process.kill()
        process.wait()


def measured(folder: Path, given: argparse.Namespace) -> None:
    """Run everything in a folder, and print."""
    alone, closed, opened = Rounds(), Rounds(), Rounds()
    hand, seconds = given.hand, given.seconds
    run = (sys.executable, "-c", PROBE, "run", hand, "--driver", "kinematic", "--log", str(folder))
    gui_command = (*COMMAND, "gui", hand, "--port", "0")
    with (
        window(folder, given.nice) as page,
        program(folder, rf"{hand}: .* active", *run),
    ):
        with mover(hand):
            one_round(alone, seconds, None)
            with program(folder, r"GUI at (\S+)", *gui_command) as (gui, address):
                for _ in range(given.rounds):
                    page.goto("about:blank")
                    one_round(closed, seconds, gui)
                    show(page, address)
                    one_round(opened, seconds, gui)
                page.goto("about:blank")
            one_round(alone, seconds, None)
        asked = in_thread(lambda: anyio.run(by_client, hand))
        with program(folder, r"GUI at (\S+)", *gui_command) as (_, address):
            show(page, address)
            clicked = by_click(hand, page)
    ticks = np.fromfile(folder / "ticks.bin", dtype=np.int64).reshape(-1, 3)
    print(f"`{hand}` at {RATE:.0f} Hz, rounds of {seconds:.0f} s, browser at nice {given.nice}\n")
    print(
        "| part | ticks | missed | lateness p50 [µs] | p99 [µs] | p99.9 [µs] "
        "| p99 of each round [µs] | the GUI's CPU |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    print(row("alone", alone, ticks))
    print(row("GUI, page closed", closed, ticks))
    print(row("GUI, page open", opened, ticks))
    for name, waited in (("by a client", asked), ("by a click in the page", clicked)):
        middle, worst = 1e3 * statistics.median(waited), 1e3 * max(waited)
        print(f"\nCommand to motion {name}: {middle:.0f} ms (median of {TRIES}), ", end="")
        print(f"at most {worst:.0f} ms.")
    warm = [each for each in opened.sizes if each[0] > opened.spans[0][1]]
    times, sizes = np.array(warm or opened.sizes).T
    slope = float(np.polyfit(times, sizes, 1)[0])
    first, last = opened.sizes[0][1] / MEGA, sizes[-1] / MEGA
    print(f"\nGUI memory: {first:.0f} MB at first, {sizes[0] / MEGA:.0f} MB warm, ", end="")
    print(f"{last:.0f} MB at the end after {times[-1] - times[0]:.0f} s; ", end="")
    print(f"a straight line gives {3600 * slope / MEGA:+.0f} MB in an hour.")


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--hand", default="schunk_svh")
    parser.add_argument("--nice", type=int, default=19)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="rtee-") as place:
        os.environ["XDG_RUNTIME_DIR"] = place
        measured(Path(place), given)


if __name__ == "__main__":
    main()
