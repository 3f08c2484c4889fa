"""Measure the time from a command to motion, stage by stage; print a Markdown table.

    python benchmarks/gui_motion.py [--tries 20] [--hand schunk_svh] [--nice 19] [--still 1e-3]

Asks for *Grasp* with the hand at rest: by a client, by a click on *Do* in a window on another
computer (a window that draws nothing, see `benchmarks/gui.py`), and by a real click in Chromium,
which renders in software here, at the lowest priority. The time begins when the client asks or the
button of the mouse is let go (by the browser's own clock), and has two ends, both by the stamps of
the loop's ticks: the first changed set-point, and *motion*, the first measured position that
differs from that at rest by more than `--still` (rad or m), in any actuator. Between the two ends,
the hand's profile accelerates: with limited jerk, that takes some time.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from common import Table, command_line
from gui_common import COMMAND, chromium, gui_of, program, shown
from gui_onlooker import Visit, controls, use, window

import rtee
from rtee.messages.state import State
from rtee.remote.blocking import BlockingHand

if TYPE_CHECKING:
    from playwright.sync_api import Page

PROBE = """
import time
from rtee.cli import main
from rtee.gui.bridge import Bridge
from rtee.remote.client import RemoteHand
from viser._gui_api import GuiApi

file = open("clicks.txt", "w", buffering=1)

def noting(kind, name, what):
    done = getattr(kind, name)

    async def note(self, *given, **more):
        file.write(f"{what} {time.monotonic()}\\n")
        return await done(self, *given, **more)

    setattr(kind, name, note)

