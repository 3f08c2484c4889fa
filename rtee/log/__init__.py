"""The log: recorder, reader, recovery, plots, export and replay of MCAP files."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rtee.log.export import to_pandas as to_pandas
    from rtee.log.reader import read as read
    from rtee.log.recorder import Recorder as Recorder
    from rtee.log.recording import Entry as Entry
    from rtee.log.recording import JointSeries as JointSeries
    from rtee.log.recording import Recording as Recording
    from rtee.log.recording import Span as Span
    from rtee.log.settings import RecorderSettings as RecorderSettings
    from rtee.log.settings import RecorderStatus as RecorderStatus

_HOME = {
    "to_pandas": "export",
    "read": "reader",
    "Recorder": "recorder",
    **dict.fromkeys(("Entry", "JointSeries", "Recording", "Span"), "recording"),
    **dict.fromkeys(("RecorderSettings", "RecorderStatus"), "settings"),
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    # Imported when first used: a reader needs no recorder, and a running hand writes no tables.
    if name in _HOME:
        return getattr(import_module(f"rtee.log.{_HOME[name]}"), name)
    raise AttributeError(f"module 'rtee.log' has no attribute '{name}'")
