"""Requests that are published instead of queried, since that reaches the hand sooner.

A goal that is published reaches the server's callback 0.11 ms sooner than one that is sent as a
Zenoh query, and so do its answer and the first changed reference: 0.65 ms against 0.76 ms until the
callback, 1.25 ms against 1.35 ms until the stamp of that reference (medians of 600 goals each, by
turns, hand at 1 kHz on a busy computer with two cores).
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Iterator

import zenoh

from rtee.errors import NoHand, TooManyRequests
from rtee.messages import network_key
from rtee.messages.identity import Signer
from rtee.messages.requests import ANSWERS, PUT, inbox_key, topic_for
from rtee.remote.session import EXPRESS, direct

_CONNECT_WITHIN = 5.0
"""Time within which the hand must subscribe to publications [s]: as long as for an answer."""


class FastRequests:
    """Publishes requests to one hand and waits for their answers.

    Each request carries a number in its attachment, and its answer the same number. Everything that
    does not depend on a single request is prepared when this object is made. All methods must be
    called in the event loop's thread.

    ``way`` is the client's access path, see `rtee.messages.requests.HELLO`. ``call_soon`` calls a
    function in the event loop's thread, from any thread; ``settle`` completes the future of an
    answer, see `Link`.
    """

    def __init__(
        self,
        session: zenoh.Session,
        hand: str,
        client: str,
        way: str,
        signer: Signer,
        call_soon: Callable[..., None],
        settle: Callable[[asyncio.Future[bytes], bool, bytes], None],
    ) -> None:
        self._hand, self._signer = hand, signer
        self._call_soon, self._complete = call_soon, settle
        self._loop = asyncio.get_running_loop()
        self._waiting: dict[str, asyncio.Future[bytes]] = {}
        self._refusals: dict[str, Callable[[bytes], None]] = {}
        self._gone: NoHand | None = None
        self._unmatched = set(PUT)
        self._connected = asyncio.Event()
        self._publishers = {
            name: self._publisher(session, name, inbox_key(hand, way, name, client)) for name in PUT
        }
        self._answers = session.declare_subscriber(
            network_key(hand, topic_for(way, f"{ANSWERS}/{client}")), direct(self._on_answer)
        )

    def _publisher(self, session: zenoh.Session, name: str, key: str) -> zenoh.Publisher:
        publisher = session.declare_publisher(key, **EXPRESS)

        def changed(status: zenoh.MatchingStatus) -> None:
            self._call_soon(self._on_match, name, status.matching)

        publisher.declare_matching_listener(direct(changed))
        return publisher

    def _on_match(self, name: str, matching: bool) -> None:
        if not matching:
            # `_connected` stays set: it is about the first time only, and `send` looks here.
            self._unmatched.add(name)
            return
        self._unmatched.discard(name)
        if not self._unmatched:
            self._connected.set()

    async def connected(self) -> None:
        """Wait until publications reach the hand; raises `NoHand`."""
        try:
            async with asyncio.timeout(_CONNECT_WITHIN):
                await self._connected.wait()
        except TimeoutError:
            raise NoHand(f"the hand '{self._hand}' does not answer") from None

    def send(self, name: str, question: bytes, within: float) -> asyncio.Future[bytes]:
        """Publish a request and return the future of its answer; see `Link.send`."""
        if self._gone:
            raise self._gone
        # The hand withdraws its subscriber from a client that sends too much (see `Inboxes`); a
        # request published meanwhile would be lost without an answer.
        if name in self._unmatched:
            raise TooManyRequests(
                f"the hand '{self._hand}' does not listen for a while: too many requests came"
            )
        number = self._signer.number()
        self._publish(name, question, number)
        # The answer is delivered in this thread, so it cannot arrive before the future exists.
        future = self._waiting[number] = self._loop.create_future()
        timer = self._loop.call_later(within, self._settle, number, False, b"")
        future.add_done_callback(lambda _: self._forget(number, timer))
        return future

    def _publish(self, name: str, question: bytes, number: str) -> None:
        attachment = self._signer.attachment(number, name, question)
        try:
            self._publishers[name].put(question, attachment=attachment)
        except zenoh.ZError as error:
            raise NoHand(f"the hand '{self._hand}' cannot be asked: {error}") from None

    def put(self, name: str, question: bytes, label: str) -> None:
        """Publish a request that is only answered if it is refused, under a label; see `refusals`.

        Raises `NoHand` if the hand has gone.
        """
        if self._gone:
            raise self._gone
        self._publish(name, question, self._signer.number(label))

    @contextlib.contextmanager
    def refusals(self, label: str, refused: Callable[[bytes], None]) -> Iterator[None]:
        """Call a function with the refusals under a label for as long as the context lasts."""
        self._refusals[label] = refused
        try:
            yield
        finally:
            del self._refusals[label]

    def _forget(self, number: str, timer: asyncio.TimerHandle) -> None:
        timer.cancel()
        self._waiting.pop(number, None)

    def _on_answer(self, sample: zenoh.Sample) -> None:
        if sample.attachment is not None:
            number = sample.attachment.to_string()
            data = sample.payload.to_bytes()
            # The first character says whether the request was accepted.
            self._call_soon(self._settle, number[1:], number[:1] == "+", data)

    def _settle(self, number: str, ok: bool, data: bytes) -> None:
        future = self._waiting.pop(number, None)
        if future is not None:
            self._complete(future, ok, data)
        elif not ok and (refused := self._refusals.get(number.partition(".")[2])) is not None:
            refused(data)

    def fail_all(self, gone: NoHand) -> None:
        """End all waiting requests, and refuse new ones by an error, since the hand has gone."""
        self._gone = gone
        # A copy, since each answer leaves the mapping.
        for number in tuple(self._waiting):
            self._settle(number, False, b"")

    def close(self) -> None:
        """Undeclare everything; blocks for a moment."""
        for publisher in self._publishers.values():
            publisher.undeclare()  # type: ignore[no-untyped-call]
        self._answers.undeclare()  # type: ignore[no-untyped-call]