noting(GuiApi, "_handle_gui_updates", "click")
noting(RemoteHand, "start", "asked")
main()
"""
RATE = 1000.0  # of the states that are watched [Hz]: those of every tick
STAGES = (
    "click, until the GUI has it",
    "GUI, until it asks the hand",
    "network and loop, until the first other set-point",
    "profile, until motion",
)


class Watch:
    """Notes when a hand begins to move.

    Attributes:
        ready: Set once it looks.
        changed: Stamp of the first tick with another set-point.
        moved: Stamp of the first tick with motion.
    """

    def __init__(self, hand: str, still: float) -> None:
        """Begin to look, in a thread of its own."""
        self.ready = threading.Event()
        self.changed = self.moved = 0.0
        self._hand, self._still = hand, still
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()
        assert self.ready.wait(20.0)

    def _look(self) -> None:
        first: State | None = None
        with rtee.connect_blocking(self._hand) as hand:
            for state in hand.states(RATE, keep=1000):
                if first is None:
                    first = state
                    self.ready.set()
                if (
                    not self.changed
                    and (state.reference_position != first.reference_position).any()
                ):
                    self.changed = state.stamp
                if np.nanmax(np.abs(state.position - first.position)) > self._still:
                    self.moved = state.stamp
                    return

    def wait(self) -> None:
        """Wait until it has moved."""
        self._thread.join(20.0)
        assert self.moved, "the hand does not move"


def noted(folder: Path, what: str, since: float) -> float:
    """Return when the GUI first noted something after a time, CLOCK_MONOTONIC [s]."""
    lines = (line.split() for line in (folder / "clicks.txt").read_text().splitlines())
    return min(float(stamp) for kind, stamp in lines if kind == what and float(stamp) >= since)


def tried(
    given: argparse.Namespace, hand: BlockingHand, begin: Callable[[], float], folder: Path | None
) -> list[list[float]]:
    """Return the lengths of the stages of each try [s]; without a folder the first two are none."""
    found = []
    for _ in range(given.tries):
        # From rest each time, and with some time to come to rest.
        hand.open()
        time.sleep(0.3)
        watch = Watch(given.hand, given.still)
        start = begin()
        watch.wait()
        times = [start, start, start, watch.changed, watch.moved]
        # A client's own request passes neither stage of the GUI.
        if folder is not None:
            times[1:3] = [noted(folder, what, start) for what in ("click", "asked")]
        found.append([after - before for before, after in itertools.pairwise(times)])
        hand.stop()
        # The next try begins with a goal, which a hand refuses while another client drives it.
        while hand.status().holder:
            time.sleep(0.01)
    return found


def clicked(page: Page) -> float:
    """Click on Do as a person would; return the time, CLOCK_MONOTONIC [s]."""
    page.evaluate(
        "void (window.released = new Promise(done => addEventListener('pointerup', event =>"
        "done(performance.timeOrigin + event.timeStamp), {once: true, capture: true})))"
    )
    page.get_by_role("button", name="Run", exact=True).first.click()
    at = page.evaluate("window.released")
    # The browser's time is that of the wall; stamps of ticks are CLOCK_MONOTONIC.
    return float(at) * 1e-3 - (time.time() - time.monotonic())


@contextmanager
def elsewhere(visit: Visit) -> Iterator[Callable[[], float]]:
    """Open a window on another computer; yield a function that clicks on Do of Grasp there."""
    with window(visit) as connection:
        found = controls(connection)
        card = next(c for c in found if c["props"]["label"] == "Grasp")
        do = next(
            c
            for c in found
            if "Run" in c["props"].get("options", ()) and c["container_uuid"] == card["uuid"]
        )
        # What the server sends has to be received, or it would stop sending.
        threading.Thread(target=lambda: sum(1 for _ in connection), daemon=True).start()

        def click() -> float:
            at = time.monotonic()
            use(connection, do, "Run")
            return at

        yield click


def asked(hand: BlockingHand) -> float:
    """Send the goal as a client; return the time, CLOCK_MONOTONIC [s]."""
    at = time.monotonic()
    hand.start("Grasp")
    return at


def measured(folder: Path, given: argparse.Namespace) -> None:
    """Run everything in a folder, and print."""
    name = given.hand
    run = (*COMMAND, "run", name, "--driver", "kinematic", "--log", str(folder))
    ways: dict[str, list[list[float]]] = {}
    with (
        program(folder, rf"{name}: .* active", *run),
        rtee.connect_blocking(name, wait=10.0) as hand,
    ):
        ways["a client"] = tried(given, hand, lambda: asked(hand), None)
        with gui_of(folder, name, (sys.executable, "-c", PROBE)) as (_, visit):
            time.sleep(2.0)
            with elsewhere(visit) as click:
                ways["a click elsewhere"] = tried(given, hand, click, folder)
            with chromium(folder, given.nice) as page, shown(page, visit):
                row = "xpath=ancestor::div[contains(@class, 'mantine-Flex-root')][1]"
                search = page.locator("label:visible", has_text="Search").locator(row)
                search.locator("input").fill("Grasp")
                page.get_by_text("PinchTight", exact=True).first.wait_for(state="hidden")
                ways["a click in Chromium here"] = tried(given, hand, lambda: clicked(page), folder)
    print(f"`{name}`, {given.tries} tries each; median (most) [ms]\n")
    table = Table("stage", *ways)
    rows = {
        stage: [[t[i] for t in tries] for tries in ways.values()] for i, stage in enumerate(STAGES)
    }
    rows["**command to the first other set-point**"] = [
        [sum(t[:3]) for t in w] for w in ways.values()
    ]
    rows["**command to motion**"] = [[sum(t) for t in w] for w in ways.values()]
    for stage, columns in rows.items():
        cells = [
            f"{1e3 * statistics.median(c):.1f} ({1e3 * max(c):.1f})" if any(c) else "–"
            for c in columns
        ]
        table.row(stage, *cells)


def main() -> None:
    """Run and print."""
    given = command_line(__doc__, tries=20, hand="schunk_svh", nice=19, still=1e-3).parse_args()
    with tempfile.TemporaryDirectory(prefix="rtee-") as place:
        measured(Path(place), given)


if __name__ == "__main__":
    main()
