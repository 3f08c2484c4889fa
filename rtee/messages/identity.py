"""Signatures of requests, which protect against forged senders and replayed requests.

The answer to ``hello`` gives a client a secret, which no other client sees. The attachment of each
of its requests is ``<number> <client> <signature>``: the number grows from one request of a kind to
the next, and the signature is an HMAC-SHA256 of the request with that secret.
"""

from __future__ import annotations

import hmac
import itertools

from msgspec import Struct

SECRET = 32
"""Length of a client's secret [bytes]: that of SHA-256's result; more would add no security."""

_SIGNATURE = 32
"""Length of a signature [hexadecimal digits]: 128 bits, which cannot be guessed."""

LONGEST_CLAIM = 200
"""Longest attachment [bytes]: names of clients have 100 at most."""


class Claim(Struct, frozen=True):
    """The sender of a request and its number in an attachment; unproven until `signed_by` is true.

    A client may add a dot and a label to the number; a published answer repeats its request's.
    """

    number: str
    client: str
    signature: str

    @property
    def count(self) -> int:
        """The number without the label; 0 if it is malformed."""
        digits = self.number.partition(".")[0]
        # isdigit alone also accepts digits that int() refuses, such as superscripts.
        return int(digits) if digits.isdigit() and digits.isascii() else 0

    def signed_by(self, key: hmac.HMAC, request: str, question: bytes) -> bool:
        """Return whether the request was signed with a secret; see `key_of`."""
        expected = _signature(key, request, self.number, question)
        # In constant time, so that the duration does not reveal how much of a guess is right.
        return hmac.compare_digest(expected, self.signature)


def claim_of(attachment: bytes | None) -> Claim | None:
    """Return the claim in the attachment of a request; ``None`` if it is malformed."""
    if attachment is None or len(attachment) > LONGEST_CLAIM:
        return None
    parts = attachment.decode("ascii", "replace").split(" ")
    # compare_digest raises an error for texts that are not ASCII.
    if len(parts) != 3 or not parts[2].isascii():
        return None
    return Claim(*parts)


class Signer:
    """Numbers and signs a client's requests; the hand accepts none until the key is set."""

    def __init__(self, client: str) -> None:
        self.key = key_of(b"")
        self._client = client
        self._counts = itertools.count(1)

    def number(self, label: str = "") -> str:
        """Return a new number, followed by a label."""
        count = next(self._counts)
        return f"{count}.{label}" if label else str(count)

    def attachment(self, number: str, request: str, question: bytes) -> str:
        """Return the attachment of a request of this name and number."""
        signature = _signature(self.key, request, number, question)
        return f"{number} {self._client} {signature}"


def key_of(secret: bytes) -> hmac.HMAC:
    """Return a secret ready to sign; made once, since OpenSSL looks SHA-256 up each time."""
    return hmac.new(secret, digestmod="sha256")


def _signature(key: hmac.HMAC, request: str, number: str, question: bytes) -> str:
    signed = key.copy()
    # Neither names nor numbers contain blanks, so that different requests give different texts.
    signed.update(f"{request} {number} ".encode() + question)
    return signed.hexdigest()[:_SIGNATURE]
