"""Plots over time of the actuators, their references, the joints and the touch sensors."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from html import escape
from typing import Final

import numpy as np
import viser
from viser import uplot

from rtee.gui.colours import line_colour, line_dash, lines_of
from rtee.gui.history import JOINT_QUANTITIES, LONGEST, QUANTITIES, PlotSource, Windows, nice_range
from rtee.gui.panels.table import table
from rtee.gui.playback import span_colour
from rtee.gui.wording import Angles, legend, put, short_names, small
from rtee.hand.model import Hand
from rtee.sample import MEASURED, FloatArray
from rtee.touch import TouchState

_SHOWN = frozenset({"position", "velocity", "effort", *JOINT_QUANTITIES})
"""Quantities shown initially; those of joints appear once a joint is chosen."""

_FOLD = 6
"""Number of actuators shown initially: more lines would be hard to tell apart."""

_HEIGHT = 140
"""Height of a plot [pixels]: four fit on a laptop's screen."""

_SMALL = "10px system-ui, sans-serif"


def line(number: int, label: str, width: float = 1.75, alpha: float = 1.0) -> uplot.Series:
    """Return the style of the line with this number, see `line_numbers`; faint means commanded."""
    kind = "commanded" if alpha < 1.0 else "measured"
    return uplot.Series(
        {
            "label": label,
            "stroke": line_colour(number),
            "width": width,
            "dash": line_dash(number),
            "alpha": alpha,
            "auto": False,  # NaN, for missing measurements, would break the scale
            "class": f"rtee-{kind}{'-dashed' * bool(line_dash(number))}",
        }
    )


def chart(
    gui: viser.GuiApi,
    data: Sequence[FloatArray],
    series: Sequence[uplot.Series],
    title: str,
    height: int,
) -> viser.GuiUplotHandle:
    """Add a plot of ``height`` [pixels] to the current container.

    ``data`` has the times, the lines, and the lower and upper end of the axis, each ``(k,)``.
    ``series`` has the styles of the time axis and of each line. ``title`` ends with the unit.
    """
    unit = title.rpartition("[")[2].rstrip("]")
    # Invisible lines set the range, since a change of scale would rebuild the plot.
    ends = [
        uplot.Series({"label": end, "stroke": "#0000", "width": 0, "class": "rtee-end"})
        for end in ("low", "high")
    ]
    return gui.add_uplot(
        tuple(data),
        (*series, *ends),
        title=title,
        scales={"x": uplot.Scale(time=False, auto=True), "y": uplot.Scale(auto=True)},
        axes=(
            uplot.Axis(font=_SMALL, size=24, space=50, label="s", labelFont=_SMALL, labelSize=12),
            uplot.Axis(font=_SMALL, size=42, space=24, label=unit, labelFont=_SMALL, labelSize=14),
        ),
        legend=uplot.Legend(show=True, live=True),  # shown while a plot is pointed at
        cursor=uplot.Cursor(sync={"key": "time"}),  # one cursor and one zoom for all plots
        height=height,
        padding=(10, 12, 0, 0),
    )


def _times(pose: float | None, spans: Sequence[tuple[float, float, str, str]]) -> str:
    """Return the marks for all plots as HTML: the time of the pose, and the actions."""
    return f'<i data-rtee-times="{escape(json.dumps({"pose": pose, "spans": spans}))}"></i>'


def _differs(new: Sequence[FloatArray], old: Sequence[FloatArray]) -> bool:
    """Return whether the data of a plot have changed, and must be sent to the browser."""
    return any(
        a.shape != b.shape or not np.allclose(a, b, atol=tolerance, equal_nan=True)
        # Times relative to now always differ slightly; those of another page differ by far more.
        for a, b, tolerance in zip(new, old, (0.5, *[1e-4] * len(old)), strict=False)
    )


