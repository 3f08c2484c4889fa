"""The flight recorder: the last chunks in memory, written out on a fault."""

from __future__ import annotations

import mmap
from collections import deque
from collections.abc import Iterable
from dataclasses import replace

from rtee.log.chunks import PackedChunk
from rtee.messages.codec import SECOND


class FlightRecorder:
    """Keeps the newest chunks within a limit of time [s] and of memory [bytes]."""

    def __init__(self, seconds: float, size: float) -> None:
        self._seconds = seconds
        self._limit = size
        self._size = 0
        self._chunks: deque[PackedChunk] = deque()

    @property
    def size(self) -> int:
        """Memory of the chunks [bytes]."""
        return self._size

    @property
    def seconds(self) -> float:
        """Time from the first to the last message [s]."""
        if not self._chunks:
            return 0.0
        return (self._chunks[-1].end - self._chunks[0].start) / SECOND

    @property
    def start(self) -> int:
        """Log time of the first message [ns since 1970]; 0 without messages."""
        return self._chunks[0].start if self._chunks else 0

    def add(self, chunk: PackedChunk) -> None:
        """Add a chunk; drop the oldest ones beyond the limits."""
        self._chunks.append(_in_memory_of_its_own(chunk))
        self._size += chunk.size
        oldest = chunk.end - int(self._seconds * SECOND)
        while self._chunks[0].end < oldest or (self._size > self._limit and len(self._chunks) > 1):
            self._size -= self._chunks.popleft().size

    def chunks(self) -> Iterable[PackedChunk]:
        """Return the chunks, oldest first."""
        return tuple(self._chunks)


def _in_memory_of_its_own(chunk: PackedChunk) -> PackedChunk:
    """Return a copy of a chunk in memory that returns to the system when the chunk is dropped.

    On the heap, blocks of many sizes that live for a minute would fragment the process's memory.
    """
    memory = mmap.mmap(-1, chunk.size)
    memory.write(chunk.record)
    memory.write(chunk.index)
    view, end = memoryview(memory), len(chunk.record)
    return replace(chunk, record=view[:end], index=view[end:])
