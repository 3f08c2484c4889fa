"""Attachment of every message of rmw_zenoh: sender, sequence number and time.

33 bytes: sequence number and time as 64-bit integers (little-endian), the length of the gid (16) as
a byte, and the gid.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cache
from typing import Protocol

from rtee.errors import MessageError, needing_extra

_LAYOUT = struct.Struct("<qqB16s")

_GID = 16
"""Length of the identifier of a publisher or client [bytes]."""

SIZE = _LAYOUT.size
"""Length of an attachment [bytes]."""


class _Bytes(Protocol):
    def __len__(self) -> int: ...

    def __bytes__(self) -> bytes: ...


@dataclass(frozen=True, slots=True)
class Attachment:
    """Attachment of a message.

    Attributes:
        sequence: Number of the message, counted from 1 by its publisher or client.
        time: Time of sending since 1970 [ns].
        gid: Identifier of the publisher or client ``(16,)``.
    """

    sequence: int
    time: int
    gid: bytes

    def encode(self) -> bytes:
        """Return the bytes of the attachment."""
        return encode(self.sequence, self.time, self.gid)


def encode(sequence: int, time: int, gid: bytes) -> bytes:
    """Return the bytes of an attachment; see `Attachment`."""
    return _LAYOUT.pack(sequence, time, _GID, gid)


def decode(data: _Bytes | None) -> Attachment:
    """Return the attachment of these bytes.

    Raises `MessageError` if there is none, or the bytes are not those of an attachment.
    """
    if data is None:
        raise MessageError("without an attachment")
    if len(data) != SIZE:  # checked before `bytes` copies it, since it may be huge
        raise MessageError(f"with an attachment of {len(data)} bytes instead of {SIZE}")
    sequence, time, length, gid = _LAYOUT.unpack(bytes(data))
    if length != _GID:
        raise MessageError(f"with an identifier of {length} bytes instead of {_GID}")
    return Attachment(sequence, time, gid)


@cache
def _check() -> None:
    with needing_extra("ROS 2", "ros2"):
        import xxhash  # noqa: F401


def gid(token: str) -> bytes:
    """Return the identifier of the entity with a liveliness token ``(16,)``: its XXH3-128.

    Raises `MissingExtra` if xxhash is missing.
    """
    _check()
    import xxhash

    # rmw_zenoh copies the low 64 bits first.
    number: int = xxhash.xxh3_128_intdigest(token.encode())
    return number.to_bytes(_GID, "little")
