"""The log: recorder, reader, recovery, plots, export and replay of MCAP files."""

from rtee.log.export import to_pandas
from rtee.log.reader import read
from rtee.log.recorder import Recorder
from rtee.log.recording import Entry, JointSeries, Recording, Span
from rtee.log.settings import RecorderSettings, RecorderStatus

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
