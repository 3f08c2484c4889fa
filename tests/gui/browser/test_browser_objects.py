"""What a simulated hand grasps, in the browser: its object and forces, live and in a recording."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from .marks import in_a_browser
from .window import Window

pytestmark = in_a_browser

FELT = re.compile(r"inner_finger\w* \d\d+\.\d N")
"""What is said of the forces while the ball is held; let go, it lies in the hand with 1 N."""


def grasp(window: Window) -> None:
    """Grasp the ball, and wait until the hand has it."""
    window.tab("Actions")
    card = window.folder("Grasp", unfold=True)
    window.button("Run", card).click()
    window.says("held by finger_1, finger_2", card)
    window.tab("View")
    window.says(FELT)  # the card may have said that of the grasp before


def toggle(window: Window, label: str) -> None:
    """Click a box of the tab View, and wait until the 3D view shows something else."""
    before = window.picture()
    window.field(label).click()
    window.pictured_anew(before)


@pytest.mark.heavy
def test_contact_forces_are_drawn_and_told(squeezer: Window) -> None:
    window = squeezer
    grasp(window)
    felt = window.says(FELT)
    toggle(window, "Contact forces")
    felt.wait_for(state="hidden")
    window.field("Contact forces").click()
    window.says(FELT)
    window.button("Open hand").click()
    felt.wait_for(state="hidden")


@pytest.mark.heavy
def test_taxels_are_drawn_and_told(squeezer: Window) -> None:
    window = squeezer
    grasp(window)
    window.tab("Touch")
    window.says("finger_1_tip")
    window.says("Length [s]")
    window.says(re.compile(r"^\d\d+\.\d\d$"))  # newtons, of a sum or the largest taxel
    window.tab("View")
    toggle(window, "Touch")
    window.field("Touch").click()
    window.button("Open hand").click()
    window.tab("Plots")


@pytest.mark.heavy
def test_a_recording_shows_the_object_where_it_was(squeezer: Window, place: Path) -> None:
    window = squeezer
    before = set((place / "logs").glob("*.mcap"))
    window.tab("Recordings")
    window.says("○ off")
    window.button("Start").click()
    window.told("a recording begins")
    window.says("recording to")
    grasp(window)
    window.tab("Recordings")
    window.type("Mark", "it has the ball")
    window.button("Set mark").click()
    window.told("it has the ball")
    window.button("Open hand").first.click()
    window.tab("View")
    window.page.get_by_text(FELT).first.wait_for(state="hidden")
    window.tab("Recordings")
    window.button("Finish").click()
    window.says("○ off")
    (recorded,) = set((place / "logs").glob("*.mcap")) - before

    panel = window.folder("Recordings", unfold=True)
    window.button("Refresh", panel).click()
    window.field("File", panel).click()
    window.page.get_by_role("option").filter(has_text=recorded.stem).click()
    window.button("Play", panel).click()
    line = panel.get_by_label("actions over time")
    line.wait_for()
    window.field("Play", panel).click()  # wait in it
    window.field("Go to", panel).click()
    window.page.get_by_role("option").filter(has_text="it has the ball").click()
    window.tab("View")
    window.says(FELT)  # in the recording; the hand itself is open
    toggle(window, "Object")
    window.field("Object").click()
    window.tab("Recordings")
    window.field("Time [s]", panel).fill("never")  # which keeps nobody in the past
    window.button("Back to live", panel).click()
    line.wait_for(state="detached")
    window.tab("View")
    window.page.get_by_text(FELT).first.wait_for(state="hidden")
    window.tab("Actions")
