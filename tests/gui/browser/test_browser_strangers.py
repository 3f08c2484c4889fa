"""Strangers at the GUI: pages of other origins, rebound names, frames, observers, HTML in names."""

from __future__ import annotations

import http.server
import threading
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import msgspec.msgpack
import pytest
import viser
from websockets.exceptions import InvalidStatus

from benchmarks.gui_onlooker import _CAMERA, Visit, admitted, controls, messages, use
from benchmarks.gui_onlooker import stop as press_stop
from benchmarks.gui_onlooker import window as window_of
from rtee.remote.blocking import BlockingHand

from .conftest import REBOUND, Links
from .marks import in_a_browser
from .running import GRIPPER, Program
from .window import Window, told

if TYPE_CHECKING:
    from playwright.sync_api import BrowserContext, Page

pytestmark = in_a_browser

PAGE = """<!doctype html><title>waiting</title><iframe src="{frame}"></iframe><script>
fetch("/camera").then((answer) => answer.arrayBuffer()).then((camera) => {{
  const socket = new WebSocket("{target}", ["viser-v{version}"]);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => {{ document.title = "connected"; socket.send(camera); }};
  socket.onmessage = async (event) => {{
    const answer = await fetch("/frame", {{method: "POST", body: event.data}});
    const order = await answer.arrayBuffer();
    if (order.byteLength) {{ socket.send(order); document.title = "pressed"; }}
  }};
  socket.onclose = () => {{ if (document.title === "waiting") document.title = "refused"; }};
}});
</script>"""


class Stranger:
    """A foreign website; its page presses a button of the GUI as soon as it sees one."""

    def __init__(self, button: str) -> None:
        self.target = self.frame = ""
        stranger = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                if self.path == "/camera":
                    self.answer(msgspec.msgpack.encode(_CAMERA))
                else:
                    self.answer(stranger.page().encode(), "text/html")

            def do_POST(self) -> None:
                frame = self.rfile.read(int(self.headers["Content-Length"]))
                order = b""
                for message in messages(frame):
                    if message.get("props", {}).get("label") == button:
                        update = {"uuid": message["uuid"], "updates": {"value": True}}
                        order = msgspec.msgpack.encode({"type": "GuiUpdateMessage", **update})
                self.answer(order)

            def answer(self, body: bytes, kind: str = "application/octet-stream") -> None:
                self.send_response(200)
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_: object) -> None:
                pass

        self._server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.port = self._server.server_address[1]
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def page(self) -> str:
        return PAGE.format(target=self.target, frame=self.frame, version=viser.__version__)

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


@pytest.fixture
def stranger(only_window: Window) -> Iterator[Stranger]:
    found = Stranger("Grasp")
    gui = urlsplit(only_window.address).netloc
    found.target, found.frame = f"ws://{gui}", f"http://{gui}/"
    yield found
    found.close()


@pytest.fixture
def page(only_window: Window, context: BrowserContext) -> Iterator[Page]:
    """Another tab of a browser that may use the GUI, which shows the gripper to every window."""
    only_window.show(GRIPPER)
    found = context.new_page()
    yield found
    found.close()
    only_window.page.bring_to_front()


def test_the_stranger_presses_open_where_nobody_asks(page: Page, stranger: Stranger) -> None:
    """The attack works against viser's own server: the tests below would notice if it did."""
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    pressed = threading.Event()
    try:
        server.gui.add_button("Grasp").on_click(lambda _: pressed.set())
        stranger.target = f"ws://127.0.0.1:{server.get_port()}"
        page.goto(f"http://localhost:{stranger.port}/")
        page.wait_for_function("document.title === 'pressed'")
        assert pressed.wait(30)
    finally:
        server.stop()


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1"])
def test_a_page_of_another_origin_cannot_connect(
    host: str, page: Page, stranger: Stranger, other: BlockingHand
) -> None:
    # From 127.0.0.1 at another port the browser even sends the cookie.
    said: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    assert other.do("PinchTight", intensity=0.5).reached
    before = other.state().position
    page.goto(f"http://{host}:{stranger.port}/")
    page.wait_for_function("document.title === 'refused'")
    until_told(page, said, "403")
    assert other.state().position == pytest.approx(before, abs=0.05)


def test_a_page_of_a_rebound_name_cannot_connect(
    page: Page, stranger: Stranger, only_window: Window
) -> None:
    port = urlsplit(only_window.address).port
    answer = page.goto(f"http://{REBOUND}:{port}/")
    assert answer is not None
    assert answer.status == 421
    # A page of the stranger's server under that name; the host is judged before the origin.
    stranger.target = f"ws://{REBOUND}:{port}"
    said: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    page.goto(f"http://{REBOUND}:{stranger.port}/")
    page.wait_for_function("document.title === 'refused'")
    until_told(page, said, "421")


def until_told(page: Page, said: list[str], status: str) -> None:
    """Wait until the console says with which status a WebSocket was refused, after the event."""
    while not any(status in text for text in said if "WebSocket" in text):
        page.wait_for_timeout(20)


def test_the_page_cannot_be_framed(page: Page, stranger: Stranger) -> None:
    page.goto(f"http://127.0.0.1:{stranger.port}/")
    page.wait_for_function("document.title === 'refused'")
    assert page.frames[1].url.startswith("chrome-error:")


def test_another_server_cannot_be_shown_in_its_place(page: Page, only_window: Window) -> None:
    place = only_window.address.split("?")[0]
    page.goto(f"{place}?websocket=ws://{REBOUND}:1&playbackPath=x&darkMode")
    assert page.url == f"{place}?darkMode="


