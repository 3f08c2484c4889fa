"""The path of a stop: a socket of its own on this computer, a query without `hello` elsewhere.

The socket receives datagrams. It has no connections, sessions or handshakes that a client could
exhaust, and costs the hand one descriptor in all. The content of a datagram does not matter: each
one is a stop. File permissions decide who may send one, as for the socket of the network.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import secrets
import socket
import struct
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rtee import monotonic
from rtee.errors import NoHand
from rtee.hand.names import safe_name

SUFFIX = ".stop"
"""Suffix of the socket's path; the rest is the same as for the network's socket."""

CERTIFICATE = "certificate_"
"""Beginning of the name under which the hand's door passes a stop on; a common name follows."""

Stopped = Callable[[Mapping[str, Any]], object]
"""Called with the fields of a ``rtee_msgs/StopReply`` once the devices have stopped."""

_MODE = 0o660
"""Mode of the socket: its user and group may send stops if they may enter its folder, too."""

_LONGEST = 256
"""Longest datagram that is read [bytes]; a longer one is cut, and still is a stop."""

_BATCH = 32
"""Stops that are read one after the other; then comes a pause of `_PAUSE`."""

_PAUSE = 0.005
"""Pause after so many stops [s]: a flood must not keep Python's interpreter lock from the loop. The
first stop of a flood stops the hand; the others wait in the kernel for their answer."""

_LOOK_EVERY = 1.0
"""Interval of the checks that the socket's file still exists [s]."""

_AGAIN = 0.05
"""Time after which a client sends its stop again [s]."""

ANSWER_WITHIN = 1.0
"""Time to wait for the answer [s]: devices confirm within 0.15 s."""

_CREDENTIALS = struct.Struct("3i")
"""Process, user and group of a sender, as Linux passes them on."""


class StopSocket:
    """Receives the stops of this computer in a thread of its own.

    Args:
        path: The socket's file; one left by a killed process is replaced.
        stop: Called with the sender in words, and with what to call once the devices have stopped.
    """

    def __init__(self, path: Path, stop: Callable[[str, Stopped], object]) -> None:
        self._path, self._stop = path, stop
        self._socket = _bound(path)
        self._inode = path.lstat().st_ino
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"stop {path.stem}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Remove the socket; blocks for a moment."""
        self._ended.set()
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as own:
            own.setblocking(False)
            own.sendto(b"", str(self._path))  # wakes the thread
        self._thread.join()
        with contextlib.suppress(OSError):
            if self._is_there():
                self._path.unlink()
        self._socket.close()

    def _is_there(self) -> bool:
        try:
            return self._path.lstat().st_ino == self._inode
        except OSError:
            return False

    def _replace(self) -> None:
        """Recreate the socket after its file was removed."""
        with contextlib.suppress(OSError):
            new = _bound(self._path)
            old, self._socket, self._inode = self._socket, new, self._path.lstat().st_ino
            old.close()

    def _run(self) -> None:
        read = 0
        while not self._ended.is_set():
            try:
                data, passed, _, sender = self._socket.recvmsg(_LONGEST, socket.CMSG_SPACE(12))
            except TimeoutError:
                # A program that cleans temporary files may have removed it.
                if not self._is_there():
                    self._replace()
                continue
            except OSError:
                monotonic.sleep(_PAUSE)
                continue
            if self._ended.is_set():
                return
            name, _, client = data.decode(errors="replace").partition(" ")
            self._stop(_words(client, passed), partial(self._answer, name, sender))
            read += 1
            if read % _BATCH == 0:
                monotonic.sleep(_PAUSE)

    def _answer(self, name: str, client: Any, fields: Mapping[str, Any]) -> None:
        confirmed = dict(zip(fields["device"], map(bool, fields["confirmed"]), strict=True))
        answer = json.dumps({"to": name, "confirmed": confirmed})
        # The client may have left, or not read: do not wait for it.
        with contextlib.suppress(OSError, TypeError):
            self._socket.sendto(answer.encode(), socket.MSG_DONTWAIT, client)


def _bound(path: Path) -> socket.socket:
    with contextlib.suppress(FileNotFoundError):
        path.unlink()
    bound = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        if sys.platform == "linux":
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        bound.bind(str(path))
        bound.settimeout(_LOOK_EVERY)
        path.chmod(_MODE)  # it is made with the process's umask, which may be anything
    except BaseException:
        bound.close()
        raise
    return bound


def _words(client: str, passed: Sequence[tuple[int, int, bytes]]) -> str:
    """Describe the sender of a stop by its own name and the kernel's data."""
    name = safe_name(client, "a client")
    for level, _, data in passed:
        if level == socket.SOL_SOCKET and len(data) >= _CREDENTIALS.size:
            process, user, _ = _CREDENTIALS.unpack_from(data)
            return f"{name} (process {process} of user {user})"
    return name


def stop_path(endpoint: str) -> Path | None:
    """Return the file of a hand's stop socket by its endpoint on this computer."""
    protocol, _, path = endpoint.partition("/")
    return Path(path).with_suffix(SUFFIX) if protocol == "unixsock-stream" else None


def stop_at(path: Path, hand: str, client: str, within: float = ANSWER_WITHIN) -> dict[str, bool]:
    """Stop the hand with a stop socket; return whether each device has confirmed. Blocks.

    Raises `NoHand` without an answer within the time [s], `OSError` if there is no such socket.
    """
    name = secrets.token_hex(8)
    with _client(path) as sender:
        sender.settimeout(_AGAIN)
        for _ in range(math.ceil(within / _AGAIN)):
            # Again and again, since a datagram may be lost while the hand replaces its socket.
            with contextlib.suppress(TimeoutError, ValueError, KeyError, TypeError, AttributeError):
                sender.send(f"{name} {client}".encode())
                answer = json.loads(sender.recv(65536))
                if answer["to"] == name:
                    return {str(k): bool(v) for k, v in answer["confirmed"].items()}
    raise silent(hand)


def silent(hand: str) -> NoHand:
    """Return the error of a stop that was not answered."""
    return NoHand(f"the hand '{hand}' does not confirm the stop: use the emergency stop")


@contextlib.contextmanager
def _client(path: Path) -> Iterator[socket.socket]:
    """Open a socket that only the hand can answer, since it is connected to the hand's socket."""
    with contextlib.ExitStack() as stack:
        client = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
        if sys.platform == "linux":
            client.bind("")  # the kernel chooses a name, without a file
        else:
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="rtee-"))
            client.bind(os.path.join(folder, "answer"))
        client.connect(str(path))
        yield client
