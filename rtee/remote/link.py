"""A client's connection to one hand: requests, topics and liveliness."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import secrets
import uuid
from collections import defaultdict, deque
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from typing import Any

import anyio
import anyio.to_thread
import zenoh

from rtee.errors import (
    ConfigError,
    GoalRejected,
    LeaseHeld,
    MessageError,
    NoHand,
    RemoteError,
    RequestRejected,
    TooManyRequests,
)
from rtee.hand.names import safe_name
from rtee.messages import network_key
from rtee.messages.identity import Signer, key_of
from rtee.messages.requests import (
    ALIVE,
    ANSWERS,
    CLIENTS,
    CONTROL,
    HELLO,
    HERE,
    PLAIN,
    REPLY,
    REQUESTS,
    SAMPLE,
    STOP,
    Request,
    Role,
    inbox_key,
    topic_for,
)
from rtee.remote.connections import vouching
from rtee.remote.credentials import common_name, person
from rtee.remote.rates import Rates
from rtee.remote.session import EXPRESS, direct

_CONNECT_WITHIN = 5.0
"""Time within which the hand must subscribe to samples [s]: as long as for an answer."""

ANSWER_WITHIN = 5.0
"""Default time to wait for an answer [s]: far longer than any request takes on a busy computer."""


_NONE = zenoh.ConsolidationMode.NONE
"""How Zenoh merges replies: not at all, or each would wait for the last one."""

_SOON = zenoh.Priority.INTERACTIVE_HIGH
"""Priority of requests."""

_FIRST = zenoh.Priority.REAL_TIME
"""Priority of a stop, which must overtake all other messages waiting to be sent."""

_TOO_FAST = 0.05
"""Time until a request that came too fast is repeated [s]: the hand accepts another one by then."""


class Link:
    """A client's connection to one hand. All methods must be called in the event loop's thread.

    The client uses an access path ``access_path`` to the hand, see `rtee.messages.requests.HELLO`.

    Attributes:
        gone: Whether the hand has gone, or this client has left it.
        role: This client's role, once it is connected.
    """

    def __init__(
        self, session: zenoh.Session, hand: str, client: str, access_path: str, prefix: str
    ) -> None:
        self.hand = hand
        self.client = client
        self.gone = False
        self._left = False
        self.role = Role.OBSERVER
        self._session = session
        self._loop = asyncio.get_running_loop()
        self._gone_callbacks: list[Callable[[], object]] = []
        self._subscribers: list[zenoh.Subscriber[None]] = []
        self._access_path = access_path
        self._signer = Signer(client)
        self._samples = session.declare_publisher(inbox_key(hand, access_path, client), **EXPRESS)
        self._samples_wanted = asyncio.Event()
        self._samples.declare_matching_listener(direct(self._on_match))
        self._refusals: dict[str, Callable[[RemoteError], None]] = {}
        # The limits that the hand applies, too: beyond them it answers late, and then not at all.
        self._rates = Rates()
        self._turns: defaultdict[str, asyncio.Lock] = defaultdict(asyncio.Lock)
        self._keys = {name: request.key(hand) for name, request in REQUESTS.items()}
        self._keys[HELLO] = network_key(hand, f"{HELLO}/{access_path}")
        # The hand knows by this token that its client is alive. Nobody else knows the token's name,
        # so nobody else can declare it.
        self._token_name = prefix + secrets.token_hex(16)[len(prefix) :]
        key = network_key(hand, f"{CLIENTS}/{self._token_name}")
        self._token = session.liveliness().declare_token(key)
        self._subscribers += [
            session.liveliness().declare_subscriber(
                network_key(hand, ALIVE), direct(self._on_liveliness), history=True
            ),
            session.declare_subscriber(
                network_key(hand, topic_for(access_path, f"{ANSWERS}/{client}")),
                direct(self._on_answer),
            ),
        ]

    def _call_soon(self, function: Callable[..., object], *arguments: object) -> None:
        # Zenoh may still deliver messages when the event loop has ended.
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(function, *arguments)

    # --- liveliness of the hand

    async def connect(self) -> None:
        """Introduce this client to the hand and wait until requests reach it; raises `NoHand`."""
        with vouching(self._token_name):
            answer = await self.request("hello", self._token_name)
        secret, _, role = answer["text"].partition(" ")
        self._signer.key = key_of(bytes.fromhex(secret))
        # An unknown role, of a newer hand, counts as the highest: the hand itself refuses requests.
        self.role = Role.__members__.get(role.upper(), Role.MAINTAINER)
        # Zenoh silently drops messages published before the hand has subscribed.
        try:
            async with asyncio.timeout(_CONNECT_WITHIN):
                await self._samples_wanted.wait()
        except TimeoutError:
            raise NoHand(f"the hand '{self.hand}' does not answer") from None
        if self.gone:
            raise self.lost()

    def on_gone(self, callback: Callable[[], object]) -> None:
        """Call a function when the hand goes."""
        self._gone_callbacks.append(callback)

    def _on_liveliness(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.DELETE:
            self._call_soon(self._on_gone)

    def lost(self) -> NoHand:
        """Return the error for pending and further requests after the hand was lost."""
        if self._left:
            return NoHand(f"this client has left the hand '{self.hand}'; connect again")
        return NoHand(f"the hand '{self.hand}' has ended or no longer answers")

    def leave(self) -> None:
        """Fail all pending requests because this client leaves; call it before `close`."""
        self._left = True
        self._on_gone()

    def _on_gone(self) -> None:
        self.gone = True
        self._samples_wanted.set()  # a client that still waits for that is told
        for callback in self._gone_callbacks:
            callback()

    # --- topics

    def subscribe(self, topic: str, receive: Callable[[bytes], object]) -> None:
        """Receive the messages on a topic of the hand until the link is closed."""

        def received(sample: zenoh.Sample) -> None:
            self._call_soon(_decoded, receive, sample.payload.to_bytes())

        self._subscribers.append(self._declared(topic, received))

    @contextlib.contextmanager
    def subscribed(
        self, topic: str, receive: Callable[[bytes], object], most: int
    ) -> Iterator[None]:
        """Receive the messages on a topic for as long as the context lasts.

        While the event loop is busy, the newest ``most`` messages are kept.
        """
        waiting: deque[bytes] = deque(maxlen=most)

        def drain() -> None:
            while waiting:
                _decoded(receive, waiting.popleft())

        def received(sample: zenoh.Sample) -> None:
            waiting.append(sample.payload.to_bytes())
            if len(waiting) == 1:  # otherwise the event loop has been woken already
                self._call_soon(drain)

        with self._subscriber(topic, received):
            yield

    @contextlib.contextmanager
    def collected(self, topic: str, most: int) -> Iterator[deque[bytes]]:
        """Collect the newest ``most`` messages on a topic for as long as the context lasts.

        Zenoh's thread collects them, so that the event loop is not woken.
        """
        messages: deque[bytes] = deque(maxlen=most)
        with self._subscriber(topic, lambda sample: messages.append(sample.payload.to_bytes())):
            yield messages

    @contextlib.contextmanager
    def _subscriber(self, topic: str, received: Callable[[zenoh.Sample], None]) -> Iterator[None]:
        subscriber = self._declared(topic, received)
        try:
            yield
        finally:
            subscriber.undeclare()  # type: ignore[no-untyped-call]

    def _declared(
        self, topic: str, received: Callable[[zenoh.Sample], None]
    ) -> zenoh.Subscriber[None]:
        key = network_key(self.hand, topic_for(self._access_path, topic))
        return self._session.declare_subscriber(key, direct(received))

    # --- requests

    async def ask(
        self, name: str, fields: Mapping[str, Any] | None = None, *, within: float = ANSWER_WITHIN
    ) -> dict[str, Any]:
        """Send a request and return the fields of its answer; see `paced`."""
        request = REQUESTS[name]
        question = b"" if fields is None else request.question.encode(fields)
        answer: dict[str, Any] = request.answer.decode(
            await self.paced(name, question, within=within)
        )
        return answer

    async def paced(
        self, name: str, question: bytes = b"", *, within: float = ANSWER_WITHIN
    ) -> bytes:
        """Send a request with an encoded question and return its encoded answer; see `send`.

        Waits while this client sends such requests faster than the hand accepts them. The time for
        the answer begins afterwards. A stop never waits.
        """
        group = REQUESTS[name].group
        if group != STOP:
            self._check_loop()
            # In the order of the calls, since one waits at a time.
            async with self._turns[name]:
                while not self._rates.allow(name):  # noqa: ASYNC110 - allowances have no event
                    await asyncio.sleep(self._rates.wait(name))
        until = self._loop.time() + within
        while True:
            try:
                return await self.send(name, question, within=within)
            except TooManyRequests:
                if self._loop.time() > until:
                    raise
            await asyncio.sleep(_TOO_FAST)

    async def request(
        self, name: str, what: str = "", *, within: float = ANSWER_WITHIN
    ) -> dict[str, Any]:
        """Send a ``rtee_msgs/ClientRequest`` and return the fields of its answer; see `send`."""
        return await self.ask(name, {"client": self.client, "what": what}, within=within)

    def send(
        self, name: str, question: bytes = b"", *, within: float = ANSWER_WITHIN
    ) -> asyncio.Future[bytes]:
        """Send a request with an encoded question now; return the future of its encoded answer.

        Raises:
            NoHand: if there is no answer within the time [s].
            ConfigError: if called in another event loop than that of this client.
            LeaseHeld: if another client holds the lease.
            RequestRejected: if the hand refuses the request, with its reason.
        """
        request = REQUESTS[name]
        if self.gone and request.group == CONTROL:
            raise self.lost()
        # A stop is sent all the same, though nobody can wait for its answer there.
        if request.group != STOP:
            self._check_loop()
        future: asyncio.Future[bytes] = self._loop.create_future()

        def replied(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                self._call_soon(self._settle, future, request, True, reply.ok.payload.to_bytes())
            elif reply.err is not None:
                self._call_soon(self._settle, future, request, False, reply.err.payload.to_bytes())

        def ended() -> None:
            # Without effect after a reply, which has completed the future.
            self._call_soon(self._settle, future, request, False, b"")

        try:
            self._session.get(
                self._keys[name],
                direct(replied, ended),
                consolidation=_NONE,
                timeout=within,
                priority=_FIRST if request.group == STOP else _SOON,
                express=True,
                payload=question,
                attachment=self._signer.attachment(self._signer.number(), name, question),
            )
        except zenoh.ZError as error:
            future.cancel()  # nobody waits for it, and Zenoh drops the query, which ends it
            raise self._unreachable(error) from None
        return future

    def _unreachable(self, error: zenoh.ZError) -> NoHand:
        if self._left:
            return self.lost()
        return NoHand(f"the hand '{self.hand}' cannot be reached: {error}")

    def _check_loop(self) -> None:
        if asyncio.get_running_loop() is not self._loop:
            raise ConfigError(
                "this client belongs to another event loop; connect in each, or use "
                "rtee.connect_blocking, whose methods any thread may call"
            )

    def put(self, question: bytes, label: str) -> None:
        """Send a sample of a stream under a label; see `refusals`. Raises `NoHand`."""
        if self.gone:
            raise self.lost()
        attachment = self._signer.attachment(self._signer.number(label), SAMPLE, question)
        try:
            self._samples.put(question, attachment=attachment)
        except zenoh.ZError as error:
            raise self._unreachable(error) from None

    def _on_match(self, status: zenoh.MatchingStatus) -> None:
        if status.matching:
            self._call_soon(self._samples_wanted.set)

    @contextlib.contextmanager
    def refusals(self, label: str, refused: Callable[[RemoteError], None]) -> Iterator[None]:
        """Call a function with the hand's refusals under a label, see `put`."""
        self._refusals[label] = refused
        try:
            yield
        finally:
            del self._refusals[label]

    def _on_answer(self, sample: zenoh.Sample) -> None:
        if sample.attachment is not None:
            label = sample.attachment.to_string().partition(".")[2]
            self._call_soon(self._refuse, label, sample.payload.to_bytes())

    def _refuse(self, label: str, data: bytes) -> None:
        if (refused := self._refusals.get(label)) is not None:
            refused(self._refusal(REQUESTS[SAMPLE], data))

    def _settle(
        self, future: asyncio.Future[bytes], request: Request, ok: bool, data: bytes
    ) -> None:
        """Complete the future of an answer; empty data of a refusal mean that none arrived."""
        # The caller may have been cancelled, or the answer has arrived before the end of the query.
        if future.done():
            return
        if ok:
            future.set_result(data)
        else:
            future.set_exception(self._refusal(request, data))

    def _refusal(self, request: Request, data: bytes) -> RemoteError:
        """Return the error of a refusal; empty data mean that there was no answer."""
        try:
            reply = REPLY.decode(data)
        except MessageError:
            if self.gone:
                return self.lost()
            # Zenoh drops what a role may not send.
            if text := request.refusal(self.role):
                return RequestRejected(text)
            # So it does to a certificate that it did not know when it started.
            known = self._access_path in (HERE, PLAIN)
            unsure = (
                "" if known else f", or does not know the certificate '{self._access_path}' yet"
            )
            return NoHand(f"the hand '{self.hand}' does not answer{unsure}")
        match reply["error"]:
            case "LeaseHeld":
                return LeaseHeld(reply["text"])
            case "TooManyRequests":
                return TooManyRequests(reply["reason"])
            case "GoalRejected" | "UnknownAction" | "ActionError":
                return GoalRejected(reply["reason"], **_details(reply["text"]))
            case _:
                return RequestRejected(reply["reason"])

    def close(self) -> None:
        """Undeclare everything; blocks for a moment."""
        # A broken connection leaves nothing to undeclare.
        with contextlib.suppress(zenoh.ZError):
            for subscriber in self._subscribers:
                subscriber.undeclare()  # type: ignore[no-untyped-call]
            self._samples.undeclare()  # type: ignore[no-untyped-call]
            # After the rest: when it goes, the hand drops this client's inbox and its lease.
            self._token.undeclare()  # type: ignore[no-untyped-call]


