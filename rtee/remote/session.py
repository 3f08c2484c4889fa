"""Zenoh sessions: a Unix socket on this computer, no scouting, dead peers detected in a second.

File permissions protect a hand on this computer: its socket is in a folder that only its user, or
the group of a service, may enter.
"""

from __future__ import annotations

import contextlib
import ctypes
import ipaddress
import json
import logging
import os
import re
import resource
import socket
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from threading import get_ident
from typing import Any, Final, TypeVar

import zenoh

from rtee import monotonic
from rtee.errors import ConfigError, NoHand
from rtee.messages.requests import HERE, PLAIN
from rtee.remote.connections import disable_linger
from rtee.remote.credentials import identity
from rtee.remote.rates import CONNECTIONS_FOR_STOPS, CONNECTIONS_OF_CERTIFICATE

log = logging.getLogger(__name__)

RUNTIME_VARIABLE: Final = "ZENOH_RUNTIME"
"""Variable of the environment that Zenoh reads when the first session of a process is opened."""


def _runtime(receiving: int) -> str:
    """Return the value for one sending thread, and the given number for everything else.

    They are separate because the sending thread may have to wait. Callbacks never wait.
    """
    more = "tx:(worker_threads:1),acc:(handover:rx),net:(handover:rx),app:(handover:rx)"
    return f"(rx:(worker_threads:{receiving}),{more})"


RUNTIME: Final = _runtime(1)
"""Zenoh's threads by default: a message wakes only two."""

_RELAY: Final = _runtime(CONNECTIONS_OF_CERTIFICATE + CONNECTIONS_FOR_STOPS + 2)
"""Zenoh's threads in a process that passes messages on. Each connection occupies one while the hand
is slow to take its data; the door limits the connections of a certificate, so that none can occupy
all threads. The last two receive from the hand and from the others."""

os.environ.setdefault(RUNTIME_VARIABLE, RUNTIME)


def relay_environment() -> dict[str, str]:
    """Return the variable for a process that passes messages on, unless the user has set it."""
    given = os.environ.get(RUNTIME_VARIABLE, RUNTIME)
    return {RUNTIME_VARIABLE: _RELAY if given == RUNTIME else given}


LEASE = 1000
"""Time without a message after which a peer counts as dead [ms]: peers send four keep-alives in
it."""

EXPRESS: dict[str, Any] = {
    "congestion_control": zenoh.CongestionControl.BLOCK,
    "priority": zenoh.Priority.INTERACTIVE_HIGH,
    "express": True,
}
"""Options for messages that must arrive soon: they wait for slow readers, but not for a batch to
fill."""

DELIVER = {**EXPRESS, "express": False}
"""Options for messages of a hand that must arrive: results, events and answers.

They wait in batches, of which a hand buffers a megabyte for each client, see `open_server`. As
express messages, each would take a batch of its own, and a burst of seventeen would fill all. A
client that reads nothing while a megabyte comes is disconnected, instead of missing messages."""

_CLOSE_AFTER = 50_000
"""Time for which a hand waits for a client with full buffers before it closes the connection [µs],
so that such clients delay all others by no more."""

T = TypeVar("T")

LOCAL = "unixsock-stream"
"""Zenoh's name of the protocol on this computer."""

TLS = "tls/"
"""Prefix of the endpoints that admit only clients with a certificate."""

_LONGEST_SOCKET = 107 if sys.platform == "linux" else 103
"""Longest path of a Unix socket [bytes]; operating systems store it in a field of fixed size."""

_SOCKET_MODE = 0o660
"""Mode of the socket: its user and group may connect if they may enter its folder, too."""

LARGEST = 1 << 20
"""Largest message that a hand assembles [bytes]: sixteen times the longest request. Zenoh's own
limit is 1 GiB for each client."""

_MOST_SESSIONS = 128
"""Most connections that a hand accepts: far more than a hand has clients, but bounded."""

