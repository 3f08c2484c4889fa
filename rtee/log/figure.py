"""The content of a plot of a recording, for any renderer: panels, lines, spans, marks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import chain, cycle
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtee.errors import LogError
from rtee.log.brief import brief
from rtee.log.reader import windows
from rtee.log.recording import Entry, JointSeries, Recording, Span, TouchSeries
from rtee.loop.plan import Plan
from rtee.messages import topics
from rtee.sample import FloatArray
from rtee.touch import TouchSensor
from rtee.types import Event, Feedback, Goal, Result

SPAN_COLOURS = ("#4c78a8", "#f58518", "#54a24b", "#b279a2", "#b8860b", "#439894", "#e45756")
MARK_COLOUR = "#444444"
_CHARACTER = 0.0098
"""Width of a character of a label, as a share of the left panels' width: estimated from the
pictures."""
_LONGEST = 40  # characters of a label; longer ones end in an ellipsis
_LANES = 3  # rows of labels above the panels; a name that fits into none is left out


@dataclass(frozen=True, slots=True)
class Band:
    """A span with its colour, and whether it is an inner action of a timed one."""

    span: Span
    colour: str
    inner: bool

    @property
    def text(self) -> str:
        """The name, with the outcome unless the goal was reached."""
        if self.span.outcome in ("reached", "ended"):
            return self.span.name
        return f"{self.span.name} ({self.span.outcome.replace('_', ' ')})"


@dataclass(frozen=True, slots=True)
class Label:
    """A text above the first row, which begins at a time [s]; lanes are counted from below."""

    t: float
    lane: int
    text: str
    colour: str


def bands_of(spans: Sequence[Span], start: float, end: float) -> tuple[Band, ...]:
    """Return the visible spans, with colours by name."""
    bands: list[Band] = []
    colours: dict[str, str] = {}

    def colour(name: str) -> str:
        return colours.setdefault(name, SPAN_COLOURS[len(colours) % len(SPAN_COLOURS)])

    for span in spans:
        if span.end < start or span.start > end:
            continue
        bands.append(Band(span, colour(span.name), inner=False))
        bands += [
            Band(inner, colour(span.name), inner=True)
            for inner in span.inner
            if inner.end >= start and inner.start <= end
        ]
    return tuple(bands)


_Text = tuple[float, float, str, str]
"""Beginning and end of a named span [s], its name and colour."""


def labels_of(
    bands: Sequence[Band], marks: Sequence[tuple[float, str]], start: float, end: float
) -> Iterator[Label]:
    """Lay out the names: inner actions below, actions above them, marks on top.

    Each kind has a few lanes. Where there are too many names for them, the longest spans get
    theirs first.
    """
    kinds: tuple[list[_Text], ...] = (
        [(b.span.start, b.span.end, b.text, b.colour) for b in bands if b.inner],
        [(b.span.start, b.span.end, b.text, b.colour) for b in bands if not b.inner],
        [(t, t, text, MARK_COLOUR) for t, text in marks],
    )
    base = 0
    for texts in kinds:
        # In the order of time, names take the fewest lanes.
        labels = _laid_out(sorted(texts), start, end)
        if len(labels) < len(texts):
            longest = sorted(texts, key=lambda text: (text[0] - text[1], text))
            labels = _laid_out(longest, start, end)
        for label in labels:
            yield replace(label, lane=base + label.lane)
        # The next kind begins above the lanes of this one.
        base += max((label.lane + 1 for label in labels), default=0)


def _laid_out(texts: Sequence[_Text], start: float, end: float) -> list[Label]:
    """Return labels, each in the lowest lane where it has room; the others are left out."""
    duration = max(end - start, 1e-9)
    labels: list[Label] = []
    lanes: list[list[tuple[float, float]]] = []  # from where to where each is taken [s]
    for t, _, text, colour in texts:
        shown = text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…"
        width = (len(shown) + 1) * _CHARACTER * duration
        at = max(start, min(t, end - width))
        free = (all(at + width <= a or b <= at for a, b in taken) for taken in lanes)
        lane = next((k for k, is_free in enumerate(free) if is_free), len(lanes))
        if lane == _LANES:
            continue
        if lane == len(lanes):
            lanes.append([])
        lanes[lane].append((at, at + width))
        labels.append(Label(at, lane, shown, colour))
    return labels


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

_JOINTS = ("position", "effort")
_TOPICS = (
    topics.ACTUATOR_STATES,
    topics.REFERENCE,
    topics.TOUCH,
    topics.TOUCH_SENSORS,
    topics.GOALS,
    topics.PLANS,
    topics.RESULTS,
    topics.EVENTS,
    topics.OBJECT,
    topics.ROBOT_DESCRIPTION,
)


class PlotSubject(StrEnum):
    """Subject of a row of the plot."""

    ACTUATOR = "actuator"
    FINGER = "finger"


@dataclass(frozen=True, slots=True)
class PlotLine:
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
class PlotRow:
    """A row of the plot: positions with their references, and efforts or currents; or touch.

    For touch, positions are the sums over the taxels and efforts the largest taxels; only then does
    the row have a unit. The title is the actuator, finger or device.
    """

    title: str
    positions: tuple[PlotLine, ...]
    efforts: tuple[PlotLine, ...]
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
    rows: tuple[PlotRow, ...]
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


class _Lines:
    """The points of the plotted lines between two times [s], thinned as they are added."""

    def __init__(self, start: float, end: float) -> None:
        self._start, self._end = start, end
        self._parts: dict[tuple[str, ...], list[tuple[FloatArray, FloatArray]]] = {}

    def add(self, series: JointSeries | TouchSeries, values: Mapping[tuple[str, ...], Any]) -> None:
        """Add points of lines, by key; they are later than those before."""
        within = (series.t >= self._start) & (series.t <= self._end)
        t = series.t[within]
        if not len(t):
            return
        # More than the line may have in the end: data thinned twice keeps every peak, too.
        share = (t[-1] - t[0]) / max(self._end - self._start, 1e-9)
        most = 8 + int(4 * share * MOST_POINTS)
        for key, column in values.items():
            self._parts.setdefault(key, []).append(thinned(t, column[within], most))

    def __contains__(self, key: tuple[str, ...]) -> bool:
        return key in self._parts

    def points(self, *key: str) -> tuple[FloatArray, FloatArray]:
        """Return the times and values of a line."""
        t, values = zip(*self._parts[key], strict=True)
        return thinned(np.concatenate(t), np.concatenate(values))

    def measured(self, kind: str) -> bool:
        """Return whether any line of a kind, with which its key begins, has a number."""
        parts = (part for key, parts in self._parts.items() if key[0] == kind for part in parts)
        return any(not np.isnan(values).all() for _, values in parts)


def read_for(paths: Sequence[Path], start: float | None, end: float | None) -> Iterator[Recording]:
    """Read what `figure` needs of a recording, piece by piece."""
    only = [*_TOPICS]
    briefs = [brief(path) for path in paths]
    # There is much feedback, and only that of timed actions adds to goals and results.
    simple = {plan[1] for each in briefs if each for plan in each.of("plan") if not plan[-1]}
    if any(each is None or any(g[1] not in simple for g in each.of("goal")) for each in briefs):
        only.append(topics.FEEDBACK)
    pieces = windows(paths, only=only, start=start, end=end)
    first = next(pieces)
    if first.actuator_states.names:
        return chain((first,), pieces)
    # Recordings of other programs have only joint states; rtee's own have them in addition.
    return windows(paths, only=(*only, topics.JOINT_STATES), start=start, end=end)


def figure(
    recording: Recording | Iterable[Recording],
    *,
    by: PlotSubject | None = None,
    actuators: Sequence[str] = (),
    start: float | None = None,
    end: float | None = None,
    fingers: dict[str, tuple[str, ...]] | None = None,
) -> Figure:
    """Return the plot of a recording, from ``start`` to ``end`` since its start [s].

    Args:
        recording: The recording, or its pieces (`read_for`), of which few are in memory at once.
        by: Subject of a row; by default, fingers if there are more than six actuators.
        actuators: Actuators to show; all unless given.
        start: Start of the plot [s].
        end: End of the plot [s].
        fingers: Actuators by finger, for rows by finger.

    Raises:
        LogError: if there is nothing to show, or an actuator is unknown.
    """
    pieces = iter((recording,) if isinstance(recording, Recording) else recording)
    first = piece = next(pieces)
    begin = 0.0 if start is None else start
    until = first.duration if end is None else end
    chosen = list(actuators)
    lines = _Lines(begin, until)
    sensors: dict[str, tuple[TouchSensor, ...]] = {}
    told = _Told([], [], [], [], [])
    while True:
        chosen = chosen or list(piece.states.names)
        _add(lines, piece, chosen)
        sensors |= {device: series.sensors for device, series in piece.touch.items()}
        told.add(piece)
        following = next(pieces, None)
        if following is None:
            break
        piece = following
    if not chosen or ("position", chosen[0]) not in lines:
        when = "" if start is end is None else " in that time"
        raise LogError(f"contains no states{when}", path=first.paths[0])
    efforts, label = _efforts(lines)
    rows = []
    for title, names in _groups(chosen, by, fingers or {}).items():
        positions: list[PlotLine] = []
        forces: list[PlotLine] = []
        for name in names:
            # By the index among all chosen actuators, so that every row has the same colours.
            colour = COLOURS[chosen.index(name) % len(COLOURS)]
            for into, kind in (
                (positions, "position"),
                (positions, "reference"),
                (forces, efforts),
            ):
                if (kind, name) in lines:
                    dashed = kind == "reference"
                    shown = f"{name} reference" if dashed else name
                    into.append(PlotLine(shown, *lines.points(kind, name), colour, dashed, name))
        rows.append(PlotRow(title, tuple(positions), tuple(forces)))
    rows += _touch_rows(lines, sensors)
    bands = bands_of(told.spans(first), begin, until)
    marks = [
        (entry.t, entry.value.text if entry.value.kind == "mark" else entry.value.kind)
        for entry in told.events
        if begin <= entry.t <= until
    ]
    return Figure(
        title=_title(first),
        rows=tuple(rows),
        bands=bands,
        marks=tuple(t for t, _ in marks),
        labels=tuple(labels_of(bands, marks, begin, until)),
        effort_label=label,
        start=begin,
        end=until,
    )


@dataclass(frozen=True, slots=True)
class _Told:
    """The entries of a recording that the plot shows: goals and events."""

    goals: list[Entry[Goal]]
    plans: list[Entry[Plan]]
    feedback: list[Entry[Feedback]]
    results: list[Entry[Result]]
    events: list[Entry[Event]]

    def add(self, piece: Recording) -> None:
        self.goals.extend(piece.goals)
        # The action alone: the plots do not need legs and grip, which are large.
        self.plans.extend(
            replace(e, value=replace(e.value, legs=(), grip=None)) for e in piece.plans
        )
        for entry in piece.feedback:
            # Only where another inner action begins.
            known = self.feedback[-1].value if self.feedback else Feedback("", 0.0)
            if (entry.value.goal_id, entry.value.inner) != (known.goal_id, known.inner):
                self.feedback.append(entry)
        self.results.extend(piece.results)
        self.events.extend(entry for entry in piece.events if entry.value.kind in DRAWN)

    def spans(self, whole: Recording) -> list[Span]:
        return replace(
            whole, goals=self.goals, plans=self.plans, feedback=self.feedback, results=self.results
        ).spans


def _add(lines: _Lines, piece: Recording, names: Sequence[str]) -> None:
    states, reference = piece.states, piece.reference
    if states.names:
        columns = {name: states.index(name) for name in names}
        kinds = ("position", "effort", "current") if len(piece.actuator_states) else _JOINTS
        lines.add(
            states,
            {(kind, n): getattr(states, kind)[:, k] for kind in kinds for n, k in columns.items()},
        )
    named = {name: reference.index(name) for name in names if name in reference.names}
    lines.add(reference, {("reference", n): reference.position[:, k] for n, k in named.items()})
    for device, series in piece.touch.items():
        begin = 0
        for index, sensor in enumerate(series.sensors):
            taxels = series.values[:, begin : begin + sensor.taxels]
            begin += sensor.taxels
            largest = taxels.max(axis=1) if taxels.ndim > 1 else taxels
            found = {"sum": series.totals[:, index], "largest": largest}
            lines.add(series, {(kind, device, sensor.name): v for kind, v in found.items()})


def _touch_rows(lines: _Lines, sensors: Mapping[str, tuple[TouchSensor, ...]]) -> Iterator[PlotRow]:
    """Yield a row for each device and unit of touch sensors."""
    for device, its in sensors.items():
        for unit in dict.fromkeys(sensor.unit for sensor in its):
            sums, largest = (
                tuple(
                    PlotLine(
                        s.name,
                        *lines.points(kind, device, s.name),
                        colour,
                        dashed=False,
                        group=s.name,
                    )
                    for s, colour in zip(its, cycle(COLOURS), strict=False)
                    if s.unit == unit and (kind, device, s.name) in lines
                )
                for kind in ("sum", "largest")
            )
            yield PlotRow(f"touch: {device}", sums, largest, unit)


def _title(recording: Recording) -> str:
    from rtee.log.info import iso

    return f"{recording.hand}, {iso(recording.start)[:19].replace('T', ' ')} UTC"


def _groups(
    names: Sequence[str], by: PlotSubject | None, fingers: dict[str, tuple[str, ...]]
) -> dict[str, list[str]]:
    """Return the rows' titles with their actuators, every actuator once."""
    if by is None:
        by = PlotSubject.FINGER if len(names) > 6 and fingers else PlotSubject.ACTUATOR
    if by is PlotSubject.ACTUATOR:
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


def _efforts(lines: _Lines) -> tuple[str, str]:
    """Return kind and label of the right column: efforts, or currents as a substitute."""
    # A device may measure neither, or only currents, without a known torque constant.
    if lines.measured("effort"):
        return "effort", "effort [N·m | N]"
    if lines.measured("current"):
        return "current", "current [A]"
    return "", "effort"
