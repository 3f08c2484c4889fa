"""Plots and tables of actuators and joints in the browser."""

from __future__ import annotations

import threading

from rtee.remote.blocking import BlockingHand

from .marks import in_a_browser
from .window import Window

pytestmark = in_a_browser

FOLLOWING = "left_inner_knuckle_joint"
"""A joint of the gripper that follows its actuator."""

_UNDER_SCROLLBARS = """
() => [...document.querySelectorAll(".mantine-ScrollArea-root")].flatMap((area) => {
  const bar = area.querySelector(":scope > [data-orientation=vertical]");
  if (!bar?.getBoundingClientRect().width) return [];
  const boxes = [...area.querySelectorAll(".mantine-Paper-root")].filter((box) => box.offsetParent);
  const right = Math.max(...boxes.map((box) => box.getBoundingClientRect().right));
  return [right - bar.getBoundingClientRect().left];
})
"""
"""How far the boxes in each panel that scrolls reach below its scrollbar [CSS px]."""


def _joint_row(window: Window) -> list[str]:
    """Return what the table of joints says of that joint."""
    row = window.page.locator("tr:visible", has_text=FOLLOWING).first
    return row.locator("td").all_inner_texts()


def test_velocities_and_joints_have_plots(window: Window, other: BlockingHand) -> None:
    other.open()
    window.tab("Plots")
    for title in ("position [rad]", "velocity [rad/s]", "effort"):
        window.says(title)
    # Pointed at, all tell their values there, each line once.
    window.page.locator(".uplot:visible .u-over").first.hover()
    shown = window.page.locator(".uplot:visible .u-legend:visible")
    window.until(lambda: not any("--" in text for text in shown.all_inner_texts()))
    assert shown.count() == window.page.locator(".uplot:visible").count()
    assert [len(text.split("\n")) for text in shown.all_inner_texts()] == [3, 2, 2], "t, lines"
    panel = window.folder("Joints", unfold=True)
    before = window.page.locator(".uplot:visible").count()
    window.field(FOLLOWING, panel).click()
    window.says("joint position [rad]")
    window.says("joint velocity [rad/s]")
    assert window.page.locator(".uplot:visible").count() == before + 2
    window.field(FOLLOWING, panel).click()
    window.page.get_by_text("joint velocity [rad/s]").locator("visible=true").wait_for(
        state="detached"
    )


def test_the_table_tells_how_fast_joints_move(window: Window, other: BlockingHand) -> None:
    other.open()
    window.tab("Joints")
    window.says("vel [rad/s]")
    window.until(lambda: _joint_row(window)[2] == "0.00")
    over = threading.Event()

    def move() -> None:
        while not over.is_set():
            other.do("PinchTight", "finger_1", "finger_2")
            other.open()

    mover = threading.Thread(target=move)
    mover.start()
    try:
        window.until(lambda: abs(float(_joint_row(window)[2])) > 0.1)
    finally:
        over.set()
        mover.join()
    window.tab("Plots")


def test_nothing_lies_under_a_scrollbar(window: Window) -> None:
    page = window.page
    size = page.viewport_size
    assert size is not None
    window.tab("Joints")
    # So low that both panels scroll.
    page.set_viewport_size({"width": size["width"], "height": 400})
    try:
        window.until(lambda: len(page.evaluate(_UNDER_SCROLLBARS)) == 2)
        assert max(page.evaluate(_UNDER_SCROLLBARS)) <= 0.0
    finally:
        page.set_viewport_size(size)
        window.tab("Plots")


def test_a_hand_without_touch_sensors_has_no_length_of_their_plots(window: Window) -> None:
    window.tab("Touch")
    window.says("The hand measures no touch.")
    assert window.page.locator("label:visible", has_text="Length [s]").count() == 0
    window.tab("Plots")
