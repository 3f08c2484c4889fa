"""The answers of sweeps, in a folder of Parquet files that pandas and DuckDB read as one table."""

from __future__ import annotations

import importlib
import json
from collections.abc import Iterator
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, Final

from rtee import monotonic
from rtee.errors import ConfigError, needing_extra
from rtee.hand.files import make_folder, write_atomically
from rtee.trials.result import TrialResult
from rtee.trials.variation import interval
from rtee.trials.work import Answer, MadeWith, Task, answer_of, kind_of, object_of, to_text

_EVERY: Final = 10.0
"""How often answers are written [s]: a killed sweep loses no more than these."""

_COLUMNS: Final = {
    **dict.fromkeys(("hand", "kind", "action", "object", "reason", "outcome", "worker"), "string"),
    **dict.fromkeys(("held", "fits"), "bool_"),
    **dict.fromkeys(("mass", "slip", "force", "peak", "rate", "low", "high"), "float64"),
    **dict.fromkeys(("survived", "variations", "method"), "int64"),
    **dict.fromkeys(("model", "actions", "mesh", "settings", "versions", "task"), "string"),
    "answer": "string",
}
"""Columns and their types; ``task`` and ``answer`` are JSON and hold everything."""


class Answers:
    """Answers of tasks, by the task and the versions with which they were made."""

    def __init__(self, folder: Path) -> None:
        """Read the answers in a folder.

        Raises:
            MissingExtra: if pyarrow is missing.
            ConfigError: if its files hold something else, or it cannot be made.
        """
        self.folder = make_folder(folder)
        with needing_extra("a table of results", "sweep"):
            self._arrow: Any = importlib.import_module("pyarrow")
            self._parquet: Any = importlib.import_module("pyarrow.parquet")
        self._schema = self._arrow.schema(
            [(name, getattr(self._arrow, kind)()) for name, kind in _COLUMNS.items()]
        )
        self._found: dict[tuple[str, MadeWith], str] = {}
        self._new: list[dict[str, Any]] = []
        self._write_at = 0.0
        self.added = 0
        for row in self._rows():
            task, answer = row.pop("task"), row.pop("answer")
            self._found[task, MadeWith(**row)] = answer

    def _rows(self) -> Iterator[dict[str, Any]]:
        names = [*(field.name for field in fields(MadeWith)), "task", "answer"]
        for path in sorted(self.folder.glob("*.parquet")):
            try:
                yield from self._parquet.read_table(path, columns=names).to_pylist()
            except (OSError, ValueError) as error:
                raise ConfigError(f"not the results of a sweep: {error}", path=path) from None

    def find(self, task: Task, made_with: MadeWith) -> Answer | None:
        """Return the stored answer of a task, if it was made with the same files."""
        found = self._found.get((to_text(task), made_with))
        return None if found is None else answer_of(task, json.loads(found))

    def add(self, hand: str, task: Task, made_with: MadeWith, worker: str, answer: Answer) -> None:
        """Add an answer; it is written within ten seconds, if others follow, and by `write`."""
        text = json.dumps(asdict(answer))
        self._found[to_text(task), made_with] = text
        row = {
            "hand": Path(hand).name,
            "kind": kind_of(task),
            "object": object_of(task),
            "worker": worker,
            "task": to_text(task),
            "answer": text,
            **asdict(made_with),
        }
        if isinstance(answer, TrialResult):
            trial, tries = answer.trial, answer.tries
            low, high = interval(answer.survived, tries)
            row |= {
                "action": trial.what,
                "mass": trial.mass,
                **{name: getattr(answer, name) for name in ("reason", "outcome", "held", "fits")},
                **{name: getattr(answer, name) for name in ("slip", "peak", "survived")},
                "force": max((force for _, force in answer.forces), default=0.0),
                "variations": tries,
                **({"rate": answer.survived / tries, "low": low, "high": high} if tries else {}),
            }
        self._new.append(row)
        self.added += 1
        if monotonic.now() >= self._write_at:
            self.write()

    def write(self) -> None:
        """Write the new answers to a further file.

        Raises:
            ConfigError: if it cannot be written.
        """
        self._write_at = monotonic.now() + _EVERY
        if not self._new:
            return
        sink = self._arrow.BufferOutputStream()
        table = self._arrow.Table.from_pylist(self._new, schema=self._schema)
        self._parquet.write_table(table, sink, compression="zstd")
        numbers = [int(path.stem.rpartition("-")[2]) for path in self.folder.glob("part-*.parquet")]
        path = self.folder / f"part-{max(numbers, default=0) + 1:06}.parquet"
        write_atomically(path, sink.getvalue().to_pybytes())
        self._new.clear()
