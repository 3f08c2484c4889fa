"""What drivers of servos on a line share: options, who must be there, and the calibration.

A calibration is the reading of each servo at 0 rad, and the identity of the servo.
"""

from __future__ import annotations

import json
import math
from abc import abstractmethod
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict

from rtee.drivers.base import Driver
from rtee.drivers.options import Positive
from rtee.errors import CalibrationError, HandshakeError, NotConnected
from rtee.hand.files import make_folder, write_atomically
from rtee.sample import FloatArray


class ServoOptions(BaseModel):
    """Options that one servo has of every kind.

    Attributes:
        direction: +1 or -1: sense of its positions with the angle.
        gear: Its turns per turn of the angle.
        model: Model number expected; else any that is known.
        torque_per_ampere: Torque per current [N·m/A]; else that of the line, or of the model.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    direction: Literal[1, -1] = 1
    gear: Positive = 1.0
    model: int | None = None
    torque_per_ampere: Positive | None = None


def check_line(baudrate: int, rates: Collection[int], ids: Sequence[int]) -> None:
    """Check the options of a line.

    Args:
        baudrate: Its rate [baud].
        rates: Rates that its servos know [baud].
        ids: Their ids.

    Raises:
        ValueError: if they do not know the rate, or two have the same id.
    """
    if baudrate not in rates:
        raise ValueError(f"baudrate is one of {', '.join(str(rate) for rate in rates)}")
    if len(set(ids)) != len(ids):
        raise ValueError("two servos have the same id")


def check_present(
    device: str,
    port: str,
    expected: Mapping[str, tuple[int, int | None]],
    found: Mapping[int, int | None],
    named: Callable[[int | None], str],
) -> None:
    """Check that all servos of a device answer, each as the model that is expected.

    Args:
        device: The device's name.
        port: Where it is, for the message.
        expected: Id and model number, if one is expected, of each servo by its name.
        found: Model number by id; ``None``: it does not answer.
        named: Returns what a model number is called.

    Raises:
        NotConnected: if none answers.
        HandshakeError: if some are missing or of another model than expected.
    """
    missing = [number for number, model in found.items() if model is None]
    # None at all means supply, port or rate; some missing means an id or a cable.
    if len(missing) == len(found):
        raise NotConnected(
            device,
            f"none of {len(found)} servos answers at {port}",
            hint="is their supply on, and is it the right port and baud rate? `rtee scan` searches",
        )
    wrong = [
        f"{number} ({name}) is {named(found[number])}, not {named(model)}"
        for name, (number, model) in expected.items()
        if model is not None and found[number] not in (None, model)
    ]
    if missing or wrong:
        problems = [f"no {', '.join(str(n) for n in missing)}"] if missing else []
        raise HandshakeError(
            device,
            f"servos {_ranges(list(found))}",
            "; ".join(problems + wrong),
            hint="check ids and cables; `rtee scan` lists the servos there are",
        )


def _ranges(numbers: Sequence[int]) -> str:
    ordered = sorted(numbers)
    if ordered == list(range(ordered[0], ordered[-1] + 1)) and len(ordered) > 2:
        return f"{ordered[0]} to {ordered[-1]}"
    return ", ".join(str(n) for n in ordered)


@dataclass(frozen=True, slots=True)
class Calibrated:
    """One servo as it was calibrated.

    Attributes:
        actuator: The actuator it drives, or its name where two drive one together.
        id: Its id.
        model: Its model number.
        drive_mode: Its drive mode, above all its sense of rotation.
        homing_offset: Its homing offset [counts].
        zero: Its position where the joint is at 0 rad [counts], within one turn.
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
        for servo in servos:
            # Not bool, a kind of int; not NaN either, which JSON as Python reads it may hold.
            if type(servo.zero) not in (int, float) or not math.isfinite(servo.zero):
                raise ValueError(f"the zero of '{servo.actuator}' is {servo.zero!r}, not a number")
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


def zeros_of(path: Path, device: str, servos: Sequence[Calibrated]) -> list[float]:
    """Return the zeros that a calibration has for servos [counts].

    Args:
        path: The file.
        device: The device's name.
        servos: The servos as they are now.

    Raises:
        CalibrationError: if the file cannot be used, or one of them is not as it was calibrated.
    """
    stored = read_calibration(path, device)
    zeros = []
    for now in servos:
        then = stored.get(now.actuator)
        if then is None:
            raise CalibrationError(device, f"'{now.actuator}' is not calibrated")
        changed = _differences(then, now)
        if changed:
            raise CalibrationError(
                device,
                f"'{now.actuator}' is not as it was calibrated: {'; '.join(changed)}; "
                "calibrate again, or set it back",
            )
        zeros.append(then.zero)
    return zeros


def _differences(then: Calibrated, now: Calibrated) -> list[str]:
    """Return what about a servo is not as it was calibrated, in words."""
    found = []
    # These move the zero or say that it is another servo; gains and limits do neither.
    for name in ("id", "model", "drive_mode", "homing_offset"):
        before, after = getattr(then, name), getattr(now, name)
        if before != after:
            found.append(f"{name.replace('_', ' ')} is {after}, was {before}")
    return found


class CalibratesServos(Driver):
    """A driver of servos whose zeros are found by putting the hand into its rest posture."""

    @abstractmethod
    async def take_zeros(self, rest: FloatArray) -> list[Calibrated]:
        """Take the present positions for a posture [rad]; raises `BusError`."""

    async def calibrate(
        self, path: Path, rest: FloatArray, ready: Callable[[str], Awaitable[None]]
    ) -> list[Calibrated]:
        """Take the pose that the user puts the hand into for its rest posture; store the zeros.

        Args:
            path: File to write.
            rest: Angles of the rest posture [rad], in the order of the actuators.
            ready: Called with what to do; returns when it is done.

        Raises:
            BusError: if the line fails.
            ConfigError: if the file cannot be written.
        """
        await self.deactivate()
        await ready("Put every joint into the rest posture; the servos are without torque.")
        found = await self.take_zeros(rest)
        write_calibration(path, found)
        return found
