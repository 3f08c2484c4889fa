"""A request as the server sees it: checked before anything is done about it, answered once."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Mapping
from typing import Any

import zenoh

from rtee.errors import LeaseHeld, MessageError, RteeError
from rtee.messages.requests import REQUESTS, Request
from rtee.messages.schema import message_type

log = logging.getLogger(__name__)

LONGEST = 65536
"""Longest question that is looked at [bytes]."""

REPLY = message_type("rtee_msgs/msg/Reply")
_EMPTY = message_type("rtee_msgs/msg/Empty")


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
        question: The question.
        fields: Its fields.
    """

    __slots__ = ("_key", "_query", "fields", "question", "request")

    def __init__(self, query: zenoh.Query, key: str, request: Request, question: bytes) -> None:
        self._query = query
        self._key = key
        self.request = request
        self.question = question
        self.fields = request.question.decode(question) if question else {}

    def answer(self, fields: Mapping[str, Any]) -> None:
        """Answer with a message of the request's type."""
        self.answer_bytes(self.request.answer.encode(fields))

    def answer_bytes(self, data: bytes) -> None:
        """Answer with an encoded message of the request's type."""
        # Whoever asked may be gone by now.
        with contextlib.suppress(zenoh.ZError), self._query:
            self._query.reply(self._key, data, express=True)

    def accept(self, text: str = "") -> None:
        """Answer that it was taken."""
        self.answer({"accepted": True, "error": "", "reason": "", "text": text})

    def refuse(self, error: Exception) -> None:
        """Answer why not."""
        refuse(self._query, error)


def refuse(query: zenoh.Query, error: Exception) -> None:
    """Answer a query with why it was not taken."""
    with contextlib.suppress(zenoh.ZError), query:
        query.reply_err(refusal(error))


def read(query: zenoh.Query, hand: str, group: str) -> Asked:
    """Take a query apart; cheap for junk of any size.

    Raises:
        MessageError: if it is no request of the group.
    """
    name = str(query.key_expr).rpartition("/")[2]
    request = REQUESTS.get(name)
    if request is None or request.group != group:
        raise MessageError(f"there is no request '{name[:50]}' in '{group}'")
    payload = query.payload
    size = 0 if payload is None else len(payload)
    if size > LONGEST:
        raise MessageError(f"{size} bytes are longer than any request")
    if payload is None or not size:
        if request.question is not _EMPTY:
            raise MessageError(f"the request '{name}' needs a {request.question.name}")
        return Asked(query, request.key(hand), request, b"")
    return Asked(query, request.key(hand), request, payload.to_bytes())
