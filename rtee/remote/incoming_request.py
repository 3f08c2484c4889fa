"""Requests in the server: checked before they are handled, answered exactly once."""

from __future__ import annotations

import contextlib
import json
import logging
from collections.abc import Callable, Mapping
from typing import Any

import zenoh

from rtee.errors import (
    GoalRejected,
    LeaseHeld,
    MessageError,
    RteeError,
    TooManyRequests,
    UnknownAction,
)
from rtee.messages import network_key
from rtee.messages.identity import LONGEST_CLAIM
from rtee.messages.requests import HELLO, INBOX, REPLY, REQUESTS, Request
from rtee.messages.schema import message_type
from rtee.remote.rates import Ignored

log = logging.getLogger(__name__)

LONGEST = 65536
"""Longest question that is decoded [bytes]: ten times the longest timed action."""

_NAMES = {
    group: ", ".join(each.name for each in REQUESTS.values() if each.group == group)
    for group in {each.group for each in REQUESTS.values()}
}
"""The names of each group's requests, for messages; joined once, since junk must cost little."""

_EMPTY = message_type("rtee_msgs/msg/Empty")

Send = Callable[[bytes, bool], object]
"""Sends an encoded answer to the client, or a refusal if the second argument is ``False``."""


def accepted(text: str = "") -> dict[str, Any]:
    """Return the fields of the ``rtee_msgs/Reply`` to an accepted request."""
    return {"accepted": True, "error": "", "reason": "", "text": text}


def refusal(error: Exception) -> bytes:
    """Return the ``rtee_msgs/Reply`` that reports an error."""
    # Any other error is a bug in the hand's code: the log needs its traceback.
    known = isinstance(error, RteeError)
    if not known:
        log.error("a request failed", exc_info=error)
    return REPLY.encode(
        {
            "accepted": False,
            "error": type(error).__name__,
            "reason": str(error) if known else f"internal error: {error!r}",
            "text": _details(error),
        }
    )


def _details(error: Exception) -> str:
    """Return the fields from which a client rebuilds the error, beside its reason."""
    if isinstance(error, LeaseHeld):
        return error.holder
    if isinstance(error, GoalRejected):
        return json.dumps({"option": error.option, "given": error.nearest, "valid": error.valid})
    if isinstance(error, UnknownAction):
        return json.dumps({"option": "action", "given": error.name, "valid": error.valid})
    return ""


class IncomingRequest:
    """A request that waits for its answer, with its encoded question.

    The client is the one that has signed it; names in the question are not trusted.
    """

    __slots__ = ("_fields", "client", "question", "request", "send")

    def __init__(self, request: Request, question: bytes, send: Send, client: str) -> None:
        self.request = request
        self.question = question
        self.send = send
        self.client = client
        self._fields: dict[str, Any] | None = None

    @property
    def fields(self) -> dict[str, Any]:
        """The fields of the question; raises `MessageError`."""
        if self._fields is None:
            self._fields = self.request.question.decode(self.question) if self.question else {}
        return self._fields

    def check(self) -> None:
        """Raise `MessageError` if the question cannot be decoded."""
        self._fields = self.fields

    def answer(self, fields: Mapping[str, Any]) -> None:
        """Send the fields of an answer."""
        self.send(self.request.answer.encode(fields), True)

    def refuse(self, error: Exception) -> None:
        """Send a refusal with an error as its reason."""
        self.send(refusal(error), False)


Handler = Callable[[IncomingRequest], bytes | None]
"""Handles a request; returns the encoded answer, or ``None`` if it is sent later."""


Later = Callable[[bytes | None], object]
"""Sends an encoded refusal after a delay; ``None``: ends the request without an answer."""


Check = Callable[[Request, bytes | None, bytes], str]
"""Returns the client's name from a request, its attachment and its question; raises `RteeError` if
the request is refused."""


