"""Recording, and looking at a recording, in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from rtee.remote.blocking import BlockingHand

from .marks import in_a_browser
from .test_browser_bar import _stops
from .window import Window

if TYPE_CHECKING:
    from playwright.sync_api import BrowserContext

pytestmark = in_a_browser


def _position(window: Window) -> float:
    """Return the position that the table of actuators shows."""
    row = window.page.locator("tr:visible", has_text="finger_joint").first
    return float(row.locator("td").nth(1).inner_text())


@pytest.mark.heavy
def test_a_recording_is_marked_ended_and_looked_at(
    window: Window, context: BrowserContext, other: BlockingHand, place: Path
) -> None:
    other.open()
    other.record("stop")
    window.status("control: free")
    before = set((place / "logs").glob("*.mcap"))
    window.tab("Recordings")
    window.says("○ off")
    window.button("Start").click()
    window.told("a recording begins")
    window.page.locator("div:visible", has_text="recording to").first.wait_for()
    for name in ("STOP", "Start", "Finish", "Set mark"):
        assert window.room(window.button(name).first) >= 0, name
    other.do("PinchTight", "finger_1", "finger_2")
    window.type("Mark", "it is closed")
    window.button("Set mark").click()
    window.told("it is closed")
    closed = other.state().position[0]
    other.open()
    window.button("Finish").click()
    window.says("○ off")
    (recorded,) = set((place / "logs").glob("*.mcap")) - before

    panel = window.folder("Recordings", unfold=True)
    window.tab("Actions")
    window.clicks()
    window.tab("Recordings")
    window.button("Play", panel).click()
    line = panel.get_by_label("actions over time")
    line.wait_for()
    # The past of this window alone, which moves nothing meanwhile.
    window.status(f"RECORDING {recorded.name}")
    assert window.clicks() <= 2
    window.field("Play", panel).click()  # wait in it
    assert _stops(window, "s", "Escape") == 3, "STOP of a window that shows a recording"
    window.page.locator("html.rtee-recorded").wait_for()
    second = context.new_page()
    second.emulate_media(color_scheme="dark")
    second.goto(window.address)
    second.locator("#rtee-mode", has_text="control: free").wait_for()
    second.locator("html[data-mantine-color-scheme=dark]").wait_for()
    second.close()
    window.page.bring_to_front()
    # Pointing into a plot moves the pose there, below the actions of that time.
    times = window.page.locator("[data-rtee-times]")
    window.until(lambda: "PinchTight" in (times.get_attribute("data-rtee-times") or ""))
    over = window.page.locator(".uplot:visible .u-over").first
    size = over.bounding_box()
    assert size is not None
    over.click(position={"x": 0.9 * size["width"], "y": 20.0})
    window.until(lambda: float(window.field("Time [s]", panel).input_value()) > 0.0)
    window.button("Open hand").click()
    window.told("this window shows a recording; go back to live first")
    said = line.locator("title").all_text_contents()
    assert any(text.startswith("PinchTight") and "reached" in text for text in said), said
    assert "it is closed" in said
    window.tab("Joints")
    window.until(lambda: window.page.locator("th:visible", has_text="max").count() == 1)
    assert window.room(window.page.locator("th:visible", has_text="max")) >= 0
    window.field("Go to", panel).click()
    window.page.get_by_role("option").filter(has_text="it is closed").click()
    window.until(lambda: abs(_position(window) - closed) <= 0.02)
    window.type("Time [s]", "0", panel)
    window.until(lambda: _position(window) <= 0.05)
    window.field("Play", panel).click()
    window.until(lambda: _position(window) >= 0.1)
    window.button("Back to live").first.click()  # that of the bar
    window.status("control: free")
    line.wait_for(state="detached")
    window.until(lambda: abs(_position(window) - other.state().position[0]) <= 0.02)
    window.tab("Plots")
