"""How a request says who sends it, so that nobody can send it under another's name, or again.

With the answer to ``hello`` a client gets a secret, which no other client sees. The attachment of
each of its requests is ``<number> <client> <signature>``: the number grows from one request of a
kind to the next, and the signature is an HMAC-SHA256 of the request with that secret.
"""

from __future__ import annotations

import hmac
import itertools
from dataclasses import dataclass, fields

SECRET = 32
"""Length of a client's secret [bytes]; that of SHA-256's result, beyond which nothing is gained."""

_SIGNATURE = 32
"""Length of a signature [hexadecimal digits]: 128 bits, which nobody guesses."""

LONGEST_CLAIM = 200
"""Longest attachment [bytes]: names of clients have 100 at most."""


@dataclass(frozen=True, slots=True)
class Claim:
    """What the attachment of a request claims; true only once `signed_by` says so.

    Attributes:
        number: The request's number, with a label of the client's own behind a dot if it has one;
            the answer to a request that was put carries it, too.
        client: The client's name.
        signature: The signature.
    """

    number: str
    client: str
    signature: str

    @property
    def count(self) -> int:
        """The number itself; 0 if it is none."""
        digits = self.number.partition(".")[0]
        # isdigit alone also holds for digits that int() refuses, such as superscripts.
        return int(digits) if digits.isdigit() and digits.isascii() else 0

    def signed_by(self, secret: bytes, request: str, question: bytes) -> bool:
        """Return whether a request was signed with a secret."""
        expected = _signature(secret, request, self.number, question)
        # In constant time, so that its duration does not tell how much of a guess is right.
        return hmac.compare_digest(expected, self.signature)


def claim_of(attachment: bytes | None) -> Claim | None:
    """Return what the attachment of a request claims; ``None`` if it is of another form."""
    if attachment is None or len(attachment) > LONGEST_CLAIM:
        return None
    parts = attachment.decode("ascii", "replace").split(" ")
    # compare_digest raises for texts that are not ASCII.
    if len(parts) != len(fields(Claim)) or not parts[2].isascii():
        return None
    return Claim(*parts)


class Signer:
    """Numbers and signs the requests of a client.

    Args:
        client: The client's name.

    Attributes:
        secret: The client's secret; nothing signed is accepted before it is set.
    """

    def __init__(self, client: str) -> None:
        self.secret = b""
        self._client = client
        self._counts = itertools.count(1)

    def number(self, label: str = "") -> str:
        """Return a new number, with a label behind it."""
        count = next(self._counts)
        return f"{count}.{label}" if label else str(count)

    def attachment(self, number: str, request: str, question: bytes) -> str:
        """Return the attachment of a request of this name and number."""
        signature = _signature(self.secret, request, number, question)
        return f"{number} {self._client} {signature}"


def _signature(secret: bytes, request: str, number: str, question: bytes) -> str:
    # Neither names nor numbers hold blanks, so that no two requests are signed alike.
    said = f"{request} {number} ".encode() + question
    return hmac.digest(secret, said, "sha256").hex()[:_SIGNATURE]
