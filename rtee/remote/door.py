"""The door of a hand: a separate process that accepts all connections with certificates.

Anyone who reaches a port can open connections as fast as they like. With the door, these cost the
hand's process nothing: no handshake, no descriptor, and no time of its interpreter. Zenoh's own
listener would not do, since it waits for 0.1 s after every failed handshake and so accepts ten
clients a second at most. The door performs the TLS handshake itself, and passes the bytes of each
certificate's connections to a Zenoh gateway that enforces the rules of its role
(`rtee.remote.access`) and leads to the hand's Unix socket.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import shutil
import socket
import ssl
import subprocess
import sys
import tempfile
import threading
import time
from collections import OrderedDict
from collections.abc import Collection, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import zenoh

from rtee import child, monotonic
from rtee.errors import ConfigError, NoHand
from rtee.messages import network_key
from rtee.messages.requests import ALIVE, REQUESTS, STOP
from rtee.remote.access import hello_limit
from rtee.remote.call_queue import CallQueue
from rtee.remote.connections import raise_file_limit
from rtee.remote.rates import CONNECTIONS_FOR_STOPS, CONNECTIONS_OF_CERTIFICATE
from rtee.remote.session import (
    close_session,
    direct,
    host_of,
    local_endpoint,
    open_listening,
    relay_environment,
)
from rtee.remote.stopping import CERTIFICATE, stop_at, stop_path

log = logging.getLogger(__name__)

_MOST_SILENT = 256
"""Most connections that have not shown a certificate yet; beyond it the oldest are closed. A
client with a certificate shows it in a few round trips, so only thousands a second can block it."""

_SILENT_FOR = 3.0
"""Time to show a certificate [s]: several round trips of a slow VPN."""

_STOPPED_WITHIN = 3.0
"""Time after which connections beyond the limit, for stops, are closed [s]: a stop takes a few
tenths, on a busy computer a second."""

_BACKLOG = 1024
"""Connections that wait in the kernel to be accepted."""

_CHUNK = 65536
"""Most bytes that are passed on at once [bytes]: the longest batch of Zenoh."""

_LINK_WITHIN = 5.0
"""Time for a gateway to reach the hand on the same computer [s]."""

_LOOK_FOR = 1.0
"""Time for the hand to answer that it is alive [s]: a round trip or two."""

_POLL = 0.01
"""Interval of checks for something that takes milliseconds [s]."""

_OPEN_WITHIN = 20.0
"""Time for the process to open its endpoints [s]; it starts in a second on a computer at rest."""

_AGAIN_AFTER = 1.0
"""Time after which a door that has ended is opened again [s]."""


class Door:
    """The door's process, which ends with this object or with this process.

    Args:
        name: Name of the hand.
        hand: Endpoint of the hand's Unix socket.
        zid: Identifier of the hand's session of Zenoh.
        listen: The door's endpoints, for TLS.
        certificates: Files with ``authority``, ``certificate`` and ``key``.
        rules: Zenoh's ``access_control`` by common name of those who are or may be admitted.
        people: Common names of the certificates that are admitted.

    Raises:
        ConfigError: if an endpoint cannot be used.
    """

    def __init__(
        self,
        name: str,
        hand: str,
        zid: str,
        listen: Collection[str],
        certificates: Mapping[str, str],
        rules: Mapping[str, Any],
        people: Collection[str],
    ) -> None:
        self._first = {
            "name": name,
            "hand": hand,
            "zid": zid,
            "listen": list(listen),
            "certificates": dict(certificates),
            "rules": dict(rules),
        }
        self._people = sorted(people)
        self._writing = threading.Lock()
        self._ended = threading.Event()
        self._process = self._opened()
        self._watcher = threading.Thread(target=self._watch, name="door", daemon=True)
        self._watcher.start()

    def admit(self, people: Collection[str]) -> None:
        """Admit clients by the common names of their certificates, and no others from now on."""
        with self._writing:
            self._people = sorted(people)
            self._say(self._process)

    def close(self) -> None:
        """End the process; blocks for a moment."""
        self._ended.set()
        with self._writing:
            process = self._process
        _end(process)
        self._watcher.join()

    def _opened(self) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            child.python("-m", "rtee.remote.door"),
            env={**child.environment(), **relay_environment()},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            encoding="utf-8",
            # Ctrl-C in a terminal is for the hand, which brings itself to rest first.
            start_new_session=True,
        )
        assert process.stdin is not None and process.stdout is not None  # noqa: S101, PT018
        timer = threading.Timer(_OPEN_WITHIN, process.kill)
        timer.start()
        try:
            with contextlib.suppress(OSError):  # it has ended; its answer says why
                process.stdin.write(json.dumps({**self._first, "people": self._people}) + "\n")
                process.stdin.flush()
            answer = process.stdout.readline().rstrip("\n")
        finally:
            timer.cancel()
        if answer != "open":
            _end(process)
            raise ConfigError(answer or "the process for connections from the network has ended")
        return process

    def _say(self, process: subprocess.Popen[str]) -> None:
        """Send the process the list of admitted clients."""
        assert process.stdin is not None  # noqa: S101
        with contextlib.suppress(OSError):  # it has ended; the next one gets it at its start
            process.stdin.write(json.dumps(self._people) + "\n")
            process.stdin.flush()

    def _watch(self) -> None:
        while True:
            self._process.wait()
            _end(self._process)
            if self._ended.wait(_AGAIN_AFTER):
                return
            log.error("the process for connections from the network has ended; opening it again")
            try:
                with self._writing:
                    self._process = self._opened()
            except (ConfigError, OSError) as error:
                log.error("it cannot be opened: %s", error)
            if self._ended.is_set():
                _end(self._process)


def _end(process: subprocess.Popen[str]) -> None:
    assert process.stdin is not None and process.stdout is not None  # noqa: S101, PT018
    with contextlib.suppress(OSError):
        process.stdin.close()
    process.stdout.close()
    process.kill()
    process.wait()


class _Gate:
    """The access path of one certificate: a Zenoh gateway with the rules of its role.

    Args:
        folder: Folder for its socket.
        hand: Endpoint of the hand's Unix socket.
        zid: Identifier of the hand's session of Zenoh.
        name: Common name of the certificate.
        rules: Zenoh's ``access_control`` for it.
        hand_name: Name of the hand.
    """

    def __init__(
        self, folder: Path, hand: str, zid: str, name: str, rules: Any, hand_name: str
    ) -> None:
        self.path = folder / f"{name}.sock"
        self._name, self._hand, self._stop_at = name, hand_name, stop_path(hand)
        self._stops = CallQueue(f"stop {name}")
        # A gateway passes messages between its two sides only: the hand, and all others.
        others = {"negated": True, "zids": [zid]}
        settings = {
            "access_control": rules,
            "downsampling": hello_limit(hand_name),
            "gateway": {"south": [{"filters": [others]}]},
        }
        self._session = open_listening([local_endpoint(self.path)], [hand], settings)
        until = monotonic.now() + _LINK_WITHIN
        # Clients look for this token first, which arrives some time after the link is open.
        alive = network_key(hand_name, ALIVE)
        while not any(
            reply.ok for reply in self._session.liveliness().get(alive, timeout=_LOOK_FOR)
        ):
            if monotonic.now() > until:
                self.close()
                raise ConfigError("the hand's network process does not answer")
            monotonic.sleep(_POLL)
        # From here, stops go through the hand's own socket for stops, too: in the hand's session
        # they may wait behind what others have sent, since it has a single thread that receives.
        self._session.declare_queryable(
            network_key(hand_name, f"{STOP}/*"),
            direct(self._on_stop),
        )

    def _on_stop(self, query: zenoh.Query) -> None:
        self._stops.put(partial(self._stop, query))

    def _stop(self, query: zenoh.Query) -> None:
        with contextlib.suppress(NoHand, OSError, zenoh.ZError), query:
            assert self._stop_at is not None  # noqa: S101
            confirmed = stop_at(self._stop_at, self._hand, f"{CERTIFICATE}{self._name}")
            fields = {"device": list(confirmed), "confirmed": list(confirmed.values())}
            query.reply(
                REQUESTS["stop"].key(self._hand),
                REQUESTS["stop"].answer.encode(fields),
                express=True,
            )

    def close(self) -> None:
        """Close all that goes through it; blocks for a moment."""
        close_session(self._session)
        self._stops.close()


class _Doorkeeper:
    """Accepts connections, requires a certificate, and forwards the data of those that have one.

    Connections without a certificate are many and short-lived in a flood, so the newest are kept.
    """

    def __init__(self, first: Mapping[str, Any], folder: Path) -> None:
        self._first, self._folder = first, folder
        self._people = frozenset(first["people"])
        self._tls = _tls(first["certificates"])
        self._silent: OrderedDict[asyncio.Task[None], None] = OrderedDict()
        self._passing: dict[str, set[asyncio.Task[None]]] = {}
        self._gates: dict[str, asyncio.Future[_Gate]] = {}

    def admit(self, people: Collection[str]) -> None:
        """Admit people, and close the connections of all others."""
        gone, self._people = self._people.difference(people), frozenset(people)
        for name in gone:
            for task in self._passing.pop(name, ()):
                task.cancel()
            gate = self._gates.pop(name, None)
            if gate is not None:
                gate.add_done_callback(_closed)

    async def keep(self, listener: socket.socket) -> None:
        """Accept connections until cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            try:
                link, _ = await loop.sock_accept(listener)
            except OSError:  # too many files are open: those in the queue wait
                await asyncio.sleep(_POLL)
                continue
            task = loop.create_task(self._welcome(link))
            self._silent[task] = None
            task.add_done_callback(lambda task: self._silent.pop(task, None))
            if len(self._silent) > _MOST_SILENT:
                self._silent.popitem(last=False)[0].cancel()

    async def _welcome(self, link: socket.socket) -> None:
        with contextlib.suppress(OSError, EOFError, ConfigError, TimeoutError):
            reader = asyncio.StreamReader()
            loop = asyncio.get_running_loop()
            transport, protocol = await loop.connect_accepted_socket(
                lambda: asyncio.StreamReaderProtocol(reader),
                link,
                ssl=self._tls,
                ssl_handshake_timeout=_SILENT_FOR,
                ssl_shutdown_timeout=_POLL,
            )
            writer = asyncio.StreamWriter(transport, protocol, reader, loop)
            task = asyncio.current_task()
            assert task is not None  # noqa: S101
            self._silent.pop(task, None)
            try:
                certificate = transport.get_extra_info("peercert")
                name = _common_name(certificate)
                passing = self._passing.setdefault(name, set())
                left = CONNECTIONS_OF_CERTIFICATE - len(passing)
                if name in self._people and left > -CONNECTIONS_FOR_STOPS:
                    passing.add(task)
                    valid = ssl.cert_time_to_seconds(certificate["notAfter"]) - time.time()
                    async with asyncio.timeout(valid if left > 0 else min(valid, _STOPPED_WITHIN)):
                        await self._pass(name, reader, writer)
            finally:
                self._passing.get(name, set()).discard(task)
                transport.abort()  # does not wait for slow readers

    async def _pass(
        self, name: str, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """Forward data in both directions until one side ends."""
        gate = await self._gate(name)
        inner_reader, inner_writer = await asyncio.open_unix_connection(str(gate.path))
        try:
            directions = (_pumped(reader, inner_writer), _pumped(inner_reader, writer))
            tasks = [asyncio.ensure_future(direction) for direction in directions]
            try:
                await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)
        finally:
            inner_writer.transport.abort()

    async def _gate(self, name: str) -> _Gate:
        """Return the gateway of a certificate; open it at its first use."""
        gate = self._gates.get(name)
        if gate is None:
            first = self._first
            rules = first["rules"].get(name)
            if rules is None:
                raise ConfigError(f"{name} is admitted from the next start")
            work = asyncio.to_thread(
                _Gate, self._folder, first["hand"], first["zid"], name, rules, first["name"]
            )
            gate = self._gates[name] = asyncio.ensure_future(work)
        try:
            return await asyncio.shield(gate)
        except (ConfigError, OSError):
            if self._gates.get(name) is gate:
                del self._gates[name]
            raise


