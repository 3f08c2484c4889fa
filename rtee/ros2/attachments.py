"""What goes with every message of rmw_zenoh: who sent it, which one it is, and when.

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
SIZE = _LAYOUT.size
"""Length of an attachment [bytes]."""


class _Bytes(Protocol):
    def __len__(self) -> int: ...

    def __bytes__(self) -> bytes: ...


@dataclass(frozen=True, slots=True)
class Attachment:
    """What goes with a message.

    Attributes:
        sequence: Number of the message, counted from 1 by its publisher or client.
        time: When it was sent, since 1970 [ns].
        gid: Identifier of the publisher or client ``(16,)``.
    """

    sequence: int
    time: int
    gid: bytes

    def encode(self) -> bytes:
        """Return its bytes."""
        return _LAYOUT.pack(self.sequence, self.time, _GID, self.gid)


def encode(sequence: int, time: int, gid: bytes) -> bytes:
    """Return the bytes of an attachment; see `Attachment`."""
    return _LAYOUT.pack(sequence, time, _GID, gid)


def decode(data: _Bytes | None) -> Attachment:
    """Return an attachment.

    Raises:
        MessageError: if it is missing, or these are not the bytes of one.
    """
    if data is None:
        raise MessageError("without an attachment")
    if len(data) != SIZE:  # looked at before anything is copied: it may be huge
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

    Raises:
        MissingExtra: if xxhash is missing.
    """
    _check()
    import xxhash

    # The low 64 bits first, as rmw_zenoh copies them.
    number: int = xxhash.xxh3_128_intdigest(token.encode())
    return number.to_bytes(_GID, "little")
