"""The GUI's page as a person sees it: controls by what they are called."""

from __future__ import annotations

import io
import re
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from .running import PATIENCE

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

Picture = NDArray[np.int16]

CLEAR, SHARE = 10, 0.004
"""Pictures differ where this share of the pixels differs by more than this, of 255."""

_NOTE_WHAT_IS_SENT = """
window.sent = [];
const post = Worker.prototype.postMessage;
Worker.prototype.postMessage = function (data, ...more) {
  if (data?.message?.updates) window.sent.push(String(data.message.updates.value));
  return post.call(this, data, ...more);
};
window.clicks = 0;
addEventListener("click", (event) => (window.clicks += event.isTrusted), true);
window.stops = 0;
window.kept = false;
const send = WebSocket.prototype.send;
WebSocket.prototype.send = function (data) {
  if (data === "stop") window.stops++;
  if (data !== "stop" || !window.kept) send.call(this, data);
};
"""
"""Notes values, clicks and stops; the latter are kept from the GUI at will."""

_UNFOLDED = """
(folder) => {
  const height = folder.offsetHeight;
  return new Promise((done) => setTimeout(() => done(folder.offsetHeight === height), 250));
}
"""
"""Whether a folder has the height that it had 250 ms ago; it unfolds in 200."""

_DRAW = """
async () => {
  window.drawing = true;
  const after = (seconds) => new Promise((go) => setTimeout(go, 1000 * seconds));
  await after(0.1);
  for (let frame = 0; frame < 2; frame++)
    await Promise.race([new Promise(window.requestAnimationFrame), after(10)]);
}
"""
"""Draws the 3D view as it is now: the frame that was waiting, then one, and what follows it.

A browser may owe a frame until the picture is taken, which makes it draw one."""

_ROOM = """
(control) => {
  const right = (each) => each.getBoundingClientRect().right;
  let room = window.innerWidth - right(control);
  for (let each = control; (each = each.parentElement); )
    if (getComputedStyle(each).overflowX !== "visible")
      room = Math.min(room, right(each) - right(control));
  return Math.round(room);
}
"""

ROW = "xpath=ancestor::div[contains(@class, 'mantine-Flex-root')][1]"


