"""The content of a plot of a recording, for any renderer: panels, lines, spans, marks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from rtee.errors import LogError
from rtee.log.labels import Band, Label, bands_of, labels_of
from rtee.log.recording import ActuatorSeries, JointSeries, Recording
from rtee.sample import FloatArray

MOST_POINTS = 4000
"""Most points of a line, twice a screen's width in pixels; thinning keeps every peak."""

COLOURS = (
    "#1f77b4",
    "#d62728",
    "#2ca02c",
    "#9467bd",
    "#ff7f0e",
    "#17becf",
    "#8c564b",
    "#e377c2",
    "#7f7f7f",
    "#bcbd22",
)
DRAWN = frozenset(
    {
        "mark",
        "grasp_lost",
        "device_fault",
        "device_lost",
        "stop",
        "thermal",
        "implausible",
        "log_resumed",
    }
)
"""Kinds of events that a plot shows."""


class By(StrEnum):
    """Subject of a row of the plot."""

    ACTUATOR = "actuator"
    FINGER = "finger"


@dataclass(frozen=True, slots=True)
class Line:
    """A line of a panel: values at times [s]; `dashed` for a reference.

    The lines of an actuator share a group.
    """

    name: str
    t: FloatArray
    values: FloatArray
    colour: str
    dashed: bool
    group: str


@dataclass(frozen=True, slots=True)
class Row:
    """A row of the plot: positions with their references, and efforts or currents; or touch.

    Of touch, the positions are the sums over the taxels, the efforts the largest taxels. Only then
    has the row a unit. The title is the actuator, finger or device.
    """

    title: str
    positions: tuple[Line, ...]
    efforts: tuple[Line, ...]
    unit: str = ""

    def labels(self, effort_label: str) -> tuple[str, str]:
        """Return the labels of the two panels, with units; ``effort_label`` for efforts."""
        if self.unit:
            return f"touch, sum [{self.unit}]", f"largest taxel [{self.unit}]"
        return "position [rad | m]", effort_label


@dataclass(frozen=True, slots=True)
class Figure:
    """A plot.

    Attributes:
        title: Title of the plot.
        rows: Rows of the plot.
        bands: Spans of actions.
        marks: Times of marks and events [s].
        labels: Names of spans, marks and events, laid out without overlap.
        effort_label: Label of the right column, with its unit.
        start: Left end of the time axis [s].
        end: Right end of the time axis [s].
    """

    title: str
    rows: tuple[Row, ...]
    bands: tuple[Band, ...]
    marks: tuple[float, ...]
    labels: tuple[Label, ...]
    effort_label: str
    start: float
    end: float

    @property
    def lanes(self) -> int:
        """Number of lanes of the labels."""
        return max((label.lane + 1 for label in self.labels), default=0)


