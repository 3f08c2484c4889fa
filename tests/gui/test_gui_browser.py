"""The GUI as people use it: a real browser, a real hand in a process of its own."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from rtee.testing.browser import browser, find_browser

from .running import Program, copy_of

if TYPE_CHECKING:
    from playwright.sync_api import BrowserContext, Locator, Page

pytestmark = [
    pytest.mark.browser,
    pytest.mark.timeout(300),
    pytest.mark.skipif(find_browser() is None, reason="no Chromium was found"),
]

HAND = "robotiq_2f_85"


@pytest.fixture(scope="module")
def place(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("gui")
    copy_of(repository, folder, HAND)
    return folder


def _hand(place: Path) -> Program:
    arguments = ("--driver", "kinematic", "--rate", "200", "--log", str(place / "logs"))
    program = Program(place, "run", HAND, *arguments)
    program.line(rf"{HAND}: .* active")
    return program


@pytest.fixture(scope="module")
def hands(place: Path) -> Iterator[list[Program]]:
    """The hand's process is the last one; a test may kill it and start another."""
    programs = [_hand(place)]
    yield programs
    for program in programs:
        program.end()


@pytest.fixture(scope="module")
def address(place: Path, hands: list[Program]) -> Iterator[str]:
    program = Program(place, "gui", "--port", "0")
    yield program.line(r"rtee: GUI at (http://\S+)")[1]
    program.end()


@pytest.fixture(scope="module")
def context() -> Iterator[BrowserContext]:
    with browser(800, 600) as opened:
        yield opened


@pytest.fixture(scope="module")
def page(context: BrowserContext, address: str) -> Page:
    page = context.pages[0]
    page.goto(address)
    page.get_by_text(f"{HAND}: connected").wait_for()
    page.get_by_role("button", name="Do", exact=True).first.wait_for()
    page.locator(".mantine-Notification-closeButton").first.click()
    return page


def _field(page: Page, label: str) -> Locator:
    """Return the first visible field with a label to type into."""
    row = "xpath=ancestor::div[contains(@class, 'mantine-Flex-root')][1]"
    found = page.locator("label:visible").filter(has_text=label).first
    return found.locator(row).locator("input:not([type=hidden])").last


def _picture(page: Page) -> bytes:
    """Return what the 3D view shows."""
    area = {"x": 340.0, "y": 200.0, "width": 100.0, "height": 300.0}
    return page.screenshot(clip=area)  # type: ignore[arg-type]


def test_a_primitive_fills_its_bar_and_moves_the_hand(page: Page) -> None:
    before = _picture(page)
    page.get_by_role("button", name="Do", exact=True).first.click()
    page.get_by_text("reached", exact=True).first.wait_for()
    bar = page.locator("[role=progressbar]").first
    assert float(bar.get_attribute("aria-valuenow") or 0) == 100.0
    assert _picture(page) != before


def test_cancel_is_said(page: Page) -> None:
    page.get_by_role("button", name="Open", exact=True).first.click()
    page.get_by_text("More", exact=True).first.click()
    speed = _field(page, "Speed [%]")
    speed.fill("5")
    speed.press("Enter")
    page.get_by_role("button", name="Do", exact=True).first.click()
    page.get_by_role("button", name="Cancel", exact=True).first.click()
    page.get_by_text("cancelled", exact=True).first.wait_for()


def test_an_action_made_here_appears_in_a_second_window(
    page: Page, context: BrowserContext, address: str, place: Path
) -> None:
    page.get_by_role("tab", name="Make").click()
    _field(page, "Name").fill("from_the_browser")
    page.get_by_role("button", name="Save as generic action").click()
    page.get_by_text("action 'from_the_browser'").first.wait_for()
    page.get_by_role("tab", name="Actions").click()
    second = context.new_page()
    second.goto(address)
    second.get_by_text("from_the_browser", exact=True).first.wait_for()
    second.close()
    stored = place / "config" / HAND / "actions" / "generic" / "from_the_browser.yaml"
    assert stored.is_file()


def test_stop_is_confirmed(page: Page) -> None:
    page.get_by_role("button", name="STOP").click()
    page.get_by_text("confirmed by").first.wait_for()


def test_a_killed_loop_is_said_plainly_and_a_new_one_goes_on(
    page: Page, place: Path, hands: list[Program]
) -> None:
    hands[-1].kill()
    page.get_by_text("Not connected").wait_for()
    hands.append(_hand(place))
    page.get_by_text(f"{HAND}: connected").wait_for()
    page.get_by_role("button", name="Do", exact=True).first.click()
    page.get_by_text("reached", exact=True).first.wait_for()
