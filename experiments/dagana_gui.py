"""Dagana in dynamics, used through the GUI by a scripted browser, as a person would."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from experiments.common import Outcome, main, plot_of, strip
from rtee.errors import ConfigError
from rtee.hand.files import make_folder
from rtee.log import Recording, Span, read
from tests.testing.browser import browser

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

HAND = "dagana"
CLAW = "dagana_gripper_claw_joint"
TOLERANCE = 0.02
CLOSED = 0.8
SIZE = (1000, 600)
_COMMAND = (sys.executable, "-c", "from rtee.cli import main; main()")
_RATE = "250"


@dataclass(frozen=True, slots=True)
class Step:
    """What the person does: an action at an intensity [%], then a look at what the GUI says.

    Attributes:
        action: Name of the action's card.
        intensity: Where the slider is put [%].
        word: What the card says in the end.
        at: Where the claw is then [rad]; ``None``: closed on the other jaw, above `CLOSED`.
    """

    action: str
    intensity: int
    word: str
    at: float | None


STEPS = (
    Step("Trig", 60, "reached", 0.6),
    Step("Grasp", 80, "reached", 0.8),
    Step("PinchTight", 100, "closed", None),
)
"""After each the person presses Open."""


def run(folder: Path, *, pictures: bool = True, steps: Sequence[Step] = STEPS) -> Outcome:
    """Start hand and GUI, act in the browser, end both, and look at the recording.

    Args:
        folder: Where recording, plot and pictures go.
        pictures: Take pictures of the browser.
        steps: What the person does.

    Raises:
        ConfigError: if there is no Chromium or no Playwright.
    """
    outcome = Outcome(
        f"each action ends as the GUI says, within {TOLERANCE:g} rad of its posture (closed: jaw "
        f"on jaw above {CLOSED:g} rad); Open opens again; the log has the spans"
    )
    logs = make_folder(folder.resolve())
    before = set(logs.glob("*.mcap"))
    stills: list[tuple[str, bytes]] = []
    with ExitStack() as stack:
        # The browser first: if there is none, nothing is started in vain.
        context = stack.enter_context(browser(*SIZE, scale=1.0 if pictures else 0.5))
        place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rtee-")))
        hand = ("run", HAND, "--driver", "mujoco", "--rate", _RATE, "--log", str(logs))
        stack.enter_context(_program(place, rf"{HAND}: .* active", *hand))
        gui = stack.enter_context(_program(place, r"GUI at (\S+)", "gui", HAND, "--port", "0"))
        person = _Person(context.pages[0], gui[1])
        for step in steps:
            said, position = person.do(step)
            seen = position >= CLOSED if step.at is None else abs(position - step.at) <= TOLERANCE
            outcome.check(
                seen and said.startswith(step.word),
                f"{step.action} at {step.intensity} % in the browser",
                f"'{said}', the claw at {position:.3f} rad",
                f"{step.word}, {_wanted(step)}",
            )
            if pictures:
                stills.append((f"{step.action} at {step.intensity} %", person.look()))
            position = person.open()
            outcome.check(
                abs(position) <= TOLERANCE,
                f"opened after {step.action}",
                f"the claw at {position:.3f} rad",
                f"0 rad within {TOLERANCE:g}",
            )
        if pictures:
            stills.append(("Open", person.look()))
    for path in sorted(set(logs.glob("*.mcap")) - before):
        _check_log(read(path), steps, outcome)
        outcome.files += [path, plot_of(path)]
    if stills:
        strip(folder / "dagana_gui.png", stills, outcome, columns=2)
    return outcome


def _check_log(recording: Recording, steps: Sequence[Step], outcome: Outcome) -> None:
    """Compare the recording with what was done: the actions, how far, and that it was opened."""
    spans = recording.spans
    names = [span.name.split()[0] for span in spans]
    wanted = [name for step in steps for name in (step.action, "open")]
    outcome.check(names == wanted, "spans in the log", ", ".join(names), "what was clicked")
    moves = [span for span in spans if span.name != "open"]
    for step, span in zip(steps, moves, strict=False):
        at = _position(recording, span)
        seen = at >= CLOSED if step.at is None else abs(at - step.at) <= TOLERANCE
        outcome.check(
            seen, f"{span.name} in the log", f"{span.outcome} at {at:.3f} rad", _wanted(step)
        )


def _wanted(step: Step) -> str:
    return f"> {CLOSED:g} rad" if step.at is None else f"{step.at:g} rad within {TOLERANCE:g}"


def _position(recording: Recording, span: Span) -> float:
    series = recording.actuator_states
    row = int(np.searchsorted(series.t, span.end)) - 1
    return float(series.position[row, series.index(CLAW)])


@contextmanager
def _program(place: Path, pattern: str, *arguments: str) -> Iterator[re.Match[str]]:
    """Run a command of rtee while the context lasts, once it has said something."""
    environment = os.environ | {"XDG_RUNTIME_DIR": str(place)}
    with subprocess.Popen(
        [*_COMMAND, *arguments], cwd=place, env=environment, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None  # noqa: S101 - narrows the type
            said: list[str] = []
            for line in process.stdout:
                said.append(line)
                if found := re.search(pattern, line):
                    break
            else:
                raise ConfigError(f"'rtee {' '.join(arguments)}' said only: {''.join(said)}")
            yield found
        finally:
            process.terminate()


class _Person:
    """Somebody who uses the GUI: types, clicks, waits, reads."""

    def __init__(self, page: Page, address: str) -> None:
        self._page = page
        page.goto(address)
        page.get_by_text(f"{HAND}: connected").wait_for()
        page.get_by_role("button", name="Run", exact=True).first.wait_for()
        for notice in page.locator(".mantine-Notification-closeButton").all():
            notice.click()

    def do(self, step: Step) -> tuple[str, float]:
        """Do an action at an intensity; returns what its card says, and where the claw is [rad]."""
        from playwright.sync_api import TimeoutError as NotThere

        page = self._page
        search = self._field("Search")
        search.fill(step.action)
        for other in {other.action for other in STEPS} - {step.action}:
            self._title(other).wait_for(state="detached")
        title = self._title(step.action)
        title.wait_for()
        if title.locator(".tabler-icon-chevron-down").count():  # it is folded
            title.click()
        intensity = self._field("Intensity [%]")
        intensity.fill(str(step.intensity))
        intensity.press("Enter")
        page.get_by_role("button", name="Run", exact=True).first.click()
        word = page.get_by_text(re.compile(r"^(reached|held|closed|stalled|timed out|aborted)"))
        try:
            word.locator("visible=true").first.wait_for()
        except NotThere as error:
            shown = page.locator("body").inner_text()
            raise ConfigError(f"{step.action} did not end; the page shows: {shown}") from error
        said = word.locator("visible=true").first.inner_text()
        at, within = (step.at, TOLERANCE) if step.at is not None else (2.0 * CLOSED, CLOSED)
        return said, self._position(at, within)

    def open(self) -> float:
        """Press Open hand; returns where the claw is when it stands [rad]."""
        self._page.get_by_role("button", name="Open hand", exact=True).first.click()
        return self._position(0.0, TOLERANCE)

    def look(self) -> bytes:
        """Return a picture of the page with the plots."""
        self._page.get_by_role("tab", name="Plots").click()
        self._page.mouse.move(SIZE[0] / 2, 8)
        self._page.wait_for_timeout(700)  # the plots are drawn anew some times a second
        return self._page.screenshot(timeout=120_000)

    def _position(self, at: float, within: float) -> float:
        """Read where the claw is from the table of joints, once it stands [rad].

        The table may come seconds after the hand on a busy computer, so it is given time to show
        the position at which the claw should be.
        """
        from playwright.sync_api import TimeoutError as NotThere

        self._page.get_by_role("tab", name="Joints").click()
        with suppress(NotThere):  # then what it shows instead is told
            self._page.wait_for_function(
                "([name, at, within]) => [...document.querySelectorAll('td')].some(cell =>"
                " cell.innerText === name && Math.abs(+cell.nextSibling.innerText - at) <= within)",
                arg=[CLAW, at, within],
            )
        row = self._page.locator("tr", has=self._page.locator("td", has_text=CLAW)).first
        cell = row.locator("td").nth(1)
        before, now = "", cell.inner_text()
        while before != now:
            self._page.wait_for_timeout(300)
            before, now = now, cell.inner_text()
        return float(now)

    def _title(self, action: str) -> Locator:
        """Return the title of an action's card."""
        titles = self._page.locator("div.mantine-Paper-root > div.mantine-Paper-root:visible")
        return titles.filter(has_text=re.compile(f"^{action}$")).first

    def _field(self, label: str) -> Locator:
        """Return the first visible field with a label to type into."""
        row = "xpath=ancestor::div[contains(@class, 'mantine-Flex-root')][1]"
        found = self._page.locator("label:visible").filter(has_text=label).first
        return found.locator(row).locator("input:not([type=hidden])").last


if __name__ == "__main__":
    main(run, "dagana_gui")
