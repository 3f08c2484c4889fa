"""Panel of the touch sensors: plots of their sums, and a table of their values."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from typing import Final

import numpy as np
import viser
from viser import uplot

from rtee.gui.history import LONGEST, Windows, nice_range
from rtee.gui.panels.plots import chart, line
from rtee.gui.panels.table import table
from rtee.gui.wording import legend, put, small
from rtee.sample import FloatArray
from rtee.touch import TouchState

_HEIGHT: Final = 180
"""Height of a plot [pixels]: plots of two units and the table fit on a laptop's screen."""

_SPAN: Final = 0.5
"""Least length of an axis, in the unit of the sensor, so that noise looks small."""

_NONE = "The hand measures no touch."


class TouchPanel:
    """Plots of the sums of the touch sensors over time, one plot for each unit."""

    def __init__(self, gui: viser.GuiApi) -> None:
        """Add the panel to the current container."""
        self._gui = gui
        self._legend = gui.add_html(small(_NONE))
        self._folder = gui.add_folder(None)
        self._window = gui.add_slider(
            "Length [s]",
            2,
            int(LONGEST),
            1,
            10,
            hint="Length of time of touch shown [s]",
            visible=False,
        )
        self._table = gui.add_html("")
        self._plots: dict[str, viser.GuiUplotHandle] = {}
        self._shown: list[tuple[str, str]] = []

    @property
    def length(self) -> float:
        """Length of the time window shown [s]."""
        return float(self._window.value)

    def show(self, states: Iterable[TouchState]) -> None:
        """Show the last readings in the table."""
        rows = []
        for state in states:
            sums = state.totals.tolist()
            for sensor, total in zip(state.sensors, sums, strict=True):
                largest = float(state.of(sensor.name).max())
                unit = "stale" if state.stale else escape(sensor.unit)
                rows.append((sensor.name, f"{total:.2f}", f"{largest:.2f}", unit))
        put(self._table, table(("sensor", "sum", "largest", "unit"), rows) if rows else "")

    def draw(self, windows: Windows) -> None:
        """Draw the lines."""
        sensors = [(s.name, s.unit) for known, _, _ in windows.values() for s in known]
        if sensors != self._shown:
            self._shown = sensors
            self._rebuild()
        for unit, plot in self._plots.items():
            data = self._data(windows, unit)
            # While a recording is opened, the lines may still be those of the hand.
            if len(data) == len(plot.data):
                plot.data = data

    def _rebuild(self) -> None:
        for plot in self._plots.values():
            plot.remove()
        self._plots.clear()
        names = list(enumerate(name for name, _ in self._shown))
        self._legend.content = legend(names) if names else small(_NONE)
        self._window.visible = bool(names)
        with self._folder:
            for unit in dict.fromkeys(unit for _, unit in self._shown):
                self._plots[unit] = self._add_plot(unit)

    def _add_plot(self, unit: str) -> viser.GuiUplotHandle:
        series = [uplot.Series(label="t [s]")]
        for number, (name, its_unit) in enumerate(self._shown):
            if its_unit == unit:
                series.append(line(number, name))
        # Placeholders for the times, the lines and the ends of the axis, until the first update.
        nothing = [np.zeros(1)] * (len(series) + 2)
        return chart(self._gui, nothing, series, f"touch, sum over taxels [{unit}]", _HEIGHT)

    def _data(self, windows: Windows, unit: str) -> tuple[FloatArray, ...]:
        """Return times [s] and lines ``(k,)``; all devices share the union of their times."""
        times = np.unique(np.concatenate([t for _, t, _ in windows.values()]))
        lines: list[FloatArray] = []
        for sensors, t, sums in windows.values():
            chosen = [index for index, sensor in enumerate(sensors) if sensor.unit == unit]
            rows = np.searchsorted(t, times, side="right") - 1
            # The first row is NaN, for times before the first reading of a device.
            known = np.full((len(t) + 1, len(sensors)), np.nan)
            known[1:] = sums.reshape(len(t), len(sensors))
            lines += [known[rows + 1, index] for index in chosen]
        ends = nice_range(lines, _SPAN)
        return (times, *lines, *(np.full(len(times), end) for end in ends))
