"""Export recordings to CSV, Parquet and NumPy files."""

from __future__ import annotations

import contextlib
import csv
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from rtee.errors import LogError, needing_extra
from rtee.log.recording import Recording
from rtee.log.sink import reason
from rtee.log.tables import Table, tables

_ROWS = 10_000  # rows converted to Python numbers at a time, which take some megabytes


class Format(StrEnum):
    """Formats of exported files."""

    CSV = "csv"
    PARQUET = "parquet"
    NPZ = "npz"


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path; at the end of the context, move its file to ``path``.

    If the file cannot be written, removes it and raises `LogError`.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=".export.") as folder:
            temporary = Path(folder, path.name)
            yield temporary
            with temporary.open("rb") as stream:
                # Before the rename, so that a power cut cannot leave an empty file at the path.
                os.fsync(stream.fileno())
            os.replace(temporary, path)
    except OSError as error:
        raise LogError(f"cannot be written: {reason(error)}", path=path) from error


def export(
    recording: Recording, output: Path, kind: Format, only: Sequence[str] = ()
) -> list[Path]:
    """Write the topics of a recording, or ``only`` some, as tables; return the files written.

    CSV and Parquet make a folder with one file per topic; NPZ makes one file with all columns,
    named ``<topic>/<column>``. Columns of joints are named ``position.<joint>`` and so on. Raises
    `LogError` if there is nothing to export, or a file cannot be written.
    """
    topic_tables = tables(recording, only)
    if not topic_tables:
        raise LogError("holds nothing that could be exported", path=recording.paths[0])
    if kind is Format.NPZ:
        _write_npz(output, topic_tables)
        return [output]
    if kind is Format.PARQUET:
        # Imported before the first file is written, so that a missing extra leaves no files.
        _parquet()
    written = []
    for name, table in topic_tables.items():
        path = output / f"{name}.{kind}"
        with replacing(path) as temporary:
            (_write_csv if kind is Format.CSV else _write_parquet)(temporary, table)
        written.append(path)
    return written


def _write_csv(path: Path, table: Table) -> None:
    # Line ends are up to the writer of CSV, as its documentation asks.
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(table)
        count = len(table["t"])
        for begin in range(0, count, _ROWS):
            part = [column[begin : begin + _ROWS].tolist() for column in table.values()]
            writer.writerows(zip(*part, strict=True))


def _parquet() -> Any:
    with needing_extra("export to Parquet", "plot"):
        import pyarrow
        import pyarrow.parquet
    return pyarrow


def _write_parquet(path: Path, table: Table) -> None:
    pyarrow = _parquet()
    columns = {name: pyarrow.array(column) for name, column in table.items()}
    pyarrow.parquet.write_table(pyarrow.table(columns), path, compression="zstd")


def _write_npz(path: Path, topic_tables: Mapping[str, Table]) -> None:
    arrays: dict[str, Any] = {
        f"{topic}/{name}": column
        for topic, table in topic_tables.items()
        for name, column in table.items()
    }
    with replacing(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, **arrays)
