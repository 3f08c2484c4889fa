"""The bar above the page: what is true, and STOP, whatever the page shows; on held states."""

from __future__ import annotations

import json
import os
import re
import signal
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from rtee.remote.blocking import BlockingHand

from .conftest import Hands
from .marks import in_a_browser
from .running import GRIPPER, Program, copy_of, free_port
from .window import Window

if TYPE_CHECKING:
    from playwright.sync_api import BrowserContext

pytestmark = in_a_browser

_OVER = """
(button) => {
  const box = button.getBoundingClientRect();
  const at = document.elementFromPoint(box.x + box.width / 2, box.y + box.height / 2);
  return at === button && box.height >= 56;
}
"""

_DEAF = """
() => {
  const kinds = "button, input, textarea, summary, [role=slider], [role=button], [role=tab]";
  const deaf = [];
  for (const each of document.querySelectorAll(kinds)) {
    if (!each.checkVisibility() || each.disabled) continue;
    const text = each.matches("input, textarea") && /^text/.test(each.type) && !each.readOnly
      && each.ariaHasPopup !== "listbox";
    each.focus();
    const due = text ? [["s", 0], ["Escape", 0], ["Escape", 1]] : [["Escape", 1], ["s", 1]];
    for (const [key, stops] of due) {
      const before = window.stops;
      each.dispatchEvent(new KeyboardEvent("keydown", {key, bubbles: true, cancelable: true}));
      if (window.stops - before !== stops)
        deaf.push(`${key} in ${each.outerHTML.slice(0, 200)}`);
    }
  }
  return deaf;
}
"""
"""Presses both keys in each control that is seen, and Escape again in text, which it has left.

Returns those in which a key stops that should not, or does not stop that should.
"""


_AT_ONCE = """
(field) => {
  field.focus();
  const before = window.stops;
  window.kept = true;
  for (const key of ["Enter", "Escape", "s"])
    field.dispatchEvent(new KeyboardEvent("keydown", {key, bubbles: true, cancelable: true}));
  window.kept = false;
  return window.stops - before;
}
"""
"""Presses Enter in a field and both keys before the page does anything; returns the stops."""

_FOLD = """
(control) => document.querySelector(
  `[data-dock-region-${control}], [data-dock-region=right] [data-dock-${control}]`).click()
"""
"""Folds the panel at the right, or unfolds it, by its own control."""


def _typed(window: Window) -> None:
    field = window.field("Intensity [%]")
    field.fill("40")
    field.press("Enter")


def _palette(window: Window) -> None:
    window.page.keyboard.press("Control+k")
    window.page.get_by_placeholder("Search commands...").wait_for()


def _settings(window: Window) -> None:
    window.page.locator(".tabler-icon-adjustments").click()
    window.says("Reset View")


def _enlarged(window: Window) -> None:
    window.page.locator(".uplot:visible").first.hover()
    window.page.locator(".tabler-icon-maximize:visible").first.click()
    window.page.locator(".mantine-Modal-content").wait_for()


def _checked(window: Window) -> None:
    window.tab("View")
    window.field("Reference").click()


def _chosen(window: Window) -> None:
    window.tab("Teach")
    window.choose("Step", "finger_joint")


STATES: dict[str, Callable[[Window], object]] = {
    "a number and Enter": _typed,
    "a checkbox": _checked,
    "a dropdown": _chosen,
    "the palette": _palette,
    "an enlarged plot": _enlarged,
    "the settings": _settings,
    "a folded panel": lambda window: window.page.evaluate(_FOLD, "collapse=right"),
}
"""States of the page, and what leaves the focus outside of a text field."""


def _stops(window: Window, *keys: str) -> int:
    """Press STOP and keys; return how many stops left the page, without stopping anything."""
    page, stop = window.page, window.button("STOP")
    before = page.evaluate("window.kept = true, window.stops")
    assert stop.evaluate(_OVER), "something covers STOP, or it is too small"
    for key in keys:
        page.keyboard.press(key)
    stop.click()
    return int(page.evaluate("window.kept = false, window.stops")) - int(before)


