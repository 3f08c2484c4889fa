"""A request as the server sees it: checked before anything is done about it, answered once."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Any

import zenoh

from rtee.errors import LeaseHeld, MessageError, RteeError
from rtee.messages.requests import REQUESTS, Request
from rtee.messages.schema import message_type

log = logging.getLogger(__name__)

LONGEST = 65536
"""Longest question that is looked at [bytes]."""

LONGEST_NUMBERED = 200
"""Longest number and client of what is put instead of asked [bytes]."""

REPLY = message_type("rtee_msgs/msg/Reply")
_EMPTY = message_type("rtee_msgs/msg/Empty")

Reply = Callable[[bytes, bool], object]
"""Sends an encoded answer, or, when ``False`` is given with it, a refusal."""


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
    """

    __slots__ = ("_fields", "_reply", "question", "request")

    def __init__(self, request: Request, question: bytes, reply: Reply) -> None:
        self.request = request
        self.question = question
        self._reply = reply
        self._fields: dict[str, Any] | None = None

    @property
    def fields(self) -> dict[str, Any]:
        """The fields of the question; raises `MessageError`."""
        if self._fields is None:
            self._fields = self.request.question.decode(self.question) if self.question else {}
        return self._fields

    def answer(self, fields: Mapping[str, Any]) -> None:
        """Answer with a message of the request's type."""
        self.answer_bytes(self.request.answer.encode(fields))

    def answer_bytes(self, data: bytes) -> None:
        """Answer with an encoded message of the request's type."""
        self._reply(data, True)

    def accept(self, text: str = "") -> None:
        """Answer that it was taken."""
        self.answer({"accepted": True, "error": "", "reason": "", "text": text})

    def refuse(self, error: Exception) -> None:
        """Answer why not."""
        self._reply(refusal(error), False)


def read(asked: zenoh.Query | zenoh.Sample, group: str) -> tuple[Request, bytes]:
    """Take a question apart; cheap for junk of any size.

    Returns:
        The request, and the question, encoded.

    Raises:
        MessageError: if it is no request of the group.
    """
    name = str(asked.key_expr).rpartition("/")[2]
    request = REQUESTS.get(name)
    if request is None or request.group != group:
        raise MessageError(f"there is no request '{name[:50]}' in '{group}'")
    payload = asked.payload
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
