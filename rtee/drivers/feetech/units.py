"""Conversion between the servos' counts and SI units: zero, direction, gear, torque."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtee.drivers.feetech.table import CURRENT_UNIT, FULL, VOLTAGE_UNIT, Family, State
from rtee.sample import FloatArray

_MOST_SPEED = 0x7FFF
"""Largest speed that fits into its register; its last bit is the sign."""


@dataclass(slots=True)
class Scale:
    """The units of one servo.

    Attributes:
        zero: Position at 0 rad [counts].
        direction: +1 or -1: sign of its positions relative to the angle.
        gear: Turns of the servo per turn of the angle.
        stall_torque: Its largest torque [N·m].
        torque_per_ampere: Its torque per current [N·m/A].
        speed_unit: Speed of the servo per speed count [rad/s].
    """

    family: Family
    zero: float
    direction: int = 1
    gear: float = 1.0
    stall_torque: float = math.nan
    torque_per_ampere: float = math.nan
    speed_unit: float = 0.0

    @property
    def rad(self) -> float:
        """Angle per count, signed [rad]."""
        return self.direction * self.family.rad_per_count / self.gear

    def to_rad(self, position: float) -> float:
        """Return the angle [rad] at a position [counts]."""
        return (position - self.zero) * self.rad

    def to_counts(self, angle: float) -> int:
        """Return the position [counts] at an angle [rad]."""
        return round(self.zero + angle / self.rad)

    def to_speed(self, rate: float) -> int:
        """Return the speed count, at least 1, for a rate of the angle [rad/s]."""
        # For some servos 0 is the largest speed, for others standstill.
        count = round(abs(rate) * self.gear / self.speed_unit)
        return min(max(count, 1), _MOST_SPEED)

    def to_torque_counts(self, torque: float) -> int:
        """Return a torque limit [0.1 % or 6.5 mA] for a torque at the angle [N·m]."""
        if self.family.limits_torque == "current":
            return round(torque / (self.gear * self.torque_per_ampere * CURRENT_UNIT))
        return min(round(FULL * torque / (self.gear * self.stall_torque)), FULL)

    @property
    def torque_unit(self) -> float:
        """Torque at the angle per count of its measurement, signed [N·m].

        It is measured by the current if the torque per current is known, else by the load; both are
        good approximations only at standstill.
        """
        by = self.stall_torque / FULL
        if self.family.has_current and math.isfinite(self.torque_per_ampere):
            by = self.torque_per_ampere * CURRENT_UNIT
        return self.direction * self.gear * by


@dataclass(frozen=True, slots=True)
class Measured:
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


class Scales:
    """The units of all servos as arrays, copied from each servo's `Scale`.

    Args:
        scales: The units, in the order of the servos.
    """

    def __init__(self, scales: Sequence[Scale]) -> None:
        family = scales[0].family
        self._zero = np.array([s.zero for s in scales])
        self._rad = np.array([s.rad for s in scales])
        self._speed = np.array([s.direction * s.speed_unit / s.gear for s in scales])
        self._torque = np.array([s.torque_unit for s in scales])
        self._by_current = np.array(
            [family.has_current and math.isfinite(s.torque_per_ampere) for s in scales]
        )
        sense = [s.direction * CURRENT_UNIT if family.has_current else math.nan for s in scales]
        self._current = np.array(sense)

    def measured(self, states: Sequence[State]) -> Measured:
        """Return states in SI units."""
        columns = np.array(
            [(s.position, s.speed, s.load, s.current, s.temperature, s.voltage) for s in states],
            dtype=np.float64,
        ).T
        position, speed, load, current, temperature, voltage = columns
        return Measured(
            (position - self._zero) * self._rad,
            speed * self._speed,
            np.where(self._by_current, current, load) * self._torque,
            current * self._current,
            temperature,
            voltage * VOLTAGE_UNIT,
        )

    def counts(self, angles: FloatArray) -> list[int]:
        """Return the positions [counts] at angles [rad]."""
        return [int(p) for p in np.rint(angles / self._rad + self._zero).tolist()]
