"""The answers of sweeps: in a folder of Parquet files, or beside a hand's actions.

Pandas and DuckDB read the Parquet files as one table.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Iterator
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, Final

from rtee import monotonic
from rtee.actions.fingerprints import Fingerprints
from rtee.errors import ConfigError, needing_extra
from rtee.hand.files import make_folder, write_atomically
from rtee.trials.result import Trial, TrialResult
from rtee.trials.store import read_results, write_results
from rtee.trials.variation import interval
from rtee.trials.work import Answer, MadeWith, Task, answer_of, kind_of, object_of, to_text

_EVERY: Final = 10.0
"""How often answers are written [s]: a killed sweep loses no more than these."""

_WRITING: Final = 0.1
"""Largest share of the time spent on a file of results, which each write makes anew."""

_VARIED: Final = ("variations", "seed", "choosing", "wanted")
"""What the key of a trial lacks, so that a result with other values is replaced."""

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
    """Answers of tasks, by the task and the versions with which they were made.

    Attributes:
        kept_in: Their folder.
        added: How many are new.
    """

    def __init__(self, folder: Path) -> None:
        """Read the answers in a folder.

        Raises:
            MissingExtra: if pyarrow is missing.
            ConfigError: if its files hold something else, or it cannot be made.
        """
        self.kept_in = make_folder(folder)
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
        for path in sorted(self.kept_in.glob("*.parquet")):
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
        numbers = [
            int(path.stem.rpartition("-")[2]) for path in self.kept_in.glob("part-*.parquet")
        ]
        path = self.kept_in / f"part-{max(numbers, default=0) + 1:06}.parquet"
        write_atomically(path, sink.getvalue().to_pybytes())
        self._new.clear()


class TrialFile:
    """Results of a hand's trials in one file, compatible with `Answers`.

    While the file holds outdated results, the new ones are in a file beside it, which replaces it
    at the end.

    Attributes:
        path: The file.
        outdated: How many results were made with other files of the hand, or by another method.
        added: How many results are new.
    """

    def __init__(self, path: Path, made_with: Fingerprints) -> None:
        """Read the results; raises `ConfigError` if the file holds something else."""
        self.path, self.added = path, 0
        self._made_with = made_with
        self._known = read_results(path, made_with)
        self.outdated = len(read_results(path).keys() - self._known.keys())
        if self.outdated:
            # An earlier command may have been interrupted while it replaced them.
            self._known |= read_results(self.kept_in, made_with)
        self._write_at = 0.0

    @property
    def keys(self) -> frozenset[str]:
        """Keys of the trials with a result."""
        return frozenset(self._known)

    @property
    def kept_in(self) -> Path:
        """The file of the new results."""
        name = f"{self.path.stem}.new{self.path.suffix}"
        return self.path.with_name(name) if self.outdated else self.path

    def find(self, task: Task, made_with: MadeWith | None = None) -> TrialResult | None:
        """Return the result of a trial with the same variations."""
        found = self._known.get(task.key) if isinstance(task, Trial) else None
        if found and all(getattr(found.trial, name) == getattr(task, name) for name in _VARIED):
            return found
        return None

    def add(self, hand: str, task: Task, made_with: MadeWith, worker: str, answer: Answer) -> None:
        """Add a result; write the file unless writing has taken too large a share of the time."""
        if isinstance(answer, TrialResult):
            self._known[answer.trial.key] = answer
            self.added += 1
            if monotonic.now() >= self._write_at:
                self.write()

    def write(self) -> None:
        """Write all results; raises `ConfigError` if they cannot be written."""
        begun = monotonic.now()
        write_results(self.kept_in, self._made_with, self._known.values())
        ended = monotonic.now()
        self._write_at = ended + (ended - begun) * (1.0 / _WRITING - 1.0)

    def finish(self) -> None:
        """Replace the outdated results by the new ones, if there are any."""
        if self.outdated and self.kept_in.exists():
            self.kept_in.replace(self.path)
