"""Chunks of a file, read and decompressed by a thread while the ones before are taken apart."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from rtee.log.file_index import ChunkPlace
from rtee.log.record_scanner import DamagedRecordError, messages_of

_AHEAD = 4


def chunks_ahead(
    path: Path, places: Sequence[ChunkPlace]
) -> Iterator[tuple[ChunkPlace, bytes | DamagedRecordError]]:
    """Yield chunks with their uncompressed records, or with what is wrong with them.

    Raises:
        OSError: if the file cannot be read.
    """

    def load(place: ChunkPlace) -> bytes | DamagedRecordError:
        try:
            return messages_of(place.record.read(stream))[0]
        except DamagedRecordError as error:
            return error

    with path.open("rb") as stream, ThreadPoolExecutor(1, "rtee-chunks") as pool:
        waiting: deque[tuple[ChunkPlace, Future[bytes | DamagedRecordError]]] = deque()
        try:
            for place in places:
                waiting.append((place, pool.submit(load, place)))
                if len(waiting) > _AHEAD:
                    first, future = waiting.popleft()
                    yield first, future.result()
            while waiting:
                first, future = waiting.popleft()
                yield first, future.result()
        finally:
            for _, future in waiting:
                future.cancel()
