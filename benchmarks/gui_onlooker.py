"""A window of the GUI without a display: receives all that a browser would, and draws nothing.

It represents a browser on another computer, whose drawing costs this one nothing::

    python benchmarks/gui_onlooker.py "http://127.0.0.1:8080/?token=..."
"""

from __future__ import annotations

import argparse
import contextlib
import http.client
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import msgspec.msgpack
import zstandard
from viser import __version__ as version
from websockets.sync.client import connect
from websockets.sync.connection import Connection
from websockets.typing import Origin, Subprotocol

_LARGEST = 2**26  # bytes of a frame that are accepted; a scene with meshes takes some 10 MB
_HEADER = 16  # bytes before the packed messages: two lengths of eight bytes

# The first message of a window, with fields as in viser's protocol.
_CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, 1.0),
    "fov": 1.3,
    "near": 0.01,
    "far": 1000.0,
    "image_height": 800,
    "image_width": 1280,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}


class Visit(NamedTuple):
    """A browser that a GUI has admitted; it may open any number of windows.

    Attributes:
        origin: The GUI's address without a token.
        cookie: Name and value of the cookie that the browser got.
    """

    origin: str
    cookie: str

    def cookies(self) -> list[dict[str, str]]:
        """Return the cookie as Playwright takes it."""
        name, _, value = self.cookie.partition("=")
        return [{"name": name, "value": value, "url": self.origin}]


def admitted(address: str) -> Visit:
    """Exchange an address that `rtee gui` has printed for a cookie, as a browser does."""
    found = urlsplit(address)
    with contextlib.closing(http.client.HTTPConnection(found.netloc, timeout=30)) as connection:
        connection.request("GET", f"{found.path}?{found.query}")
        answer = connection.getresponse()
    cookie = answer.getheader("Set-Cookie")
    if cookie is None:
        raise SystemExit(f"the GUI answers {answer.status}; each address opens one browser")
    return Visit(f"{found.scheme}://{found.netloc}", cookie.partition(";")[0])


@contextlib.contextmanager
def window(visit: Visit) -> Iterator[Connection]:
    """Connect as a browser's window does, for as long as the context lasts."""
    protocol = Subprotocol(f"viser-v{version}")
    with connect(
        f"ws://{urlsplit(visit.origin).netloc}/",
        origin=Origin(visit.origin),
        additional_headers={"Cookie": visit.cookie},
        subprotocols=[protocol],
        compression=None,
        max_size=_LARGEST,
        proxy=None,
        close_timeout=1.0,
    ) as connection:
        # The server takes a window for open when it first says where it looks from.
        connection.send(msgspec.msgpack.encode(_CAMERA))
        yield connection


def messages(frame: bytes) -> list[dict[str, Any]]:
    """Return the messages in a frame; arrays remain as their placeholders."""
    size, packed = (int.from_bytes(frame[at : at + 8], "little") for at in (0, 8))
    data = frame[_HEADER : _HEADER + packed]
    unpacked = zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
    found: list[dict[str, Any]] = msgspec.msgpack.decode(unpacked)["messages"]
    return found


def controls(connection: Connection, last: str = "Preview") -> list[dict[str, Any]]:
    """Return the messages that create the page's controls, until one with a label or an option."""
    found: list[dict[str, Any]] = []
    for frame in connection:
        news = messages(frame) if isinstance(frame, bytes) else []
        found += [message for message in news if "label" in message.get("props", ())]
        props = [message["props"] for message in found]
        if any(last == each["label"] or last in each.get("options", ()) for each in props):
            break
    return found


def stop(visit: Visit) -> None:
    """Press STOP in the bar above the page."""
    place = f"{visit.origin.replace('http', 'ws', 1)}/bar"
    with connect(
        place, origin=Origin(visit.origin), additional_headers={"Cookie": visit.cookie}, proxy=None
    ) as bar:
        bar.send("stop")
        bar.recv()


def use(connection: Connection, control: dict[str, Any], value: object = True) -> None:
    """Use a control as the page does: set its value, or click a button."""
    update = {"type": "GuiUpdateMessage", "uuid": control["uuid"], "updates": {"value": value}}
    connection.send(msgspec.msgpack.encode(update))


def kinds(frames: Iterable[bytes]) -> Counter[str]:
    """Return the number of messages in frames by kind; updates by the changed property."""
    found: Counter[str] = Counter()
    for frame in frames:
        for message in messages(frame):
            what = " ".join(sorted(message.get("updates", ())))
            found[f"{message['type']} {what}".rstrip()] += 1
    return found


def main() -> None:
    """Receive until ended; print the amount received in every second if asked to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("address", help="as `rtee gui` has printed it, or without its token")
    parser.add_argument("--cookie", help="of a browser that was admitted already")
    parser.add_argument("--tell", action="store_true", help="print frames and bytes per second")
    given = parser.parse_args()
    frames = size = 0
    due = time.monotonic() + 1.0
    visit = Visit(given.address, given.cookie) if given.cookie else admitted(given.address)
    with window(visit) as connection:
        for frame in connection:
            frames, size = frames + 1, size + len(frame)
            if given.tell and time.monotonic() >= due:
                due += 1.0
                print(f"{frames} frames, {size} bytes", flush=True)
                frames = size = 0


if __name__ == "__main__":
    main()
