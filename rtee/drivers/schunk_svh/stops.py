"""Where the stops found by homing are kept, so that a later program can attach to the hand."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from rtee.drivers.schunk_svh import codec
from rtee.drivers.schunk_svh.channels import Channel
from rtee.hand.files import make_folder, write_atomically


def read_stops(path: Path | None) -> dict[int, int]:
    """Return the stops [ticks] by channel, or nothing where there is no file that makes sense."""
    if path is None:
        return {}
    try:
        stored = json.loads(path.read_text("utf-8"))
        found = {int(channel): int(ticks) for channel, ticks in stored["stops"].items()}
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return {}
    return found if all(0 <= channel < codec.CHANNELS for channel in found) else {}


def write_stops(path: Path | None, stops: dict[int, int]) -> None:
    """Keep the stops [ticks] by channel; raises `ConfigError` if the file cannot be written."""
    if path is not None:
        make_folder(path.parent)
        text = json.dumps({"stops": {str(c): stops[c] for c in sorted(stops)}}, indent=2)
        write_atomically(path, text + "\n")


def plausible(
    stops: Mapping[int, int], table: Sequence[Channel], feedback: codec.FeedbackAll
) -> bool:
    """Return whether every finger stands where its stop allows."""
    for index, stop in stops.items():
        low, high = table[index].soft_limits(stop)
        slack = (high - low) // 10
        if not low - slack <= feedback.positions[index] <= high + slack:
            return False
    return True
