"""Recordings of trials in simulated time."""

from __future__ import annotations

from pathlib import Path

from rtee.log import Recorder, RecorderSettings
from rtee.trials.bench import TrialBench


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
