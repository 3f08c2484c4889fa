"""Ticks column by column, in a fifth of the space that their messages take.

The records of the messages of a tick have one layout. The values that change from tick to tick are
eight-byte numbers, most of which change smoothly: the differences of such numbers, taken as
integers and up to three times, are small. They are exact, as integers wrap around.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from rtee.errors import MessageError
from rtee.messages.codec import header
from rtee.messages.mcap_chunk import LARGEST_CHUNK
from rtee.messages.schema import message_type

_TICKS: Final = message_type("rtee_msgs/msg/Ticks")
_WORD = 8  # bytes of a number
_TIMES = (15, 23)  # offsets of the times in a record's head (MCAP specification, "Message")
_FIELDS = 35  # offset of the first field in a record: its head, and the head of CDR
_PLACES, _FEW = 6, 16  # number of places with sample ticks, to find the best interval
_MOST = 3  # differences are taken as often as this, at most: more would add noise

Bytes = NDArray[np.uint8]


def encode_ticks(rows: Bytes, records: list[int], wall: int) -> bytes:
    """Return a ``rtee_msgs/Ticks`` of the last tick's time [ns since 1970].

    The rows are the bytes of ticks ``(ticks, size)``, in which records begin at some offsets.
    """
    ticks, size = rows.shape
    changing = (rows != rows[0]).any(axis=0)
    words = np.concatenate(
        [
            np.concatenate((np.add(_TIMES, begin), np.arange(begin + _FIELDS, end - 7, _WORD)))
            for begin, end in zip(records, (*records[1:], size), strict=True)
        ]
    )
    within = sliding_window_view(changing, _WORD, writeable=True)
    words = words[within[words].any(axis=1)]
    within[words] = False
    others = np.flatnonzero(changing)
    values = np.empty((len(words), ticks), dtype="<u8")
    for place, word in enumerate(words.tolist()):
        values[place] = np.ndarray(ticks, "<u8", rows, word, (size,))
    order = _orders(values)
    for times in range(1, _MOST + 1):
        again = order >= times
        values[again, 1:] -= values[again, :-1]
    folded = _folded(values)
    planes = folded.view(np.uint8).reshape(len(words), ticks, _WORD).transpose(0, 2, 1)
    return _TICKS.encode(
        {
            "header": header(wall),
            "ticks": ticks,
            "record": records,
            "first": rows[0],
            "number": words,
            "order": order,
            "other": others,
            "columns": np.frombuffer(planes.tobytes() + rows[:, others].T.tobytes(), np.uint8),
        }
    )


def _folded(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return small negative numbers as small positive ones, too."""
    folded: NDArray[np.uint64] = (values << np.uint64(1)) ^ (values.view("<i8") >> 63).view("<u8")
    return folded


def _orders(values: NDArray[np.uint64]) -> NDArray[np.uint8]:
    """Return the order of differences of each row that makes them smallest."""
    begins = np.linspace(0, max(0, values.shape[1] - _FEW), _PLACES).astype(np.intp)
    some = values[:, (begins[:, np.newaxis] + np.arange(_FEW)).clip(max=values.shape[1] - 1)]
    bits = []
    for _ in range(_MOST):
        some = np.diff(some)
        bits.append(np.log2(_folded(some) + 1.0).mean(axis=(1, 2)))
    orders: Bytes = (1 + np.argmin(bits, axis=0)).astype(np.uint8)
    return orders


def decode_ticks(message: bytes) -> tuple[Bytes, list[int]]:
    """Return the rows and the offsets of records in a ``rtee_msgs/Ticks``.

    Raises:
        MessageError: if it is not valid.
    """
    fields = _TICKS.decode(message)
    ticks, words, others = fields["ticks"], fields["number"], fields["other"]
    first, order = (np.frombuffer(fields[name], np.uint8) for name in ("first", "order"))
    columns = np.frombuffer(fields["columns"], np.uint8)
    split = ticks * _WORD * len(words)
    if (
        not 0 < ticks * len(first) <= LARGEST_CHUNK
        or len(columns) != split + ticks * len(others)
        or len(order) != len(words)
        or max(words, default=0) + _WORD > len(first)
        or max(others, default=0) >= len(first)
    ):
        raise MessageError("the columns of the ticks do not match their records")
    planes = columns[:split].reshape(len(words), _WORD, ticks).transpose(0, 2, 1)
    folded = np.ascontiguousarray(planes).view("<u8")[..., 0]
    values = (folded >> np.uint64(1)) ^ (np.uint64(0) - (folded & np.uint64(1)))
    for times in range(1, _MOST + 1):
        again = order >= times
        values[again] = np.cumsum(values[again], axis=1, dtype=np.uint64)
    rows = np.tile(first, (ticks, 1))
    numbers = np.ascontiguousarray(values.T).view(np.uint8).reshape(ticks, len(words), _WORD)
    sliding_window_view(rows, _WORD, axis=1, writeable=True)[:, words] = numbers
    rows[:, others] = columns[split:].reshape(len(others), ticks).T
    return rows, fields["record"].tolist()
