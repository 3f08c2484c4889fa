"""Common Data Representation: the bytes of ROS 2 messages, little-endian (XCDR version 1).

Layout as in the OMG's CDR and as ROS 2 uses it: four bytes of encapsulation header, then the
fields in order, each primitive aligned to its own size counted from after that header; a string
is its length with the closing NUL as ``uint32``, its UTF-8 bytes and the NUL; a sequence is its
length as ``uint32`` and its elements.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtee.errors import MessageError, foreign

HEADER = b"\x00\x01\x00\x00"
"""Encapsulation header: CDR, little-endian, no options."""

LONGEST = 64 * 1024 * 1024
"""Longest message that is decoded [bytes]: 64 MiB, far more than any message of a hand."""

SCALARS: dict[str, struct.Struct] = {
    "bool": struct.Struct("<?"),
    "int8": struct.Struct("<b"),
    "uint8": struct.Struct("<B"),
    "int16": struct.Struct("<h"),
    "uint16": struct.Struct("<H"),
    "int32": struct.Struct("<i"),
    "uint32": struct.Struct("<I"),
    "int64": struct.Struct("<q"),
    "uint64": struct.Struct("<Q"),
    "float32": struct.Struct("<f"),
    "float64": struct.Struct("<d"),
}
DTYPES: dict[str, np.dtype[Any]] = {name: np.dtype(name).newbyteorder("<") for name in SCALARS}
# ROS 2's other names of uint8 (REP 2016); those of NumPy are of other types.
for _octet in ("byte", "char"):
    SCALARS[_octet], DTYPES[_octet] = SCALARS["uint8"], DTYPES["uint8"]

_LENGTH = SCALARS["uint32"]
_DOUBLE = SCALARS["float64"]
# Paddings by length; the largest alignment is eight bytes.
_PADDING = tuple(bytes(size) for size in range(8))


class Writer:
    """Builds the bytes of one message.

    Args:
        begin: Beginning of the message, including the encapsulation header.
    """

    __slots__ = ("_buffer",)

    def __init__(self, begin: bytes = HEADER) -> None:
        self._buffer = bytearray(begin)

    def align(self, size: int) -> None:
        """Pad with zeros up to a multiple of ``size`` bytes."""
        # Alignment counts from the end of the header of four bytes.
        self._buffer += bytes((4 - len(self._buffer)) % size)

    def scalar(self, kind: str, value: Any) -> None:
        """Append one number or truth value of a primitive kind."""
        packer = SCALARS[kind]
        buffer = self._buffer
        buffer += _PADDING[(4 - len(buffer)) % packer.size] + packer.pack(value)

    def double(self, value: float) -> None:
        """Append a ``float64``."""
        buffer = self._buffer
        buffer += _PADDING[(4 - len(buffer)) % 8] + _DOUBLE.pack(value)

    def string(self, value: str) -> None:
        """Append a string."""
        # "replace", since lone surrogates, as in file names that are not UTF-8, would raise.
        data = value.encode("utf-8", "replace")
        buffer = self._buffer
        # The header of four bytes does not change an alignment to four bytes.
        buffer += _PADDING[-len(buffer) % 4] + _LENGTH.pack(len(data) + 1) + data + b"\0"

    def strings(self, values: Sequence[str]) -> None:
        """Append a sequence of strings."""
        # These are also sequences, whose elements would be written one by one.
        if isinstance(values, (str, bytes)):
            raise TypeError("a list of strings expected")
        self.length(len(values))
        for value in values:
            self.string(value)

    def length(self, count: int) -> None:
        """Append the length of a sequence."""
        buffer = self._buffer
        buffer += _PADDING[-len(buffer) % 4] + _LENGTH.pack(count)

    def array(self, kind: str, values: Sequence[Any] | NDArray[Any]) -> None:
        """Append a sequence of numbers or truth values."""
        if isinstance(values, (list, tuple)):  # for few numbers, faster than an array of them
            self.length(len(values))
            if values:
                self.align(SCALARS[kind].size)
                self._buffer += struct.pack(f"<{len(values)}{SCALARS[kind].format[1:]}", *values)
            return
        array = np.ascontiguousarray(values, dtype=DTYPES[kind])
        self.length(array.size)
        # An empty sequence has no padding after its length.
        if array.size:
            self.align(array.itemsize)
            self._buffer += array.tobytes()

    def fixed(self, kind: str, values: Sequence[Any] | NDArray[Any]) -> None:
        """Append an array of a fixed number of numbers or truth values."""
        array = np.ascontiguousarray(values, dtype=DTYPES[kind])
        self.align(array.itemsize)
        self._buffer += array.tobytes()

    def done(self) -> bytes:
        """Return the message."""
        return bytes(self._buffer)


class Reader:
    """Decodes the bytes of one message; checks every length before using it.

    Raises:
        MessageError: if the bytes are not a message of this encoding; all methods raise it if the
            bytes end too early or a length is invalid.
    """

    __slots__ = ("_data", "_end", "_position")

    def __init__(self, data: bytes | bytearray | memoryview) -> None:
        if len(data) > LONGEST:
            raise MessageError(f"{len(data)} bytes is more than any message has")
        # `bytes`, the type of messages from the network, are decoded fastest.
        self._data = data if isinstance(data, bytes) else bytes(data)
        self._end = len(self._data)
        # The first two bytes name the encoding; the other two are options, unused in this version.
        if self._data[:2] != HEADER[:2] or self._end < 4:
            raise MessageError("no little-endian CDR header at the start")
        self._position = 4

    @property
    def remaining(self) -> int:
        """Number of bytes left."""
        return self._end - self._position

    def align(self, size: int) -> None:
        """Skip the padding up to a multiple of ``size`` bytes."""
        self._position += (len(HEADER) - self._position) % size

    def _take(self, count: int) -> int:
        """Advance by a number of bytes; return the position before."""
        start = self._position
        end = start + count
        if end > self._end:
            raise self._short(count, start)
        self._position = end
        return start

    def _short(self, count: int, start: int) -> MessageError:
        left = self._end - start
        return MessageError(f"{count} bytes expected at offset {start - len(HEADER)}, {left} left")

    def scalar(self, kind: str) -> Any:
        """Return one number or truth value of a primitive kind."""
        unpacker = SCALARS[kind]
        self._position += (4 - self._position) % unpacker.size
        return unpacker.unpack_from(self._data, self._take(unpacker.size))[0]

    def skip(self, count: int) -> None:
        """Skip a number of bytes."""
        self._take(count)

    def double(self) -> float:
        """Return a ``float64``."""
        # As `_take` does, without the call: most fields are of this kind.
        start = self._position + (4 - self._position) % 8
        self._position = end = start + 8
        if end > self._end:
            raise self._short(8, start)
        value: float = _DOUBLE.unpack_from(self._data, start)[0]
        return value

    def name(self) -> str:
        """Return a string from outside in which unprintable characters are escaped."""
        text = self.string()
        return text if text.isprintable() else foreign(text)

    def strings(self) -> list[str]:
        """Return a sequence of strings, which are names in all messages of rtee."""
        # A string takes at least five bytes: its length and the NUL.
        count = self.length(5)
        return [self.name() for _ in range(count)] if count else []

    def string(self) -> str:
        """Return a string."""
        data, start = self._data, self._position
        length = self.length(1)
        # `length` has checked that so many bytes are left.
        begin = self._position
        self._position = end = begin + length
        # The length includes the NUL, so that even an empty string has the length 1.
        if length == 0 or data[end - 1] != 0:
            raise MessageError(f"string without its closing NUL at offset {start - len(HEADER)}")
        try:
            return data[begin : end - 1].decode()
        except UnicodeDecodeError:
            raise MessageError(
                f"string that is not UTF-8 at offset {start - len(HEADER)}"
            ) from None

    def length(self, least: int) -> int:
        """Return the length of a sequence whose elements take at least ``least`` bytes each."""
        # As `_take` does, without the call.
        start = self._position + -self._position % 4
        self._position = end = start + 4
        if end > self._end:
            raise self._short(4, start)
        count: int = _LENGTH.unpack_from(self._data, start)[0]
        # Checked before allocating memory, since a damaged length may mean gigabytes.
        if count * least > self._end - end:
            raise MessageError(f"sequence of {count} elements, but {self.remaining} bytes left")
        return count

    def array(self, kind: str) -> NDArray[Any]:
        """Return a sequence of numbers or truth values, as a new array."""
        dtype = DTYPES[kind]
        count = self.length(dtype.itemsize)
        return self.fixed(kind, count) if count else np.empty(0, dtype=dtype)

    def fixed(self, kind: str, count: int) -> NDArray[Any]:
        """Return an array of a fixed number of numbers or truth values."""
        dtype = DTYPES[kind]
        self.align(dtype.itemsize)
        start = self._take(count * dtype.itemsize)
        # Converted from bytes, since a byte of 2 read as bool would stay a 2 in memory.
        if kind == "bool":
            return np.frombuffer(self._data, np.uint8, count, start).astype(bool)
        # A copy, since a view is read-only, often misaligned, and keeps the message in memory.
        return np.frombuffer(self._data, dtype, count, start).copy()

    def numbers(self, kind: str) -> list[Any]:
        """Return a sequence of numbers or truth values as a list."""
        packer = SCALARS[kind]
        count = self.length(packer.size)
        if not count:
            return []
        self.align(packer.size)
        start = self._take(count * packer.size)
        return list(struct.unpack_from(f"<{count}{packer.format[1:]}", self._data, start))

    def finish(self) -> None:
        """Check that only padding is left."""
        # Padding is shorter than the largest alignment, which is eight bytes.
        if self._position != self._end and (
            self.remaining >= 8 or any(self._data[self._position :])
        ):
            raise MessageError(f"{self.remaining} bytes too many at the end")
