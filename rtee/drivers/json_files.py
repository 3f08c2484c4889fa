"""JSON files in which drivers store what a calibration has found."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, TypeVar

from rtee.errors import CalibrationError
from rtee.hand.files import write_all
from rtee.hand.validation import validated

T = TypeVar("T")


def read_calibration_file(
    path: Path, device: str, kind: type[T], *, of: str = "", **made_with: object
) -> T:
    """Return the content of a calibration file.

    Args:
        path: The file.
        device: The device's name, for the message.
        kind: The type of the content.
        of: The calibrated device in the message, such as `` of servos``.
        made_with: Required values of fields; a file with other values belongs to another device.

    Raises:
        CalibrationError: if the file is missing, holds no such calibration, or is for another
            device.
    """
    try:
        found = validated(kind, json.loads(path.read_text("utf-8")))
    except FileNotFoundError:
        raise CalibrationError(
            device, f"there is no calibration at {path}; `rtee calibrate` makes one"
        ) from None
    except (OSError, ValueError) as error:
        raise CalibrationError(device, f"{path} is not a calibration{of}: {error}") from error
    for name, now in made_with.items():
        if (then := getattr(found, name)) != now:
            text = f"{path} was made with {name} {then}, not {now}; calibrate again"
            raise CalibrationError(device, text)
    return found


def write_json(path: Path, value: Any) -> None:
    """Write a value as JSON, creating the folder if needed; raises `ConfigError` if that fails."""
    write_all({path: json.dumps(value, indent=2) + "\n"})
