"""Measured end stops of one two-finger gripper: fully open and fully closed."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from rtee.errors import CalibrationError
from rtee.hand.files import make_folder, write_atomically

_LEAST_RANGE = 100
"""Counts between the ends, at least; a gripper whose way is free has about 227."""


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
    """Return a calibration unchanged.

    Raises:
        CalibrationError: if the gripper cannot have moved the whole way.
    """
    found = stops.closed_count - stops.open_count
    if found < _LEAST_RANGE:
        raise CalibrationError(
            device,
            f"it moved {found} counts between open and closed, at least {_LEAST_RANGE} are "
            "expected: is something between the fingers?",
        )
    return stops


def read_end_stops(path: Path, device: str, model: str, unit: int) -> EndStops:
    """Return the stored calibration of a gripper.

    Raises:
        CalibrationError: if it is missing, of another gripper, or no calibration.
    """
    try:
        stops = EndStops(**json.loads(path.read_text("utf-8")))
    except FileNotFoundError:
        raise CalibrationError(
            device, f"there is no calibration at {path}; `rtee calibrate` makes one"
        ) from None
    except (OSError, ValueError, TypeError) as error:
        raise CalibrationError(device, f"{path} is not a calibration: {error}") from error
    if (stops.model, stops.unit) != (model, unit):
        raise CalibrationError(
            device,
            f"{path} was made with a {stops.model}, unit {stops.unit}, not with this {model}, "
            f"unit {unit}; calibrate again",
        )
    return checked(stops, device)


def write_end_stops(path: Path, stops: EndStops) -> None:
    """Store a calibration; raises `ConfigError` if the file cannot be written."""
    make_folder(path.parent)
    write_atomically(path, json.dumps(asdict(stops), indent=2) + "\n")
