"""A simulated ZeroMQ server that runs an emulated device on three TCP ports of this machine."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol, runtime_checkable

import zmq

from rtee import monotonic
from rtee.buses.faults import Faults
from rtee.buses.simulated import Simulation
from rtee.buses.zmq import DirectServer, Endpoints
from rtee.errors import BusBroken


@runtime_checkable
class Serves(Protocol):
    """An emulator that answers requests in addition to receiving commands."""

    def serve(self, request: bytes, now: float) -> bytes | None:
        """Return the answer to a request, or ``None`` for no answer."""
        ...


class SimulatedZmq(Simulation, DirectServer):
    """A server that publishes the messages of `Emulator.step` and passes on commands and requests.

    Attributes:
        endpoints: Its addresses; ports that are not given are chosen at the first start and kept.
        faults: Faults of the wire: messages are lost, late or duplicated. Corruption does not
            occur, since TCP detects it.

    Args:
        ports: Where it publishes states, receives commands and answers requests.
    """

    def __init__(
        self,
        *,
        name: str = "zmq",
        host: str = "127.0.0.1",
        ports: tuple[int, int, int] | None = None,
    ) -> None:
        super().__init__(name)
        chosen: tuple[int | str, ...] = ports or ("*", "*", "*")
        self.endpoints = Endpoints(*(f"tcp://{host}:{port}" for port in chosen))
        self.faults = Faults()
        self._context: zmq.Context[Any] | None = None
        self._sockets: list[Any] = []
        self._clients: list[tuple[Callable[[bytes], None], Callable[[str], None]]] = []
        self._late: list[tuple[float, Callable[[], None]]] = []
        self._stepped = 0.0

    @property
    def address(self) -> str:
        """The address at which it publishes states."""
        return self.endpoints.state

    @property
    def place(self) -> Endpoints | DirectServer:
        """Where clients connect: at its addresses, or directly on simulated time."""
        return self.endpoints if self._loop is None else self

    def connect(self, receive: Callable[[bytes], None], broke: Callable[[str], None]) -> None:
        """Connect a client, on simulated time."""
        self._clients.append((receive, broke))

    def leave(self, receive: Callable[[bytes], None]) -> None:
        """Disconnect a client; idempotent."""
        self._clients = [client for client in self._clients if client[0] != receive]

    def command(self, message: bytes) -> None:
        """Receive a command, on simulated time."""
        if self._there:
            self._hear(message, monotonic.now())
            self._schedule()

    async def request(self, message: bytes) -> bytes:
        """Answer a request, on simulated time."""
        answer = self._answer(message, monotonic.now()) if self._there else None
        return await asyncio.get_running_loop().create_future() if answer is None else answer

    def _plug(self) -> None:
        if self._there:
            return
        self._there = True
        if self._loop is not None:
            return
        self._context = zmq.Context()
        bound = []
        for kind, place in zip((zmq.PUB, zmq.SUB, zmq.ROUTER), self.endpoints, strict=True):
            socket = self._context.socket(kind)
            socket.setsockopt(zmq.LINGER, 0)
            if kind == zmq.SUB:
                socket.setsockopt(zmq.SUBSCRIBE, b"")
            try:
                socket.bind(place)
            except zmq.ZMQError as error:
                socket.close()
                # All sockets or none, since a server with only some of them is useless.
                self._unplug()
                raise BusBroken(place, f"cannot listen there: {error}") from error
            self._sockets.append(socket)
            bound.append(socket.getsockopt_string(zmq.LAST_ENDPOINT))
        self.endpoints = Endpoints(*bound)

    def _unplug(self) -> None:
        self._there = False
        clients, self._clients = self._clients, []
        for _, broke in clients:
            broke("the server closed the connection")
        sockets, self._sockets = self._sockets, []
        for made in sockets:
            made.close(linger=0)
        self._late.clear()
        if self._context is not None:
            self._context.term()
            self._context = None

    def _next_due(self) -> float | None:
        periods = [e.period for e in self.emulators if e.period]
        due = [when for when, _ in self._late]
        if periods and self._there:
            due.append(self._stepped + min(periods))
        return min(due) if due else None

    def _turn(self, timeout: float | None) -> None:
        poller = zmq.Poller()
        poller.register(self._wake_out, zmq.POLLIN)
        for made in self._sockets[1:]:
            poller.register(made, zmq.POLLIN)
        # The unit of zmq's timeouts is 1 ms, as an integer.
        poller.poll(None if timeout is None else int(timeout * 1000.0))
        now = monotonic.now()
        if self._sockets:
            self._receive(now)
        self._step(now)

    def _step(self, now: float) -> None:
        if self.plugged:
            self._publish(now)
        for when, action in [late for late in self._late if late[0] <= now]:
            self._late.remove((when, action))
            action()

    def _receive(self, now: float) -> None:
        _, commands, service = self._sockets
        with contextlib.suppress(zmq.Again):
            while True:
                self._hear(commands.recv(zmq.NOBLOCK), now)
        with contextlib.suppress(zmq.Again):
            while True:
                *envelope, request = service.recv_multipart(zmq.NOBLOCK)
                answer = self._answer(request, now)
                if answer is not None:
                    service.send_multipart([*envelope, answer])

    def _hear(self, command: bytes, now: float) -> None:
        for late in self.faults.copies() if self.faults.requests else [0.0]:
            self._after(now + late, partial(self._feed, command))

    def _answer(self, request: bytes, now: float) -> bytes | None:
        servers = [emulator for emulator in self.emulators if isinstance(emulator, Serves)]
        return servers[0].serve(request, now) if servers else None

    def _after(self, when: float, action: Callable[[], None]) -> None:
        if when <= monotonic.now():
            action()
        else:
            self._late.append((when, action))

    def _feed(self, data: bytes) -> None:
        for emulator in self.emulators:
            emulator.feed(data, monotonic.now())

    def _publish(self, now: float) -> None:
        period = min((e.period for e in self.emulators if e.period), default=0.0)
        # A wait is rounded to milliseconds and may end early, but not by half a period.
        if not period or now - self._stepped < period * 0.5:
            return
        self._stepped = now
        for emulator in self.emulators:
            for data in emulator.step(now):
                if isinstance(data, bytes):
                    for late in self.faults.copies():
                        self._after(now + late, partial(self._send, data))

    def _send(self, data: bytes) -> None:
        for receive, _ in tuple(self._clients):
            receive(data)
        if self._sockets:
            with contextlib.suppress(zmq.Again):
                self._sockets[0].send(data, zmq.NOBLOCK)
