"""A ZeroMQ server as a bus: it publishes states, receives commands and answers requests."""

from __future__ import annotations

import asyncio
import contextlib
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import zmq
import zmq.asyncio

from rtee import monotonic
from rtee.buses.bus import Bus, listen
from rtee.errors import BusBroken, BusTimeout


class Endpoints(NamedTuple):
    """Addresses of a server.

    Attributes:
        state: Address at which it publishes states.
        command: Address at which it receives commands.
        service: Address at which it answers requests.
    """

    state: str
    command: str
    service: str


class DirectServer(ABC):
    """A server in this event loop, on simulated time."""

    @abstractmethod
    def connect(self, receive: Callable[[bytes], None], broke: Callable[[str], None]) -> None:
        """Connect a client, which receives the states and detects the loss of the server."""

    @abstractmethod
    def leave(self, receive: Callable[[bytes], None]) -> None:
        """Disconnect a client; idempotent."""

    @abstractmethod
    def command(self, message: bytes) -> None:
        """Receive a command; drop it if the server is not there."""

    @abstractmethod
    async def request(self, message: bytes) -> bytes:
        """Answer a request; waits forever if nothing answers."""


class ZmqBus(Bus):
    """Three sockets to a server. Of the commands not yet sent, only the newest is kept.

    ZeroMQ connects and reconnects in the background, so a missing server causes timeouts. The bus
    is broken when the server closes the connection for states.
    """

    def __init__(self, name: str, endpoints: Callable[[], Endpoints | DirectServer]) -> None:
        super().__init__(name)
        self._endpoints = endpoints
        self._context: zmq.asyncio.Context | None = None
        self._state: Any = None
        self._command: Any = None
        self._service: Any = None
        self._monitor: Any = None
        self._direct: DirectServer | None = None
        self._tasks: list[asyncio.Task[None]] = []
        self._listeners: list[Callable[[bytes, float], None]] = []
        self._asking = asyncio.Lock()

    def subscribe(self, callback: Callable[[bytes, float], None]) -> Callable[[], None]:
        """Call ``callback(message, stamp)`` for every state; return a function that ends this."""
        return listen(self._listeners, callback)

    def send_now(self, message: bytes) -> None:
        """Send a command, replacing one not yet sent; raises `BusBroken` or `BusClosed`."""
        self.check()
        self.counters.transactions += 1
        self._count("tx", message, monotonic.now())
        if self._direct is not None:
            self._direct.command(message)
            return
        with contextlib.suppress(zmq.Again):
            self._command.send(message, zmq.NOBLOCK)

    async def request(self, message: bytes, deadline: float) -> bytes:
        """Send a request and return the answer; errors as for `send_now`.

        Raises:
            BusTimeout: if no answer came within ``deadline`` [s].
        """
        self.check()
        self.counters.transactions += 1
        try:
            async with asyncio.timeout(deadline), self._asking:
                self._count("tx", message, monotonic.now())
                if self._direct is not None:
                    answer = await self._direct.request(message)
                else:
                    await self._service.send(message)
                    answer = bytes(await self._service.recv())
        except TimeoutError:
            self.counters.timeouts += 1
            raise BusTimeout(self.name, f"no answer within {deadline:.3f} s") from None
        except zmq.ZMQError as error:
            raise BusBroken(self.name, f"the request failed: {error}") from error
        self._count("rx", answer, monotonic.now())
        return answer

    async def _open(self) -> None:
        await self._close()
        places = self._endpoints()
        if isinstance(places, DirectServer):
            self._direct = places
            places.connect(self._receive, self._broke)
            return
        context = self._context = zmq.asyncio.Context()
        try:
            self._state = context.socket(zmq.SUB)
            # Short queue [messages], since old states are useless.
            self._state.setsockopt(zmq.RCVHWM, 16)
            # [ms]; half of the default, to find a restarted server quickly.
            self._state.setsockopt(zmq.RECONNECT_IVL, 50)
            self._state.subscribe(b"")
            self._monitor = self._state.get_monitor_socket(zmq.EVENT_DISCONNECTED)
            self._state.connect(places.state)
            self._command = context.socket(zmq.PUB)
            # Keep only the newest command: an old one must never be executed after a break.
            self._command.setsockopt(zmq.CONFLATE, 1)
            self._command.connect(places.command)
            self._service = context.socket(zmq.REQ)
            # An unanswered request must not block the next one, and its late answer must not be
            # mistaken for the next one's.
            self._service.setsockopt(zmq.REQ_RELAXED, 1)
            self._service.setsockopt(zmq.REQ_CORRELATE, 1)
            self._service.connect(places.service)
        except zmq.ZMQError as error:
            await self._close()
            raise BusBroken(self.name, f"cannot be opened: {error}") from error
        self._tasks = [asyncio.create_task(self._read()), asyncio.create_task(self._watch())]

    async def _read(self) -> None:
        while True:
            self._receive(bytes(await self._state.recv()))

    def _receive(self, message: bytes) -> None:
        stamp = monotonic.now()
        self._count("rx", message, stamp)
        for listener in tuple(self._listeners):
            listener(message, stamp)

    async def _watch(self) -> None:
        await self._monitor.recv_multipart()
        self._broke("the server closed the connection")

    async def _close(self) -> None:
        direct, self._direct = self._direct, None
        if direct is not None:
            direct.leave(self._receive)
        tasks, self._tasks = self._tasks, []
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        if self._state is not None and self._monitor is not None:
            # Before closing, since the monitor's socket belongs to that of the states.
            self._state.disable_monitor()
        for made in (self._monitor, self._state, self._command, self._service):
            if made is not None:
                made.close(linger=0)
        self._monitor = self._state = self._command = self._service = None
        context, self._context = self._context, None
        if context is not None:
            context.destroy(linger=0)
