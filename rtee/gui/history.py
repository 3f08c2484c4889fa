"""Ring buffer of the newest states, the data of the plots."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final, Protocol

import numpy as np

from rtee.log import Span
from rtee.messages.state import State
from rtee.sample import MEASURED, BoolArray, FloatArray
from rtee.touch import TouchSensor, TouchState
from rtee.types import Result

QUANTITIES: Final = tuple(MEASURED)
"""Quantities measured per actuator; the history also stores the ``reference`` positions."""

JOINT_QUANTITIES: Final = ("joint_position", "joint_velocity")
"""Quantities of all joints, computed from those of the actuators."""

LONGEST: Final = 60.0
"""Longest time window of the plots [s]."""

POINTS: Final = 200
"""Maximum number of points per line: about one for every second pixel of a plot's width."""


_DISORDER: Final = 1.0
"""Largest step back in the states' stamps that is disorder on the network [s]; after a larger one,
the clock is another, since the hand's computer was started again."""

_SPANS: Final = 100
"""Maximum number of stored actions: more within a minute would be indistinguishable."""


class PlotSource(Protocol):
    """Data source of the plots, with its own time axis [s]."""

    @property
    def pose(self) -> float | None:
        """Time of the pose in the 3D view [s]; ``None`` for the newest."""

    def window(self, name: str, columns: Sequence[int], length: float) -> tuple[FloatArray, ...]:
        """Return times and the columns of a quantity, thinned for display."""

    def measured(self, name: str) -> BoolArray:
        """Return which columns of a quantity have a value at some time."""

    def spans(self, length: float) -> Sequence[Span]:
        """Return the actions in a window of ``length`` [s]."""


def stride(count: int) -> int:
    """Return the step that thins ``count`` points to at most `POINTS`."""
    return max(1, -(-count // POINTS))


class StateHistory:
    """Ring buffer of the newest states and their actions; times are relative to now."""

    pose: float | None = None

    def __init__(self, actuators: int, joints: int, rate: float = 100.0) -> None:
        """Allocate buffers for `LONGEST` seconds of states that arrive at ``rate`` [Hz]."""
        self._capacity = int(LONGEST * rate)
        self._time = np.full(self._capacity, np.nan)
        sizes = dict.fromkeys((*QUANTITIES, "reference"), actuators)
        sizes |= dict.fromkeys(JOINT_QUANTITIES, joints)
        self._values = {
            # Single precision is far finer than a pixel, and halves the memory.
            name: np.full((self._capacity, size), np.nan, dtype=np.float32)
            for name, size in sizes.items()
        }
        self._measured = {name: np.zeros(size, dtype=bool) for name, size in sizes.items()}
        self._spans: deque[Span] = deque(maxlen=_SPANS)
        self._running: Span | None = None
        self._now = 0.0
        self._count = 0

    def add(self, state: State, joint_velocity: FloatArray) -> None:
        """Add a state and the joint velocities ``(m,)`` computed from it [rad/s | m/s]."""
        if state.stamp < self._now - _DISORDER:
            self._count, self._running = 0, None
            self._spans.clear()
        row = self._count % self._capacity
        self._time[row] = self._now = state.stamp
        values = {name: getattr(state, name) for name in QUANTITIES}
        values["reference"] = state.reference_position
        values |= {"joint_position": state.joint_position, "joint_velocity": joint_velocity}
        for name, value in values.items():
            self._values[name][row] = value
            self._measured[name] |= np.isfinite(value)
        self._count += 1

    def measured(self, name: str) -> BoolArray:
        """Return which columns of a quantity ever had a value."""
        return self._measured[name]

    def on_goal(self, goal_id: str, action: str) -> None:
        """Set the running goal; an empty ``goal_id`` means that none runs."""
        if not goal_id or any(span.goal_id == goal_id for span in self._spans):
            self._running = None
        elif self._running is None or self._running.goal_id != goal_id:
            self._running = Span(action, self._now, self._now, "running", goal_id)

    def on_result(self, result: Result) -> None:
        """Record the end of a goal."""
        name = " ".join((result.action, *result.elements))
        begin = self._now - result.duration
        self._spans.append(Span(name, begin, self._now, result.outcome, result.goal_id))
        self.on_goal(result.goal_id, "")  # no goal runs any longer

    def spans(self, length: float) -> list[Span]:
        """Return the actions of the last ``length`` seconds, including the running one."""
        running = [] if self._running is None else [replace(self._running, end=self._now)]
        return [
            replace(span, start=max(span.start - self._now, -length), end=span.end - self._now)
            for span in (*self._spans, *running)
            if span.end > self._now - length
        ]

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
"""Number of touch readings kept per device: as long as the other plots, at 100 Hz."""


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
        """Return the readings of the last ``length`` seconds, thinned for display."""
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

    The lines may have gaps of ``NaN``; the range is at least ``least`` long.
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