def test_nobody_opens_it_without_a_cookie(only_window: Window) -> None:
    found = urlsplit(only_window.address)
    cookie = f"rtee_{found.port}"
    for given in ("", f"{cookie}=wrong", f"other=1; {cookie}=", f"{cookie}={found.query[6:]}"):
        with (
            pytest.raises(InvalidStatus, match="403"),
            window_of(Visit(f"http://{found.netloc}", given)),
        ):
            pass


@pytest.mark.heavy
def test_an_address_of_the_history_opens_nothing_elsewhere(
    page: Page, only_window: Window, links: Links
) -> None:
    """The token stayed in the browser's history, and opened the GUI to whoever read it there."""
    link = links.operator()
    answer = page.goto(link)
    page.get_by_text(f"{GRIPPER}: connected").wait_for()
    assert answer is not None
    assert answer.headers["referrer-policy"] == "no-referrer"
    assert "token" not in page.url
    assert "token" not in page.evaluate("document.referrer")
    with pytest.raises(SystemExit, match="403"):
        admitted(link)  # as another browser that got it
    page.goto(link)  # in the same one it is a bookmark like any other
    page.get_by_text(f"{GRIPPER}: connected").wait_for()
    assert "token" not in page.url


@pytest.mark.heavy
def test_it_opens_again_in_another_tab_and_after_a_reload(page: Page, only_window: Window) -> None:
    page.goto(only_window.address.split("?")[0])
    page.get_by_text(f"{GRIPPER}: connected").wait_for()
    page.reload()
    page.get_by_text(f"{GRIPPER}: connected").wait_for()
    assert "token" not in page.url
    # By its port, since a browser keeps those of other GUIs on this computer, too.
    own = f"rtee_{urlsplit(page.url).port}"
    kept = [each for each in page.context.cookies(page.url) if each.get("name") == own]
    assert [(each.get("httpOnly"), each.get("sameSite")) for each in kept] == [(True, "Strict")]


@pytest.mark.heavy
def test_a_link_elsewhere_opens_it(page: Page, stranger: Stranger, links: Links) -> None:
    page.goto(f"http://localhost:{stranger.port}/")
    page.evaluate("link => { window.location.href = link }", links.operator())
    page.get_by_text(f"{GRIPPER}: connected").wait_for()


def test_nobody_makes_a_tunnel(gui: Program, links: Links) -> None:
    visit = admitted(links.operator())
    with window_of(visit) as asking:
        there = {found["props"]["label"]: found for found in controls(asking)}
        asking.send(msgspec.msgpack.encode({"type": "ShareUrlRequest"}))
        use(asking, there["Search"], "nothing")  # hides all cards, once the request is done
        for frame in asking:
            assert isinstance(frame, bytes)
            told = messages(frame)
            assert "ShareUrlUpdated" not in {message["type"] for message in told}
            if any(message.get("updates", {}).get("visible") is False for message in told):
                break
    assert gui.process.poll() is None


def test_html_in_a_panel_runs_nothing(page: Page) -> None:
    """Names are escaped; and if one were not, the page's policy would stop its script."""
    from rtee.gui.access import Access, PageRole
    from rtee.gui.visitors import Visitors

    access = Access()
    server = Visitors(access).open_server(0)
    try:
        server.gui.add_html('<p>seen</p><img src="x" onerror="window.owned = true">')
        said: list[str] = []
        page.on("console", lambda message: said.append(message.text))
        page.goto(access.links(server.get_port())[PageRole.OPERATOR])
        page.get_by_text("seen").wait_for()
        page.wait_for_function("document.images.length && document.images[0].complete")
        assert page.evaluate("window.owned") is None
    finally:
        server.stop()


# --- observers


def _by_name(found: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the messages that create controls by label, and by the names of their buttons."""
    props = [(each, each["props"]) for each in found]
    return {name: each for each, has in props for name in (has["label"], *has.get("options", ()))}


def test_an_observer_sees_and_stops_only(page: Page, links: Links, other: BlockingHand) -> None:
    page.goto(links.observer())
    page.get_by_text(f"{GRIPPER}: connected").wait_for()
    page.get_by_text("View only. STOP works.").wait_for()
    of = "each => getComputedStyle(each).pointerEvents"
    for name in ("Open hand", "Run", "Preview"):
        button = page.get_by_role("button", name=name, exact=True).first
        button.wait_for()
        assert button.evaluate(of) == "none"
    # A script of their own reaches the server, which takes only the stop.
    assert other.do("PinchTight", intensity=0.5).reached
    before = other.state().position
    visit = admitted(links.observer())
    with window_of(visit) as connection:
        there = _by_name(controls(connection))
        use(connection, there["Open hand"], "Open hand")
        use(connection, there["Jog (holds the hand)"])
        press_stop(visit)
        told(page, "; confirmed")
    page.evaluate("window.told = []")
    page.get_by_role("button", name="STOP").click()
    told(page, "; confirmed")
    assert other.status().holder == ""
    assert other.state().position == pytest.approx(before, abs=0.05)
    page.goto(links.operator())  # the browser keeps one cookie
    page.get_by_text(f"{GRIPPER}: connected").wait_for()
    with window_of(admitted(links.operator())) as connection:
        there = _by_name(controls(connection))
        use(connection, there["Open hand"], "Open hand")
        while abs(other.state().position - before).max() < 1e-2:
            page.wait_for_timeout(50)
