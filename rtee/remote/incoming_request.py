"""A request as the server sees it: checked before anything is done about it, answered once."""

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
"""Longest question that is looked at [bytes]: ten times that of the longest timed action."""

LONGEST_NUMBERED = 200
"""Longest number and client of what is put [bytes]; names of clients have 100 at most."""

REPLY = message_type("rtee_msgs/msg/Reply")
_EMPTY = message_type("rtee_msgs/msg/Empty")

Send = Callable[[bytes, bool], object]
"""Sends an encoded answer, or, when ``False`` is given with it, a refusal."""


def accepted(text: str = "") -> dict[str, Any]:
    """Return the fields of a ``rtee_msgs/Reply`` to a request that was taken."""
    return {"accepted": True, "error": "", "reason": "", "text": text}


def refusal(error: Exception) -> bytes:
    """Return the ``rtee_msgs/Reply`` that tells an error."""
    if not isinstance(error, RteeError):
        log.error("a request failed", exc_info=error)
    known = isinstance(error, RteeError)
    return REPLY.encode(
        {
            "accepted": False,
            "error": type(error).__name__,
            "reason": str(error) if known else f"internal error: {error!r}",
            "text": error.holder if isinstance(error, LeaseHeld) else "",
        }
    )


class Asked:
    """A question that is waiting for its answer.

    Attributes:
        request: Which request it is.
        question: The question, encoded.
        send: Sends the encoded answer.
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
        """Answer with a message of the request's type."""
        self.send(self.request.answer.encode(fields), True)

    def accept(self, text: str = "") -> None:
        """Answer that it was taken."""
        self.send(REPLY.encode(accepted(text)), True)

    def refuse(self, error: Exception) -> None:
        """Answer why not."""
        self.send(refusal(error), False)


def receive(
    message: zenoh.Query | zenoh.Sample, group: str, handle: Callable[[Asked], None], send: Send
) -> None:
    """Have a request of a group handled; what is none, or cannot be done, is refused."""
    try:
        handle(Asked(*_read(message, group), send))
    except Exception as error:
        send(refusal(error), False)


def _read(message: zenoh.Query | zenoh.Sample, group: str) -> tuple[Request, bytes]:
    """Take a question apart; cheap for junk of any size.

    Returns:
        The request, and the question, encoded.

    Raises:
        MessageError: if it is no request of the group.
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


def numbered(sample: zenoh.Sample) -> tuple[str, str]:
    """Return the number and the client under which something was put; empty if it was not so."""
    attachment = sample.attachment
    if attachment is None or len(attachment) > LONGEST_NUMBERED:
        return "", ""
    number, _, client = attachment.to_bytes().decode("ascii", "replace").partition(" ")
    return number, client


def reply(hand: str, query: zenoh.Query, data: bytes, ok: bool) -> None:
    """Answer a query with a message, or with a refusal; may wait for the network."""
    # Whoever asked may be gone by now.
    with contextlib.suppress(zenoh.ZError), query:
        if ok:
            # All hands may have been asked at once: this one answers under its own name.
            asked = str(query.key_expr).split("/", 2)[2]
            query.reply(network_key(hand, asked), data, express=True)
        else:
            query.reply_err(data)