_SILENT_FOR = 3000
"""Time in which a new connection must have introduced itself [ms]: over a VPN it takes up to 1 s.
Zenoh lets a hundred wait, and admits no others until then."""

_RESERVED = 64
"""Files that connections leave for devices, the recording and stops; a hand has about 25."""

_CONNECT_WITHIN = 10.0
"""Time to open a session with a listening endpoint [s]: over a VPN it takes up to 1 s."""

_PROBE_WITHIN = 3.0
"""Time until a connection must be accepted [s]: TCP repeats a lost first packet after 1 s."""

_AGAIN = 0.2
"""Time between two attempts to open a session [s]: the hand may have too many clients."""

_KEPT: Final[set[int]] = set()
"""Zenoh's threads that keep their thread state of Python. Otherwise each message makes a new one
and removes it, which takes 40 to 50 µs of processor time, 10 to 25 µs of them before the callback.
"""

_MOST_KEPT: Final = 16
"""Most such threads, each with some 20 KiB: a hand's process has three, a client's one."""

_HOST = r"(\[[^][/?#\s]*:[^][/?#\s]*\]|[^][:/?#\s]+)"
"""A host: a name or an IPv4 address, or an IPv6 address in brackets."""

_ENDPOINT = re.compile(
    rf"((tcp|udp|tls|quic|ws)/{_HOST}:[0-9]{{1,5}}"
    r"|(serial|unixpipe|unixsock-stream|vsock)/[^?#]+)(\?[^#]*)?(#.*)?"
)
_TCP = re.compile(rf"(?:tcp|tls)/{_HOST}:([0-9]{{1,5}})")
_SOCKET = re.compile(LOCAL + r"/([^?#]+)")

