"""A serial line: requests and answers with deadlines and retries."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, TypeVar, cast

from rtee import monotonic
from rtee.buses.bus import Bus
from rtee.buses.link import Line, SerialTransport, ended, open_link
from rtee.buses.parser import Parser
from rtee.buses.timing import Pause
from rtee.errors import BusBroken, BusTimeout, FrameError

F = TypeVar("F")

_UNRETURNED = 1024
"""Bytes sent last that are kept to recognise their echo: several frames of every protocol."""

_NOTHING: Any = object()
"""Result of an answer's future if no answer came in time."""


def _give_up(answer: asyncio.Future[Any]) -> None:
    if not answer.done():
        answer.set_result(_NOTHING)


class SerialBus(Bus):
    """A serial line, or a socket that leads to one; one transaction at a time.

    Attributes:
        line: Settings of the line.
        gap: Silence kept between the last byte received or sent and the next request [s].
        fresh: Whether bytes received before a request are discarded, for protocols whose answers
            do not identify their request.

    Args:
        address: Returns the address to connect to; by default ``name``.
    """

    def __init__(
        self,
        name: str,
        line: Line,
        *,
        address: Callable[[], str] | None = None,
        gap: float = 0.0,
        fresh: bool = False,
    ) -> None:
        super().__init__(name)
        self.line = line
        self.gap = gap
        self.fresh = fresh
        self._address = address or (lambda: name)
        self._transport: asyncio.Transport | None = None
        self._protocol: asyncio.Protocol | None = None
        self._lock = asyncio.Lock()
        self._queue = 0  # number of tasks that wait for the line
        self._answer: asyncio.Future[Any] | None = None
        self._parser: Parser[Any] | None = None
        self._accept: Callable[[Any], bool] | None = None
        self._encode: Callable[[Any], bytes] | None = None
        self._echo = _Echo()
        self._listener: Callable[[bytes], None] | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._pause = Pause()
        self._last = 0.0
        self._unreturned = b""  # bytes sent that an adapter may still return
        self._other = False  # whether bytes came that are not an echo

    async def transact(
        self,
        request: bytes | Callable[[], bytes],
        parser: Parser[F],
        deadline: float,
        retries: int = 1,
        *,
        accept: Callable[[F], bool] | None = None,
        encode: Callable[[F], bytes] | None = None,
        whom: str = "",
    ) -> F:
        """Send a request and return the frame that answers it.

        Args:
            request: The bytes to send, or a function that makes them for each attempt.
            parser: Finds the answer; it is reset before every attempt.
            deadline: Longest time for the whole transaction, including retries and waiting for the
                line [s].
            retries: How often the request may be sent again within that time.
            accept: Returns whether a frame is the answer; others are counted as strays.
            encode: Returns the bytes of a frame, for protocols whose requests have the form of
                answers: then an adapter's echo of the request does not count as its answer. The
                first request after connecting must be one whose answer differs from it.
            whom: Name of the device for error messages, on a line with several devices.

        Raises:
            BusTimeout: if no byte came in time.
            FrameError: if bytes came in time, but no valid frame.
            BusBroken: if the link is broken.
            BusClosed: if the bus is closed.
        """
        end = monotonic.now() + deadline
        # The parser outlives the transaction, so only its new errors belong to this one.
        errors = parser.errors
        received = 0
        # A free lock is acquired without a timeout context, which costs more than the lock. A lock
        # that was just released is not free while others wait: the first of them gets it.
        if self._lock.locked() or self._queue:
            await self._wait_for_line(deadline)
        else:
            await self._lock.acquire()
        counters = self.counters
        try:
            self.check()
            counters.transactions += 1
            for attempt in range(retries + 1):
                share = (end - monotonic.now()) / (retries + 1 - attempt)
                if share <= 0.0:
                    break
                if attempt:
                    counters.retries += 1
                before = counters.bytes_received
                try:
                    # A future instead of a coroutine saves an iteration of the event loop.
                    frame = await self._ask(request, parser, share, accept, encode)
                finally:
                    self._asked()
                if frame is not _NOTHING:
                    return cast("F", frame)
                counters.timeouts += 1
                # Invalid bytes and silence are different errors; an adapter's echo of the request,
                # and nothing else, is silence.
                received += counters.bytes_received - before if self._other else 0
        finally:
            counters.checksum_errors += parser.errors - errors
            self._lock.release()
        where = f"{whom}: " if whom else ""
        if received:
            raise FrameError(
                self.name, f"{where}{received} bytes but no valid answer in {deadline:.3f} s"
            )
        raise BusTimeout(self.name, f"{where}no answer within {deadline:.3f} s")

    def _ask(
        self,
        request: bytes | Callable[[], bytes],
        parser: Parser[F],
        share: float,
        accept: Callable[[F], bool] | None,
        encode: Callable[[F], bytes] | None,
    ) -> asyncio.Future[Any]:
        """Send a request and return the future of its answer: `_NOTHING` after a timeout."""
        parser.reset()
        loop = asyncio.get_running_loop()
        answer = self._answer = loop.create_future()
        data = request if isinstance(request, bytes) else request()
        self._other = False

        def ask() -> None:
            if answer.done():
                return  # timed out, or the link is broken
            if self._not_silent(ask):
                return
            if self.fresh and isinstance(self._transport, SerialTransport):
                self._transport.read_now()  # without a parser, bytes are discarded
                if self._not_silent(ask):
                    return
            self._parser, self._accept = parser, accept
            if encode is not None and self._echo.possible:
                self._encode = encode
                self._echo.begin(data, self.counters.bytes_received)
            self._write(data)

        ask()
        # A timer costs less than asyncio.timeout, and is started after the request was sent, to
        # send it as early as possible in every cycle.
        self._timer = loop.call_later(share, _give_up, answer)
        return answer

    def _not_silent(self, ask: Callable[[], None]) -> bool:
        """Return whether the silent gap still lasts; if so, call ``ask`` again at its end."""
        # `ask` checks again, since a late answer may have extended the gap meanwhile.
        if not self.gap or (due := self._last + self.gap) <= monotonic.now():
            return False
        self._pause.start(due, ask)
        return True

    def _asked(self) -> None:
        self._answer = self._parser = self._accept = self._encode = None
        if self.gap:
            self._pause.cancel()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    async def send(self, data: bytes, deadline: float = 0.1) -> None:
        """Send bytes that are not answered, waiting for the line for ``deadline`` [s] at most.

        Raises:
            BusTimeout: if the line was not free in time.
            BusBroken: if the link is broken.
            BusClosed: if the bus is closed.
        """
        if not self._lock.locked() and not self.gap:
            self.check()
            self.counters.transactions += 1
            self._write(data)
            return
        await self._wait_for_line(deadline)
        try:
            self.check()
            self.counters.transactions += 1
            if self.gap:
                await self._pause.until(self._last + self.gap)
            self._write(data)
        finally:
            self._lock.release()

    async def _wait_for_line(self, deadline: float) -> None:
        self._queue += 1
        try:
            async with asyncio.timeout(deadline):
                await self._lock.acquire()
        except TimeoutError:
            self.counters.timeouts += 1
            raise BusTimeout(self.name, f"the line was not free within {deadline:.3f} s") from None
        finally:
            self._queue -= 1

    def listen(self, listener: Callable[[bytes], None] | None) -> None:
        """Pass bytes that answer no request to ``listener``; devices may send by themselves."""
        self._listener = listener

    def _write(self, data: bytes) -> None:
        self.check()
        if self._transport is None:
            raise BusBroken(self.name, "no link")
        self._count("tx", data, monotonic.now())
        self._unreturned = (self._unreturned + data)[-_UNRETURNED:]
        self._transport.write(data)
        # After writing, since the gap begins with the last byte.
        self._last = monotonic.now()

    def _received(self, data: bytes) -> None:
        self._last = monotonic.now()
        self._count("rx", data, self._last)
        if self._unreturned.startswith(data):
            self._unreturned = self._unreturned[len(data) :]
        else:
            self._unreturned, self._other = b"", True
        if self._parser is None or self._answer is None:
            self.counters.strays += len(data)
            if self._listener is not None:
                self._listener(data)
            return
        for frame in self._parser.feed(data):
            mine = not self._echoed(frame) and (self._accept is None or self._accept(frame))
            if self._answer.done() or not mine:
                self.counters.strays += 1
            else:
                if self._encode is not None:
                    self._echo.answered(self._encode(frame), self.counters.bytes_received)
                self._answer.set_result(frame)

    def _echoed(self, frame: Any) -> bool:
        """Return whether a frame is the adapter's echo of the request."""
        return self._encode is not None and self._echo.returned(self._encode(frame))

    def _lost(self, protocol: asyncio.Protocol, error: Exception | None) -> None:
        # A late report about an earlier link is ignored.
        if protocol is not self._protocol:
            return
        self._broke(str(error) if error else "")
        if self._answer is not None and not self._answer.done():
            self._answer.set_exception(BusBroken(self.name, f"the link failed: {self._cause}"))

    async def _open(self) -> None:
        await self._close()
        self._echo, self._unreturned = _Echo(), b""
        transport, protocol = await open_link(
            self._address(),
            self.line,
            lambda: _Protocol(self._received, self._lost),
            name=self.name,
        )
        # A TCP bridge may accept the connection and close it before this code runs again.
        if transport.is_closing():
            raise BusBroken(self.name, "the other end closed the connection at once")
        self._transport, self._protocol = transport, protocol

    async def _close(self) -> None:
        self._protocol = None
        self._pause.close()
        transport, self._transport = self._transport, None
        if self._answer is not None and not self._answer.done():
            self._answer.set_exception(BusBroken(self.name, "the bus was closed meanwhile"))
        if transport is not None:
            transport.abort()
            await ended(transport)


