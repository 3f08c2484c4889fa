"""The wire between a client and a hand: questions with answers, topics, and whether it is there."""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import zenoh

from rtee.errors import LeaseHeld, MessageError, NoHand, RequestRejected
from rtee.messages import network_key
from rtee.messages.requests import ALIVE, CLIENTS, PUT, REQUESTS, STOP
from rtee.messages.schema import message_type
from rtee.remote.fast_requests import Putting
from rtee.remote.session import direct

_REPLY = message_type("rtee_msgs/msg/Reply")


class Link:
    """A client's session with one hand. All methods are called in the event loop's thread.

    Args:
        session: The network.
        hand: The hand's name.
        client: This client's name on the network.

    Attributes:
        putting: What is in a hurry goes this way.
    """

    def __init__(self, session: zenoh.Session, hand: str, client: str) -> None:
        self.hand = hand
        self.client = client
        self._session = session
        self._loop = asyncio.get_running_loop()
        self._subscribers: list[zenoh.Subscriber[None]] = []
        self.putting = Putting(session, hand, client, self._call_soon, self._error)
        self._token = session.liveliness().declare_token(network_key(hand, f"{CLIENTS}/{client}"))

    def _call_soon(self, function: Callable[..., object], *arguments: object) -> None:
        # Zenoh may still deliver when the event loop has ended.
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(function, *arguments)

    def _declared(self, key: str, receive: Callable[[bytes], object]) -> zenoh.Subscriber[None]:
        def received(sample: zenoh.Sample) -> None:
            self._call_soon(_decoded, receive, sample.payload.to_bytes())

        return self._session.declare_subscriber(key, direct(received))

    def subscribe(self, topic: str, receive: Callable[[bytes], object]) -> None:
        """Have messages on a topic of the hand taken until the link is closed."""
        self._subscribers.append(self._declared(network_key(self.hand, topic), receive))

    @contextlib.contextmanager
    def subscribed(self, key: str, receive: Callable[[bytes], object], most: int) -> Any:
        """Have messages on a key taken for as long as the context lasts.

        While the event loop is held up, the newest ``most`` wait.
        """
        waiting: deque[bytes] = deque(maxlen=most)

        def drain() -> None:
            while waiting:
                _decoded(receive, waiting.popleft())

        def received(sample: zenoh.Sample) -> None:
            waiting.append(sample.payload.to_bytes())
            if len(waiting) == 1:
                self._call_soon(drain)

        subscriber = self._session.declare_subscriber(key, direct(received))
        try:
            yield
        finally:
            subscriber.undeclare()  # type: ignore[no-untyped-call]

    @contextlib.contextmanager
    def collected(self, key: str, most: int) -> Iterator[deque[bytes]]:
        """Collect messages on a key for as long as the context lasts; the newest ``most`` stay.

        Zenoh's thread collects them: the event loop is not woken.
        """
        found: deque[bytes] = deque(maxlen=most)

        def received(sample: zenoh.Sample) -> None:
            found.append(sample.payload.to_bytes())

        subscriber = self._session.declare_subscriber(key, direct(received))
        try:
            yield found
        finally:
            subscriber.undeclare()  # type: ignore[no-untyped-call]

    def watch(self, gone: Callable[[], object]) -> None:
        """Call ``gone`` when the hand is there no more."""

        def changed(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.DELETE:
                self._call_soon(gone)

        key = network_key(self.hand, ALIVE)
        self._subscribers.append(
            self._session.liveliness().declare_subscriber(key, direct(changed), history=True)
        )

    async def ask(
        self, name: str, fields: Mapping[str, Any] | None = None, *, within: float = 5.0
    ) -> dict[str, Any]:
        """Ask the hand and return the fields of its answer; see `ask_bytes`."""
        request = REQUESTS[name]
        question = b"" if fields is None else request.question.encode(fields)
        return request.answer.decode(await self.ask_bytes(name, question, within=within))

    async def ask_bytes(self, name: str, question: bytes = b"", *, within: float = 5.0) -> bytes:
        """Ask the hand and return its answer; see `send`."""
        return await self.send(name, question, within=within)

    def send(
        self, name: str, question: bytes = b"", *, within: float = 5.0
    ) -> asyncio.Future[bytes]:
        """Send a question to the hand, now, and return its answer to come.

        Args:
            name: Name of the request.
            question: The question, encoded.
            within: Time to wait for the answer [s].

        Raises:
            NoHand: if there is no answer.
            LeaseHeld: if another client holds the hand.
            RequestRejected: if the hand refused; with its reason.
        """
        if name in PUT:
            return self.putting.send(name, question, within)
        request = REQUESTS[name]
        future: asyncio.Future[bytes] = self._loop.create_future()

        def settle(ok: bool, data: bytes) -> None:
            if future.done():
                return
            if ok:
                future.set_result(data)
            else:
                future.set_exception(self._error(data))

        def replied(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                self._call_soon(settle, True, reply.ok.payload.to_bytes())
            elif reply.err is not None:
                self._call_soon(settle, False, reply.err.payload.to_bytes())

        def ended() -> None:
            self._call_soon(settle, False, b"")

        first = request.group == STOP
        try:
            self._session.get(
                request.key(self.hand),
                direct(replied, ended),
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=within,
                priority=zenoh.Priority.REAL_TIME if first else zenoh.Priority.INTERACTIVE_HIGH,
                express=True,
                payload=question,
            )
        except zenoh.ZError as error:
            raise NoHand(f"the hand '{self.hand}' cannot be asked: {error}") from None
        return future

    def _error(self, data: bytes) -> Exception:
        try:
            reply = _REPLY.decode(data)
        except MessageError:
            return NoHand(f"the hand '{self.hand}' does not answer")
        if reply["error"] == LeaseHeld.__name__:
            return LeaseHeld(reply["text"])
        return RequestRejected(reply["reason"])

    def close(self) -> None:
        """Undeclare everything; blocks for a moment."""
        with contextlib.suppress(zenoh.ZError):
            for subscriber in self._subscribers:
                subscriber.undeclare()  # type: ignore[no-untyped-call]
            self.putting.close()
            self._token.undeclare()  # type: ignore[no-untyped-call]
            self._session.close()  # type: ignore[no-untyped-call]


def _decoded(receive: Callable[[bytes], object], data: bytes) -> None:
    # Anybody may publish on a key; what is no message there is nobody's.
    with contextlib.suppress(MessageError):
        receive(data)
