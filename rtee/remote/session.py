"""Zenoh sessions as rtee opens them: loopback, no scouting, dead peers noticed within a second."""

from __future__ import annotations

import contextlib
import json
import os
import re
import socket
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import zenoh

from rtee.errors import ConfigError, NoHand

RUNTIME = "(rx:(worker_threads:1),tx:(worker_threads:1)"
RUNTIME += ",acc:(handover:rx),net:(handover:rx),app:(handover:rx))"
"""Zenoh's threads: one that sends and one for all else, so that a message wakes only those two.

Where the one that sends has to wait, the other must be able to; callbacks never wait."""

os.environ.setdefault("ZENOH_RUNTIME", RUNTIME)  # read when the first session is opened

LEASE = 1000
"""After this long without a sign of life a peer counts as dead [ms]; four signs are sent in it."""

EXPRESS: dict[str, Any] = {
    "congestion_control": zenoh.CongestionControl.BLOCK,
    "priority": zenoh.Priority.INTERACTIVE_HIGH,
    "express": True,
}
"""What must arrive soon: it waits for who is slow to take it, and for no message behind it."""

T = TypeVar("T")

LOOPBACK = "127.0.0.1"

_ATTEMPTS = 5
"""Attempts to listen on a free port; that another process takes it in between is rare."""

_CONNECT_WITHIN = 10
"""Time to connect to an endpoint where somebody listens [s]; over a VPN it takes up to one."""

_PROBE_WITHIN = 3.0
"""Time until somebody must have accepted a connection [s]: TCP sends its first packet twice."""

_LINGERS = struct.pack("ii", 1, 10)
"""SO_LINGER as Zenoh sets it: on, 10 s."""

_LETS_GO = struct.pack("ii", 0, 0)
"""SO_LINGER off: closing returns at once."""

_ENDPOINT = re.compile(
    r"((tcp|udp|tls|quic|ws)/(\[[^\]]+\]|[^:/?#]+):[0-9]{1,5}"
    r"|(serial|unixpipe|unixsock-stream|vsock)/[^?#]+)(\?[^#]*)?(#.*)?"
)
_TCP = re.compile(r"tcp/(\[[^\]]+\]|[^:/]+):([0-9]{1,5})")

_COMMON: dict[str, Any] = {
    "mode": "peer",
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "transport/link/tx/lease": LEASE,
    "transport/link/tx/keep_alive": 4,
    # A congested client must not hold up the loop: what cannot be sent at once is dropped.
    "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
    "transport/link/tx/queue/congestion_control/block/wait_before_close": LEASE * 1000,
    "transport/shared_memory/enabled": False,
    "adminspace/enabled": False,
}


def _configured(settings: dict[str, Any]) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in (_COMMON | settings).items():
        config.insert_json5(key, json.dumps(value))
    return config


def direct(
    callback: Callable[[T], object], ended: Callable[[], object] | None = None
) -> zenoh.handlers.Callback[T]:
    """Return a handler that is called in Zenoh's own thread; it must return at once.

    Zenoh's other kind of handler has a Python thread of its own, which keeps a process from ending
    until the session is closed.
    """
    return zenoh.handlers.Callback(callback, ended, indirect=False)


def let_go_at_once() -> None:
    """Have connections closed without waiting for what a client that has stalled did not take.

    Zenoh makes its sockets wait with closing for 10 s as long as something is on its way, and
    closes them in the thread that receives: one client that stalls or is cut off would keep all
    others from being heard.
    """
    folder = Path("/dev/fd")
    for name in os.listdir(folder) if folder.is_dir() else ():
        if not (folder / name).is_socket():
            continue
        with (
            contextlib.suppress(OSError),  # closed meanwhile
            socket.socket(fileno=os.dup(int(name))) as link,
        ):
            if link.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, len(_LINGERS)) == _LINGERS:
                link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LETS_GO)


def free_endpoint() -> str:
    """Return a loopback endpoint with a port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return f"tcp/{LOOPBACK}:{probe.getsockname()[1]}"


def open_server(listen: Sequence[str], connect: Sequence[str]) -> tuple[zenoh.Session, str]:
    """Open a session that listens on a loopback port of its own and where else it is told.

    Blocks for some milliseconds.

    Args:
        listen: Further endpoints to listen on.
        connect: Endpoints to connect to, for example of a Zenoh router; they may come up later.

    Returns:
        The session and its loopback endpoint.

    Raises:
        ConfigError: if an endpoint cannot be used.
    """
    _check([*listen, *connect])
    for attempt in range(_ATTEMPTS):
        local = free_endpoint()
        settings = {
            "listen/endpoints": [local, *listen],
            "listen/exit_on_failure": True,
            "connect/endpoints": list(connect),
            "connect/exit_on_failure": False,
            "connect/timeout_ms": 0 if not connect else -1,
        }
        try:
            return zenoh.open(_configured(settings)), local
        except zenoh.ZError as error:
            # Another process may have taken the free port in between.
            if listen or connect or attempt == _ATTEMPTS - 1:
                where = ", ".join([*listen, *connect]) or local
                raise ConfigError(
                    f"the network endpoint {where} cannot be used: {_words(error)}"
                ) from None
    raise AssertionError


def open_client(endpoints: Sequence[str]) -> zenoh.Session:
    """Open a session that connects to a hand and listens nowhere; blocks for some milliseconds.

    Raises:
        NoHand: if nobody answers there.
        ConfigError: if an endpoint is none.
    """
    _check(endpoints)
    settings = {
        "listen/endpoints": [],
        "connect/endpoints": list(endpoints),
        "connect/exit_on_failure": True,
        "connect/timeout_ms": _CONNECT_WITHIN * 1000,
    }
    try:
        # Zenoh would try again and again where nobody listens.
        for endpoint in endpoints:
            _probe(endpoint)
        session = zenoh.open(_configured(settings))
        let_go_at_once()
        return session
    except (OSError, OverflowError, UnicodeError, zenoh.ZError) as error:
        raise NoHand(f"nobody answers at {', '.join(endpoints)}: {_words(error)}") from None


def _check(endpoints: Sequence[str]) -> None:
    for endpoint in endpoints:
        if _ENDPOINT.fullmatch(endpoint) is None:
            raise ConfigError(
                f"'{endpoint}' is no endpoint; it is written PROTOCOL/HOST:PORT, such as"
                " tcp/robot:7447"
            )


def _probe(endpoint: str) -> None:
    """Raise `OSError` if nobody listens on a plain TCP endpoint."""
    match = _TCP.fullmatch(endpoint)
    if match is not None:
        socket.create_connection((match[1].strip("[]"), int(match[2])), _PROBE_WITHIN).close()


def _words(error: Exception) -> str:
    """Return an error's text without the place in Zenoh's source."""
    if isinstance(error, OSError):
        return error.strerror or str(error) or "no answer"
    said = str(error).partition(" at /")[0]
    return "no answer" if "Timeout" in said else said