class _Echo:
    """Decides whether an adapter returns what the host sends, as some on two-wire lines do.

    A frame that equals the request is its echo, unless the adapter is known to return nothing: some
    answers equal their request.

    Attributes:
        possible: Whether the adapter may return what is sent.
    """

    def __init__(self) -> None:
        self.possible = True
        self._proven = False
        self._returned = False
        self._request = b""
        self._half = 1
        self._before = 0

    def begin(self, request: bytes, received: int) -> None:
        """Record a request, and the number of bytes received before it."""
        self._request, self._before, self._returned = request, received, False
        self._half = max(1, len(request) // 2)

    def returned(self, raw: bytes) -> bool:
        """Return whether a frame with these bytes is the echo of the request."""
        if not self.possible or raw != self._request:
            return False
        self._request = b""  # an equal frame that follows is the answer
        self._returned = True
        return True

    def answered(self, raw: bytes, received: int) -> None:
        """Record the bytes of an answer, and the number of bytes received by then."""
        # A damaged echo still has most of its bytes; noise is a byte or two.
        self._proven |= self._returned
        self.possible = self._proven or received - self._before - len(raw) >= self._half


class _Protocol(asyncio.Protocol):
    def __init__(
        self,
        received: Callable[[bytes], None],
        lost: Callable[[asyncio.Protocol, Exception | None], None],
    ) -> None:
        # Directly the bus's method, since a forwarding method would cost time in every cycle.
        self.data_received = received  # type: ignore[method-assign,assignment]
        self._end = lost

    def connection_lost(self, exc: Exception | None) -> None:
        self._end(self, exc)
