"""A relay before the GUI that keeps the frames sent to a window over its websocket."""

from __future__ import annotations

import contextlib
import socket
import threading
from types import TracebackType
from urllib.parse import urlsplit

from gui_onlooker import Visit


def split(data: bytes) -> tuple[list[bytes], bytes]:
    """Return the payloads of the whole websocket frames in data from a server, and the rest."""
    found: list[bytes] = []
    at = 0
    while len(data) >= at + 2:
        length, head = data[at + 1] & 0x7F, 2
        # 126 and 127 announce a length of 2 or 8 bytes (RFC 6455, section 5.2).
        if length >= 126:
            wide = 2 if length == 126 else 8
            head += wide
            length = int.from_bytes(data[at + 2 : at + head], "big")
        if len(data) < at + head + length:
            break
        if data[at] & 0x0F == 2:  # binary
            found.append(data[at + head : at + head + length])
        at += head + length
    return found, data[at:]


class Relay:
    """Passes all data on in both directions while the context lasts.

    Attributes:
        visit: A browser whose windows connect through it.
    """

    def __init__(self, visit: Visit) -> None:
        """Prepare a relay for a browser in a GUI."""
        place = urlsplit(visit.origin)
        self._target = (str(place.hostname), int(place.port or 80))
        self._server = socket.create_server(("127.0.0.1", 0))
        own = f"http://127.0.0.1:{self._server.getsockname()[1]}"
        self.visit = visit._replace(origin=own)
        self._sockets: list[socket.socket] = [self._server]
        self._frames: list[bytes] = []

    def __enter__(self) -> Relay:
        """Begin."""
        threading.Thread(target=self._accept, daemon=True).start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End; closes all connections."""
        for each in self._sockets:
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()

    def take(self) -> list[bytes]:
        """Return the frames received since the last call."""
        frames, self._frames = self._frames, []
        return frames

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                window = self._server.accept()[0]
                gui = socket.create_connection(self._target)
                self._sockets += (window, gui)
                for source, sink, keep in ((window, gui, False), (gui, window, True)):
                    threading.Thread(
                        target=self._pass_on, args=(source, sink, keep), daemon=True
                    ).start()

    def _pass_on(self, source: socket.socket, sink: socket.socket, keep: bool) -> None:
        head, rest = b"", b""
        with contextlib.suppress(OSError):
            while data := source.recv(1 << 16):
                sink.sendall(data)
                if not keep:
                    continue
                if b"\r\n\r\n" not in head:
                    head += data
                    start, found, data = head.partition(b"\r\n\r\n")
                    if not found:
                        continue
                    # Only a connection that switches to the websocket protocol carries frames.
                    keep = b" 101 " in start.splitlines()[0]
                frames, rest = split(rest + data)
                self._frames += frames
            sink.shutdown(socket.SHUT_WR)