def test_stop_is_there_and_both_keys_work_in_every_state(
    window: Window, other: BlockingHand, lasting: str
) -> None:
    page = window.page
    for tab in ("Actions", "Teach", "Simulate", "Recordings", "View", "Plots", "Joints", "Touch"):
        window.tab(tab)
        page.evaluate("window.kept = true")
        assert page.evaluate(_DEAF) == [], tab
        page.evaluate("window.kept = false")
    window.tab("Plots")
    window.tab("Actions")
    assert window.field("Intensity [%]").evaluate(_AT_ONCE) == 2
    for where, go in STATES.items():
        go(window)
        # What is typed to search commands is text.
        keys = () if where == "the palette" else ("s", "Escape")
        assert _stops(window, *keys) == 1 + len(keys), where
        if not keys:
            page.keyboard.press("Escape")
            page.get_by_placeholder("Search commands...").wait_for(state="hidden")
    page.evaluate(_FOLD, "minimize-all")
    page.locator(".tabler-icon-arrow-back").click()
    window.tab("View")
    window.field("Reference").click()  # as it was
    window.tab("Actions")
    window.type("Intensity [%]", "100")  # which other tests run with
    for press in (window.button("STOP").click, lambda: page.keyboard.press("Escape")):
        other.start(lasting)
        window.status(f"running {lasting}")
        press()
        window.status("stopped")
        window.until(lambda: other.status().action == "")


_COVERED = """
() => {
  const view = document.querySelector("canvas").getBoundingClientRect();
  const covers = document.querySelectorAll("#root .mantine-Paper-root, #rtee-bar");
  return Math.max(...[...covers].map((each) => {
    const box = each.getBoundingClientRect();
    return Math.min(box.bottom, view.bottom) - Math.max(box.top, view.top);
  }));
}
"""
"""How much of the hand's view the panels and the bar cover [CSS px]; at most 0: nothing."""

_CUT = """
() => [...document.querySelectorAll("#rtee-said > *")].filter((each) => {
  const box = each.getBoundingClientRect(), bar = each.closest("#rtee-bar").getBoundingClientRect();
  const whole = each.id === "rtee-doing" || each.scrollWidth <= each.clientWidth;
  return !whole || box.bottom > bar.bottom || box.top < bar.top;
}).map((each) => each.textContent)
"""
"""The texts of the bar that are cut off; that of what is done may be long."""


def test_a_phone_shows_the_hand_beside_its_panels_and_each_text_of_the_bar(window: Window) -> None:
    page = window.page
    size = page.viewport_size
    assert size is not None
    page.set_viewport_size({"width": 390, "height": 844})
    try:
        window.until(lambda: page.evaluate(_COVERED) <= 0)
        assert page.evaluate("document.querySelector('canvas').clientHeight") > 200
        assert page.evaluate(_CUT) == []
    finally:
        page.set_viewport_size(size)


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
        for press in (window.button("STOP").click, lambda: window.page.keyboard.press("s")):
            press()
            window.status("STOP has NOT reached the hand")
    finally:
        os.kill(process, signal.SIGCONT)
    window.status(f"{GRIPPER}: connected")
    window.page.locator("html:not(.rtee-old)").wait_for()


@pytest.mark.heavy
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
        page.route("**/", lambda _: None)  # as a network that is down: no answer, and no refusal
        program.kill()
        page.get_by_text("the GUI does not answer").wait_for()
        page.keyboard.press("Escape")
        page.unroute("**/")
        page.get_by_text("the GUI has ended").wait_for()
        page.get_by_text("STOP did not leave this page: use the emergency stop").wait_for()
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


_OFF = "fault 7 (not activated)"


def _recover(window: Window, why: str | re.Pattern[str]) -> None:
    """Recover a device, once it is said why that is needed."""
    window.status(why)
    window.button("Recover …").click()
    window.says("gripper will be powered")
    assert _stops(window, "s", "Escape") == 3, "while it is asked"
    window.button("Recover now").click()


@pytest.mark.heavy
def test_a_pulled_cable_is_said_and_recovered_from(
    any_window: Window, place: Path, repository: Path
) -> None:
    """The emulator at the other end of a pty ends, and another begins."""
    window, line = any_window, place / "line"
    file = copy_of(repository, place, GRIPPER, "wired") / "hand.yaml"
    file.write_text(file.read_text().replace("/dev/ttyUSB0", str(line)))
    plug = ("emulate", "robotiq_2f", "--link", str(line))
    gripper = Program(place, *plug)
    gripper.line("robotiq_2f at")
    hand = Program(place, "run", "wired", "--driver", "devices", "--rate", "50", "--no-log")
    try:
        hand.line("wired: ")
        window.show("wired", _OFF)
        _recover(window, _OFF)
        window.status("wired: connected")
        gripper.kill()
        window.status("no data from gripper")
        window.status("is it plugged in?")
        gripper.end()
        gripper = Program(place, *plug)
        _recover(window, "inactive")
        _recover(window, _OFF)  # it was without power meanwhile
        window.status("wired: connected")
        window.button("Open hand").click()
        window.button("Run", window.folder("PinchTight")).click()
        window.says("reached", window.folder("PinchTight"))
    finally:
        window.show(GRIPPER)
        hand.end()
        gripper.end()
