"""The bar above the page: what is true, and STOP, whatever the page shows; on held states."""

from __future__ import annotations

import json
import os
import re
import signal
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from rtee.remote.blocking import BlockingHand

from .conftest import Hands
from .marks import in_a_browser
from .running import GRIPPER, Program, free_port
from .window import Window

if TYPE_CHECKING:
    from playwright.sync_api import BrowserContext

pytestmark = in_a_browser

_OVER = """
(button) => {
  const box = button.getBoundingClientRect();
  const at = document.elementFromPoint(box.x + box.width / 2, box.y + box.height / 2);
  return [at === button, box.height];
}
"""


def _typed(window: Window) -> None:
    field = window.field("Intensity [%]")
    field.fill("40")
    field.press("Enter")


def _palette(window: Window) -> None:
    window.page.keyboard.press("Control+k")
    window.page.get_by_placeholder("Search commands...").wait_for()


def _settings(window: Window) -> None:
    window.page.locator(".tabler-icon-adjustments, .tabler-icon-adjustments-horizontal").click()
    window.says("Reset View")


def _enlarged(window: Window) -> None:
    window.page.locator(".uplot:visible").first.hover()
    window.page.locator("[class*=mantine-ActionIcon]:visible").last.click()


STATES: dict[str, Callable[[Window], object]] = {
    "a tab": lambda window: window.tab("Actions"),
    "a dropdown": lambda window: window.choose("Finger 1", "finger_1", window.folder("PinchTight")),
    "a number and Enter": _typed,
    "a checkbox": lambda window: (window.tab("View"), window.field("Reference").click()),
    "a button": lambda window: (window.tab("Actions"), window.button("Preview").first.click()),
}
"""What leaves the focus outside of a text field."""

COVERED: dict[str, Callable[[Window], object]] = {"the palette": _palette}
"""What lies above the page."""


def test_stop_is_there_and_both_keys_work_in_every_state(
    window: Window, other: BlockingHand, lasting: str
) -> None:
    stop = window.button("STOP")

    def stops(press: Callable[[], object], where: str) -> None:
        other.start(lasting)
        window.status(f"running {lasting}")
        covered, height = stop.evaluate(_OVER)
        assert (covered, height >= 56) == (True, True), where
        press()
        window.status("stopped")
        window.until(lambda: other.status().action == "")

    for where, go in STATES.items():
        go(window)
        for key in ("Escape", "s"):
            stops(lambda key=key: window.page.keyboard.press(key), f"{key} after {where}")
    for where, go in COVERED.items():
        go(window)
        stops(stop.click, f"a click over {where}")
        window.page.keyboard.press("Escape")
    window.page.get_by_placeholder("Search commands...").wait_for(state="hidden")
    window.tab("Actions")


def test_a_frozen_hand_is_old_at_once_and_comes_back(window: Window, place: Path) -> None:
    # Of the hand itself: a signal that no process can receive is not passed on to it.
    (entry,) = (place / "run").rglob(f"{GRIPPER}.json")
    process = json.loads(entry.read_text())["pid"]
    plots = window.page.locator(".uplot:visible").count()
    os.kill(process, signal.SIGSTOP)
    try:
        window.status(re.compile(r"no data for \d"))
        window.status("STOP cannot reach the hand, use the emergency stop")
        window.page.locator("html.rtee-old").wait_for()
        assert window.page.title().endswith("no data")
        assert window.page.locator(".uplot:visible").count() == plots, "evidence was wiped"
        window.button("STOP").click()
        window.status("STOP has NOT reached the hand")
    finally:
        os.kill(process, signal.SIGCONT)
    window.status(f"{GRIPPER}: connected")
    window.page.locator("html:not(.rtee-old)").wait_for()


def test_a_page_says_that_its_gui_has_gone_and_where_the_new_one_is(
    place: Path, context: BrowserContext, window: Window, hands: Hands
) -> None:
    assert hands[GRIPPER].process.poll() is None
    port = str(free_port())
    program = Program(place, "gui", GRIPPER, "--port", port)
    page = context.new_page()
    try:
        page.goto(program.line(r"rtee: GUI at (http://\S+)")[1])
        page.get_by_text(f"{GRIPPER}: connected").wait_for()
        program.kill()
        page.get_by_text("the GUI has ended").wait_for()
        page.get_by_text("STOP cannot reach the hand, use the emergency stop").wait_for()
        assert page.title() == "no GUI"
        program.end()
        program = Program(place, "gui", GRIPPER, "--port", port)
        program.line("GUI at")
        page.get_by_text("the GUI was started again: open the address it has printed").wait_for()
    finally:
        page.close()
        window.page.bring_to_front()
        program.end()
