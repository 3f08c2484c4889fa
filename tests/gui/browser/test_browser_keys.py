"""The GUI without a mouse."""

from __future__ import annotations

import pytest

from rtee.remote.blocking import BlockingHand

from .marks import in_a_browser
from .window import Window

pytestmark = in_a_browser

FOCUSED = "document.activeElement.innerText || document.activeElement.value"


def _leave_fields(window: Window) -> None:
    window.page.evaluate("document.activeElement.blur()")


def test_keys_open_cancel_and_stop(window: Window, other: BlockingHand, lasting: str) -> None:
    keys = window.page.keyboard
    other.do("PinchTight", "finger_1", "finger_2")
    window.forget()
    _leave_fields(window)
    keys.press("o")
    window.until(lambda: other.state().position[0] <= 0.02)
    card = window.folder(lasting, unfold=True)
    window.button("Run", card).click()
    window.status(f"running {lasting}")
    _leave_fields(window)
    keys.press("c")
    window.says("cancelled", card)
    _leave_fields(window)
    keys.press("s")
    window.told("; confirmed")


def test_a_key_typed_into_a_field_is_text(window: Window, other: BlockingHand) -> None:
    other.do("PinchTight", "finger_1", "finger_2", intensity=0.5)
    before = other.state().position[0]
    window.field("Search").press_sequentially("sos co")
    assert window.field("Search").input_value() == "sos co"
    window.type("Search", "")
    assert other.state().position[0] == pytest.approx(before, abs=0.01)
    assert "; confirmed" not in str(window.page.evaluate("window.told"))


def test_the_palette_finds_actions_of_this_hand(window: Window, other: BlockingHand) -> None:
    other.open()
    _leave_fields(window)
    window.page.keyboard.press("Control+k")
    search = window.page.get_by_placeholder("Search commands...")
    search.wait_for()
    search.fill("run pinchtight")
    selected = window.page.locator("[data-action][data-selected]", has_text="Run PinchTight")

    def found() -> bool:
        if not selected.count():  # perhaps of the list as it was before what is sought
            window.page.keyboard.press("ArrowDown")
        return bool(selected.count())

    window.until(found)
    window.page.keyboard.press("Enter")
    window.until(lambda: other.state().position[0] >= 0.5)


def test_tab_goes_through_the_controls_and_is_seen(window: Window, other: BlockingHand) -> None:
    page = window.page
    window.button("Open hand").focus()
    seen = []
    for _ in range(8):
        page.keyboard.press("Tab")
        seen.append(str(page.evaluate(FOCUSED)).strip())
        ring = page.evaluate("getComputedStyle(document.activeElement).outlineStyle")
        shape = page.evaluate("getComputedStyle(document.activeElement).borderStyle")
        assert ring != "none" or shape != "none", f"where the focus is cannot be seen: {seen}"
    assert seen[:2] == ["Cancel", "Actions"]


def test_open_by_enter(window: Window, other: BlockingHand) -> None:
    other.do("PinchTight", "finger_1", "finger_2", intensity=0.5)
    window.button("Open hand").focus()
    window.page.keyboard.press("Enter")
    window.until(lambda: other.state().position[0] <= 0.02)
