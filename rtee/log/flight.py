"""The flight recorder: the last chunks in memory, written out on a fault."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from rtee.log.chunks import PackedChunk

_SECOND = 1_000_000_000


class FlightRecorder:
    """Keeps the newest chunks within a bound of time and of memory.

    Args:
        seconds: How much to keep [s].
        size: Memory that it may take [bytes].
    """

    def __init__(self, seconds: float, size: float) -> None:
        self._seconds = seconds
        self._limit = size
        self._size = 0
        self._chunks: deque[PackedChunk] = deque()

    @property
    def size(self) -> int:
        """Memory that the chunks take [bytes]."""
        return self._size

    @property
    def seconds(self) -> float:
        """Time from the first to the last message [s]."""
        if not self._chunks:
            return 0.0
        return (self._chunks[-1].end - self._chunks[0].start) / _SECOND

    @property
    def start(self) -> int:
        """Log time of the first message [ns since 1970]; 0 if there is none."""
        return self._chunks[0].start if self._chunks else 0

    def add(self, chunk: PackedChunk) -> None:
        """Keep a chunk; forget those that are too old or too many."""
        self._chunks.append(chunk)
        self._size += chunk.size
        oldest = chunk.end - int(self._seconds * _SECOND)
        while self._chunks[0].end < oldest or (self._size > self._limit and len(self._chunks) > 1):
            self._size -= self._chunks.popleft().size

    def chunks(self) -> Iterable[PackedChunk]:
        """Return the chunks, oldest first."""
        return tuple(self._chunks)
