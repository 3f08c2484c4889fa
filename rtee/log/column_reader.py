"""Read many messages of one layout into arrays at once."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from rtee.errors import MessageError
from rtee.log.chunks import MESSAGE
from rtee.log.file_index import ChunkPlace
from rtee.log.resync import DamagedRecordError
from rtee.messages.cdr import DTYPES
from rtee.messages.layout import places
from rtee.messages.schema import MessageType

_AFTER_LENGTH = MESSAGE.size - 9  # bytes of a record's head behind opcode and length
_SEQUENCE = 11  # offset of the sequence number in a record: opcode, length, channel
_LOG_TIME = 15  # offset of the log time, behind the sequence number
_LEAST_ROOM = 16  # least number of rows allocated: fewer would have to grow soon

Bytes = NDArray[np.uint8]
Offsets = NDArray[np.int64]


def walk(data: bytes) -> dict[int, list[int]]:
    """Return the offsets of the messages in a chunk by channel, also of channels defined in it."""
    starts: dict[int, list[int]] = {}
    position = 0
    while position + MESSAGE.size <= len(data):
        opcode, length, channel = struct.unpack_from("<BQH", data, position)
        if position + 9 + length > len(data):
            break
        # 5: a message (MCAP specification, "Opcodes").
        if opcode == 5 and length >= _AFTER_LENGTH:
            starts.setdefault(channel, []).append(position)
        position += 9 + length
    return starts


def gather(data: Bytes, starts: Offsets, size: int) -> Bytes:
    """Return ``size`` bytes from each start ``(k, size)``; all must be within the data."""
    # Overlapping windows over the same memory let one indexing copy all messages.
    windows = np.lib.stride_tricks.as_strided(
        data, shape=(max(0, data.size - size + 1), size), strides=(1, 1), writeable=False
    )
    rows: Bytes = windows[starts]
    return rows


def lengths(data: Bytes, starts: Offsets) -> NDArray[np.int64]:
    """Return the lengths of the messages whose records begin at the starts [bytes]."""
    raw = np.ascontiguousarray(gather(data, starts + 1, 8)).view("<u8")[:, 0]
    return raw.astype(np.int64) - _AFTER_LENGTH


def contents(data: Bytes, starts: Offsets) -> Iterator[bytes]:
    """Yield the messages whose records begin at the starts, without the records' heads."""
    for start, size in zip(starts.tolist(), lengths(data, starts).tolist(), strict=True):
        begin = start + MESSAGE.size
        yield data[begin : begin + size].tobytes()


def log_times(data: Bytes, starts: Offsets) -> NDArray[np.int64]:
    """Return the log times [ns since 1970] of the records at the starts."""
    return np.ascontiguousarray(gather(data, starts + _LOG_TIME, 8)).view("<i8")[:, 0]


def sequences(data: Bytes, starts: Offsets) -> NDArray[np.int64]:
    """Return the sequence numbers of the records at the starts."""
    raw = np.ascontiguousarray(gather(data, starts + _SEQUENCE, 4)).view("<u4")[:, 0]
    return raw.astype(np.int64)


def valid(data: Bytes, starts: Offsets, channel: int) -> bool:
    """Return whether messages of the channel begin at all starts of an index."""
    if not starts.size:
        return True
    if starts.min() < 0 or starts.max() + MESSAGE.size > data.size:
        return False
    heads = gather(data, starts, 11)
    # The index comes from a file, so that it is checked before its use as offsets.
    if not (heads[:, 0] == 5).all():
        return False
    if not (np.ascontiguousarray(heads[:, 9:11]).view("<u2") == channel).all():
        return False
    sizes = lengths(data, starts)
    return bool((sizes >= 0).all() and (starts + MESSAGE.size + sizes <= data.size).all())


def starts_of(
    place: ChunkPlace, stream: BinaryIO, data: Bytes, channels: Iterable[int]
) -> dict[int, Offsets] | None:
    """Return the offsets of the messages by channel; ``None`` if an index is wrong."""
    if not place.indexes:
        return None
    starts: dict[int, Offsets] = {}
    for number in channels:
        index = place.indexes.get(number)
        if index is None:
            continue
        try:
            # Behind channel (2 bytes) and size (4): pairs of log time and offset.
            entries = np.frombuffer(index.read(stream)[6:], dtype="<u8").reshape(-1, 2)
        except (DamagedRecordError, ValueError):
            return None
        offsets = entries[:, 1].astype(np.int64)
        if not valid(data, offsets, number):
            return None
        starts[number] = offsets
    return starts


