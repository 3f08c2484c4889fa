"""The contract of a sans-I/O frame parser."""

from __future__ import annotations

from typing import Protocol, TypeVar

F = TypeVar("F")


class Parser(Protocol[F]):
    """Cuts a stream of bytes into frames; does no I/O and never raises on what it is fed.

    Its buffer is bounded by the longest frame of its protocol, and after garbage it finds the next
    good frame without losing it.

    Attributes:
        errors: Frames with a wrong checksum or a wrong shape seen so far.
    """

    errors: int

    def feed(self, data: bytes) -> list[F]:
        """Take bytes and return the frames that they complete, in order."""
        ...

    def reset(self) -> None:
        """Forget the bytes of an incomplete frame."""
        ...
