"""A hand's calibration: the reading of each servo at 0 rad, and the identity of the servo."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from rtee.errors import CalibrationError
from rtee.hand.files import make_folder, write_atomically


@dataclass(frozen=True, slots=True)
class Calibrated:
    """One servo as it was calibrated.

    Attributes:
        actuator: The actuator it drives.
        id: Its id.
        model: Its model number.
        drive_mode: Its drive mode.
        homing_offset: Its homing offset [pulse].
        zero: Its position where the joint is at 0 rad [pulse], within one turn.
    """

    actuator: str
    id: int
    model: int
    drive_mode: int
    homing_offset: int
    zero: float


def read_calibration(path: Path, device: str) -> dict[str, Calibrated]:
    """Return the calibrated servos by actuator.

    Raises:
        CalibrationError: if the file is missing or says something else.
    """
    try:
        stored = json.loads(path.read_text("utf-8"))
        servos = [Calibrated(**entry) for entry in stored["servos"]]
    except FileNotFoundError:
        raise CalibrationError(
            device, f"there is no calibration at {path}; `rtee calibrate` makes one"
        ) from None
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise CalibrationError(device, f"{path} is not a calibration of servos: {error}") from error
    return {servo.actuator: servo for servo in servos}


def write_calibration(path: Path, servos: list[Calibrated]) -> None:
    """Write a calibration; raises `ConfigError` if the file cannot be written."""
    make_folder(path.parent)
    text = json.dumps({"servos": [asdict(servo) for servo in servos]}, indent=2)
    write_atomically(path, text + "\n")


def differences(then: Calibrated, now: Calibrated) -> list[str]:
    """Return what about a servo is not as it was calibrated, in words."""
    found = []
    for name in ("id", "model", "drive_mode", "homing_offset"):
        before, after = getattr(then, name), getattr(now, name)
        if before != after:
            found.append(f"{name.replace('_', ' ')} is {after}, was {before}")
    return found
