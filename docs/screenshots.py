"""Make the pictures of the GUI: ``python docs/screenshots.py [FOLDER]``.

Runs each hand with its kinematic driver, one also in simulation, opens the GUI in a headless
browser, has it do something and takes a picture. Needs Chromium, and the extras of the GUI, of the
simulation and of planning; takes some minutes where the browser has no graphics card.
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
    from playwright.sync_api import Locator, Page

LAPTOP, TABLET = (1280, 800), (1024, 768)
"""Sizes of the page [CSS px]."""

PICTURES = {
    "gui_schunk_svh": ("schunk_svh", LAPTOP),
    "gui_robotiq_2f_85": ("robotiq_2f_85", LAPTOP),
    "gui_heri_ii_tablet": ("heri_ii", TABLET),
}
"""Hand and size by picture; ``gui_try`` has a function of its own."""

ACTION = "PinchTight"
COMMAND = (sys.executable, "-c", "from rtee.cli import main; main()")

STEP = 5
"""Step of red, green and blue, of 255: two at most from the page, which is not seen. The pictures
have two thirds of the size. Palettes of 256 colours were off by 18 to 98 in single pixels."""

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


ENDED = re.compile(
    "^(reached|held|stalled|touched|something of|closed on|nothing|timed out|aborted)"
)
"""How the result of a goal begins, see `rtee.remote.words`."""


def opened(hand: str, folder: Path) -> None:
    """Open a hand that runs in a folder, so that the plots show how it closes."""
    os.environ["RTEE_RUNTIME_DIR"] = str(folder)
    with rtee.connect_blocking(hand, client="screenshots") as client:
        client.open()


def visit(page: Page, address: str) -> None:
    """Open the page and wait until it shows a hand."""
    page.set_default_timeout(PATIENCE)
    page.goto(address)
    page.get_by_text("Primitives", exact=True).wait_for()
    page.wait_for_timeout(3000)
    close = "document.querySelectorAll('.mantine-Notification-closeButton')"
    page.evaluate(f"{close}.forEach((each) => each.click())")  # none, with a graphics card


def row(page: Page, label: str) -> Locator:
    """Return the first visible row with a label."""
    return page.locator("label:visible", has_text=label).first.locator(
        "xpath=ancestor::div[contains(@class, 'mantine-Flex-root')][1]"
    )


def finish(page: Page) -> None:
    """Wait until a goal has ended: for its result, not for that of trials, which is folded."""
    page.get_by_text(ENDED).locator("visible=true").first.wait_for()
    page.mouse.move(640, 20)
    page.wait_for_timeout(3000)


def act(page: Page, action: str) -> None:
    """Do an action: unfold its card if need be, and show it alone."""
    row(page, "Search").locator("input").fill(action)
    page.wait_for_timeout(1500)
    if not page.get_by_role("button", name="Run", exact=True).first.is_visible():
        page.get_by_text(action, exact=True).first.click()
    page.get_by_role("button", name="Run", exact=True).first.click()
    finish(page)


def take(page: Page, path: Path) -> None:
    """Save a picture of the page, with values that compress well."""
    page.screenshot(path=path, timeout=120_000)
    with Image.open(path) as picture:
        image = picture.convert("RGB")
    image.point([round(v / STEP) * STEP for v in range(256)] * 3).save(path, optimize=True)


def picture_of(hand: str, size: tuple[int, int], path: Path) -> None:
    """Make the picture of a hand after a pinch."""
    with (
        tempfile.TemporaryDirectory(prefix="rtee-") as name,
        program(
            Path(name), hand, "run", hand, "--driver", "kinematic", "--rate", "200", "--no-log"
        ),
    ):
        opened(hand, Path(name))
        with (
            program(Path(name), r"GUI at (\S+)", "gui", hand, "--port", "0") as gui,
            browser(*size) as context,
        ):
            visit(context.pages[0], gui[1])
            act(context.pages[0], ACTION)
            take(context.pages[0], path)


def choose(page: Page, label: str, option: str) -> None:
    """Choose an option of a dropdown."""
    row(page, label).locator("input:not([type=hidden])").last.click()
    page.get_by_role("option", name=option, exact=True).click()


def picture_of_a_plan(folder: Path) -> None:
    """Picture a grasp that was planned for a simulated box, and done."""
    # A higher one stands so near to the palm that the bars of the fingers close on its lower edge.
    hand, obj = "robotiq_2f_85", "box:0.04x0.04x0.06"
    simulated = ("--driver", "mujoco", "--object", obj, "--rate", "100", "--no-log")
    with (
        tempfile.TemporaryDirectory(prefix="rtee-") as name,
        program(Path(name), hand, "run", hand, *simulated),
        program(Path(name), r"GUI at (\S+)", "gui", hand, "--port", "0") as gui,
        browser(*LAPTOP) as context,
    ):
        page = context.pages[0]
        visit(page, gui[1])
        page.get_by_role("tab", name="Simulate").click()
        choose(page, "Object", "box")
        height = row(page, "Height [mm]").locator("input:not([type=hidden])").last
        height.fill("60")
        height.press("Enter")
        page.get_by_role("button", name="Suggest grasps", exact=True).click()
        page.get_by_text(re.compile("^best: ")).first.wait_for()
        page.get_by_role("button", name="Grasp", exact=True).first.click()
        page.mouse.move(640, 400)
        page.mouse.wheel(0, 300)  # the whole object
        finish(page)
        take(page, folder / "gui_try.png")


def main() -> None:
    """Make all pictures."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parent / "assets")
    folder.mkdir(parents=True, exist_ok=True)
    for name, (hand, size) in PICTURES.items():
        picture_of(hand, size, folder.resolve() / f"{name}.png")
    picture_of_a_plan(folder.resolve())


if __name__ == "__main__":
    main()
