"""Tables of any length: kept in a file while their rows come, and given back piece by piece."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zstandard
from numpy.typing import NDArray

_ROWS = 10_000  # most rows of a piece: as Python numbers, they take some megabytes
_NUMBER = 32  # characters that any number has at most

Column = NDArray[Any]
Table = dict[str, Column]
"""Columns of the same length by name."""


class _Piece(NamedTuple):
    """Rows of a table: their number, the columns' names and types, and their places in the file."""

    rows: int
    layout: tuple[tuple[str, np.dtype[Any]], ...]
    places: NDArray[np.int64]


class Spool:
    """A table in a temporary file.

    A column that is missing in some pieces is ``NaN`` there. One with other types of values in some
    pieces has a type for all.

    Args:
        path: Where the file is made, in a folder that is removed afterwards.
    """

    def __init__(self, path: Path) -> None:
        self._stream = path.open("w+b")
        # Each column is a frame of its own, which takes no memory between the pieces.
        self._compressor = zstandard.ZstdCompressor(level=1)
        self._pieces: list[_Piece] = []
        self._kinds: dict[str, np.dtype[Any]] = {}
        self.rows = 0

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def add(self, table: Table) -> None:
        """Add rows."""
        for name, column in table.items():
            self._kinds[name] = _common(self._kinds.get(name), column)
        count = len(table["t"])
        for begin in range(0, count, _ROWS):
            part = {name: column[begin : begin + _ROWS] for name, column in table.items()}
            self._add(part)
        self.rows += count

    def _add(self, table: Table) -> None:
        layout = tuple((name, column.dtype) for name, column in table.items())
        if self._pieces and self._pieces[-1].layout == layout:
            layout = self._pieces[-1].layout  # one object for many pieces
        places = [self._stream.tell()]
        for column in table.values():
            self._stream.write(self._compressor.compress(column.tobytes()))
            places.append(self._stream.tell())
        self._pieces.append(_Piece(len(table["t"]), layout, np.array(places)))

    def kinds(self) -> dict[str, np.dtype[Any]]:
        """Return the types of the columns by name, in order."""
        return {
            name: kind if kind.itemsize else np.dtype("<U1") for name, kind in self._kinds.items()
        }

    def column(self, name: str) -> Iterator[Column]:
        """Yield a column in pieces."""
        kind = self.kinds()[name]
        for piece in self._pieces:
            yield self._read(piece, name, kind)

    def tables(self, pieces: int = 1) -> Iterator[Table]:
        """Yield the table in parts of so many pieces."""
        kinds = self.kinds()
        for begin in range(0, len(self._pieces), pieces):
            some = self._pieces[begin : begin + pieces]
            yield {
                name: np.concatenate([self._read(piece, name, kind) for piece in some])
                for name, kind in kinds.items()
            }

    def _read(self, piece: _Piece, name: str, kind: np.dtype[Any]) -> Column:
        index = next((k for k, (each, _) in enumerate(piece.layout) if each == name), None)
        if index is None:
            return np.full(piece.rows, np.nan, dtype=kind)
        begin, end = piece.places[index : index + 2].tolist()
        self._stream.seek(begin)
        data = zstandard.ZstdDecompressor().decompress(self._stream.read(end - begin))
        column = np.frombuffer(data, dtype=piece.layout[index][1])
        if kind.kind == column.dtype.kind or "U" not in (kind.kind, column.dtype.kind):
            return column.astype(kind, copy=False)
        if kind.kind == "U":
            return np.array([str(value) for value in column.tolist()], dtype=kind)
        return np.full(piece.rows, np.nan, dtype=kind)  # nothing in it


def _common(kind: np.dtype[Any] | None, column: Column) -> np.dtype[Any]:
    """Return a type for the values of a column and for those before."""
    new = column.dtype
    if new.kind == "U" and not (column != "").any():
        # Nothing is known of these values: of the type "no characters", unless others are.
        return kind or np.dtype("<U0")
    if kind is None or not kind.itemsize:
        return new
    if "U" in (kind.kind, new.kind):
        lengths = [each.itemsize // 4 for each in (kind, new) if each.kind == "U"]
        return np.dtype(f"<U{max(lengths) if kind.kind == new.kind else max(*lengths, _NUMBER)}")
    if np.dtype(np.uint64) in (kind, new) and {kind.kind, new.kind} <= {"u", "i"}:
        return np.dtype(np.uint64)  # counters, which are never negative
    return np.result_type(kind, new)
