"""Common parts of all servos on a shared line: options, units, presence, calibration.

The engine of their drivers is `rtee.drivers.servos`. A calibration consists of the reading of each
servo at 0 rad, and the servo's identity.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import IntFlag
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from rtee.drivers.json_files import read_calibration_file
from rtee.drivers.options import DeviceOptions, Moment, NotNegative, Pause, Positive
from rtee.errors import CalibrationError, DeviceFault, HandshakeError, NotConnected
from rtee.hand.validation import Finite, Section
from rtee.sample import FloatArray

LATENCY = 1e-3
"""Latency of a USB adapter per read [s]: the shortest setting of an FTDI chip's timer."""

DELAY_UNIT = 2e-6
"""Time per count of a servo's return delay [s]."""

_VOLTAGE_UNIT = 0.1
"""Supply voltage per count [V]."""

_MOST_SPEED = 0x7FFF
"""Largest speed that fits into the registers [counts]."""


class ServoOptions(Section, frozen=True, kw_only=True):
    """Options of one servo, common to all kinds.

    Attributes:
        id: Its id on the line.
        zero: Its position at 0 rad [counts]; by default the middle of its range or turn.
        direction: +1 or -1: sign of its positions relative to the joint's angle.
        gear: Turns of the servo per turn of the joint.
        model: Expected model number; by default any known one.
        torque_per_ampere: Torque per current [N·m/A]; by default that of the line or the model.
        p: Proportional gain; by default that of the line.
        i: Integral gain.
        d: Derivative gain.
    """

    direction: Literal[1, -1] = 1
    gear: Positive = 1.0
    model: int | None = None
    torque_per_ampere: Positive | None = None
    id: Annotated[int, Meta(ge=0, le=253)]
    zero: NotNegative | None = None
    p: Annotated[int, Meta(ge=0)] | None = None
    i: Annotated[int, Meta(ge=0)] | None = None
    d: Annotated[int, Meta(ge=0)] | None = None


class LineOptions(DeviceOptions, frozen=True):
    """Options of a line of servos, common to all kinds."""

    port: str = "/dev/ttyUSB0"
    """A tty, socket:// or rfc2217://."""
    baudrate: int = 1_000_000
    """Rate of the line [baud]."""
    calibration: Path | None = None
    """File of a calibration (``rtee calibrate``); its zeros replace those above."""
    p: Annotated[int, Meta(ge=0)] | None = None
    """Proportional gain; by default, that of the servos."""
    i: Annotated[int, Meta(ge=0)] | None = None
    """Integral gain."""
    d: Annotated[int, Meta(ge=0)] | None = None
    """Derivative gain."""
    return_delay: Annotated[int, Meta(ge=0, le=254)] | None = 0
    """Written to servos that have another one [2 µs]; null leaves them."""
    outside: Annotated[float, Meta(gt=0, le=10)] = 0.35
    """How far a joint may be outside its limits before its zero is doubted."""
    deadline: Moment = 0.1
    """Longest time for an exchange [s]."""
    retries: Annotated[int, Meta(ge=0, le=10)] = 2
    turnaround: Pause = LATENCY
    """Time per answer that the bytes do not explain [s]."""


def check_line(
    line: LineOptions, servos: Mapping[str, ServoOptions], rates: Collection[int], most_gain: int
) -> None:
    """Check the options of a line.

    Args:
        line: The options.
        servos: Those of its servos, by name.
        rates: The rates that they support [baud].
        most_gain: Their largest gain [counts].

    Raises:
        ValueError: if a value is not supported, or two servos have the same id.
    """
    if line.baudrate not in rates:
        raise ValueError(f"baudrate must be one of {', '.join(str(rate) for rate in rates)}")
    if len({servo.id for servo in servos.values()}) != len(servos):
        raise ValueError("two servos have the same id")
    gains = [line.p, line.i, line.d, *(g for s in servos.values() for g in (s.p, s.i, s.d))]
    if any(gain is not None and gain > most_gain for gain in gains):
        raise ValueError(f"gains must be from 0 to {most_gain}")


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
            hint="check ids and cables; `rtee scan` lists the servos it finds",
        )


def _ranges(numbers: Sequence[int]) -> str:
    ordered = sorted(numbers)
    if ordered == list(range(ordered[0], ordered[-1] + 1)) and len(ordered) > 2:
        return f"{ordered[0]} to {ordered[-1]}"
    return ", ".join(str(n) for n in ordered)


_CURES = {
    "OVERHEATING": "let it cool down",
    "VOLTAGE": "check its supply",
    "INPUT_VOLTAGE": "check its supply",
}
"""What to do about an error of a servo, by the name of its bit; all others: free the hand."""


def fault_of(
    device: str, names: Mapping[int, str], errors: Mapping[int, IntFlag], hint: str
) -> DeviceFault:
    """Return the fault of servos that report errors.

    Args:
        device: The device's name.
        names: Names of the servos, by id.
        errors: Error bits of each servo that reports any, by id.
        hint: What `recover` does about them, once their cause is gone.
    """
    problems, code, cures = [], 0, []
    for number, error in errors.items():
        code |= error
        cures += [_CURES.get(bit.name or "", "free the hand") for bit in error]
        words = ", ".join(bit.name.lower().replace("_", " ") for bit in error if bit.name)
        # Without a known bit, the servo has only reported that something is wrong.
        problems.append(f"{words or 'alert'} in servo {number} ({names[number]})")
    what = " and ".join(dict.fromkeys(cures)) or "free the hand and check its supply"
    return DeviceFault(device, code, "; ".join(problems), hint=f"{what}, then {hint}")


