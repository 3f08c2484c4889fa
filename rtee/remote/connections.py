"""The sockets that Zenoh opens in this process: their number, their users and their closing.

Zenoh accepts every permitted client, does not limit the sessions of one user, and does not report
the sender of a message. Its sockets are open files of this process: they are found among these, and
shut down when a user has too many. A client proves its user by a socket of its own when it says
hello.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import resource
import socket
import struct
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import zenoh

from rtee.remote.directory import peer_of
from rtee.remote.rates import CONNECTIONS_OF_USER

_TOGETHER = 0.25
"""Time between a new connection and a check of all [s]."""

_LINGER = (socket.SOL_SOCKET, socket.SO_LINGER)

_ZENOH_LINGER = struct.pack("ii", 1, 10)
"""SO_LINGER as Zenoh sets it: on, 10 s."""

_NO_LINGER = struct.pack("ii", 0, 0)
"""SO_LINGER off: closing a socket returns at once."""


def _connected() -> Iterator[tuple[socket.socket, Any]]:
    """Return the connected sockets of this process, each with its other side.

    Each is a duplicate, which shares the socket; closing it does not close the socket.
    """
    folder = Path("/dev/fd")
    for name in os.listdir(folder) if folder.is_dir() else ():
        with contextlib.suppress(OSError):  # closed since, not a socket, or not connected
            if not (folder / name).is_socket():
                continue
            with socket.socket(fileno=os.dup(int(name))) as link:
                if link.type == socket.SOCK_STREAM:
                    yield link, link.getpeername()


def disable_linger() -> None:
    """Make this process close connections without waiting for unsent data.

    Zenoh sets SO_LINGER to 10 s and closes sockets in its receiving thread. Closing the connection
    of a client that froze with unread data would therefore block the requests of all others for
    10 s; ``tests/remote/test_remote_lost.py`` shows it. Zenoh has no setting for this.
    """
    for link, _ in _connected():
        _lingers_no_more(link)


def _lingers_no_more(link: socket.socket) -> None:
    if link.getsockopt(*_LINGER, len(_ZENOH_LINGER)) == _ZENOH_LINGER:
        link.setsockopt(*_LINGER, _NO_LINGER)


def raise_file_limit() -> int:
    """Raise the limit of open files to the hard limit; return it, -1 for no limit."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != hard:
        # Refused where the system's own limit is lower than the hard one.
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
            soft = hard
    return soft


class Connections:
    """Limits each user's connections through a Unix socket; disables lingering on the others.

    Its own thread checks them shortly after new ones have appeared.
    """

    def __init__(self, session: zenoh.Session, path: str) -> None:
        """Watch the connections of a Zenoh session and of its Unix socket at a path."""
        self._path = path
        self._new, self._ended = threading.Event(), threading.Event()
        told: zenoh.handlers.Callback[zenoh.LinkEvent] = zenoh.handlers.Callback(
            lambda _: self._new.set(), indirect=False
        )
        self._listener = session.info.declare_link_events_listener(told)
        self._thread = threading.Thread(target=self._run, name="connections", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread; blocks for a moment."""
        self._ended.set()
        self._new.set()
        self._thread.join()
        self._listener.undeclare()  # type: ignore[no-untyped-call]

    def _run(self) -> None:
        while True:
            self._new.wait()
            # Checked together, so that many new connections take little time of the interpreter.
            self._ended.wait(_TOGETHER)
            self._new.clear()
            if self._ended.is_set():  # asked last: `close` may have come before the line above
                return
            with contextlib.suppress(OSError):  # too many files are open
                self._look()

    def _look(self) -> None:
        held: dict[int, list[int]] = {}
        for link, _ in _connected():
            _lingers_no_more(link)
            if link.family == socket.AF_UNIX and link.getsockname() == self._path:
                held.setdefault(_user(link), []).append(_inode(link))
        # The newest ones: the kernel numbers sockets in the order in which they are made.
        surplus = {
            inode for links in held.values() for inode in sorted(links)[CONNECTIONS_OF_USER:]
        }
        for link, _ in _connected() if surplus else ():
            if _inode(link) in surplus:
                link.shutdown(socket.SHUT_RDWR)


@contextlib.contextmanager
def vouching(token: str) -> Iterator[None]:
    """Let a hand on this computer find out with `user_of` whose process declared a token."""
    with contextlib.ExitStack() as stack:
        if sys.platform == "linux":
            listener = stack.enter_context(socket.socket(socket.AF_UNIX))
            listener.bind(_voucher(token))
            listener.listen(8)
        yield


def user_of(token: str) -> int:
    """Return the user whose process is `vouching` for a token; -1 if no process is."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as link:
        link.setblocking(False)
        link.connect(_voucher(token))
        return _user(link)
    return -1


def _voucher(token: str) -> str:
    # Everybody can list the names of sockets without a file, and a token's name is a secret.
    return "\0rtee-" + hashlib.sha256(token.encode()).hexdigest()[:32]


def _inode(link: socket.socket) -> int:
    """Return the number of a socket, which its duplicates share."""
    return os.fstat(link.fileno()).st_ino


def _user(link: socket.socket) -> int:
    """Return the user at the other side of a Unix socket."""
    if sys.platform != "linux":
        return -1
    return peer_of(link)[1]
