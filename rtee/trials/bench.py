"""A hand ready for trials."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from rtee.actions.library import ActionLibrary
from rtee.hand.load import hand_folder, load_configured
from rtee.hand.model import Hand
from rtee.log import Recorder, RecorderSettings
from rtee.loop.settings import LoopSettings, loop_settings

RATE = 250.0
"""Ticks per second of a trial [Hz]."""


@dataclass(frozen=True)
class TrialBench:
    """A hand ready for trials."""

    hand: Hand
    library: ActionLibrary
    settings: LoopSettings
    folder: Path


@lru_cache(maxsize=8)
def bench(name: str, rate: float = RATE) -> TrialBench:
    """Load a hand, by name or folder, for trials at a rate [Hz].

    Raises:
        UserError: for every mistake in its files.
    """
    hand, config = load_configured(name)
    folder = hand_folder(name)[0]
    library = ActionLibrary.load(hand, folder / "actions")
    return TrialBench(hand, library, loop_settings(config, rate=rate), folder)


def recorder_for(ready: TrialBench, folder: Path) -> Recorder:
    """Return a recorder that drops nothing, however fast simulated time runs."""
    files = {
        file.relative_to(ready.folder).as_posix(): file.read_bytes()
        for file in [
            ready.folder / "hand.yaml",
            *sorted((ready.folder / "actions").rglob("*.yaml")),
        ]
    }
    return Recorder(
        ready.hand,
        RecorderSettings(folder, queue_time=1e6, sync=False, flight_recorder=0.0),
        rate=ready.settings.rate,
        loop=ready.settings,
        attachments=files,
        metadata={"drivers": "mujoco", "clock": "simulated"},
        simulated=True,
    )
