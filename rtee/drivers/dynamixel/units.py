"""Conversion between a joint's angle and a servo's pulses: zero, direction, gear, turns."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rtee.drivers.dynamixel.table import PULSES, RAD_PER_PULSE, VELOCITY_UNIT
from rtee.sample import FloatArray

_STATE = np.dtype([("current", "<i2"), ("velocity", "<i4"), ("position", "<i4")])


@dataclass(slots=True)
class Scale:
    """The units of one joint.

    Attributes:
        zero: Pulses at 0 rad, within one turn.
        direction: +1 or -1: sign of the pulses relative to the joint's angle.
        gear: Turns of the servo per turn of the joint.
        current_unit: Current per count [A].
        torque_per_ampere: Torque of the joint per current [N·m/A].
        turn: Whole turns by which the servo's count exceeds the joint's angle; set by `unwrap`.
    """

    zero: float
    direction: int = 1
    gear: float = 1.0
    current_unit: float = math.nan
    torque_per_ampere: float = math.nan
    turn: int = 0

    def to_rad(self, pulses: float) -> float:
        """Return the joint's angle [rad]."""
        servo = (pulses - self.zero - self.turn * PULSES) * RAD_PER_PULSE
        return self.direction * servo / self.gear

    def to_pulses(self, angle: float) -> int:
        """Return the servo's position [pulse] for a joint's angle [rad]."""
        servo = self.direction * angle * self.gear
        return round(servo / RAD_PER_PULSE + self.zero) + self.turn * PULSES

    def to_speed_counts(self, velocity: float) -> int:
        """Return a speed limit in counts, at least 1, for a joint's velocity [rad/s]."""
        # A profile velocity of 0 means no limit to the servo, so the slowest motion is one count.
        return max(1, round(abs(velocity) * self.gear / VELOCITY_UNIT))

    def to_current(self, counts: float) -> float:
        """Return the current [A], positive if it increases the joint's angle."""
        return self.direction * counts * self.current_unit

    def to_effort(self, counts: float) -> float:
        """Return the joint's torque [N·m]."""
        return self.to_current(counts) * self.torque_per_ampere * self.gear

    def to_current_counts(self, effort: float) -> int:
        """Return a current limit in counts for a joint's torque [N·m]."""
        current = abs(effort) / (self.torque_per_ampere * self.gear)
        return round(current / self.current_unit)

    def unwrap(self, pulses: float, lower: float, upper: float) -> float:
        """Choose the turn in which a position [pulse] lies in a range [rad], or nearest to it.

        After a power cycle a servo counts within one turn again, so that a joint whose range
        crosses the wrap may read a whole turn off. Returns the distance from the range [rad].
        """
        self.turn = 0
        step = 2.0 * math.pi / self.gear
        # The turn nearest to the middle of the range leaves the largest margin.
        middle = (lower + upper) / 2.0 if math.isfinite(upper - lower) else 0.0
        away = self.direction * (self.to_rad(pulses) - middle) / step
        self.turn = round(away)
        angle = self.to_rad(pulses)
        return max(lower - angle, angle - upper, 0.0)


class Scales:
    """The units of all joints as arrays, copied from each joint's `Scale`.

    Args:
        ids: Ids of the joints' servos.
        scales: The joints' units.
    """

    def __init__(self, ids: Sequence[int], scales: Sequence[Scale]) -> None:
        self._ids = tuple(ids)
        sense = np.array([float(s.direction) for s in scales])
        gear = np.array([s.gear for s in scales])
        self._turns = np.array([float(s.turn * PULSES) for s in scales])
        self._zero = np.array([s.zero for s in scales])
        self._rad = sense * RAD_PER_PULSE / gear
        self._speed = sense * VELOCITY_UNIT / gear
        self._current = sense * np.array([s.current_unit for s in scales])
        self._effort = self._current * np.array([s.torque_per_ampere for s in scales]) * gear

    def measured(
        self, data: Mapping[int, bytes]
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return positions [rad], velocities [rad/s], efforts [N·m] and currents [A].

        The data are the state registers by id: current, velocity and position.
        """
        reported = np.frombuffer(b"".join([data[number] for number in self._ids]), _STATE)
        amount = reported["current"]
        return (
            (reported["position"] - (self._zero + self._turns)) * self._rad,
            reported["velocity"] * self._speed,
            amount * self._effort,
            amount * self._current,
        )

    def pulses(self, angles: FloatArray) -> list[int]:
        """Return the servos' positions [pulse] for the joints' angles [rad]."""
        # Rounded before the turns are added, as in `Scale.to_pulses`, so that both agree.
        return [int(p) for p in (np.rint(angles / self._rad + self._zero) + self._turns).tolist()]
