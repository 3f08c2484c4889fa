"""The page for headsets, with a scripted session in Chromium."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pytest
import viser
from remote.served_leap import served
from remote.serving import Served

from rtee.cli.teleop import follow_headset
from rtee.gui.access import Access, PageRole
from rtee.gui.visitors import Visitors
from rtee.retarget import LAYOUTS
from rtee.testing.human_hand import HumanHand

from .marks import in_a_browser

if TYPE_CHECKING:
    from playwright.sync_api import BrowserContext, Page

__all__ = ["served"]

pytestmark = in_a_browser

XR = """
window.joints = POINTS;
window.XRWebGLLayer = class {};
const hand = { values: () => window.joints.map((_, k) => k) };
class Session {
  inputSources = [{ handedness: "right", hand }];
  async updateRenderState() {}
  async requestReferenceSpace() { return {}; }
  requestAnimationFrame(seen) {
    const getJointPose = (k) => {
      const [x, y, z] = window.joints[k];
      return { transform: { position: { x, y, z } } };
    };
    setTimeout(() => { if (!this.over) seen(performance.now(), { getJointPose }); }, 20);
  }
  async end() {
    if (!this.over) { this.over = true; this.onend(); }
  }
}
Object.defineProperty(navigator, "xr", { value: {
  requestSession: async () => (window.session = new Session()),
} });
"""


def joints(curls: float) -> list[list[float]]:
    """Return the joints of an XRHand [m]."""
    points = HumanHand().points((curls,) * 5)
    layout = LAYOUTS["webxr"]
    found = np.zeros((layout.count, 3))
    found[[part[0] for part in layout.order]] = points
    return [[float(value) for value in row] for row in found]


@pytest.fixture
def server() -> Iterator[tuple[viser.ViserServer, Access]]:
    access = Access(observers=True)
    follow = partial(follow_headset, hand="leap_hand", endpoint=None)
    server = Visitors(access, follow).open_server(0)
    yield server, access
    server.stop()


@pytest.fixture
def page(
    served: Served, server: tuple[viser.ViserServer, Access], context: BrowserContext
) -> Iterator[Page]:
    with ExitStack() as stack:
        page = context.new_page()
        stack.callback(page.close)
        page.add_init_script(XR.replace("POINTS", json.dumps(joints(0.0))))
        port = server[0].get_port()
        page.goto(server[1].links(port)[PageRole.OPERATOR])
        page.goto(f"http://127.0.0.1:{port}/headset")
        yield page


def test_a_session_moves_the_hand_and_ends(page: Page, served: Served) -> None:
    page.get_by_role("button", name="Start").click()
    page.wait_for_function("document.getElementById('status').textContent.includes('follows')")
    page.evaluate(f"window.joints = {json.dumps(joints(0.6))}")
    middle = served.loop.hand.actuator_index("middle_mcp_forward")
    # It stays closed until the session's end.
    while served.loop.controller.reference_position[middle] < 0.3:
        page.wait_for_timeout(50)
    page.evaluate("window.session.end()")
    while served.loop.controller.stream is not None:
        page.wait_for_timeout(50)
    assert "ended" in (page.get_by_role("status").text_content() or "")


def test_a_hand_that_is_none_is_told(page: Page, served: Served) -> None:
    page.evaluate("window.joints = window.joints.slice(0, 20)")
    page.get_by_role("button", name="Start").click()
    page.wait_for_function("document.getElementById('status').textContent.includes('25 points')")
    assert served.loop.controller.stream is None


def test_who_watches_gets_no_page(
    server: tuple[viser.ViserServer, Access], context: BrowserContext
) -> None:
    port, page = server[0].get_port(), context.new_page()
    page.goto(server[1].links(port)[PageRole.OBSERVER])
    answer = page.goto(f"http://127.0.0.1:{port}/headset")
    assert answer is not None
    assert answer.status == 403
    page.close()
