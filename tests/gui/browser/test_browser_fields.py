"""Number fields: what is typed counts once it is entered, and only in range."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest

from rtee.remote.blocking import BlockingHand

from .marks import in_a_browser
from .window import Window, enter

if TYPE_CHECKING:
    from playwright.sync_api import Locator

pytestmark = in_a_browser


def _sent(window: Window) -> list[str]:
    """Return the values and clicks that the page has sent."""
    return list(window.page.evaluate("window.sent"))


def _jogged(window: Window, other: BlockingHand, to: str) -> tuple[Locator, Locator]:
    """Jog the open gripper to a position [rad]; return the box that holds it, and the field."""
    other.open()
    window.tab("Teach")
    hold = window.field("Jog (holds the hand)")
    hold.click()
    window.status("control: this window")
    field = window.field("finger_joint [rad]")
    enter(field, to)
    window.until(lambda: abs(other.state().position[0] - float(to)) <= 0.005)
    return hold, field


@pytest.mark.samples("", "abc", "-5", "900")
@pytest.mark.parametrize("text", ["", "abc", "-5", "900", "30,5", "1e1", "5-"])
def test_a_width_that_is_none_grasps_nothing_and_says_so(
    window: Window, other: BlockingHand, text: str
) -> None:
    other.open()
    panel = window.folder("Hold an object", unfold=True)
    window.type("Width [mm]", "30", panel)
    window.type("Width [mm]", "31", panel)
    before = _sent(window)
    field = window.field("Width [mm]", panel)
    field.fill(text)
    window.button("Grasp", panel).click()
    said = window.says(
        re.compile(
            rf"^Width \[mm\] should be [\d.]+ to [\d.]+, not {text or 'empty'}; it is 31 again, "
            "and Grasp was not pressed$"
        ),
        panel,
    )
    assert field.input_value() == "31"
    assert _sent(window) == before
    window.button("Grasp", panel).click()
    said.wait_for(state="detached")
    window.until(lambda: other.state().position[0] > 0.05)
    assert field.input_value() == "31"
    window.button("Cancel").click()
    window.status("control: free")


def test_what_is_on_the_way_to_a_number_is_not_sent(window: Window, other: BlockingHand) -> None:
    panel = window.folder("Hold an object", unfold=True)
    window.type("Width [mm]", "30", panel)
    field, before = window.field("Width [mm]", panel), _sent(window)
    field.select_text()
    field.press_sequentially("45.57")
    assert _sent(window) == before
    field.press("Escape")
    assert field.input_value() == "30"
    field.select_text()
    field.press_sequentially("45.5")
    field.press("Tab")
    window.until(lambda: _sent(window) == [*before, "45.5"])
    window.type("Width [mm]", "30", panel)


def test_a_field_without_a_slider_has_its_range_too(window: Window) -> None:
    window.tab("Simulate")
    mass, before = window.field("Mass [kg]"), _sent(window)
    enter(mass, "0")
    window.says("Mass [kg] should be 0.001 to 100, not 0; it is 0.1 again")
    assert _sent(window) == before
    window.type("Mass [kg]", "0.25")
    assert mass.input_value() == "0.25"
    window.type("Mass [kg]", "0.1")


def test_a_jogged_hand_goes_only_to_what_was_entered(window: Window, other: BlockingHand) -> None:
    hold, field = _jogged(window, other, "0.6")
    assert not window.page.locator("#rtee-refused").count(), "refused, though it was entered"
    before = _sent(window)
    field.select_text()
    field.press_sequentially("0.4")
    assert _sent(window) == before
    enter(field, "9")
    window.says(re.compile(r"finger_joint \[rad\] should be 0 to .*, not 9; it is 0\.\d+ again"))
    assert _sent(window) == before
    assert other.state().position[0] == pytest.approx(0.6, abs=0.01)
    enter(field, "0.4")
    window.until(lambda: abs(other.state().position[0] - 0.4) <= 0.005)
    hold.click()
    window.status("control: free")


def _by_keys(*keys: str, at: str = "") -> Callable[[Window], None]:
    """Return a press of keys, the first in the field; the others at a button, if one is named."""

    def press(window: Window) -> None:
        window.page.keyboard.press(keys[0])
        if at:
            window.button(at).focus()
        for key in keys[1:]:
            window.page.keyboard.press(key)

    return press


def _by_holding_escape(window: Window) -> None:
    for _ in range(6):
        window.page.keyboard.down("Escape")
        window.page.wait_for_timeout(50)
    window.page.keyboard.up("Escape")


STOPS: dict[str, Callable[[Window], None]] = {
    "the mouse": lambda window: window.button("STOP").click(),
    "Enter on STOP": _by_keys("Tab", "Enter", at="STOP"),
    "Space on STOP": _by_keys("Shift+Tab", "Space", at="STOP"),
    "a key after Tab": _by_keys("Tab", "s"),
    "a key after Escape": _by_keys("Escape", "Escape"),
    "Escape held down": _by_holding_escape,
}
"""Ways to stop a hand, out of a field in which somebody types."""


def test_what_ends_a_motion_sends_nothing_that_was_only_typed(
    window: Window, other: BlockingHand
) -> None:
    hold, field = _jogged(window, other, "0.2")
    before = _sent(window)
    for how, stop in STOPS.items():
        stops = window.page.evaluate("window.stops")
        field.select_text()
        field.press_sequentially("0.7")
        stop(window)
        assert window.page.evaluate("window.stops") == stops + 1, how
        assert _sent(window) == before, how
        assert float(field.input_value()) == pytest.approx(0.2, abs=0.01), how
    field.fill("0.7")
    field.press("ArrowUp")
    window.until(lambda: _sent(window) == [*before, "0.201"])
    before = _sent(window)
    field.fill("0.7")
    window.button("Cancel").click()
    window.says(
        re.compile(r"^finger_joint \[rad\] acts on the hand only by Enter; it is 0\.\d+ again$")
    )
    field.fill("0.7")
    hold.click()
    window.status("control: free")
    assert _sent(window) == [*before, "Cancel", "false"]
    assert other.state().position[0] == pytest.approx(0.2, abs=0.01)


def test_the_grip_effort_changes_only_by_enter(window: Window, other: BlockingHand) -> None:
    window.tab("Teach")
    field = window.field("Holding effort [%]", window.folder("Tune", unfold=True))
    before = _sent(window)
    field.fill("90")
    field.press("Tab")
    window.says(
        re.compile(r"^Holding effort \[%\] acts on the hand only by Enter; it is \d+ again$")
    )
    assert _sent(window) == before


def test_a_hand_that_moves_meanwhile_does_not_change_what_is_typed(
    window: Window, other: BlockingHand
) -> None:
    other.open()
    window.tab("Teach")
    field = window.field("finger_joint [rad]")
    window.wait(field, "field => Math.abs(field.value) < 0.01")
    field.select_text()
    field.press_sequentially("0.")
    other.do("PinchTight", "finger_1", "finger_2", intensity=0.5)
    half = other.state().position[0]
    window.wait(field, f"field => Math.abs(field.defaultValue - {half}) < 0.01")
    field.press_sequentially("25")
    assert field.input_value() == "0.25"
    field.press("Escape")
    assert float(field.input_value()) == pytest.approx(half, abs=0.01)


def test_a_wrong_field_keeps_nobody_from_opening_the_hand(
    window: Window, other: BlockingHand
) -> None:
    other.do("PinchTight", "finger_1", "finger_2", intensity=0.5)
    panel = window.folder("Hold an object", unfold=True)
    window.field("Width [mm]", panel).fill("abc")
    window.button("Open hand").click()
    window.until(lambda: other.state().position[0] <= 0.02)
    window.says(re.compile("^Width .* again$"), panel)


def test_a_wrong_field_keeps_nobody_from_ending_a_trial(window: Window) -> None:
    window.tab("Simulate")
    window.field("Mass [kg]").fill("abc")
    window.button("Cancel").last.click()
    window.told("this window runs no trial or planning")
    window.says("Mass [kg] should be 0.001 to 100, not abc; it is 0.1 again")
