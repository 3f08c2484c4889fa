"""Export recordings to CSV, Parquet and NumPy files."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import zstandard
from numpy.typing import NDArray

from rtee.errors import LogError, needing_extra, suggestion
from rtee.hand.files import cleared_on_failure, failing, replaced
from rtee.log.brief import actuators_of
from rtee.log.reader import windows
from rtee.log.recording import ActuatorSeries, Entry, JointSeries, Recording
from rtee.messages import topics
from rtee.messages.codec import SECOND
from rtee.messages.convert import plain
from rtee.messages.layout import JOINT_ARRAYS
from rtee.messages.state import ACTUATOR_COLUMNS
from rtee.types import Result

if TYPE_CHECKING:
    import pandas


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

    A column that is missing in some pieces is ``NaN`` there. One whose type
    differs between pieces gets a common type.

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
        """Yield the table in parts of the given number of pieces."""
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
    """Return a type that fits a column's new values and the previous ones."""
    new = column.dtype
    if new.kind == "U" and not (column != "").any():
        # The column is empty so far: it keeps the previous type, or is text of length 0.
        return kind or np.dtype("<U0")
    if kind is None or not kind.itemsize:
        return new
    if "U" in (kind.kind, new.kind):
        lengths = [each.itemsize // 4 for each in (kind, new) if each.kind == "U"]
        return np.dtype(f"<U{max(lengths) if kind.kind == new.kind else max(*lengths, _NUMBER)}")
    if np.dtype(np.uint64) in (kind, new) and {kind.kind, new.kind} <= {"u", "i"}:
        return np.dtype(np.uint64)  # counters, which are never negative
    return np.result_type(kind, new)


_GROUP = 5  # pieces of a row group: 50,000 rows of a hundred columns take 40 MB


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
    with failing("cannot be written", path, LogError), cleared_on_failure(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replaced(path) as temporary:
            yield temporary


def read_for(paths: Sequence[Path], only: Sequence[str] = ()) -> Iterator[Recording]:
    """Read what `export` needs of a recording, piece by piece."""
    wanted = {*_checked(only)}
    # Plans name their goals by numbers, and readings their sensors.
    more = {topics.PLANS: topics.GOALS, topics.TOUCH: topics.TOUCH_SENSORS}
    wanted |= {more[name] for name in wanted & more.keys()}
    return windows(paths, only=wanted)


def export(
    recording: Recording | Iterable[Recording], output: Path, kind: Format, only: Sequence[str] = ()
) -> list[Path]:
    """Write the topics of a recording, or ``only`` some, as tables; return the files written.

    The recording may come in pieces (`read_for`): whatever its length, few are in memory at once.
    CSV and Parquet make a folder with one file per topic; NPZ makes one file with all columns,
    named ``<topic>/<column>``. Columns of joints are named ``position.<joint>`` and so on. Raises
    `LogError` if there is nothing to export, or a file cannot be written.
    """
    if kind is Format.PARQUET:
        # Imported before the first file is written, so that a missing extra leaves no files.
        _parquet()
    folder = output.parent if kind is Format.NPZ else output
    path, spools = output, dict[str, Spool]()
    with failing("cannot be written", output, LogError), contextlib.ExitStack() as stack:
        stack.enter_context(cleared_on_failure(folder))
        folder.mkdir(parents=True, exist_ok=True)
        temporary = stack.enter_context(tempfile.TemporaryDirectory(dir=folder, prefix=".export."))
        for piece in (recording,) if isinstance(recording, Recording) else recording:
            path = piece.paths[0]
            for name, table in tables(piece, only).items():
                if name not in spools:
                    spools[name] = Spool(Path(temporary, name))
                    stack.callback(spools[name].close)
                spools[name].add(table)
        if not spools:
            raise LogError("contains nothing to export", path=path)
        if kind is Format.NPZ:
            _write_npz(output, spools)
            return [output]
        written = []
        for name in (name for name in TABLES if name in spools):
            path = output / f"{name}.{kind}"
            with replacing(path) as new:
                (_write_csv if kind is Format.CSV else _write_parquet)(new, spools[name])
            written.append(path)
        return written


def _write_csv(path: Path, spool: Spool) -> None:
    # The CSV writer sets the line ends, as its documentation asks.
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(spool.kinds())
        for table in spool.tables():
            writer.writerows(zip(*(column.tolist() for column in table.values()), strict=True))


def _parquet() -> Any:
    with needing_extra("export to Parquet", "plot"):
        import pyarrow
        import pyarrow.parquet
    return pyarrow


def _write_parquet(path: Path, spool: Spool) -> None:
    pyarrow = _parquet()
    text, number = pyarrow.string(), pyarrow.from_numpy_dtype
    kinds = {name: text if k.kind == "U" else number(k) for name, k in spool.kinds().items()}
    schema = pyarrow.schema(kinds)
    with pyarrow.parquet.ParquetWriter(path, schema, compression="zstd") as writer:
        for table in spool.tables(_GROUP):
            writer.write_table(pyarrow.table(table, schema=schema))


def _write_npz(path: Path, spools: Mapping[str, Spool]) -> None:
    # Only here, since a running hand imports this module, too.
    import zipfile

    with (
        replacing(path) as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive,
    ):
        for topic, spool in ((name, spools[name]) for name in TABLES if name in spools):
            for name, kind in spool.kinds().items():
                # As `numpy.savez_compressed` does, without the whole column in memory.
                with archive.open(f"{topic}/{name}.npy", "w", force_zip64=True) as stream:
                    head = {"descr": kind.str, "fortran_order": False, "shape": (spool.rows,)}
                    np.lib.format.write_array_header_1_0(stream, head)
                    for part in spool.column(name):
                        stream.write(part.tobytes())


def to_pandas(recording: Recording, topic: str = topics.ACTUATOR_STATES) -> pandas.DataFrame:
    """Return a topic of a recording as a table of pandas.

    Args:
        recording: The recording.
        topic: ``actuator_states``, ``reference``, ``results``, ``events`` and so on, as the files
            that ``rtee log export`` writes are named.

    Returns:
        A row for each message, by its time since the recording's start [s]. Columns of actuators
        are named ``position.<actuator>`` and so on; without messages there are no rows.

    Raises:
        LogError: if there is no such topic, or no recording.
        MissingExtra: if pandas is not installed.
    """
    if not isinstance(recording, Recording):
        raise LogError(f"a table is made of what rtee.log.read returns, not of {recording!r:.100}")
    with needing_extra("a table of pandas", "pandas"):
        import pandas
    return pandas.DataFrame(tables(recording, [topic]).get(topic, {"t": []})).set_index("t")


_LARGEST = 2**63 - 1  # largest number of 64 bits with a sign


def _series(series: JointSeries) -> Table:
    table: Table = {"t": series.t, "wall_ns": series.wall}
    wide: Sequence[str] = JOINT_ARRAYS
    if isinstance(series, ActuatorSeries):
        table |= {"tick": series.tick, "monotonic": series.time}
        wide = ACTUATOR_COLUMNS
    for quantity in wide:
        values = getattr(series, quantity)
        for index, name in enumerate(series.names):
            table[f"{quantity}.{name}"] = values[:, index]
    return table


def _text(value: object) -> str:
    if isinstance(value, Mapping):
        return " ".join(f"{key}={item}" for key, item in value.items())
    if isinstance(value, (tuple, list)):
        return " ".join(map(str, value))
    return "" if value is None else str(value)


def _column(values: Sequence[Any]) -> Column:
    # Before integers, since a bool is an int in Python.
    if all(isinstance(value, bool) for value in values):
        return np.array(values, dtype=bool)
    if all(isinstance(value, int) for value in values):
        # Counters and numbers of ticks are unsigned 64-bit integers.
        large = any(value > _LARGEST for value in values)
        return np.array(values, dtype=np.uint64 if large else np.int64)
    numbers = [value for value in values if value is not None]
    if numbers and all(isinstance(value, (int, float)) for value in numbers):
        return np.array([np.nan if value is None else value for value in values], dtype=np.float64)
    return np.array([_text(value) for value in values], dtype=np.str_)


def _times(entries: Sequence[Entry[Any]]) -> Table:
    return {
        "t": np.array([entry.t for entry in entries], dtype=np.float64),
        "wall_ns": np.array([entry.wall for entry in entries], dtype=np.int64),
    }


def _entries(entries: Sequence[Entry[Any]]) -> Table:
    table = _times(entries)
    if not entries:
        return table
    for field in dataclasses.fields(entries[0].value):
        table[field.name] = _column([getattr(entry.value, field.name) for entry in entries])
    return table


def _results(entries: Sequence[Entry[Result]]) -> Table:
    table = _entries(entries)
    table["outcome"] = np.array([entry.value.outcome for entry in entries], dtype=np.str_)
    return table


def _commands(recording: Recording) -> Table:
    """Return one table for all kinds of commands, with the fields of their message."""
    names = ("kind", "text", "values", "tick", "stamp")
    records = [entry.value for entry in recording.commands]
    rows = [(*plain(each.command), each.tick, each.stamp) for each in records]
    columns = {name: _column([row[i] for row in rows]) for i, name in enumerate(names)}
    return _times(recording.commands) | columns


def _stream_samples(recording: Recording) -> Table:
    """Return a table with a column for each name; ``NaN`` in the rows of samples without it."""
    samples = [entry.value.command for entry in recording.stream_samples]
    table = _times(recording.stream_samples)
    for name in ("stream", "stamp", "arrival"):
        table[name] = _column([getattr(sample, name) for sample in samples])
    for kind in ("targets", "velocity", "positions", "velocities"):
        values = [getattr(sample, kind) for sample in samples]
        for name in dict.fromkeys(name for each in values for name in each):
            table[f"{kind}.{name}"] = np.array([each.get(name, np.nan) for each in values])
    return table


def _plans(recording: Recording) -> Table:
    """Return a table with a row for each motion of a plan, and a column for each actuator."""
    actuators = recording.actuator_states.names or actuators_of(recording.metadata)
    rows = [(each, leg) for each in recording.plans for leg in each.value.legs]
    table = _times([entry for entry, _ in rows])
    table["goal_id"] = _column([entry.value.goal_id for entry, _ in rows])
    for name in ("action", "elements", "timeout"):
        table[name] = _column([getattr(entry.value, name) for entry, _ in rows])
    for name in ("name", "before", "after"):
        table[name] = _column([getattr(leg, name) for _, leg in rows])
    for index in sorted({index for _, leg in rows for index in leg.targets}):
        column = [leg.targets.get(index, np.nan) for _, leg in rows]
        table[f"target.{actuators[index]}"] = np.array(column)
    return table


def _channels(recording: Recording) -> Table:
    rows = [
        (t, name, index, float(value))
        for name, channel in recording.channels.items()
        for t, values in zip(channel.t.tolist(), channel.values, strict=True)
        for index, value in enumerate(values.tolist())
    ]
    # Channels change at different times, but a table is sorted by time.
    rows.sort(key=lambda row: row[0])
    times = np.array([row[0] for row in rows], dtype=np.float64)
    return {
        "t": times,
        "wall_ns": recording.start + np.rint(times * SECOND).astype(np.int64),
        "channel": np.array([row[1] for row in rows], dtype=np.str_),
        "index": np.array([row[2] for row in rows], dtype=np.int64),
        "value": np.array([row[3] for row in rows], dtype=np.float64),
    }


def _touch(recording: Recording) -> Table:
    """Return a table with a row for each sensor and reading: the sum and the taxels."""
    rows = [
        (float(each.t[k]), device, sensor.name, sensor.unit, bool(each.stale[k]), i, k, each)
        for device, each in recording.touch.items()
        for k in range(len(each))
        for i, sensor in enumerate(each.sensors)
    ]
    rows.sort(key=lambda row: row[0])
    texts = {"device": 1, "sensor": 2, "unit": 3}
    table: Table = {"t": np.array([row[0] for row in rows], dtype=np.float64)}
    table["wall_ns"] = np.array([each.wall[k] for *_, k, each in rows], dtype=np.int64)
    table |= {name: np.array([row[i] for row in rows], dtype=np.str_) for name, i in texts.items()}
    table["stale"] = np.array([row[4] for row in rows], dtype=bool)
    table["total"] = np.array([each.totals[k, i] for *_, i, k, each in rows], dtype=np.float64)
    taxels = (each.state(k).of(name).tolist() for _, _, name, _, _, _, k, each in rows)
    table["taxels"] = np.array([_text(values) for values in taxels], dtype=np.str_)
    return table


def _described(topic: str) -> Callable[[Recording], Table]:
    """Return a function that makes the table of a topic: a column per field, a row per item."""

    def flat(fields: Mapping[str, Any], path: str = "") -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name, value in fields.items():
            if isinstance(value, Mapping):
                found |= flat(value, f"{path}{name}.")
            else:
                found[path + name] = value.tolist() if isinstance(value, np.ndarray) else value
        return found

    def make(recording: Recording) -> Table:
        rows = [
            (entry, flat(item))
            for entry in recording.others.get(topic, ())
            # The transforms of a message are its only field.
            for item in entry.value.get("transforms", [entry.value])
        ]
        names = dict.fromkeys(name for _, row in rows for name in row)
        columns = {name: _column([row.get(name) for _, row in rows]) for name in names}
        return _times([entry for entry, _ in rows]) | columns

    return make


_MAKERS: Mapping[str, Callable[[Recording], Table]] = {
    topics.JOINT_STATES: lambda recording: _series(recording.joint_states),
    topics.ACTUATOR_STATES: lambda recording: _series(recording.actuator_states),
    topics.REFERENCE: lambda recording: _series(recording.reference),
    topics.CHANNELS: _channels,
    topics.TOUCH: _touch,
    topics.GOALS: lambda recording: _entries(recording.goals),
    topics.PLANS: _plans,
    topics.COMMANDS: _commands,
    topics.STREAM_SAMPLES: _stream_samples,
    topics.GRIP: lambda recording: _entries(recording.grip),
    topics.FEEDBACK: lambda recording: _entries(recording.feedback),
    topics.RESULTS: lambda recording: _results(recording.results),
    topics.EVENTS: lambda recording: _entries(recording.events),
    topics.DEVICE_STATUS: lambda recording: _entries(recording.device_status),
    topics.LOOP_STATISTICS: lambda recording: _entries(recording.loop_statistics),
    **{name: _described(name) for name in sorted(topics.DESCRIBING)},
}

TABLES = tuple(_MAKERS)
"""Topics that can be converted to a table: all that a recording has."""


def tables(recording: Recording, only: Sequence[str] = ()) -> dict[str, Table]:
    """Return the topics of a recording that have messages, or ``only`` some, as tables.

    Raises `LogError` if a topic does not exist.
    """
    wanted = _checked(only)
    chosen = {name: make(recording) for name, make in _MAKERS.items() if name in wanted}
    return {name: table for name, table in chosen.items() if len(table["t"])}


def _checked(only: Sequence[str]) -> Sequence[str]:
    for name in only:
        if name not in _MAKERS:
            raise LogError(f"unknown topic '{name}'; {suggestion(name, _MAKERS)}")
    return only or TABLES