def handle_request(
    message: zenoh.Query | zenoh.Sample,
    group: str,
    check: Check,
    handle: Handler,
    send: Send,
    later: Later | None = None,
    answers_junk: Callable[[], bool] = lambda: True,
) -> None:
    """Check and handle a request of a group, and send the answer or a refusal.

    Args:
        message: The request.
        group: The group.
        check: Returns the client's name, or refuses the request.
        handle: Handles the request.
        send: Sends the answer.
        later: Sends refusals to clients that send too much; ``None``: `send` does, at once.
        answers_junk: Returns whether to answer a message that is not a request of the group.
    """
    try:
        try:
            request, question = read(message, group)
        except MessageError:
            if not answers_junk():
                raise Ignored from None
            raise
        client = check(request, attachment_of(message), question)
    except Ignored:
        if later is not None:
            later(None)
    except TooManyRequests as error:
        if later is None:
            send(refusal(error), False)
        else:
            later(refusal(error))
    # Any error, since the client waits for an answer.
    except Exception as error:
        send(refusal(error), False)
    else:
        answer_to(IncomingRequest(request, question, send, client), handle)


def answer_to(request: IncomingRequest, handle: Handler) -> None:
    """Handle a checked request, and send the answer or a refusal."""
    try:
        answer = handle(request)
    except Ignored:
        pass
    except Exception as error:
        request.refuse(error)
    else:
        if answer is not None:
            request.send(answer, True)


def read(message: zenoh.Query | zenoh.Sample, group: str) -> tuple[Request, bytes]:
    """Return the kind of a request and its encoded question; cheap for junk of any size.

    Raises `MessageError` if the message is not a request of the group.
    """
    name = _name(message, group)
    request = REQUESTS.get(name)
    if request is None or request.group != group:
        raise MessageError(f"there is no request '{name[:50]}' in '{group}', but {_NAMES[group]}")
    payload = message.payload
    # The length first: copying the bytes holds Python's interpreter lock, which the loop needs.
    size = 0 if payload is None else len(payload)
    if size > LONGEST:
        raise MessageError(f"{size} bytes is more than any request has")
    if payload is None or not size:
        if request.question is not _EMPTY:
            raise MessageError(f"the request '{name}' needs a {request.question.name}")
        return request, b""
    return request, payload.to_bytes()


def _name(message: zenoh.Query | zenoh.Sample, group: str) -> str:
    if group == HELLO:  # the last part of its key is the access path
        return HELLO
    parts = str(message.key_expr).split("/")
    # After the prefix and the hand: put/PATH/NAME/CLIENT, or GROUP/NAME.
    return parts[4] if parts[2] == INBOX else parts[3]


def last_part(message: zenoh.Query | zenoh.Sample) -> str:
    """Return the last part of a message's key."""
    return str(message.key_expr).rpartition("/")[2]


def attachment_of(message: zenoh.Query | zenoh.Sample) -> bytes | None:
    """Return the attachment of a message; ``None`` if it is missing or too long for a claim."""
    attachment = message.attachment
    if attachment is None or len(attachment) > LONGEST_CLAIM:
        return None
    return attachment.to_bytes()


def reply(hand: str, query: zenoh.Query, data: bytes, ok: bool) -> None:
    """Answer a query with a message, or with a refusal; may wait for the network."""
    if not ok:
        refuse(query, data)
        return
    with contextlib.suppress(zenoh.ZError), query:  # the client may have left
        # A query may address all hands at once; each answers under its own name.
        key = str(query.key_expr).split("/", 2)[2]
        query.reply(network_key(hand, key), data, express=True)


def refuse(query: zenoh.Query, data: bytes | None) -> None:
    """End a query with a refusal or, with ``None``, without an answer; may wait for the network."""
    # The context always ends the query; otherwise its client would wait for the timeout.
    with contextlib.suppress(zenoh.ZError), query:  # the client may have left
        if data is not None:
            query.reply_err(data)
