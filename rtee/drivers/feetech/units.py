"""From the servos' counts to SI units and back: zero, direction, gear, torque."""

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
        family: Its family.
        zero: Position where its angle is 0 [counts].
        direction: +1 or -1: sense of its positions with the angle.
        gear: Its turns per turn of the angle.
        stall_torque: Its largest torque [N·m].
        torque_per_ampere: Its torque per current [N·m/A].
        speed_unit: Its angle per second of a speed count [rad/s].
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
        # To some servos 0 means the largest speed, to others standstill.
        count = round(abs(rate) * self.gear / self.speed_unit)
        return min(max(count, 1), _MOST_SPEED)

    def to_torque_counts(self, torque: float) -> int:
        """Return a torque limit [0.1 % or 6.5 mA] for a torque at the angle [N·m]."""
        if self.family.limits_torque == "current":
            return round(torque / (self.gear * self.torque_per_ampere * CURRENT_UNIT))
        return min(round(FULL * torque / (self.gear * self.stall_torque)), FULL)

    @property
    def torque_unit(self) -> float:
        """Torque at the angle by a count of what measures it, signed [N·m].

        That is a count of the load, or of the current where the torque per current is known; near
        the truth at standstill.
        """
        by = self.stall_torque / FULL
        if self.family.has_current and math.isfinite(self.torque_per_ampere):
            by = self.torque_per_ampere * CURRENT_UNIT
        return self.direction * self.gear * by


@dataclass(frozen=True, slots=True)
class Measured:
    """What the servos of a device measure, each in its place ``(n,)``.

    Attributes:
        angle: Angles [rad].
        rate: Their rates [rad/s].
        torque: Torques [N·m]; ``NaN``: not known.
        current: Currents [A]; ``NaN``: not measured.
        temperature: Temperatures [°C].
        voltage: Supplies [V].
    """

    angle: FloatArray
    rate: FloatArray
    torque: FloatArray
    current: FloatArray
    temperature: FloatArray
    voltage: FloatArray


class Scales:
    """The units of all servos at once, as they are when this is made; see `Scale`.

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
        """Return what states tell, in SI units."""
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