class Calibrated(Section, frozen=True):
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
    zero: Finite


class _Calibration(Section, frozen=True):
    servos: tuple[Calibrated, ...]


def read_calibration(path: Path, device: str) -> dict[str, Calibrated]:
    """Return the calibrated servos by actuator; raises `CalibrationError`."""
    stored = read_calibration_file(path, device, _Calibration, of=" of servos")
    return {servo.actuator: servo for servo in stored.servos}


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
                f"'{now.actuator}' has changed since its calibration: {'; '.join(changed)}; "
                "calibrate it again, or undo the change",
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


@dataclass(slots=True)
class ServoScale:
    """The units of one servo.

    Attributes:
        count: Angle of the servo per count of its position [rad].
        zero: Position at 0 rad of the joint [counts].
        direction: +1 or -1: sign of its positions relative to the joint's angle.
        gear: Turns of the servo per turn of the joint.
        speed_unit: Speed of the servo per speed count [rad/s].
        current_unit: Current per count [A].
        effort_unit: Torque of the joint per count of its measurement [N·m].
        limit_unit: Torque of the joint per count of the torque limit [N·m].
        turns: Whole turns by which the servo's position is ahead of the joint's [counts]; set by
            `unwrap`.
    """

    count: float
    zero: float
    direction: int = 1
    gear: float = 1.0
    speed_unit: float = math.nan
    current_unit: float = math.nan
    effort_unit: float = math.nan
    limit_unit: float = math.nan
    turns: int = 0

    @property
    def rad(self) -> float:
        """Angle of the joint per count, signed [rad]."""
        return self.direction * self.count / self.gear

    def to_rad(self, position: float) -> float:
        """Return the joint's angle [rad] at a position [counts]."""
        return (position - self.zero - self.turns) * self.rad

    def to_counts(self, angle: float) -> int:
        """Return the position [counts] at an angle of the joint [rad]."""
        return round(self.zero + angle / self.rad) + self.turns

    def to_speed(self, rate: float) -> int:
        """Return the speed limit [counts], at least 1, for a rate of the joint [rad/s]."""
        # For some servos 0 is the largest speed, for others standstill.
        return min(max(round(abs(rate) * self.gear / self.speed_unit), 1), _MOST_SPEED)

    def to_limit(self, torque: float) -> int:
        """Return the torque limit [counts] for a torque of the joint [N·m]."""
        return round(abs(torque) / self.limit_unit)

    def unwrap(self, position: float, lower: float, upper: float) -> None:
        """Choose the turn that brings a position [counts] into a range [rad], or nearest to it.

        After a power cycle a servo counts within one turn again, so that a joint whose range
        crosses the wrap may read a whole turn off.
        """
        self.turns = 0
        turn = 2.0 * math.pi / self.count
        # The turn nearest to the middle of the range leaves the largest margin.
        middle = (lower + upper) / 2.0 if math.isfinite(upper - lower) else 0.0
        self.turns = round(round((self.to_rad(position) - middle) / (self.rad * turn)) * turn)


@dataclass(frozen=True, slots=True)
class MeasuredServos:
    """The measurements of the servos of a device, arrays ``(n,)``.

    Attributes:
        angle: Angles [rad].
        rate: Angular velocities [rad/s].
        torque: Torques [N·m]; ``NaN``: not known.
        current: Currents [A]; ``NaN``: not measured.
        temperature: Temperatures [°C].
        voltage: Supply voltages [V].
    """

    angle: FloatArray
    rate: FloatArray
    torque: FloatArray
    current: FloatArray
    temperature: FloatArray
    voltage: FloatArray


class ServoScales:
    """The units of all servos as arrays, copied from each servo's `ServoScale`.

    Args:
        scales: The units, in the order of the servos.
    """

    def __init__(self, scales: Sequence[ServoScale]) -> None:
        sense = np.array([float(s.direction) for s in scales])
        self._turns = np.array([float(s.turns) for s in scales])
        self._zero = np.array([s.zero for s in scales])
        self._origin = self._zero + self._turns
        self._rad = np.array([s.rad for s in scales])
        self._speed = sense * np.array([s.speed_unit / s.gear for s in scales])
        self._effort = sense * np.array([s.effort_unit for s in scales])
        self._current = sense * np.array([s.current_unit for s in scales])

    def measured(self, columns: FloatArray) -> MeasuredServos:
        """Return measurements in SI units.

        Args:
            columns: Position, speed, effort, current, temperature [°C] and voltage [0.1 V] of each
                servo ``(6, n)`` [counts].
        """
        position, speed, effort, current, temperature, voltage = columns
        return MeasuredServos(
            (position - self._origin) * self._rad,
            speed * self._speed,
            effort * self._effort,
            current * self._current,
            temperature,
            voltage * _VOLTAGE_UNIT,
        )

    def counts(self, angles: FloatArray) -> list[int]:
        """Return the positions [counts] at angles of the joints [rad]."""
        # Rounded before the turns are added, as in `ServoScale.to_counts`, so that both agree.
        return [int(p) for p in (np.rint(angles / self._rad + self._zero) + self._turns).tolist()]
