"""Common parts of drivers of servos on a line: options, presence check and calibration.

A calibration consists of the reading of each servo at 0 rad, and the servo's identity.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import IntFlag
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from rtee.drivers.base import Driver
from rtee.drivers.json_files import read_calibration_file, write_json
from rtee.drivers.options import Positive
from rtee.errors import CalibrationError, DeviceFault, HandshakeError, NotConnected
from rtee.sample import FloatArray


class ServoOptions(BaseModel):
    """Options of one servo that all kinds have.

    Attributes:
        direction: +1 or -1: sign of its positions relative to the joint's angle.
        gear: Turns of the servo per turn of the joint.
        model: Expected model number; by default any known one.
        torque_per_ampere: Torque per current [N·m/A]; by default that of the line or the model.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    direction: Literal[1, -1] = 1
    gear: Positive = 1.0
    model: int | None = None
    torque_per_ampere: Positive | None = None


def check_line(baudrate: int, rates: Collection[int], ids: Sequence[int]) -> None:
    """Check the options of a line: its rate, its servos' rates [baud], and their ids.

    Raises `ValueError` if they do not support the rate, or two have the same id.
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
    """Check that all servos of a device answer, each with the expected model number.

    Args:
        device: The device's name.
        port: Its port, for the message.
        expected: Id and expected model number (``None``: any) of each servo, by its name.
        found: Model number by id; ``None``: no answer.
        named: Returns the name of a model number.

    Raises:
        NotConnected: if no servo answers.
        HandshakeError: if some are missing or of another model.
    """
    missing = [number for number, model in found.items() if model is None]
    # If none answers, the cause is supply, port or rate; if some do, it is an id or a cable.
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


def fault_of(
    device: str, names: Mapping[int, str], errors: Mapping[int, IntFlag], hint: str
) -> DeviceFault:
    """Return the fault of servos that report errors.

    Args:
        device: The device's name.
        names: Names of the servos, by id.
        errors: Error bits of each servo that reports any, by id.
        hint: What to do about them.
    """
    problems, code = [], 0
    for number, error in errors.items():
        code |= error
        words = ", ".join(bit.name.lower().replace("_", " ") for bit in error if bit.name)
        # Without a known bit, the servo has only reported that something is wrong.
        problems.append(f"{words or 'alert'} in servo {number} ({names[number]})")
    return DeviceFault(device, code, "; ".join(problems), hint=hint)


@dataclass(frozen=True, slots=True)
class Calibrated:
    """One calibrated servo.

    Attributes:
        actuator: The actuator that it drives, or its own name if two servos drive one together.
        model: Its model number.
        drive_mode: Its drive mode, which includes the sense of rotation.
        homing_offset: Its homing offset [counts].
        zero: Its position at 0 rad of the joint [counts], within one turn.
    """

    actuator: str
    id: int
    model: int
    drive_mode: int
    homing_offset: int
    zero: float


def read_calibration(path: Path, device: str) -> dict[str, Calibrated]:
    """Return the calibrated servos by actuator; raises `CalibrationError`."""

    def servos_of(stored: Any) -> list[Calibrated]:
        servos = [Calibrated(**entry) for entry in stored["servos"]]
        for servo in servos:
            # `bool` is an `int`, and Python's JSON reader accepts NaN.
            if type(servo.zero) not in (int, float) or not math.isfinite(servo.zero):
                raise ValueError(f"the zero of '{servo.actuator}' is {servo.zero!r}, not a number")
        return servos

    servos = read_calibration_file(path, device, servos_of, of=" of servos")
    return {servo.actuator: servo for servo in servos}


def zeros_of(path: Path, device: str, servos: Sequence[Calibrated]) -> list[float]:
    """Return the calibrated zeros of servos [counts].

    Args:
        path: The file.
        device: The device's name.
        servos: The servos as found.

    Raises:
        CalibrationError: if the file cannot be used, or a servo has changed since.
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
    """Return the changes of a servo since its calibration, in words."""
    changes = []
    # These change the zero or identify another servo; gains and limits do neither.
    for name in ("id", "model", "drive_mode", "homing_offset"):
        before, after = getattr(then, name), getattr(now, name)
        if before != after:
            changes.append(f"{name.replace('_', ' ')} is {after}, was {before}")
    return changes


class CalibratesServos(Driver):
    """A driver of servos that are calibrated with the hand in its rest posture."""

    @abstractmethod
    async def take_zeros(self, rest: FloatArray) -> list[Calibrated]:
        """Set the zeros so that the present positions are a posture [rad]; raises `BusError`."""

    async def calibrate(
        self, path: Path, rest: FloatArray, ready: Callable[[str], Awaitable[None]]
    ) -> list[Calibrated]:
        """Let the user put the hand into its rest posture; set and store the zeros.

        Arguments and errors as for `Calibrates.calibrate`.
        """
        # Servos with torque would resist the hand that bends the joints.
        await self.deactivate()
        await ready("Put every joint into the rest posture; the servos are without torque.")
        servos = await self.take_zeros(rest)
        write_json(path, {"servos": [asdict(servo) for servo in servos]})
        return servos
