"""Read many messages of one layout into arrays at once."""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rtee.errors import MessageError
from rtee.log.chunks import AFTER_LENGTH, MESSAGE
from rtee.log.file_index import ChunkPlace
from rtee.log.record_scanner import DamagedRecordError
from rtee.messages.cdr import DTYPES
from rtee.messages.layout import places
from rtee.messages.schema import MessageType

_FIELDS = ("opcode", "length", "channel", "sequence", "time", "published")
_HEADS = np.dtype([*zip(_FIELDS, ("u1", "<u8", "<u2", "<u4", "<i8", "<i8"), strict=True)])
"""Layout of the head of a record, as MESSAGE."""

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
        if opcode == 5 and length >= AFTER_LENGTH:
            starts.setdefault(channel, []).append(position)
        position += 9 + length
    return starts


def gather(data: Bytes, starts: Offsets, size: int) -> Bytes:
    """Return ``size`` bytes from each start ``(k, size)``; all must be within the data."""
    # Overlapping windows over the same memory let one indexing copy all messages.
    windows = np.lib.stride_tricks.as_strided(
        data, shape=(max(0, data.size - size + 1), size), strides=(1, 1), writeable=False
    )
    return windows[starts]


class Messages(NamedTuple):
    """Messages of one channel in a chunk's data: offsets and heads of their records."""

    data: Bytes
    starts: Offsets
    heads: NDArray[Any]

    @property
    def times(self) -> NDArray[np.int64]:
        """Log times [ns since 1970]."""
        return self.heads["time"]

    @property
    def sizes(self) -> NDArray[np.int64]:
        """Lengths without the records' heads [bytes]."""
        return self.heads["length"].astype(np.int64) - AFTER_LENGTH

    def where(self, chosen: NDArray[np.bool_]) -> Messages:
        """Return the selected messages."""
        if chosen.all():
            return self
        return Messages(self.data, self.starts[chosen], self.heads[chosen])

    def contents(self) -> Iterator[bytes]:
        """Yield the messages, without the records' heads."""
        for start, size in zip(self.starts.tolist(), self.sizes.tolist(), strict=True):
            begin = start + MESSAGE.size
            yield self.data[begin : begin + size].tobytes()

    def valid(self, channel: int) -> bool:
        """Return whether whole messages of the channel are there."""
        sizes = self.sizes
        return bool(
            # 5: a message (MCAP specification, "Opcodes").
            (self.heads["opcode"] == 5).all()
            and (self.heads["channel"] == channel).all()
            and (sizes >= 0).all()
            and (self.starts + MESSAGE.size + sizes <= self.data.size).all()
        )


def messages(data: Bytes, offsets: Any) -> Messages | None:
    """Return the messages at some offsets; ``None`` if one is outside of the data."""
    starts = np.asarray(offsets).astype(np.int64)
    if starts.size and (starts.min() < 0 or starts.max() + MESSAGE.size > data.size):
        return None
    return Messages(data, starts, gather(data, starts, MESSAGE.size).view(_HEADS)[:, 0])


def messages_of(
    place: ChunkPlace, stream: BinaryIO, data: bytes, channels: Collection[int]
) -> dict[int, Messages]:
    """Return the messages of a chunk by channel: by its index, otherwise by walking over it."""
    array = np.frombuffer(data, dtype=np.uint8)
    found = _indexed(place, stream, array, channels)
    if found is None:
        walked = {k: messages(array, v) for k, v in walk(data).items() if k in channels}
        found = {k: each for k, each in walked.items() if each is not None}
    return found


def messages_in(rows: Bytes, records: Sequence[int]) -> dict[int, Messages]:
    """Return the messages of ticks by channel; ``records`` are the offsets of records in each row.

    Raises:
        MessageError: if there are no messages.
    """
    found: dict[int, Messages] = {}
    for begin in records:
        some = messages(rows.reshape(-1), np.arange(len(rows)) * rows.shape[1] + begin)
        channel = -1 if some is None else int(some.heads["channel"][0])
        if some is None or not some.valid(channel):
            raise MessageError("ticks without messages")
        found[channel] = some
    return found


def _indexed(
    place: ChunkPlace, stream: BinaryIO, data: Bytes, channels: Iterable[int]
) -> dict[int, Messages] | None:
    """Return the messages by channel; ``None`` if an index is missing or wrong."""
    if not place.indexes:
        return None
    found: dict[int, Messages] = {}
    for number in channels:
        index = place.indexes.get(number)
        if index is None:
            continue
        try:
            # Behind channel (2 bytes) and size (4): pairs of log time and offset.
            entries = np.frombuffer(index.read(stream)[6:], dtype="<u8").reshape(-1, 2)
        except (DamagedRecordError, ValueError):
            return None
        # The index comes from a file, so that it is checked before its use as offsets.
        some = messages(data, entries[:, 1])
        if some is None or not some.valid(number):
            return None
        found[number] = some
    return found


def order_of(times: NDArray[np.int64]) -> slice | NDArray[np.int64]:
    """Return an index that sorts by time; for sorted times a slice, which copies nothing."""
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
        self._constant = np.empty(0, dtype=bool)  # which bytes all messages share
        self._columns: dict[str, NDArray[Any]] = {}
        self._times = np.empty(self._room, dtype=np.int64)
        self._count = 0
        self.names: tuple[str, ...] = ()
        self.skipped = 0

    def clear(self) -> None:
        """Start over with the same layout; arrays returned before do not change."""
        self._times, self._count, self.skipped = np.empty_like(self._times), 0, 0
        self._columns = {name: np.empty_like(each) for name, each in self._columns.items()}

    def add(self, kind: MessageType, messages: Messages) -> None:
        """Add messages of a type."""
        count = len(messages.starts)
        if count and (self._first.size or self._fix(kind, messages)):
            fitting = messages.where(messages.sizes == self._first.size)
            rows = gather(fitting.data, fitting.starts + MESSAGE.size, self._first.size)
            # The bytes between the arrays (names, lengths) must equal those of the first message,
            # or the columns would have another meaning.
            other = (rows != self._first) & self._constant
            if other.any():
                same = ~other.any(axis=1)
                rows, fitting = rows[same], fitting.where(same)
            self._store(rows, fitting.times)
            count -= len(rows)
        self.skipped += count

    def _fix(self, kind: MessageType, messages: Messages) -> bool:
        """Take the layout from the first valid message; return whether there is one."""
        for message in messages.contents():
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
        # Whatever lies between the arrays is constant.
        self._constant = np.ones(self._first.size, dtype=bool)
        for place in where.values():
            self._constant[place] = False
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
        only positions.
        """
        column = self._columns.get(name)
        if column is not None and column.shape[1] == len(self.names):
            return column[: self._count]
        return np.full((self._count, len(self.names)), default)

    def scalars(self, name: str) -> NDArray[Any]:
        """Return a scalar field of all messages ``(k,)``; 0 for messages without it."""
        column = self._columns.get(name)
        return np.zeros(self._count) if column is None else column[: self._count, 0]
