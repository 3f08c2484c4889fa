"""The GUI where neither the extra `sim` nor `extract` is installed."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from rtee.errors import install_line

from .conftest import Hands
from .marks import in_a_browser
from .running import GRIPPER, Program
from .window import Window

if TYPE_CHECKING:
    from playwright.sync_api import BrowserContext

pytestmark = in_a_browser

MISSING = "mujoco,coal,pinocchio"

WITHOUT = """
import sys
from importlib.machinery import PathFinder

names = sys.argv.pop(1).split(",")

class Finder(PathFinder):
    @classmethod
    def find_spec(cls, fullname, path=None, target=None):
        if fullname.partition(".")[0] not in names:
            return super().find_spec(fullname, path, target)

sys.meta_path[sys.meta_path.index(PathFinder)] = Finder
from rtee.cli import main
main()
"""
"""Runs rtee as if some packages were not installed: finders don't find them."""


@pytest.fixture
def bare(context: BrowserContext, place: Path, hands: Hands) -> Iterator[Window]:
    """A window on a GUI without the extras, showing the gripper."""
    assert hands[GRIPPER].process.poll() is None
    command = (sys.executable, "-c", WITHOUT, MISSING)
    program = Program(place, "gui", GRIPPER, "--port", "0", command=command)
    try:
        page = context.new_page()
        window = Window(page, program.line(r"rtee: GUI at (http://\S+)")[1])
        window.open(GRIPPER)
        yield window
        page.close()
        context.pages[0].bring_to_front()
    finally:
        program.end()
    said = program.rest()
    assert "Traceback" not in said, said


@pytest.mark.heavy
def test_the_try_tab_says_what_is_missing_and_the_hand_still_moves(bare: Window) -> None:
    bare.tab("Simulate")
    bare.says(f"trying an action needs the extra 'sim': {install_line('sim')}")
    bare.button("Suggest grasps").click()
    bare.says(f"planning a grasp needs the extra 'extract': {install_line('extract')}")
    bare.button("Try").click()
    bare.says("trying an action needs the extra 'sim'")
    bare.forget()
    bare.tab("Actions")
    card = bare.folder("PinchTight", unfold=True)
    bare.button("Run", card).click()
    bare.says("reached", card)
    bare.button("Open hand").first.click()
