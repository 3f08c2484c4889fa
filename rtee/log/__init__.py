"""The log: recorder, reader, recovery, plots, export and replay of MCAP files."""

from typing import TYPE_CHECKING, Any

from rtee.log.reader import read
from rtee.log.recorder import Recorder
from rtee.log.recording import Entry, JointSeries, Recording, Span
from rtee.log.settings import RecorderSettings, RecorderStatus

if TYPE_CHECKING:
    from rtee.log.export import to_pandas as to_pandas

__all__ = [
    "Entry",
    "JointSeries",
    "Recorder",
    "RecorderSettings",
    "RecorderStatus",
    "Recording",
    "Span",
    "read",
    "to_pandas",
]


def __getattr__(name: str) -> Any:
    # Imported when first used: a hand that runs writes no tables.
    if name == "to_pandas":
        from rtee.log.export import to_pandas

        return to_pandas
    raise AttributeError(f"module 'rtee.log' has no attribute '{name}'")
