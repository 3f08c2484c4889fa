"""Make the pictures of the GUI: ``python docs/screenshots.py [FOLDER]``.

Runs each hand with its kinematic driver, one also in simulation, opens the GUI in a headless
browser, has it do something and takes pictures at 1280×800 and in a tablet's size. Needs Chromium;
takes some minutes where the browser has no graphics card.
"""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from PIL import Image

import rtee
from tests.testing.browser import browser

if TYPE_CHECKING:
    from playwright.sync_api import Page

HANDS = {
    "schunk_svh": "PinchTight",
    "robotiq_2f_85": "PinchTight",
    "heri_ii": "PinchTight",
}
SIZES = {"": (1280, 800), "_tablet": (1024, 768)}
COMMAND = (sys.executable, "-c", "from rtee.cli import main; main()")
COLOURS = 192
PATIENCE = 600_000
"""How long anything may take [ms]: planning tries grasps, which takes minutes where others work."""


@contextlib.contextmanager
def program(folder: Path, pattern: str, *arguments: str) -> Iterator[re.Match[str]]:
    """Run a command of rtee while the context lasts, once it has said something."""
    environment = os.environ | {"RTEE_RUNTIME_DIR": str(folder)}
    with subprocess.Popen(
        [*COMMAND, *arguments], cwd=folder, env=environment, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            lines: list[str] = []
            for line in process.stdout:
                lines.append(line)
                if found := re.search(pattern, line):
                    yield found
                    break
            else:
                raise SystemExit(f"rtee {' '.join(arguments)} said only: {''.join(lines)}")
        finally:
            process.terminate()


def opened(hand: str, folder: Path) -> None:
    """Open a hand that runs in a folder, so that the plots show how it closes."""
    os.environ["RTEE_RUNTIME_DIR"] = str(folder)
    with rtee.connect_blocking(hand, client="screenshots") as client:
        client.open()


def act(page: Page, action: str) -> None:
    """Do an action: unfold its card if need be, and show it alone."""
    search = page.locator("label:visible", has_text="Search").locator(
        "xpath=ancestor::div[contains(@class, 'mantine-Flex-root')][1]"
    )
    search.locator("input").fill(action)
    page.wait_for_timeout(1500)
    if not page.get_by_role("button", name="Run", exact=True).first.is_visible():
        page.get_by_text(action, exact=True).first.click()
    page.get_by_role("button", name="Run", exact=True).first.click()
    # Not what trials found, which is folded.
    page.get_by_text(re.compile("^(reached|held).*$")).locator("visible=true").first.wait_for()
    page.mouse.move(640, 20)
    page.wait_for_timeout(3000)


def take(page: Page, path: Path) -> None:
    """Save a picture of the page with few colours, which is small."""
    page.screenshot(path=path, timeout=120_000)
    with Image.open(path) as picture:
        few = picture.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    few.save(path, optimize=True)


def picture_of(hand: str, action: str, folder: Path) -> None:
    """Make the pictures of one hand."""
    with (
        tempfile.TemporaryDirectory(prefix="rtee-") as name,
        program(
            Path(name), hand, "run", hand, "--driver", "kinematic", "--rate", "200", "--no-log"
        ),
    ):
        for suffix, (width, height) in SIZES.items():
            opened(hand, Path(name))
            # Each address opens one browser.
            with (
                program(Path(name), r"GUI at (\S+)", "gui", hand, "--port", "0") as gui,
                browser(width, height) as context,
            ):
                page = context.pages[0]
                page.set_default_timeout(PATIENCE)
                page.goto(gui[1])
                page.get_by_text("Primitives", exact=True).wait_for()
                page.wait_for_timeout(3000)
                page.locator(".mantine-Notification-closeButton").first.click()
                act(page, action)
                take(page, folder / f"gui_{hand}{suffix}.png")


def choose(page: Page, label: str, option: str) -> None:
    """Choose an option of a dropdown."""
    row = page.locator("label:visible", has_text=label).first.locator(
        "xpath=ancestor::div[contains(@class, 'mantine-Flex-root')][1]"
    )
    row.locator("input:not([type=hidden])").last.click()
    page.get_by_role("option", name=option, exact=True).click()


def picture_of_a_plan(folder: Path) -> None:
    """Picture a grasp that was planned for a simulated box, and done."""
    hand, obj = "robotiq_2f_85", "box:0.04x0.04x0.1"
    simulated = ("--driver", "mujoco", "--object", obj, "--rate", "100", "--no-log")
    with (
        tempfile.TemporaryDirectory(prefix="rtee-") as name,
        program(Path(name), hand, "run", hand, *simulated),
        program(Path(name), r"GUI at (\S+)", "gui", hand, "--port", "0") as gui,
        browser(*SIZES[""]) as context,
    ):
        page = context.pages[0]
        page.set_default_timeout(PATIENCE)
        page.goto(gui[1])
        page.get_by_text("Primitives", exact=True).wait_for()
        page.wait_for_timeout(3000)
        page.locator(".mantine-Notification-closeButton").first.click()
        page.get_by_role("tab", name="Simulate").click()
        choose(page, "Object", obj)
        page.get_by_role("button", name="Suggest grasps", exact=True).click()
        page.get_by_text(re.compile("^best: ")).first.wait_for()
        page.get_by_role("button", name="Grasp", exact=True).first.click()
        ended = page.get_by_text(re.compile("^(reached|held|stalled).*$"))
        ended.locator("visible=true").first.wait_for()
        page.mouse.move(640, 400)
        page.mouse.wheel(0, 300)  # the whole box
        page.mouse.move(640, 20)
        page.wait_for_timeout(3000)
        take(page, folder / "gui_try.png")


def main() -> None:
    """Make all pictures."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parent / "assets")
    folder.mkdir(parents=True, exist_ok=True)
    for hand, action in HANDS.items():
        picture_of(hand, action, folder.resolve())
    picture_of_a_plan(folder.resolve())


if __name__ == "__main__":
    main()
