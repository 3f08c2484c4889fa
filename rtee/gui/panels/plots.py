"""Plots of the actuators, their references, and all joints, over time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import viser
from viser import uplot

from rtee.gui.colours import line_colour, line_dash, line_numbers
from rtee.gui.history import (
    JOINT_QUANTITIES,
    LONGEST,
    QUANTITIES,
    Source,
    nice_range,
)
from rtee.gui.wording import legend, short_names, units
from rtee.hand.colours import finger_of_link
from rtee.hand.model import Hand
from rtee.sample import MEASURED, FloatArray

_SHOWN = frozenset({"position", "velocity", "effort", *JOINT_QUANTITIES})
"""Quantities shown at first; those of joints appear once a joint is chosen."""

_FOLD = 6
"""Number of actuators shown at first: more lines would be hard to tell apart."""

_HEIGHT = 140
"""Height of a plot [pixels]: four fit on a laptop's screen."""

_SMALL = "10px system-ui, sans-serif"


def _units(actuators: Sequence[str], joints: Sequence[str]) -> dict[str, str]:
    """Return the unit of each quantity, for actuators and joints of these kinds."""
    return {
        name: units(name.removeprefix("joint_"), kinds)
        for names, kinds in ((QUANTITIES, actuators), (JOINT_QUANTITIES, joints))
        for name in names
    }


def chart(
    gui: viser.GuiApi,
    data: Sequence[FloatArray],
    series: Sequence[uplot.Series],
    title: str,
    height: int,
) -> viser.GuiUplotHandle:
    """Add a plot of a height [pixels] to the current container.

    The data are the times, the lines, and last the lower and the upper end of the axis, ``(k,)``
    each; the series are the styles of the time axis and of each line. The title has the unit.
    """
    # Invisible lines set the range, since a change of the scales would rebuild the plot.
    ends = [uplot.Series(label=end, stroke="#0000", width=0) for end in ("low", "high")]
    return gui.add_uplot(
        tuple(data),
        (*series, *ends),
        title=title,
        scales={"x": uplot.Scale(time=False, auto=True), "y": uplot.Scale(auto=True)},
        axes=(
            uplot.Axis(font=_SMALL, size=28, space=50),
            uplot.Axis(font=_SMALL, size=48, space=24),
        ),
        legend=uplot.Legend(show=False),
        cursor=uplot.Cursor(sync={"key": "time"}),  # one cursor for all plots
        height=height,
        padding=(10, 12, 0, 0),
    )


def _differs(new: FloatArray, old: FloatArray) -> bool:
    """Return whether a line would look another way: each is sent to the browser as a whole."""
    return new.shape != old.shape or not np.allclose(new, old, atol=1e-4, equal_nan=True)


class PlotsPanel:
    """Plots of the chosen actuators and joints."""

    def __init__(self, gui: viser.GuiApi, hand: Hand, history: Source) -> None:
        """Add the panel to the current container; the history is that of the live hand."""
        self._gui = gui
        self._units = _units([a.kind for a in hand.actuators], [j.kind for j in hand.joints])
        self._names = short_names(hand.actuator_names)
        self._joints = short_names(hand.joint_names)
        self._live = self._source = history
        owner = finger_of_link(hand)
        self._lines = line_numbers(hand, ["".join(a.fingers[:1]) for a in hand.actuators])
        self._joint_lines = line_numbers(hand, [owner.get(j.child, "") for j in hand.joints])
        self._legend = gui.add_html("")
        self._folder = gui.add_folder(None)
        self._pause = gui.add_checkbox("Pause", False, hint="Freeze the plots; nothing is lost")
        self._window = gui.add_slider(
            "Window [s]", 2, int(LONGEST), 1, 10, hint="Length of time shown [s]"
        )
        with gui.add_folder("Quantities", expand_by_default=False):
            self._quantities = {
                name: gui.add_checkbox(
                    self._title(name),
                    name in _SHOWN,
                    hint=f"Plot the {self._title(name)} of what is chosen below",
                )
                for name in self._units
            }
        self._chosen = self._boxes("Actuators", self._names, _FOLD)
        self._chosen_joints = self._boxes("Joints", self._joints, 0)
        for box in (*self._quantities.values(), *self._chosen, *self._chosen_joints):
            box.on_update(lambda _: self._changed())
        self._plots: dict[str, viser.GuiUplotHandle] = {}
        # Rebuilt at the next drawing, once even if many boxes change together.
        self._stale = True

    def _title(self, name: str) -> str:
        return f"{name.replace('_', ' ')} [{self._units[name]}]"

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

    def _changed(self) -> None:
        self._stale = True

    def follow(self, source: Source | None) -> None:
        """Plot another source; ``None`` stands for the live hand."""
        self._source = self._live if source is None else source

    @property
    def _columns(self) -> list[int]:
        return [index for index, box in enumerate(self._chosen) if box.value]

    @property
    def _joint_columns(self) -> list[int]:
        return [index for index, box in enumerate(self._chosen_joints) if box.value]

    def _rebuild(self) -> None:
        for plot in self._plots.values():
            plot.remove()
        self._plots.clear()
        columns, joints = self._columns, self._joint_columns
        names = [(self._lines[index], self._names[index]) for index in columns]
        names += [(self._joint_lines[index], self._joints[index]) for index in joints]
        self._legend.content = legend(
            names,
            "thin&nbsp;line:&nbsp;commanded" if columns else "choose actuators or joints below",
        )
        with self._folder:
            for name, box in self._quantities.items():
                chosen = joints if name in JOINT_QUANTITIES else columns
                if box.value and chosen:
                    self._plots[name] = self._add_plot(name, chosen)

    def _add_plot(self, name: str, columns: Sequence[int]) -> viser.GuiUplotHandle:
        series = [uplot.Series(label="t [s]")]

        def add(number: int, label: str, width: float, alpha: float = 1.0) -> None:
            series.append(
                uplot.Series(
                    label=label,
                    stroke=line_colour(number),
                    width=width,
                    dash=line_dash(number),
                    alpha=alpha,
                    auto=False,  # NaN, where nothing is measured, would break the scale
                )
            )

        joints = name in JOINT_QUANTITIES
        lines, names = (self._joint_lines, self._joints) if joints else (self._lines, self._names)
        for index in columns:
            add(lines[index], names[index], 1.75)
        if name == "position":
            for index in columns:
                add(lines[index], f"{names[index]} commanded", 0.75, 0.7)
        return chart(self._gui, self._data(name), series, self._title(name), _HEIGHT)

    def _data(self, name: str) -> tuple[FloatArray, ...]:
        length = float(self._window.value)
        columns = self._joint_columns if name in JOINT_QUANTITIES else self._columns
        data = self._source.window(name, columns, length)
        if name == "position":
            data += self._source.window("reference", columns, length)[1:]
        ends = nice_range(data[1:], MEASURED[name.removeprefix("joint_")].span)
        # Single precision is far finer than a pixel, and half to send.
        return tuple(
            line.astype(np.float32)
            for line in (*data, *(np.full(len(data[0]), end) for end in ends))
        )

    def draw(self) -> None:
        """Update the plots; called a few times a second."""
        if self._stale:
            self._stale = False
            self._rebuild()
        if self._pause.value:
            return
        for name, plot in self._plots.items():
            data = self._data(name)
            if len(data) != len(plot.data):  # a box changed meanwhile: another number of lines
                self._stale = True
                return
            if any(map(_differs, data[1:], plot.data[1:])):
                plot.data = data
