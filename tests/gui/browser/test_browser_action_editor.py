"""Making actions in the browser: jog, save, compose, put in sequence, rename, delete, undo."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from rtee.actions.types import Action, Composed, Timed
from rtee.errors import LeaseHeld
from rtee.remote.blocking import BlockingHand

from .marks import in_a_browser
from .running import GRIPPER
from .window import Window, enter

pytestmark = in_a_browser


@pytest.fixture
def window(window: Window) -> Window:
    window.tab("Teach")
    return window


def _made(other: BlockingHand, name: str) -> Action:
    (action,) = other.actions(name=name)
    return action


def test_jog_moves_the_hand_while_nobody_else_can(window: Window, other: BlockingHand) -> None:
    other.open()
    hold = window.field("Jog (holds the hand)")
    hold.click()
    window.status("control: this window")
    with pytest.raises(LeaseHeld, match="gui"):
        other.open()
    slider = window.field("finger_joint [rad]")
    enter(slider, "0.42")
    window.until(lambda: abs(other.state().position[0] - 0.42) <= 0.005)
    window.button("−").click()
    window.until(lambda: abs(other.state().position[0] - 0.4) <= 0.005)
    hold.click()
    window.status("control: free")
    enter(slider, "0.7")
    window.wait(slider, "field => Math.abs(field.value - 0.4) < 0.01")
    assert other.state().position[0] == pytest.approx(0.4, abs=0.01)


def test_the_hand_follows_the_sliders_as_a_stream(window: Window, other: BlockingHand) -> None:
    other.open()
    hold, follow = window.field("Jog (holds the hand)"), window.field("Move live")
    follow.click()
    hold.click()
    window.status("control: this window")
    slider = window.field("finger_joint [rad]")
    for position in (0.2, 0.5, 0.3):
        enter(slider, f"{position}")
        window.until(lambda at=position: abs(other.state().position[0] - at) <= 0.005)
        stream = other.status().stream
        assert stream.stream.startswith("gui")
        assert stream.samples > 0
        assert stream.refused == 0
    follow.click()
    window.until(lambda: other.status().stream.stream == "")
    assert other.state().position[0] == pytest.approx(0.3, abs=0.01)
    enter(slider, "0.6")  # not a stream any more, but jogged to
    window.until(lambda: abs(other.state().position[0] - 0.6) <= 0.005)
    hold.click()
    window.status("control: free")


def test_the_sliders_follow_the_hand_while_nobody_jogs(window: Window, other: BlockingHand) -> None:
    other.do("PinchTight", "finger_1", "finger_2", intensity=0.5)
    half = other.state().position[0]
    window.wait(
        window.field("finger_joint [rad]"), f"field => Math.abs(field.value - {half}) < 0.01"
    )


def test_a_posture_is_saved_and_stored(window: Window, other: BlockingHand, place: Path) -> None:
    other.do("PinchTight", "finger_1", "finger_2", intensity=0.5)
    there = other.state().position[0]
    # The window shows, and saves, what it has last heard of the hand.
    shown = f"field => Math.abs(field.value - {there}) < 0.01"
    window.wait(window.field("finger_joint [rad]"), shown)
    here = window.folder("Save this posture", unfold=True)
    window.type("Name", "half", here)
    window.button("Save pose", here).click()
    window.told("action 'half'")
    assert _made(other, "half").posture.position["finger_joint"] == pytest.approx(there, abs=0.02)
    stored = place / "config" / GRIPPER / "actions" / "generic" / "half.yaml"
    assert stored.is_file()
    window.type("Name", "../half", here)
    window.button("Save pose", here).click()
    window.told("Refused")
    other.remove_action("half")
    assert not stored.exists()


@pytest.mark.heavy
def test_actions_are_put_in_sequence_and_composed(window: Window, other: BlockingHand) -> None:
    panel = window.folder("Combine actions", unfold=True)
    for action, scale, before, after in (
        ("Grasp", "50", "0", "0.2"),
        ("PinchTight", "20", "0.1", "0"),
    ):
        name = action if action == "Grasp" else f"{action} finger_1 finger_2"
        window.type("Scale [%]", scale, panel)
        window.type("Before [s]", before, panel)
        window.type("After [s]", after, panel)
        window.choose("Add", name, panel)
        window.says(f"{name} × 0.{scale[0]}", panel)
    window.button("Up", panel).click()
    window.says("1. PinchTight finger_1 finger_2 × 0.2", panel)
    window.type("Name", "in_turn", panel)
    window.button("Sequence", panel).click()
    window.told("action 'in_turn'")
    made = _made(other, "in_turn")
    assert isinstance(made, Timed)
    assert [(s.use.action, s.use.scale, s.before, s.after) for s in made.steps] == [
        ("PinchTight", 0.2, 0.1, 0.0),
        ("Grasp", 0.5, 0.0, 0.2),
    ]
    window.says("no parts yet", panel)

    window.type("Scale [%]", "40", panel)
    window.type("Name", "", panel)
    window.tab("Actions")
    window.clicks()
    window.tab("Teach")
    for action in ("Grasp", "PinchTight finger_1 finger_2"):
        window.choose("Add", action, panel)
    window.says("2. PinchTight finger_1 finger_2 × 0.4", panel)
    window.button("Compose", panel).click()
    window.button("Run it", panel).click()  # shown as a ghost until now
    window.says("reached", panel)
    assert window.clicks() <= 7
    composed = _made(other, "Grasp_PinchTight")
    assert isinstance(composed, Composed)
    assert composed.parts[0].scale == 0.4
    other.open()
    window.says(re.compile("old, then .* open: reached", re.IGNORECASE), panel)

    window.tab("Actions")
    card = window.folder("in_turn")
    window.says("0.1 s before, 0 s after", card)
    window.button("Run", card).click()
    window.says("reached", card)
    bars = card.locator("[role=progressbar]")
    assert [bars.nth(n).get_attribute("aria-valuenow") for n in range(3)] == ["100"] * 3
    for name in ("in_turn", "Grasp_PinchTight"):
        other.remove_action(name)


@pytest.mark.heavy
def test_an_action_is_renamed_deleted_and_brought_back(window: Window, other: BlockingHand) -> None:
    other.add_generic("nudge", {"finger_joint": 0.2}, description="a little", store=True)
    panel = window.folder("Rename or delete", unfold=True)
    window.choose("Action", "nudge", panel)
    window.type("New name", "push", panel)
    window.button("Rename", panel).click()
    window.told("'nudge' is now 'push'")
    window.choose("Action", "push", panel)
    window.button("Delete", panel).click()
    window.told("'push'; Undo brings it back")
    assert other.actions(name="push") == []
    window.button("Undo", panel).click()
    window.told("action 'push' is there again")
    push = _made(other, "push")
    assert (push.posture.position["finger_joint"], push.description) == (0.2, "a little")
    other.remove_action("push")