def thinned(
    t: FloatArray, values: FloatArray, most: int = MOST_POINTS
) -> tuple[FloatArray, FloatArray]:
    """Return at most ``most`` points of a line: the lowest and the highest of every stretch."""
    if len(t) <= most:
        return t, values
    # Two points for each stretch and both ends of the line make at most `most`.
    stretch = -(-len(t) // max(1, most // 2 - 1))
    count = -(-len(t) // stretch)
    # The last stretch is padded with NaN to the length of the others.
    filled = np.full(count * stretch, np.nan)
    filled[: len(t)] = values
    # argmin and argmax would return the index of a NaN; an infinity never wins against a number.
    whole = np.where(np.isnan(filled), np.inf, filled).reshape(count, stretch)
    low = whole.argmin(axis=1)
    high = np.where(np.isinf(whole), -np.inf, whole).argmax(axis=1)
    base = np.arange(count) * stretch
    chosen: NDArray[np.intp] = np.unique(
        np.concatenate(([0, len(t) - 1], base + low, base + high)).astype(np.intp)
    )
    return t[chosen], values[chosen]


def figure(
    recording: Recording,
    *,
    by: By | None = None,
    actuators: Sequence[str] = (),
    start: float | None = None,
    end: float | None = None,
    fingers: dict[str, tuple[str, ...]] | None = None,
) -> Figure:
    """Return the plot of a recording, from ``start`` to ``end`` since its start [s].

    Args:
        recording: The recording.
        by: Subject of a row; by default, fingers if there are more than six actuators.
        actuators: Actuators to show; all unless given.
        start: Begin of the plot [s].
        end: End of the plot [s].
        fingers: Actuators by finger, for rows by finger.

    Raises:
        LogError: if there is nothing to show, or an actuator is unknown.
    """
    states = recording.states
    chosen = list(actuators) or list(states.names)
    for name in chosen:
        states.index(name)
    begin = 0.0 if start is None else start
    until = recording.duration if end is None else end
    within = (states.t >= begin) & (states.t <= until)
    if not within.any():
        when = " in that time" if len(states) else ""
        raise LogError(f"holds no states{when}", path=recording.paths[0])
    groups = _groups(chosen, by, fingers or {})
    efforts, label = _efforts(recording, within)
    rows = []
    for title, names in groups.items():
        positions: list[Line] = []
        forces: list[Line] = []
        for name in names:
            # By the index among all chosen actuators, so that every row has the same colours.
            colour = COLOURS[chosen.index(name) % len(COLOURS)]
            column = states.index(name)
            positions += _position_lines(recording, name, colour, begin, until)
            if efforts is not None:
                t, values = thinned(states.t[within], efforts[within, column])
                forces.append(Line(name, t, values, colour, dashed=False, group=name))
        rows.append(Row(title, tuple(positions), tuple(forces)))
    rows += _touch_rows(recording, begin, until)
    bands = bands_of(recording.spans, begin, until)
    marks = [
        (entry.t, entry.value.text if entry.value.kind == "mark" else entry.value.kind)
        for entry in recording.events
        if entry.value.kind in DRAWN and begin <= entry.t <= until
    ]
    return Figure(
        title=_title(recording),
        rows=tuple(rows),
        bands=bands,
        marks=tuple(t for t, _ in marks),
        labels=tuple(labels_of(bands, marks, begin, until)),
        effort_label=label,
        start=begin,
        end=until,
    )


def _touch_rows(recording: Recording, start: float, end: float) -> Iterator[Row]:
    """Yield a row for each device and unit of touch sensors."""
    for device, series in recording.touch.items():
        within = (series.t >= start) & (series.t <= end)
        for unit in dict.fromkeys(sensor.unit for sensor in series.sensors):
            sums: list[Line] = []
            largest: list[Line] = []
            begin = 0
            for index, sensor in enumerate(series.sensors):
                taxels = series.values[within, begin : begin + sensor.taxels]
                begin += sensor.taxels
                if sensor.unit != unit:
                    continue
                colour = COLOURS[index % len(COLOURS)]
                for into, values in ((sums, series.totals[within, index]), (largest, taxels)):
                    if values.ndim > 1:
                        values = values.max(axis=1)
                    t, thin = thinned(series.t[within], values)
                    into.append(Line(sensor.name, t, thin, colour, dashed=False, group=sensor.name))
            yield Row(f"touch: {device}", tuple(sums), tuple(largest), unit)


def _title(recording: Recording) -> str:
    from rtee.log.info import iso

    return f"{recording.hand}, {iso(recording.start)[:19].replace('T', ' ')} UTC"


def _groups(
    names: Sequence[str], by: By | None, fingers: dict[str, tuple[str, ...]]
) -> dict[str, list[str]]:
    """Return the rows' titles with their actuators, every actuator once."""
    if by is None:
        by = By.FINGER if len(names) > 6 and fingers else By.ACTUATOR
    if by is By.ACTUATOR:
        return {name: [name] for name in names}
    owners = {name: [f for f, its in fingers.items() if name in its] for name in names}
    groups: dict[str, list[str]] = {}
    for finger in fingers:
        own = [name for name in names if owners[name] == [finger]]
        if own:
            groups[finger] = own
    # An actuator of several fingers gets a row of its own instead of one line per finger.
    shared = [name for name in names if len(owners[name]) != 1]
    if shared:
        groups["several fingers"] = shared
    return groups


def _position_lines(
    recording: Recording, name: str, colour: str, start: float, end: float
) -> list[Line]:
    lines = []
    series: tuple[tuple[JointSeries, bool], ...] = (
        (recording.states, False),
        (recording.reference, True),
    )
    for source, dashed in series:
        if name not in source.names:
            continue
        within = (source.t >= start) & (source.t <= end)
        t, values = thinned(source.t[within], source.position[within, source.index(name)])
        label = f"{name} reference" if dashed else name
        lines.append(Line(label, t, values, colour, dashed, name))
    return lines


def _efforts(recording: Recording, within: NDArray[np.bool_]) -> tuple[FloatArray | None, str]:
    """Return the values and label of the right column: efforts, or currents as a substitute."""
    states = recording.states
    # A device may measure neither, or only currents, without a known torque constant.
    if not np.isnan(states.effort[within]).all():
        return states.effort, "effort [N·m | N]"
    if isinstance(states, ActuatorSeries) and not np.isnan(states.current[within]).all():
        return states.current, "current [A]"
    return None, "effort"