def order_of(times: NDArray[np.int64]) -> slice | NDArray[np.int64]:
    """Return the index that sorts by time; a slice, which copies nothing, for sorted times."""
    if times.size < 2 or bool((times[1:] >= times[:-1]).all()):
        return slice(None)
    # Stable, so that messages of the same time stay in the order of the file.
    return np.argsort(times, kind="stable")


class MessageColumns:
    """Collects messages of one type and layout into arrays, one row per message.

    The first message fixes the layout: the names and the lengths of its arrays. Messages with
    another layout are skipped and counted. Room for the expected number is allocated at once.
    """

    def __init__(self, expected: int) -> None:
        self._room = max(expected, _LEAST_ROOM)
        self._where: dict[str, slice] = {}
        self._first = np.empty(0, dtype=np.uint8)
        self._constant: list[tuple[int, int]] = []
        self._columns: dict[str, NDArray[Any]] = {}
        self._times = np.empty(self._room, dtype=np.int64)
        self._count = 0
        self.names: tuple[str, ...] = ()
        self.skipped = 0

    def clear(self) -> None:
        """Begin anew with the same layout; arrays that were returned stay as they are."""
        self._times, self._count, self.skipped = np.empty_like(self._times), 0, 0
        self._columns = {name: np.empty_like(each) for name, each in self._columns.items()}

    def add(self, kind: MessageType, data: Bytes, starts: Offsets) -> None:
        """Add the messages of a type whose records begin at the starts in a chunk's data."""
        if not starts.size:
            return
        if not self._first.size and not self._fix(kind, data, starts):
            self.skipped += len(starts)
            return
        fitting = lengths(data, starts) == self._first.size
        if not fitting.all():
            self.skipped += int(len(starts) - fitting.sum())
            starts = starts[fitting]
            if not starts.size:
                return
        rows = gather(data, starts + MESSAGE.size, self._first.size)
        same = np.ones(len(rows), dtype=bool)
        # The bytes between the arrays (names, lengths) must equal those of the first message, or
        # the columns would have another meaning.
        for begin, end in self._constant:
            same &= (rows[:, begin:end] == self._first[begin:end]).all(axis=1)
        if not same.all():
            self.skipped += int(len(rows) - same.sum())
            rows, starts = rows[same], starts[same]
        self._store(rows, log_times(data, starts))

    def _fix(self, kind: MessageType, data: Bytes, starts: Offsets) -> bool:
        """Take the layout from the first valid message; return whether there is one."""
        for message in contents(data, starts):
            try:
                fields = kind.decode(message)
                where = places(kind, message)
            except MessageError:
                continue
            self.names = tuple(fields.get("name", ()))
            self._first = np.frombuffer(message, dtype=np.uint8)
            break
        else:
            return False
        position = 0
        # Whatever lies between the arrays is constant.
        for place in where.values():
            self._constant.append((position, place.start))
            position = place.stop
        self._constant.append((position, self._first.size))
        self._where = {each.name: where[each.name] for each in kind.fields if each.name in where}
        for field in kind.fields:
            if field.name in where:
                place, dtype = where[field.name], DTYPES[field.kind]
                count = (place.stop - place.start) // dtype.itemsize
                self._columns[field.name] = np.empty((self._room, count), dtype)
        return True

    def _store(self, rows: Bytes, times: NDArray[np.int64]) -> None:
        begin = self._count
        end = begin + len(rows)
        if end > self._room:
            self._grow(end)
        self._times[begin:end] = times
        for name, column in self._columns.items():
            # A view of another type needs bytes without gaps.
            part = np.ascontiguousarray(rows[:, self._where[name]])
            column[begin:end] = part.view(column.dtype)
        self._count = end

    def _grow(self, least: int) -> None:
        self._room = max(least, 2 * self._room)
        self._times = np.resize(self._times, self._room)
        for name, column in self._columns.items():
            grown = np.empty((self._room, column.shape[1]), dtype=column.dtype)
            grown[: self._count] = column[: self._count]
            self._columns[name] = grown

    @property
    def times(self) -> NDArray[np.int64]:
        """Log times of the messages [ns since 1970]."""
        return self._times[: self._count]

    def column(self, name: str, default: float = 0) -> NDArray[Any]:
        """Return a field of all messages ``(k, n)``, with the default for messages without it.

        Recordings of earlier versions may lack the field; those of other programs may have
        positions alone.
        """
        column = self._columns.get(name)
        if column is not None and column.shape[1] == len(self.names):
            return column[: self._count]
        return np.full((self._count, len(self.names)), default)

    def scalars(self, name: str) -> NDArray[Any]:
        """Return a scalar field of all messages ``(k,)``; 0 for messages without it."""
        column = self._columns.get(name)
        return np.zeros(self._count) if column is None else column[: self._count, 0]
