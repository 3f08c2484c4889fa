"""The bar above the page, with the hand's present state and STOP.

The server inserts it into viser's page. It has its own WebSocket, so that no folded panel, dialog
or loss of viser's connection removes it. If messages stop, the page itself reports that it has lost
the GUI.
"""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import json
import re
from functools import lru_cache
from pathlib import Path
from typing import Final, Protocol

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Response

PATH: Final = "/bar"
"""Path of the WebSocket."""

_PERIOD: Final = 0.2
"""Time between two checks of the state [s]; a page without messages for several of them reports the
loss."""

_BEAT: Final = 3
"""Number of checks after which a message is sent even if nothing has changed, as a heartbeat."""

_BUTTONS: Final = re.compile(r"stop|live|narrow|time [0-9]{1,9}\.[0-9]{3}")
"""A command of a page; ``time`` is the time of a recording at the pointer [s]."""

_PARTS: Final = "".join(
    f"<{tag}>{Path(__file__).with_name(name).read_text(encoding='utf-8')}</{tag}>"
    for tag, name in (
        ("style", "bar.css"),
        ("script", "bar.js"),
        ("script", "fields.js"),
        ("script", "plots.js"),
    )
)


class Desk(Protocol):
    """Text and buttons of the bar; called in the server's thread."""

    def words(self, key: str) -> dict[str, object]:
        """Return the text of the bar of the window with this key, which may be empty at first."""
        ...

    def press(self, button: str, key: str) -> None:
        """Execute a command: ``stop``, ``narrow``, or show the hand ``live`` or at a ``time``."""
        ...


@lru_cache(maxsize=2)
def _with_bar(body: bytes, encoding: str) -> bytes:
    page = gzip.decompress(body) if encoding == "gzip" else body
    page = page.replace(b"</title>", b"</title>" + _PARTS.encode(), 1)
    return gzip.compress(page) if encoding == "gzip" else page


def put_into(response: Response) -> None:
    """Put the bar into a response with viser's page."""
    if response.headers.get("Content-Type", "").startswith("text/html"):
        encoding = response.headers.get("Content-Encoding", "")
        response.body = _with_bar(bytes(response.body), encoding)
        del response.headers["Content-Length"]
        response.headers["Content-Length"] = str(len(response.body))


async def handle(connection: ServerConnection, desk: Desk) -> None:
    """Send the state to a page until it is gone; receive its window's key and buttons."""
    key = ""

    async def listen() -> None:
        nonlocal key
        with contextlib.suppress(ConnectionClosed):  # the page has gone without closing
            async for message in connection:
                message = str(message)
                if _BUTTONS.fullmatch(message):
                    desk.press(message, key)
                else:
                    key = message

    listening = asyncio.ensure_future(listen())
    told, since = "", _BEAT
    with contextlib.suppress(ConnectionClosed):
        while not listening.done():
            words = json.dumps(desk.words(key))
            since += 1
            if words != told or since >= _BEAT:
                await connection.send("" if words == told else words)
                told, since = words, 0
            await asyncio.sleep(_PERIOD)
    listening.cancel()
