"""A simulated ZeroMQ server that runs an emulated device on three TCP ports of this machine."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import zmq

from rtee import monotonic
from rtee.buses.line_model import MessageWire
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
        self._wire = MessageWire()
        chosen: tuple[int | str, ...] = ports or ("*", "*", "*")
        self.endpoints = Endpoints(*(f"tcp://{host}:{port}" for port in chosen))
        self._context: zmq.Context[Any] | None = None
        self._sockets: list[Any] = []
        self._clients: list[tuple[Callable[[bytes], None], Callable[[str], None]]] = []

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
        self._wire.reset()
        if self._context is not None:
            self._context.term()
            self._context = None

    def _turn(self, timeout: float | None) -> None:
        poller = zmq.Poller()
        poller.register(self._wake_out, zmq.POLLIN)
        for made in self._sockets[1:]:
            poller.register(made, zmq.POLLIN)
        # The unit of zmq's timeouts is 1 ms, as an integer; rounded down, it would wait in vain.
        poller.poll(None if timeout is None else math.ceil(timeout * 1000.0))
        now = monotonic.now()
        if self._sockets:
            self._receive(now)
        self._step(now)

    def _step(self, now: float) -> None:
        for message in self._wire.step(now):
            for receive, _ in tuple(self._clients):
                receive(message)
            if self._sockets:
                with contextlib.suppress(zmq.Again):
                    self._sockets[0].send(message, zmq.NOBLOCK)

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
        self._wire.receive(command, now)
        # At once, since a request that follows must find the command done.
        self._step(now)

    def _answer(self, request: bytes, now: float) -> bytes | None:
        servers = [emulator for emulator in self.emulators if isinstance(emulator, Serves)]
        return servers[0].serve(request, now) if servers else None
