"""Live plots of position, reference, velocity, effort, current and temperature."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import viser
from viser import uplot

from rtee.gui.colours import finger_colour
from rtee.messages.state import State
from rtee.types import FloatArray

QUANTITIES = ("position", "velocity", "effort", "current", "temperature")
_UNITS = {
    "position": "rad | m",
    "velocity": "rad/s | m/s",
    "effort": "N·m | N",
    "current": "A",
    "temperature": "°C",
}
_POINTS = 600
_LONGEST = 60.0
_FOLD = 6


class History:
    """The newest states, in memory that does not grow.

    Attributes:
        rate: States per second kept at most [Hz].
    """

    def __init__(self, size: int, rate: float = 100.0) -> None:
        """Keep ``_LONGEST`` seconds of ``size`` actuators."""
        self.rate = rate
        self._capacity = int(_LONGEST * rate)
        self._time = np.full(self._capacity, np.nan)
        self._values = {
            name: np.full((self._capacity, size), np.nan) for name in (*QUANTITIES, "reference")
        }
        self._count = 0

    def add(self, state: State) -> None:
        """Take a state."""
        row = self._count % self._capacity
        self._time[row] = state.stamp
        for name in QUANTITIES:
            self._values[name][row] = getattr(state, name)
        self._values["reference"][row] = state.reference_position
        self._count += 1

    def window(self, name: str, columns: Sequence[int], length: float) -> tuple[FloatArray, ...]:
        """Return times relative to now [s] and the columns of a quantity, thinned for display."""
        filled = min(self._count, self._capacity)
        if filled == 0:
            return tuple(np.zeros(0) for _ in range(len(columns) + 1))
        start = self._count - filled
        rows = np.arange(start, self._count) % self._capacity
        time = self._time[rows]
        rows, time = rows[time >= time[-1] - length], time[time >= time[-1] - length]
        step = max(1, len(rows) // _POINTS)
        # Whole multiples of the step since the start keep the picture from flickering.
        keep = (np.arange(self._count - len(rows), self._count) % step) == 0
        rows, time = rows[keep], time[keep]
        values = self._values[name][rows]
        now = self._time[(self._count - 1) % self._capacity]
        return (time - now, *(np.ascontiguousarray(values[:, c]) for c in columns))


class PlotsPanel:
    """Plots of the chosen actuators."""

    def __init__(self, gui: viser.GuiApi, names: Sequence[str]) -> None:
        """Put the panel where the GUI builds now.

        Args:
            gui: The browser's controls.
            names: The actuators.
        """
        self._gui = gui
        self._names = tuple(names)
        self.history = History(len(self._names))
        self._window = gui.add_slider(
            "Window [s]", 2, int(_LONGEST), 1, 10, hint="Length of time shown"
        )
        self._pause = gui.add_checkbox("Pause", False, hint="Freeze the plots; nothing is lost")
        with gui.add_folder("Quantities", expand_by_default=True):
            self._quantities = {
                name: gui.add_checkbox(
                    f"{name} [{_UNITS[name]}]", name in ("position", "effort"), hint=f"Plot {name}"
                )
                for name in QUANTITIES
            }
        with gui.add_folder("Actuators", expand_by_default=len(self._names) <= _FOLD):
            self._chosen = [
                gui.add_checkbox(name, index < _FOLD, hint="Show this actuator in the plots")
                for index, name in enumerate(self._names)
            ]
        for box in (*self._quantities.values(), *self._chosen):
            box.on_update(lambda _: self._changed())
        self._plots: dict[str, viser.GuiUplotHandle] = {}
        self._folder = gui.add_folder("Plots")
        self._stale = True

    def _changed(self) -> None:
        self._stale = True

    @property
    def _columns(self) -> list[int]:
        return [index for index, box in enumerate(self._chosen) if box.value]

    def _rebuild(self) -> None:
        for plot in self._plots.values():
            plot.remove()
        self._plots.clear()
        columns = self._columns
        if not columns:
            return
        with self._folder:
            for name, box in self._quantities.items():
                if box.value:
                    self._plots[name] = self._add_plot(name, columns)

    def _add_plot(self, name: str, columns: Sequence[int]) -> viser.GuiUplotHandle:
        series = [uplot.Series(label="t [s]")]
        for index in columns:
            colour = "rgb({},{},{})".format(*finger_colour(index))
            series.append(uplot.Series(label=self._names[index], stroke=colour, width=1.5))
        if name == "position":
            for index in columns:
                colour = "rgba({},{},{},0.5)".format(*finger_colour(index))
                series.append(
                    uplot.Series(
                        label=f"{self._names[index]} ref", stroke=colour, width=1, dash=(6, 4)
                    )
                )
        return self._gui.add_uplot(
            self._data(name, columns),
            tuple(series),
            title=f"{name} [{_UNITS[name]}]",
            scales={"x": uplot.Scale(time=False, auto=True), "y": uplot.Scale(auto=True)},
            legend=uplot.Legend(show=len(columns) <= _FOLD),
            aspect=2.0,
        )

    def _data(self, name: str, columns: Sequence[int]) -> tuple[FloatArray, ...]:
        length = float(self._window.value)
        data = self.history.window(name, columns, length)
        if name == "position":
            data = (*data, *self.history.window("reference", columns, length)[1:])
        return data

    def draw(self) -> None:
        """Bring the plots up to date; call it a few times a second."""
        if self._stale:
            self._stale = False
            self._rebuild()
        if self._pause.value:
            return
        columns = self._columns
        for name, plot in self._plots.items():
            plot.data = self._data(name, columns)
