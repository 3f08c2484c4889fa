"""The samples of streams, which are published: they need no answer."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Iterator

import zenoh

from rtee.errors import NoHand
from rtee.messages import network_key
from rtee.messages.identity import Signer
from rtee.messages.requests import ANSWERS, SAMPLE, inbox_key, topic_for
from rtee.remote.session import EXPRESS, direct

_CONNECT_WITHIN = 5.0
"""Time within which the hand must subscribe to samples [s]: as long as for an answer."""


class Samples:
    """Publishes samples of streams to one hand, and reports those that it refuses.

    All methods must be called in the event loop's thread. ``access_path``: see
    `rtee.messages.requests.HELLO`; ``call_soon`` calls a function in the event loop's thread, from
    any thread.
    """

    def __init__(
        self,
        session: zenoh.Session,
        hand: str,
        client: str,
        access_path: str,
        signer: Signer,
        call_soon: Callable[..., None],
    ) -> None:
        self._hand, self._signer, self._call_soon = hand, signer, call_soon
        self._refusals: dict[str, Callable[[bytes], None]] = {}
        self._connected = asyncio.Event()
        self._publisher = session.declare_publisher(inbox_key(hand, access_path, client), **EXPRESS)
        self._publisher.declare_matching_listener(direct(self._on_match))
        self._answers = session.declare_subscriber(
            network_key(hand, topic_for(access_path, f"{ANSWERS}/{client}")),
            direct(self._on_answer),
        )

    def _on_match(self, status: zenoh.MatchingStatus) -> None:
        if status.matching:
            self._call_soon(self._connected.set)

    async def connected(self) -> None:
        """Wait until samples reach the hand; raises `NoHand`."""
        try:
            async with asyncio.timeout(_CONNECT_WITHIN):
                await self._connected.wait()
        except TimeoutError:
            raise NoHand(f"the hand '{self._hand}' does not answer") from None

    def put(self, question: bytes, label: str) -> None:
        """Publish an encoded sample under a label; see `refusals`. Raises `NoHand`."""
        attachment = self._signer.attachment(self._signer.number(label), SAMPLE, question)
        try:
            self._publisher.put(question, attachment=attachment)
        except zenoh.ZError as error:
            raise NoHand(f"the hand '{self._hand}' cannot be asked: {error}") from None

    @contextlib.contextmanager
    def refusals(self, label: str, refused: Callable[[bytes], None]) -> Iterator[None]:
        """Call a function with the refusals under a label for as long as the context lasts."""
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
            refused(data)

    def close(self) -> None:
        """Undeclare everything; blocks for a moment."""
        self._publisher.undeclare()  # type: ignore[no-untyped-call]
        self._answers.undeclare()  # type: ignore[no-untyped-call]
