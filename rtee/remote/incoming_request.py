"""A request as the server receives it: checked before it is handled, answered exactly once."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Mapping
from typing import Any

import zenoh

from rtee.errors import LeaseHeld, MessageError, RteeError
from rtee.messages import network_key
from rtee.messages.requests import REQUESTS, Request
from rtee.messages.schema import message_type

log = logging.getLogger(__name__)

LONGEST = 65536
"""Longest question that is decoded [bytes]: ten times that of the longest timed action."""

LONGEST_NUMBERED = 200
"""Longest attachment of a published request [bytes]; names of clients have 100 at most."""

REPLY = message_type("rtee_msgs/msg/Reply")
_EMPTY = message_type("rtee_msgs/msg/Empty")

Send = Callable[[bytes, bool], object]
"""Sends an encoded answer to the client; a refusal if the second argument is ``False``."""


def accepted(text: str = "") -> dict[str, Any]:
    """Return the fields of the ``rtee_msgs/Reply`` to an accepted request."""
    return {"accepted": True, "error": "", "reason": "", "text": text}


def refusal(error: Exception) -> bytes:
    """Return the ``rtee_msgs/Reply`` that reports an error."""
    known = isinstance(error, RteeError)
    if not known:
        log.error("a request failed", exc_info=error)
    return REPLY.encode(
        {
            "accepted": False,
            "error": type(error).__name__,
            "reason": str(error) if known else f"internal error: {error!r}",
            "text": error.holder if isinstance(error, LeaseHeld) else "",
        }
    )


class IncomingRequest:
    """A request that waits for its answer.

    Attributes:
        request: Which request it is.
        question: The question, encoded.
        send: Sends the answer.
    """

    __slots__ = ("_fields", "question", "request", "send")

    def __init__(self, request: Request, question: bytes, send: Send) -> None:
        self.request = request
        self.question = question
        self.send = send
        self._fields: dict[str, Any] | None = None

    @property
    def fields(self) -> dict[str, Any]:
        """The fields of the question; raises `MessageError`."""
        if self._fields is None:
            self._fields = self.request.question.decode(self.question) if self.question else {}
        return self._fields

    def answer(self, fields: Mapping[str, Any]) -> None:
        """Send the fields of an answer."""
        self.send(self.request.answer.encode(fields), True)

    def refuse(self, error: Exception) -> None:
        """Send the reason why the request is refused."""
        self.send(refusal(error), False)


Handler = Callable[[IncomingRequest], bytes | None]
"""Handles a request; returns the encoded answer, or ``None`` if it will be sent later."""


def handle_request(
    message: zenoh.Query | zenoh.Sample, group: str, handle: Handler, send: Send
) -> None:
    """Check a request of a group, have it handled, and send the answer or the reason against it."""
    try:
        answer = handle(IncomingRequest(*_read(message, group), send))
    except Exception as error:
        send(refusal(error), False)
    else:
        if answer is not None:
            send(answer, True)


def _read(message: zenoh.Query | zenoh.Sample, group: str) -> tuple[Request, bytes]:
    """Return which request a message is and its encoded question; cheap for junk of any size.

    Raises:
        MessageError: if the message is not a request of the group.
    """
    name = str(message.key_expr).rpartition("/")[2]
    request = REQUESTS.get(name)
    if request is None or request.group != group:
        raise MessageError(f"there is no request '{name[:50]}' in '{group}'")
    payload = message.payload
    size = 0 if payload is None else len(payload)
    if size > LONGEST:
        raise MessageError(f"{size} bytes are longer than any request")
    if payload is None or not size:
        if request.question is not _EMPTY:
            raise MessageError(f"the request '{name}' needs a {request.question.name}")
        return request, b""
    return request, payload.to_bytes()


def number_and_client(sample: zenoh.Sample) -> tuple[str, str]:
    """Return the number and the client of a published request; empty if it carries none."""
    attachment = sample.attachment
    if attachment is None or len(attachment) > LONGEST_NUMBERED:
        return "", ""
    number, _, client = attachment.to_bytes().decode("ascii", "replace").partition(" ")
    return number, client


def reply(hand: str, query: zenoh.Query, data: bytes, ok: bool) -> None:
    """Answer a query with a message, or with a refusal; may wait for the network."""
    with contextlib.suppress(zenoh.ZError), query:  # the client may have left by now
        if ok:
            # A query may address all hands at once; each answers under its own name.
            asked = str(query.key_expr).split("/", 2)[2]
            query.reply(network_key(hand, asked), data, express=True)
        else:
            query.reply_err(data)
