"""The GUI as people use it: a real browser, real hands in processes of their own."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from benchmarks.gui_onlooker import admitted, controls, use
from benchmarks.gui_onlooker import window as window_of
from rtee.errors import RequestRejected
from rtee.remote.blocking import BlockingHand

from .conftest import Hands
from .marks import in_a_browser
from .running import GRIPPER, Program
from .window import Window

if TYPE_CHECKING:
    from playwright.sync_api import BrowserContext

pytestmark = in_a_browser


def test_a_primitive_fills_its_bar_and_moves_the_hand(window: Window) -> None:
    before = window.picture()
    card = window.folder("PinchTight", unfold=True)
    window.clicks()
    window.field("Intensity [%]", card).click()
    window.type("Intensity [%]", "60", card)
    window.button("Run", card).click()
    window.says("reached", card)
    assert window.clicks() <= 2
    # The card may have said that it was reached before.
    window.wait(card.locator("[role=progressbar]").first, "bar => bar.ariaValueNow === '100'")
    window.pictured_anew(before)
    window.type("Intensity [%]", "100", card)
    window.says("old, then other settings: reached", card)


def test_a_preview_shows_a_ghost_and_goes(window: Window, other: BlockingHand) -> None:
    card = window.folder("PinchTight", unfold=True)
    before = window.picture()
    position = other.state().position[0]
    window.button("Preview", card).click()
    shown = window.pictured_anew(before)
    window.type("Intensity [%]", "30", card)
    window.pictured_anew(shown)
    window.button("Preview", card).click()
    window.type("Intensity [%]", "100", card)
    # The model of the servo settles for some time after a goal has ended, by millionths.
    assert other.state().position[0] == pytest.approx(position, abs=1e-4)


@pytest.mark.heavy
def test_a_pinch_goes_to_just_before_contact_and_on(window: Window, other: BlockingHand) -> None:
    other.open()
    card = window.folder("PinchTight", unfold=True)
    more = window.folder("More", card, unfold=True)
    (pinch,) = other.actions("primitive", "PinchTight")
    target, contact = pinch.posture.position["finger_joint"], pinch.evidence[0].contact_at
    assert contact is not None
    for stage, least, most in (
        ("to just before contact", 0.5 * contact * target, contact * target),
        ("from contact to grasp", 0.98 * target, 1.02 * target),
    ):
        window.choose("Stage", stage, more)
        window.button("Run", card).click()
        window.until(lambda a=least, b=most: a <= other.state().position[0] <= b)
        window.says("reached", card)
    window.choose("Stage", "to the grasp", more)


def test_an_opening_in_millimetres_is_what_the_hand_goes_to(
    window: Window, other: BlockingHand
) -> None:
    other.open()
    card = window.folder("PinchTight", unfold=True)
    window.type("Opening [mm]", "40", window.folder("More", card, unfold=True))
    window.button("Run", card).click()
    window.says(re.compile(r"reached at 4\d\.\d mm"), card)  # reached within its tolerance
    (known,) = [each for each in other.openings() if each.action == "PinchTight"]
    (pinch,) = other.actions("primitive", "PinchTight")
    target = known.intensity_at(0.04) * pinch.posture.position["finger_joint"]
    window.until(lambda: other.state().position[0] == pytest.approx(target, abs=2e-3))
    assert known.least_force < known.most_force
    assert not known.unlimited
    window.type("Intensity [%]", "100", card)


def test_forces_are_offered_for_the_opening_that_is_chosen(
    window: Window, other: BlockingHand
) -> None:
    (known,) = [each for each in other.openings() if each.action == "PinchTight"]
    card = window.folder("PinchTight", unfold=True)
    more = window.folder("More", card, unfold=True)
    for width in ("20", "70"):
        window.type("Opening [mm]", width, more)
        most = math.floor(known.forces_at(float(width) / 1e3)[1] * 10.0) / 10.0
        window.says(f"0 to {most:g} N at {width} mm", card)
        assert other.do("PinchTight", opening=float(width) / 1e3, force=most).reached
        with pytest.raises(RequestRejected, match="gives at most"):
            other.do("PinchTight", opening=float(width) / 1e3, force=most + 0.2)
    window.type("Intensity [%]", "100", card)


def test_cancel_is_said(window: Window, lasting: str) -> None:
    card = window.folder(lasting, unfold=True)
    window.button("Run", card).click()
    window.status(f"running {lasting}")
    window.button("Cancel").click()
    window.says("cancelled", card)


def test_an_action_made_elsewhere_appears_in_every_window_and_goes(
    window: Window, context: BrowserContext, other: BlockingHand
) -> None:
    other.add_generic("from_elsewhere", {"finger_joint": 0.3})
    window.says("from_elsewhere")
    second = Window(context.new_page(), window.address)
    second.page.goto(window.address)
    second.says("from_elsewhere")
    # What is typed in a window is that window's alone, and who jogs is told in the others.
    second.type("Search", "from_else")
    assert window.field("Search").input_value() == ""
    second.tab("Teach")
    second.field("Jog (holds the hand)").click()
    second.status("control: this window")
    window.status("control: another window")
    second.field("Jog (holds the hand)").click()
    window.status("control: free")
    second.tab("Actions")
    other.remove_action("from_elsewhere")
    for each in (window, second):
        each.page.get_by_text("from_elsewhere", exact=True).first.wait_for(state="detached")
    second.page.close()
    window.page.bring_to_front()


def test_who_holds_the_hand_is_named_and_what_is_refused_is_said(
    window: Window, other: BlockingHand
) -> None:
    other.acquire_lease()
    try:
        window.status(f"control: {other.client}")
        card = window.folder("PinchTight", unfold=True)
        window.button("Run", card).click()
        window.says(f"the hand is held by '{other.client}'", card)
        window.told("Refused")
        window.forget()
        window.tab("Teach")
        window.field("Jog (holds the hand)").click()
        window.told("Refused")
        window.wait(window.field("Jog (holds the hand)"), "box => !box.checked")
        window.button("STOP").click()
        window.told("; confirmed")
    finally:
        other.release_lease()
    window.status("control: free")


@pytest.mark.heavy
def test_a_killed_loop_is_said_plainly_and_a_new_one_goes_on(
    window: Window, hands: Hands, gui: Program
) -> None:
    hands.kill(GRIPPER)
    window.says("not connected")
    window.says(re.compile("no hand|has ended|is not running"))
    assert hands[GRIPPER].process.poll() is None
    window.says(f"{GRIPPER}: connected")
    card = window.folder("PinchTight", unfold=True)
    window.button("Run", card).click()
    window.says("reached", card)
    assert gui.process.poll() is None


def test_a_gui_that_dies_lets_go_of_the_hand(
    place: Path, hands: Hands, other: BlockingHand
) -> None:
    program = Program(place, "gui", GRIPPER, "--port", "0")
    visit = admitted(program.line(r"rtee: GUI at (http://\S+)")[1])
    try:
        jog = None
        while jog is None:  # its page is filled once it has found the hand
            with window_of(visit) as connection:
                named = {found["props"]["label"]: found for found in controls(connection)}
                jog = named.get("Jog (holds the hand)")
                if jog is not None:
                    use(connection, jog)
                    _until(lambda: other.status().holder.startswith("gui"))
    finally:
        program.kill()
    _until(lambda: other.status().holder == "")
    assert other.open().reached
    program.end()


def _until(true: Callable[[], bool]) -> None:
    while not true():
        time.sleep(0.02)