@contextlib.asynccontextmanager
async def introduced(
    session: zenoh.Session, hand: str, access_path: str, client: str, *, prefix: str = ""
) -> AsyncIterator[Link]:
    """Open a link to a hand in a session, which may serve others, too; see `Link.connect`.

    Args:
        session: The session.
        hand: The hand.
        access_path: The access path, see `rtee.remote.find.FoundSession`.
        client: A name for this client, shown to people.
        prefix: Beginning of its token's name, hexadecimal: `rtee.messages.requests.WATCHES`.
    """
    # The process id and a random part distinguish clients of the same name. The client's own name
    # is cut, so that all fits into the 100 characters of a name.
    own = client[:50].replace(".", "_")  # a dot sets off the person of a certificate
    owner = "" if access_path in (HERE, PLAIN) else f"{person(access_path)}."
    identity = safe_name(f"{owner}{own}-{os.getpid()}-{uuid.uuid4().hex[:8]}", "client")
    link = Link(session, hand, identity, common_name(access_path), prefix)
    try:
        yield link
    finally:
        link.leave()
        # Even when cancelled: while its token is there, the client is alive to the hand.
        with anyio.CancelScope(shield=True):
            await anyio.to_thread.run_sync(link.close)


def _details(text: str) -> dict[str, Any]:
    """Return the details that the hand sent with a refused goal."""
    with contextlib.suppress(ValueError, TypeError):
        said = json.loads(text)
        return {
            "option": str(said["option"]),
            "given": str(said["given"]),
            "valid": [str(name) for name in said["valid"]],
        }
    return {}


def _decoded(receive: Callable[[bytes], object], data: bytes) -> None:
    # Any peer may publish on a key; undecodable messages are ignored.
    with contextlib.suppress(MessageError):
        receive(data)
