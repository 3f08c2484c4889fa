"""The page for headsets: a person's hand in WebXR moves the robot hand over a WebSocket."""

from __future__ import annotations

import json
from collections.abc import AsyncIterable, AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Final
from urllib.parse import parse_qs

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from rtee.errors import RteeError

PATH: Final = "/headset"
"""The page's path, and that of its WebSocket."""

PAGE: Final = Path(__file__).with_name("headset.html").read_text(encoding="utf-8")
"""The HTML page, which sends the 25 joints of an XRHand in each frame of a session."""

Follow = Callable[[AsyncIterable[str], str], Awaitable[None]]
"""Moves the hand from JSON lines, the frames of a person's left or right hand, until they end."""


async def handle(connection: ServerConnection, follow: Follow) -> None:
    """Let the frames of a page move the hand; send the page the error if this fails."""
    path = "" if connection.request is None else connection.request.path
    side = parse_qs(path.partition("?")[2]).get("side", ["right"])[0]
    try:
        await follow(_lines(connection), side)
    except RteeError as error:
        await connection.send(json.dumps({"error": str(error)}))


async def _lines(connection: ServerConnection) -> AsyncIterator[str]:
    """Yield the text messages of a page until the page has gone."""
    try:
        while True:
            message = await connection.recv()
            yield message if isinstance(message, str) else ""
    except ConnectionClosed:
        return