class Window:
    """A browser's window on the GUI."""

    def __init__(self, page: Page, address: str) -> None:
        self.page = page
        page.add_init_script(_NOTE_WHAT_IS_SENT)
        self.address = address

    def open(self, hand: str) -> None:
        """Open the page and wait for a hand."""
        self.page.goto(self.address)
        self.page.get_by_text(f"{hand}: connected").wait_for()
        self.button("Run").first.wait_for()
        self.page.locator(".mantine-Notification-closeButton").first.click()

    def show(self, hand: str, link: str | re.Pattern[str] = "") -> None:
        """Choose a hand and its actions, unless they are shown; wait for what is said of it."""
        if not self.page.title().startswith(f"{hand}:"):
            self.choose("Hand", hand)
        self.page.get_by_text(link or f"{hand}: connected").first.wait_for()
        self.tab("Actions")
        self.button("Run").first.wait_for()
        if self.field("Search").input_value():
            self.field("Search").fill("")

    def tab(self, name: str) -> None:
        """Choose a tab."""
        self.page.get_by_role("tab", name=name).click()

    def folder(self, name: str, within: Locator | None = None, *, unfold: bool = False) -> Locator:
        """Return a folder with what is in it."""
        label = (within or self.page).locator("div.mantine-Paper-root > div.mantine-Paper-root")
        label = label.filter(has_text=re.compile(f"^{re.escape(name)}$")).first
        folder = label.locator("xpath=..")
        if unfold:
            label.wait_for()
            if label.locator(".tabler-icon-chevron-down").count():
                label.click()
                folder.locator("label:visible, button:visible").first.wait_for()
                # A click on what still moves is lost if it has moved before the button is up.
                self.wait(folder, _UNFOLDED)
            folder.locator("label:visible, button:visible").first.wait_for()
        return folder

    def button(self, name: str, within: Locator | None = None) -> Locator:
        """Return the visible buttons of a name."""
        return (within or self.page).get_by_role("button", name=name, exact=True)

    def field(self, label: str, within: Locator | None = None) -> Locator:
        """Return the first visible field with a label."""
        found = (within or self.page).locator("label:visible").filter(has_text=label).first
        return found.locator(ROW).locator("input:not([type=hidden])").last

    def type(self, label: str, text: str, within: Locator | None = None) -> None:
        """Type something into a field, enter it, and wait until the page has sent it."""
        field = self.field(label, within)
        if field.input_value() == text:
            return
        sent = self.page.evaluate("window.sent.length")
        enter(field, text)
        self.page.wait_for_function(
            "([sent, text]) => window.sent.slice(sent).includes(text)", arg=[sent, text]
        )

    def choose(self, label: str, option: str, within: Locator | None = None) -> None:
        """Choose an option of a dropdown; open it again if something has closed it."""
        from playwright.sync_api import TimeoutError as NotThere

        wanted = self.page.get_by_role("option", name=option, exact=True)
        field = self.field(label, within)
        end = time.monotonic() + PATIENCE
        while True:
            # In the middle of the panel: at its edge, the heading of a folder may lie over it.
            field.evaluate("(each) => each.scrollIntoView({block: 'center'})")
            try:
                field.click(timeout=4000)
                return wanted.click(timeout=4000)
            except NotThere:
                if time.monotonic() > end:
                    raise

    def says(self, text: str | re.Pattern[str], within: Locator | None = None) -> Locator:
        """Wait until something is said that stays; returns where."""
        found = (within or self.page).get_by_text(text).locator("visible=true").first
        found.wait_for()
        return found

    def clicks(self) -> int:
        """Return how often something was clicked since the last call."""
        return int(self.page.evaluate("[window.clicks, (window.clicks = 0)][0]"))

    def told(self, text: str | re.Pattern[str]) -> None:
        """Wait until a notification has said something since `forget`; it may have closed."""
        told(self.page, text)

    def until(self, true: Callable[[], bool]) -> None:
        """Wait until something is true that stays so, or comes again."""
        _until(self.page, true)

    def status(self, text: str | re.Pattern[str]) -> None:
        """Wait until the bar, or the lines below Open hand, say something."""
        self.page.locator("[role=status]").filter(has_text=text).first.wait_for()

    def room(self, control: Locator) -> float:
        """Return how far a control is from the edge of what shows it [CSS px]; < 0: cut off."""
        return float(control.evaluate(_ROOM))

    def wait(self, control: Locator, condition: str) -> None:
        """Wait until something is true of a control: a JavaScript function of it."""
        self.page.wait_for_function(condition, arg=control.element_handle())

    def forget(self) -> None:
        """Close the notifications, wait until they have gone, and forget what they said."""
        close = "document.querySelectorAll('.mantine-Notification-closeButton')"
        self.page.evaluate("window.told = []")
        self.page.wait_for_function(f"[...{close}].map(each => each.click()).length === 0")

    def picture(self) -> Picture:
        """Return what the middle of the 3D view shows ``(h, w, 3)``, once it shows something."""
        found = self._picture()
        while (found == found[0, 0]).all():
            found = self._picture()
        return found

    def _picture(self) -> Picture:
        area = {"x": 380.0, "y": 160.0, "width": 160.0, "height": 340.0}
        self.page.evaluate(_DRAW)
        data = self.page.screenshot(clip=area)  # type: ignore[arg-type]
        self.page.evaluate("window.drawing = false")
        with Image.open(io.BytesIO(data)) as image:
            return np.asarray(image.convert("RGB"), dtype=np.int16)

    def pictured_anew(self, before: Picture) -> Picture:
        """Wait until the 3D view shows something clearly different."""
        now = before

        def differs() -> bool:
            nonlocal now
            now = self.picture()
            return bool((np.abs(now - before).max(axis=2) > CLEAR).mean() > SHARE)

        _until(self.page, differs)
        return now


def enter(field: Locator, text: str) -> None:
    """Type something into a number field, and enter it; wait until the page has left the field."""
    field.fill(text)
    field.press("Enter")
    # It leaves a moment later, and what is typed by then would count as left, too.
    field.evaluate("field => new Promise((done) => setTimeout(done))")


def told(page: Page, text: str | re.Pattern[str]) -> None:
    """Wait until a notification of a page has said something; it may have closed."""
    pattern = text.pattern if isinstance(text, re.Pattern) else re.escape(text)
    _until(page, lambda: any(re.search(pattern, each) for each in page.evaluate("window.told")))


def _until(page: Page, true: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE
    while not true():
        assert time.monotonic() < end, f"not within {PATIENCE:.0f} s"
        page.wait_for_timeout(50)
