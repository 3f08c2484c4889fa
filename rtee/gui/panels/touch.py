"""The panel of touch sensors: a plot of their sums, and a table of what they measure."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Final

import numpy as np
import viser
from numpy.typing import NDArray
from viser import uplot

from rtee.gui.colours import line_colour, line_dash
from rtee.gui.history import LONGEST, POINTS, nice_range
from rtee.gui.panels.plots import chart
from rtee.gui.panels.table import table
from rtee.gui.wording import small
from rtee.sample import FloatArray
from rtee.touch import TouchSensor, TouchState

_HEIGHT: Final = 180
"""Height of a plot [pixels]: two units and the table fit on a laptop's screen."""

_KEPT: Final = int(100 * LONGEST)
"""Readings kept of a device: as long as the other plots, at 100 Hz."""

_SPAN: Final = 0.5
"""Least length of an axis, in the unit: noise should look like noise."""

_NONE = "The hand measures no touch."

Windows = Mapping[str, tuple[tuple[TouchSensor, ...], FloatArray, FloatArray]]
"""By device: its sensors, times relative to now ``(k,)`` [s], and the sums ``(k, sensors)``."""


class TouchPanel:
    """Plots the sums of the touch sensors over time, one plot for each unit."""

    def __init__(self, gui: viser.GuiApi) -> None:
        """Add the panel to the current container."""
        self._gui = gui
        self._legend = gui.add_html(small(_NONE))
        self._folder = gui.add_folder(None)
        self._window = gui.add_slider(
            "Length [s]", 2, int(LONGEST), 1, 10, hint="Length of time of touch shown [s]"
        )
        self._table = gui.add_html("")
        self._plots: dict[str, viser.GuiUplotHandle] = {}
        self._shown: list[tuple[str, str]] = []
        self._history: dict[str, deque[TouchState]] = {}

    def add(self, state: TouchState) -> None:
        """Add a reading of the live hand."""
        kept = self._history.setdefault(state.device, deque(maxlen=_KEPT))
        if kept and kept[-1].sensors is not state.sensors:
            kept.clear()
        kept.append(state)

    def live(self) -> Windows:
        """Return the newest readings."""
        now = max((kept[-1].stamp for kept in self._history.values()), default=0.0)
        found = {}
        for device, kept in self._history.items():
            stamps = np.array([state.stamp for state in kept]) - now
            rows = _thinned(np.flatnonzero(stamps >= -self.length))
            chosen = [kept[row] for row in rows]
            sums = np.array([state.totals for state in chosen])
            found[device] = (kept[-1].sensors, stamps[rows], sums)
        return found

    @property
    def length(self) -> float:
        """Length of time that is shown [s]."""
        return float(self._window.value)

    def show(self, states: Iterable[TouchState]) -> None:
        """Show in the table what was measured last."""
        rows = []
        for state in states:
            sums = state.totals.tolist()
            for sensor, total in zip(state.sensors, sums, strict=True):
                largest = float(state.of(sensor.name).max())
                said = "stale" if state.stale else sensor.unit
                rows.append((sensor.name, f"{total:.2f}", f"{largest:.2f}", escape(said)))
        self._table.content = table(("sensor", "sum", "largest", "unit"), rows) if rows else ""

    def draw(self, windows: Windows) -> None:
        """Draw the lines."""
        sensors = [(s.name, s.unit) for its, _, _ in windows.values() for s in its]
        if sensors != self._shown:
            self._shown = sensors
            self._rebuild()
        for unit, plot in self._plots.items():
            data = self._data(windows, unit)
            if len(data) == len(plot.data):
                plot.data = data

    def _rebuild(self) -> None:
        for plot in self._plots.values():
            plot.remove()
        self._plots.clear()
        self._legend.content = _legend([n for n, _ in self._shown]) if self._shown else small(_NONE)
        with self._folder:
            for unit in dict.fromkeys(unit for _, unit in self._shown):
                self._plots[unit] = self._add_plot(unit)

    def _add_plot(self, unit: str) -> viser.GuiUplotHandle:
        series = [uplot.Series(label="t [s]")]
        for number, (name, its) in enumerate(self._shown):
            if its == unit:
                series.append(
                    uplot.Series(
                        label=name,
                        stroke=line_colour(number),
                        dash=line_dash(number),
                        width=1.75,
                        auto=False,
                    )
                )
        # Times, the lines and the ends of the axis; the first update brings the values.
        nothing = [np.zeros(1)] * (len(series) + 2)
        return chart(self._gui, nothing, series, f"touch, sum over taxels [{unit}]", _HEIGHT)

    def _data(self, windows: Windows, unit: str) -> tuple[FloatArray, ...]:
        """Return times and lines; those of several devices share the times of all."""
        times = np.unique(np.concatenate([t for _, t, _ in windows.values()]))
        lines: list[FloatArray] = []
        for sensors, t, sums in windows.values():
            chosen = [index for index, sensor in enumerate(sensors) if sensor.unit == unit]
            rows = np.searchsorted(t, times, side="right") - 1
            # A row of NaN first, for times before a device's readings, or without any.
            known = np.full((len(t) + 1, len(sensors)), np.nan)
            known[1:] = sums.reshape(len(t), len(sensors))
            lines += [known[rows + 1, index] for index in chosen]
        ends = nice_range(lines, _SPAN)
        return (times, *lines, *(np.full(len(times), end) for end in ends))


def _thinned(rows: NDArray[np.intp]) -> list[int]:
    """Return at most `POINTS` of some rows, and always the last."""
    step = max(1, -(-len(rows) // POINTS))
    chosen: list[int] = rows[::-1][::step][::-1].tolist()
    return chosen


def _legend(names: Sequence[str]) -> str:
    items = "".join(
        f'<span style="white-space:nowrap;margin-right:0.8em">'
        f'<span style="display:inline-block;width:1.3em;vertical-align:middle;'
        f'border-top:3px {"dashed" if line_dash(i) else "solid"} {line_colour(i)}"></span> '
        f"{escape(name)}</span>"
        for i, name in enumerate(names)
    )
    return f'<div style="font-size:0.75em;line-height:1.5;padding:0.4em 0.75em 0">{items}</div>'