class PlotsPanel:
    """Plots of the chosen actuators and joints."""

    def __init__(self, gui: viser.GuiApi, hand: Hand, history: PlotSource, angles: Angles) -> None:
        """Add the panel to the current container; ``history`` is that of the live hand."""
        self._gui = gui
        self._angles = angles
        actuators = tuple(actuator.kind for actuator in hand.actuators)
        joints = tuple(joint.kind for joint in hand.joints)
        self._kinds = dict.fromkeys(QUANTITIES, actuators) | dict.fromkeys(JOINT_QUANTITIES, joints)
        self._names = short_names(hand.actuator_names)
        self._joints = short_names(hand.joint_names)
        self._live = self._source = history
        self._lines, self._joint_lines = lines_of(hand)
        self._legend = gui.add_html("")
        self._times = gui.add_html("")
        self._folder = gui.add_folder(None)
        self._pause = gui.add_checkbox("Pause", False, hint="Freeze the plots; nothing is lost")
        self._window = gui.add_slider(
            "Window [s]", 2, int(LONGEST), 1, 10, hint="Length of time shown [s]"
        )
        with gui.add_folder("Quantities", expand_by_default=False):
            self._quantities = {
                name: gui.add_checkbox(
                    name.replace("_", " "),
                    name in _SHOWN,
                    hint=f"Plot the {name.replace('_', ' ')} of the choices below",
                )
                for name in self._kinds
            }
        self._chosen = self._boxes("Actuators", self._names, _FOLD)
        self._chosen_joints = self._boxes("Joints", self._joints, 0)
        self._plots: dict[str, viser.GuiUplotHandle] = {}
        self._shown: tuple[dict[str, list[int]], bool] | None = None

    def _title(self, name: str) -> str:
        unit = self._angles.unit(name.removeprefix("joint_"), self._kinds[name])
        return f"{name.replace('_', ' ')} [{unit}]"

    def _boxes(self, title: str, names: Sequence[str], shown: int) -> list[viser.GuiCheckboxHandle]:
        with self._gui.add_folder(title, expand_by_default=False):
            every = self._gui.add_button_group(
                "Show", ("All", "None"), hint=f"Show all {title.lower()} in the plots, or none"
            )
            boxes = [
                self._gui.add_checkbox(name, index < shown, hint=f"Show {name} in the plots")
                for index, name in enumerate(names)
            ]

        def choose(event: viser.GuiEvent) -> None:
            for box in boxes:
                box.value = event.target.value == "All"

        every.on_click(choose)
        return boxes

    def follow(self, source: PlotSource | None) -> None:
        """Plot another source; ``None`` for the live hand."""
        self._source = self._live if source is None else source

    def _wanted(self) -> dict[str, list[int]]:
        """Return the chosen and measured columns of each quantity."""
        wanted = {}
        for name in ("reference", *self._quantities):
            joints = name in JOINT_QUANTITIES
            known = self._source.measured(name)
            if self._quantities["position" if name == "reference" else name].value:
                boxes = enumerate(self._chosen_joints if joints else self._chosen)
                wanted[name] = [index for index, box in boxes if box.value and known[index]]
        return {name: columns for name, columns in wanted.items() if columns}

    def _rebuild(self, shown: dict[str, list[int]]) -> None:
        for plot in self._plots.values():
            plot.remove()
        self._plots.clear()
        self._shown = shown, self._angles.degrees
        joints = {i for name in JOINT_QUANTITIES for i in shown.get(name, ())}
        columns = {i for name in shown if name not in JOINT_QUANTITIES for i in shown[name]}
        names = [(self._lines[index], self._names[index]) for index in sorted(columns)]
        names += [(self._joint_lines[index], self._joints[index]) for index in sorted(joints)]
        hint = "" if names else "choose actuators or joints below"
        hint = "thin&nbsp;line:&nbsp;commanded" if "reference" in shown else hint
        self._legend.content = legend(names, hint)
        with self._folder:
            for name in self._quantities:
                if name in shown:
                    self._plots[name] = self._add_plot(name, shown)

    def _add_plot(self, name: str, shown: dict[str, list[int]]) -> viser.GuiUplotHandle:
        series = [uplot.Series(label="t [s]")]

        joints = name in JOINT_QUANTITIES
        lines, names = (self._joint_lines, self._joints) if joints else (self._lines, self._names)
        series += [line(lines[index], names[index]) for index in shown[name]]
        if name == "position":
            series += [
                line(lines[index], f"{names[index]} commanded", 0.75, 0.7)
                for index in shown.get("reference", ())
            ]
        return chart(self._gui, self._data(name, shown), series, self._title(name), _HEIGHT)

    def _data(self, name: str, shown: dict[str, list[int]]) -> tuple[FloatArray, ...]:
        length, quantity = float(self._window.value), name.removeprefix("joint_")
        columns = list(shown[name])
        data = self._source.window(name, columns, length)
        if name == "position" and "reference" in shown:
            data += self._source.window("reference", shown["reference"], length)[1:]
            columns += shown["reference"]
        factors = [self._angles.factor(quantity, self._kinds[name][c]) for c in columns]
        data = (data[0], *(f * each for f, each in zip(factors, data[1:], strict=True)))
        ends = nice_range(data[1:], max(factors) * MEASURED[quantity].span)
        # Single precision is far finer than a pixel, and halves the traffic.
        return tuple(
            line.astype(np.float32)
            for line in (*data, *(np.full(len(data[0]), end) for end in ends))
        )

    def draw(self) -> None:
        """Update the plots; called a few times a second."""
        shown = self._wanted()
        if (shown, self._angles.degrees) != self._shown:
            self._rebuild(shown)
        if self._pause.value:
            return
        source = self._source
        spans = [
            (round(span.start, 3), round(span.end, 3), span.name, span_colour(span))
            for span in source.spans(float(self._window.value))
        ]
        put(self._times, _times(source.pose, spans))
        for name, plot in self._plots.items():
            data = self._data(name, shown)
            if _differs(data, plot.data):
                plot.data = data


_TOUCH_HEIGHT: Final = 180
"""Height of a plot [pixels]: plots of two units and the table fit on a laptop's screen."""

_SPAN: Final = 0.5
"""Smallest length of an axis, in the unit of the sensor, so that noise looks small."""

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
            hint="Length of time shown [s]",
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
        """Draw the readings in ``windows``; rebuild the plots if the sensors have changed."""
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
        return chart(self._gui, nothing, series, f"touch, sum over taxels [{unit}]", _TOUCH_HEIGHT)

    def _data(self, windows: Windows, unit: str) -> tuple[FloatArray, ...]:
        """Return the union of all devices' times [s], the lines ``(k,)`` and the axis ends."""
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
