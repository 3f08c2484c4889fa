"""Counters of a hand for monitoring a fleet: clients, goals by outcome, stops, lateness."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sized
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from rtee.loop.handloop import HandLoop
    from rtee.loop.report import Tally

_BOUNDS: Final = (1e-5, 2.5e-5, 5e-5, 1e-4, 2.5e-4, 5e-4, 1e-3, 2.5e-3, 5e-3, 1e-2, 1e-1)
"""Bounds of durations [s]: three a decade, from a good clock's lateness to a hundred ticks."""


@dataclass(frozen=True, slots=True)
class Counts:
    """Counters of events since a hand started; see ``rtee_msgs/Counts``.

    Attributes:
        version: Version of rtee.
        clients: Clients that are connected.
        stops: Stops.
        result: Outcome of the last goal, or an empty string; see `rtee.types.Result.outcome`.
        goals: Goals by outcome.
        bound: Bounds of durations [s].
        lateness: Ticks that were late by at most each bound.
        busy: Ticks that took at most each bound of processor time.
        lateness_sum: Lateness of all ticks together [s].
        busy_sum: Processor time of all ticks together [s].
    """

    version: str = ""
    clients: int = 0
    stops: int = 0
    result: str = ""
    goals: dict[str, int] = field(default_factory=dict)
    bound: tuple[float, ...] = ()
    lateness: tuple[int, ...] = ()
    busy: tuple[int, ...] = ()
    lateness_sum: float = 0.0
    busy_sum: float = 0.0


def counts_of(message: dict[str, Any]) -> Counts:
    """Return the counts of a decoded message."""
    held: dict[str, Any] = {n: tuple(message[n].tolist()) for n in ("bound", "lateness", "busy")}
    outcomes = message.pop("outcome")
    held["goals"] = dict(zip(outcomes, message["goals"].tolist(), strict=True))
    return Counts(**(message | held))


def counting(loop: HandLoop, clients: Sized, tally: Tally) -> Callable[[], dict[str, Any]]:
    """Return a function that returns a hand's `Counts` as the fields of a ``rtee_msgs/Counts``.

    Any thread may call it.
    """
    version = _version()

    def counts() -> dict[str, Any]:
        clock = loop.clock_statistics
        fields = asdict(Counts(version, len(clients), tally.stops, tally.last))
        if clock is not None:
            fields |= {
                "bound": _BOUNDS,
                "lateness": clock.lateness.at_most(_BOUNDS),
                "busy": clock.busy.at_most(_BOUNDS),
                "lateness_sum": clock.lateness.total(),
                "busy_sum": clock.busy.total(),
            }
        ends = dict(tally.ends)
        return fields | {"outcome": list(ends), "goals": list(ends.values())}

    return counts


def _version() -> str:
    """Return the version of rtee; empty if it is not installed."""
    # `importlib.metadata` would take 1.5 MB of a hand's memory.
    found = (path for folder in sys.path for path in Path(folder).glob("rtee-*.dist-info"))
    return next((path.name.split("-")[1].removesuffix(".dist") for path in found), "")
