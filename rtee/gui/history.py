"""Ring buffer of the newest states, the data of the plots."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Final, Protocol

import numpy as np

from rtee.messages.state import State
from rtee.sample import MEASURED, FloatArray
from rtee.touch import TouchSensor, TouchState

QUANTITIES: Final = tuple(MEASURED)
"""Quantities measured per actuator; ``reference`` positions come in addition."""

JOINT_QUANTITIES: Final = ("joint_position", "joint_velocity")
"""Quantities of all joints, computed from those of the actuators."""

LONGEST: Final = 60.0
"""Longest time that the plots can show [s]."""

POINTS: Final = 200
"""Most points of a line: as many as a plot is wide in every second pixel."""


class Source(Protocol):
    """Source of the lines of the plots."""

    def window(self, name: str, columns: Sequence[int], length: float) -> tuple[FloatArray, ...]:
        """Return times relative to now [s] and the columns of a quantity, thinned for display."""


def stride(count: int) -> int:
    """Return the step that thins ``count`` points to at most `POINTS`."""
    return max(1, -(-count // POINTS))


class History:
    """Ring buffer of the newest states."""

    def __init__(self, actuators: int, joints: int, rate: float = 100.0) -> None:
        """Allocate memory for the longest time that plots can show, at a rate of states [Hz]."""
        self._capacity = int(LONGEST * rate)
        self._time = np.full(self._capacity, np.nan)
        sizes = dict.fromkeys((*QUANTITIES, "reference"), actuators)
        sizes |= dict.fromkeys(JOINT_QUANTITIES, joints)
        self._values = {
            # Single precision is far finer than a pixel, and halves the memory.
            name: np.full((self._capacity, size), np.nan, dtype=np.float32)
            for name, size in sizes.items()
        }
        self._count = 0

    def add(self, state: State, joint_velocity: FloatArray) -> None:
        """Add a state and the joint velocities ``(m,)`` computed from it [rad/s | m/s]."""
        row = self._count % self._capacity
        self._time[row] = state.stamp
        for name in QUANTITIES:
            self._values[name][row] = getattr(state, name)
        self._values["reference"][row] = state.reference_position
        self._values["joint_position"][row] = state.joint_position
        self._values["joint_velocity"][row] = joint_velocity
        self._count += 1

    def window(self, name: str, columns: Sequence[int], length: float) -> tuple[FloatArray, ...]:
        """Return times relative to now [s] and the columns of a quantity, thinned for display."""
        filled = min(self._count, self._capacity)
        if filled == 0:
            return tuple(np.zeros(0) for _ in range(len(columns) + 1))
        numbers = np.arange(self._count - filled, self._count)
        time = self._time[numbers % self._capacity]
        now = time[-1]
        numbers = numbers[time >= now - length]
        # Multiples of the step, counted from the first state, select the same points each time;
        # otherwise the lines would flicker.
        rows = numbers[numbers % stride(len(numbers)) == 0] % self._capacity
        values = self._values[name][rows].astype(np.float64)
        return (self._time[rows] - now, *(values[:, column] for column in columns))


Windows = Mapping[str, tuple[tuple[TouchSensor, ...], FloatArray, FloatArray]]
"""By device: its sensors, times relative to now ``(k,)`` [s], and the sums ``(k, sensors)``."""

_KEPT: Final = int(100 * LONGEST)
"""Number of readings of touch kept per device: as long as the other plots, at 100 Hz."""


class TouchHistory:
    """The newest readings of the touch sensors."""

    def __init__(self) -> None:
        self._kept: dict[str, deque[TouchState]] = {}

    def add(self, state: TouchState) -> None:
        """Add a reading."""
        kept = self._kept.setdefault(state.device, deque(maxlen=_KEPT))
        # Readings of other sensors have another length and cannot be plotted together.
        if kept and kept[-1].sensors is not state.sensors:
            kept.clear()
        kept.append(state)

    def newest(self) -> list[TouchState]:
        """Return the last reading of each device."""
        return [kept[-1] for kept in self._kept.values()]

    def windows(self, length: float) -> Windows:
        """Return the readings of the last seconds, thinned for display."""
        now = max((state.stamp for state in self.newest()), default=0.0)
        windows = {}
        for device, kept in self._kept.items():
            stamps = np.array([state.stamp for state in kept]) - now
            rows = np.flatnonzero(stamps >= -length)
            # From the end, so that the newest reading is always among those kept.
            rows = rows[::-1][:: stride(len(rows))][::-1]
            sums = np.array([kept[row].totals for row in rows])
            windows[device] = (kept[-1].sensors, stamps[rows], sums)
        return windows


def nice_range(lines: Sequence[FloatArray], least: float) -> tuple[float, float]:
    """Return a range for an axis that contains all lines and rarely changes as they move.

    The lines may have gaps of ``NaN``; the range has at least a given length.
    """
    known = [line[np.isfinite(line)] for line in lines]
    values = np.concatenate(known) if known else np.zeros(0)
    if not len(values):
        return 0.0, least
    low, high = float(values.min()), float(values.max())
    span = max(high - low, least)
    step = 10.0 ** math.floor(math.log10(span))
    step *= next(factor for factor in (0.25, 0.5, 1.0, 2.5) if span <= 4.0 * factor * step)
    # The margin of 1e-9 steps keeps rounding errors from adding a step to a range that fits.
    low, high = math.floor(low / step + 1e-9) * step, math.ceil(high / step - 1e-9) * step
    lacking = max(0, math.ceil((least - (high - low)) / (2.0 * step) - 1e-9))
    return low - lacking * step, high + lacking * step
