"""Measured end stops of one two-finger gripper: fully open and fully closed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rtee.drivers.json_files import read_calibration_file
from rtee.errors import CalibrationError

_LEAST_RANGE = 100
"""Smallest plausible travel [counts]; a gripper that moves freely has about 227."""


@dataclass(frozen=True, slots=True)
class EndStops:
    """A calibration. The gripper has no serial number, so model and unit identify it.

    Attributes:
        model: The model it was made with.
        unit: The gripper's Modbus number.
        open_count: gPO when fully open.
        closed_count: gPO when fully closed.
    """

    model: str
    unit: int
    open_count: int
    closed_count: int

    def __str__(self) -> str:
        return f"open at {self.open_count}, closed at {self.closed_count} counts"


def checked(stops: EndStops, device: str) -> EndStops:
    """Return a calibration; raises `CalibrationError` if it does not cover the whole range."""
    travel = stops.closed_count - stops.open_count
    if travel < _LEAST_RANGE:
        raise CalibrationError(
            device,
            f"it moved {travel} counts between open and closed, at least {_LEAST_RANGE} are "
            "expected: is something between the fingers?",
        )
    return stops


def read_end_stops(path: Path, device: str, model: str, unit: int) -> EndStops:
    """Return the stored calibration of a gripper; raises `CalibrationError`."""
    stops = read_calibration_file(path, device, lambda stored: EndStops(**stored))
    if (stops.model, stops.unit) != (model, unit):
        raise CalibrationError(
            device,
            f"{path} was made with a {stops.model}, unit {stops.unit}, not with this {model}, "
            f"unit {unit}; calibrate again",
        )
    return checked(stops, device)