def _closed(gate: asyncio.Future[_Gate]) -> None:
    if not gate.cancelled() and gate.exception() is None:
        threading.Thread(target=gate.result().close, daemon=True).start()


async def _pumped(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while data := await reader.read(_CHUNK):
        writer.write(data)
        await writer.drain()


def _tls(certificates: Mapping[str, str]) -> ssl.SSLContext:
    """Return the TLS settings: a certificate of the hand's authority is required of clients."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.verify_mode = ssl.CERT_REQUIRED
    context.load_verify_locations(certificates["authority"])
    context.load_cert_chain(certificates["certificate"], certificates["key"], password="")
    context.num_tickets = 0  # a session that is resumed would show no certificate again
    return context


def _common_name(certificate: Mapping[str, Any]) -> str:
    for part in certificate["subject"]:
        for key, value in part:
            if key == "commonName":
                return str(value)
    return ""


def _bound(endpoint: str) -> socket.socket:
    """Return a socket that listens at an endpoint; raises `ConfigError`."""
    host, port = host_of(endpoint)
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        listener = socket.create_server((host, port), family=family, backlog=_BACKLOG)
    except OSError as error:
        words = error.strerror or str(error)
        raise ConfigError(f"the network endpoint {endpoint} cannot be used: {words}") from None
    listener.setblocking(False)
    return listener


async def _serve(first: Mapping[str, Any], folder: Path) -> None:
    try:
        listeners = [_bound(endpoint) for endpoint in first["listen"]]
        keeper = _Doorkeeper(first, folder)
    except (ConfigError, OSError) as error:
        print(error, flush=True)  # noqa: T201
        return
    loop = asyncio.get_running_loop()

    def follow() -> None:
        for line in sys.stdin:
            loop.call_soon_threadsafe(keeper.admit, json.loads(line))
        shutil.rmtree(folder, ignore_errors=True)
        os._exit(0)

    threading.Thread(target=follow, daemon=True).start()
    print("open", flush=True)  # noqa: T201
    async with asyncio.TaskGroup() as group:
        for listener in listeners:
            group.create_task(keeper.keep(listener))


def main() -> None:
    """Open the door described by the first line of the input; later lines list the admitted.

    Ends with the input: when the hand's process ends, however it does.
    """
    first = json.loads(sys.stdin.readline())
    raise_file_limit()
    folder = Path(tempfile.mkdtemp(prefix="rtee-"))
    try:
        asyncio.run(_serve(first, folder))
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main()