_COMMON: dict[str, Any] = {
    "mode": "peer",
    # Hands are found by their announcement or endpoint; no packet is sent to the network unasked.
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "transport/link/tx/lease": LEASE,
    "transport/link/tx/keep_alive": 4,
    # A batch is sent as soon as the thread that sends is free, however few messages it has.
    "transport/link/tx/queue/batching/time_limit": 0,
    # A congested client must not delay the loop: states that cannot be sent at once are dropped.
    "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
    # Results must not be lost: a connection is closed only when its peer counts as dead [µs].
    "transport/link/tx/queue/congestion_control/block/wait_before_close": LEASE * 1000,
    # Messages are a few kilobytes, too small to gain from shared memory.
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
    """Return a handler that calls ``callback`` in Zenoh's own thread; it must return at once.

    Zenoh's other kind of handler starts a Python thread, which keeps the process from ending until
    the session is closed.
    """

    def call(message: T) -> None:
        thread = get_ident()
        if thread not in _KEPT and len(_KEPT) < _MOST_KEPT:
            _KEPT.add(thread)
            ctypes.pythonapi.PyGILState_Ensure()  # never released
        callback(message)

    return zenoh.handlers.Callback(call, ended, indirect=False)


def fits(path: Path) -> bool:
    """Return whether a path is short enough for a Unix socket."""
    return len(os.fsencode(str(path.absolute()))) <= _LONGEST_SOCKET


def local_endpoint(path: Path) -> str:
    """Return the endpoint of a Unix socket; raises `ConfigError` if the path cannot be used."""
    name = str(path.absolute())
    if not fits(path):
        raise ConfigError(
            f"is longer than {_LONGEST_SOCKET} bytes, the limit for the path of a socket; set"
            " RTEE_RUNTIME_DIR to a folder with a shorter one",
            path=path,
        )
    endpoint = f"{LOCAL}/{name}"
    if _SOCKET.fullmatch(endpoint) is None:
        raise ConfigError("the path of a socket may not contain ? or #", path=path)
    return endpoint


def open_session(config: zenoh.Config) -> zenoh.Session:
    """Open a Zenoh session; Zenoh reads its number of threads from an environment variable.

    Raises `ConfigError` if the variable is malformed, `zenoh.ZError` for what Zenoh refuses.
    """
    # Missing if another environment has replaced the one in which this module was imported.
    text = os.environ.setdefault(RUNTIME_VARIABLE, RUNTIME).strip()
    wrong = ConfigError(
        f"{RUNTIME_VARIABLE}={text[:80]} does not describe Zenoh's threads, as "
        "(rx:(worker_threads:1)) does"
    )
    # Zenoh ends the thread with a message of its own where it cannot parse the variable.
    if not (text.startswith("(") and text.endswith(")") and text.count("(") == text.count(")")):
        raise wrong
    try:
        return zenoh.open(config)
    except BaseException as error:
        if type(error).__name__ == "PanicException":
            raise wrong from None
        raise


def open_server(
    local: Path,
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    further: Mapping[str, Any] | None = None,
) -> tuple[zenoh.Session, str]:
    """Open a session that listens on a Unix socket and on further endpoints.

    Blocks for some milliseconds. Returns the session and its endpoint on this computer. The
    endpoints to connect to, such as a Zenoh router, may come up later; ``further`` are settings of
    Zenoh. Raises `ConfigError` if an endpoint cannot be used.
    """
    check_endpoints([*listen, *connect])
    endpoint = local_endpoint(local)
    session = open_listening([endpoint, *listen], connect, further)
    # Zenoh makes the socket with the process's umask, which may be anything.
    local.chmod(_SOCKET_MODE)
    return session, endpoint


def open_listening(
    listen: Sequence[str], connect: Sequence[str], further: Mapping[str, Any] | None = None
) -> zenoh.Session:
    """Open a session that listens on endpoints, like `open_server` but without a Unix socket."""
    try:
        return open_session(listening(listen, connect, further))
    except (OSError, zenoh.ZError) as error:
        where = ", ".join([*listen, *connect])
        raise ConfigError(f"the network endpoint {where} cannot be used: {_words(error)}") from None


def listening(
    listen: Sequence[str], connect: Sequence[str], further: Mapping[str, Any] | None = None
) -> zenoh.Config:
    """Return Zenoh's settings for `open_listening`."""
    settings = {
        "listen/endpoints": list(listen),
        "listen/exit_on_failure": True,
        "connect/endpoints": list(connect),
        "connect/exit_on_failure": False,
        # A router may come up later, so Zenoh keeps trying.
        "connect/timeout_ms": 0 if not connect else -1,
        "transport/link/rx/max_message_size": LARGEST,
        "transport/unicast/max_sessions": most_sessions(),
        "transport/unicast/accept_timeout": _SILENT_FOR,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": _CLOSE_AFTER,
        # Batches of 64 KiB that are buffered for a client, the most that Zenoh allows.
        "transport/link/tx/queue/size/interactive_high": 16,
    }
    return _configured(settings | dict(further or {}))


def most_sessions() -> int:
    """Return the largest number of connections of this process; lower if it may open few files."""
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    # RLIM_INFINITY is -1.
    return _MOST_SESSIONS if files < 0 else max(1, min(_MOST_SESSIONS, files - _RESERVED))


def access_path(endpoint: str) -> str:
    """Return a client's access path through an endpoint; see `FoundSession`."""
    if endpoint.startswith(TLS):
        return identity().name
    return HERE if endpoint.startswith(LOCAL) else PLAIN


def host_of(endpoint: str) -> tuple[str, int]:
    """Return host and port of a TCP or TLS endpoint; raises `ConfigError` for any other."""
    match = _TCP.fullmatch(endpoint)
    if match is None:
        raise ConfigError(f"'{endpoint}' should be written tls/HOST:PORT")
    return match[1].strip("[]"), int(match[2])


def address_of(text: str, what: str) -> tuple[str, int]:
    """Return host and port of ``HOST:PORT``; raises `ConfigError`, which names its purpose."""
    match = re.fullmatch(rf"(?:{_HOST}|([0-9a-fA-F:.]+)):([0-9]{{1,5}})", text)
    if match is None or int(match[3]) >= 1 << 16:
        raise ConfigError(f"{what}: '{text[:50]}' should be HOST:PORT, such as 127.0.0.1:9464")
    return (match[1] or match[2]).strip("[]"), int(match[3])


def is_safe(endpoint: str) -> bool:
    """Return whether only admitted clients can connect through an endpoint."""
    # An endpoint with metadata does not match: anything not understood counts as unsafe.
    match = _TCP.fullmatch(endpoint)
    if match is not None and not endpoint.startswith(TLS):
        with contextlib.suppress(ValueError):
            return ipaddress.ip_address(match[1].strip("[]")).is_loopback
        return match[1] == "localhost"
    return endpoint.startswith((TLS, LOCAL))


def close_session(session: zenoh.Session) -> None:
    """Close a session; blocks for some milliseconds, or 10 s if a peer is frozen."""
    try:
        session.close()  # type: ignore[no-untyped-call]
    except zenoh.ZError as error:
        # Its links close at the latest when this process ends, and others then forget it.
        log.warning("a session did not close: %s", str(error).partition(" at ")[0])


def open_client(
    endpoints: Sequence[str],
    within: float | None = None,
    certificates: Mapping[str, Any] | None = None,
) -> zenoh.Session:
    """Open a session that connects to a hand and does not listen; blocks for milliseconds.

    ``certificates`` are Zenoh's settings of those to show instead of this user's.

    Raises `NoHand` without an answer within the time [s], by default 10 s, and `ConfigError`
    if an endpoint is malformed.
    """
    check_endpoints(endpoints)
    settings: dict[str, Any] = {
        # A router does not pass on messages between two peers.
        "mode": "client",
        "listen/endpoints": [],
        "connect/endpoints": list(endpoints),
        "connect/exit_on_failure": True,
        "connect/timeout_ms": 0,
    }
    if certificates is not None:
        settings |= certificates
    elif any(endpoint.startswith(TLS) for endpoint in endpoints):
        settings |= identity().settings()
    until = monotonic.now() + (within or _CONNECT_WITHIN)
    try:
        while True:
            # One attempt at a time, since Zenoh would retry although the hand has ended meanwhile.
            for endpoint in endpoints:
                _probe(endpoint)
            left = max(until - monotonic.now(), _AGAIN)
            settings["transport/unicast/open_timeout"] = round(left * 1000)
            try:
                session = open_session(_configured(settings))
            except zenoh.ZError:
                if monotonic.now() + _AGAIN > until:
                    raise
            else:
                disable_linger()
                return session
            monotonic.sleep(_AGAIN)
    except (OSError, OverflowError, UnicodeError, zenoh.ZError) as error:
        raise NoHand(f"nothing answers at {', '.join(endpoints)}: {_words(error)}") from None


def check_endpoints(endpoints: Sequence[str]) -> None:
    """Raise `ConfigError` unless all endpoints are in Zenoh's format."""
    for endpoint in endpoints:
        if _ENDPOINT.fullmatch(endpoint) is None:
            raise ConfigError(
                f"'{endpoint}' is not an endpoint; it is written PROTOCOL/HOST:PORT, such as"
                " tcp/robot:7447 or tcp/[::1]:7447"
            )


def _probe(endpoint: str) -> None:
    """Raise `OSError` if an endpoint of TCP, TLS or a Unix socket has no listener."""
    if match := _TCP.fullmatch(endpoint):
        socket.create_connection((match[1].strip("[]"), int(match[2])), _PROBE_WITHIN).close()
    elif match := _SOCKET.fullmatch(endpoint):
        with socket.socket(socket.AF_UNIX) as probe:
            probe.settimeout(_PROBE_WITHIN)
            probe.connect(match[1])


def _words(error: Exception) -> str:
    """Return an error's text without the location in Zenoh's source."""
    if isinstance(error, OSError):
        return error.strerror or str(error) or "no answer"
    text = str(error).partition(" at /")[0]
    return "no answer" if "Timeout" in text or "Unable to connect" in text else text
