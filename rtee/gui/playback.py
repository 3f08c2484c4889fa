"""Playback of a recording: the state at any time, and the lines of the plots around that time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

import numpy as np

from rtee.errors import LogError
from rtee.gui.history import JOINT_QUANTITIES, stride
from rtee.hand.model import Hand
from rtee.log import Recording, Span
from rtee.log.recording import row_at
from rtee.messages.state import ACTUATOR_COLUMNS, State
from rtee.objects.description import ObjectDescription
from rtee.sample import BoolArray, FloatArray
from rtee.touch import TouchSensor, TouchState
from rtee.types import Outcome

_OUTCOMES: dict[str, str] = {
    Outcome.REACHED: "#009e73",
    Outcome.HELD: "#009e73",
    Outcome.TOUCHED: "#009e73",
    Outcome.ABORTED: "#d55e00",
}
"""Colours of the bars of a timeline by the action's outcome."""

_OTHER = "#e69f00"
"""Colour of any other outcome."""

_LOOKED_AT = 10_000
"""Number of states of a long recording searched for measured values, which takes milliseconds."""


class Playback:
    """A recording, and the displayed time since its start [s]."""

    def __init__(self, recording: Recording, hand: Hand) -> None:
        """Prepare a recording of a hand for playback.

        Raises `LogError` if the recording is of another hand, or contains no measurements.
        """
        self.recording = recording
        self._hand = hand
        states = recording.actuator_states
        if set(states.names) != set(hand.actuator_names):
            raise LogError(f"is a recording of '{recording.hand}', not of '{hand.name}'")
        if not len(states):
            raise LogError("this recording has no measurements")
        self._measured: dict[str, BoolArray] = {}
        self._order = [states.names.index(name) for name in hand.actuator_names]
        self._sent = (
            [recording.reference.names.index(name) for name in hand.actuator_names]
            if len(recording.reference)
            else []
        )
        self._joints = [
            recording.joint_states.names.index(name)
            for name in hand.joint_names
            if name in recording.joint_states.names
        ]
        self.time = 0.0

    @property
    def pose(self) -> float:
        """The displayed time, which the plots mark [s]."""
        return self.time

    def measured(self, name: str) -> BoolArray:
        """Return which columns of a quantity have a value in the recording."""
        if name not in self._measured:
            columns = range(len(self._hand.joints if name in JOINT_QUANTITIES else self._order))
            step = max(1, len(self.recording.actuator_states) // _LOOKED_AT)
            lines = self._lines(name, columns, slice(None, None, step))
            self._measured[name] = np.array([np.isfinite(line).any() for line in lines])
        return self._measured[name]

    def spans(self, length: float) -> Sequence[Span]:
        """Return the actions of the recording."""
        return self.recording.spans

    def _page(self, length: float) -> tuple[float, float]:
        """Return the start and end of the plotted window [s], which advances by whole pages."""
        begin = length * (min(self.time, math.nextafter(self.duration, 0.0)) // length)
        return begin, begin + length

    @property
    def object_description(self) -> ObjectDescription | None:
        """The simulated object in the hand, if the recording has one."""
        return self.recording.object_description

    @property
    def duration(self) -> float:
        """Length of the recording [s]."""
        # The timeline divides by the duration, and a recording may hold a single state.
        return max(self.recording.duration, 0.001)

    @property
    def marks(self) -> list[tuple[float, str]]:
        """Times [s] and texts of the marks set by users."""
        return [(entry.t, entry.value.text) for entry in self.recording.marks]

    def state(self) -> State:
        """Return the state at the displayed time."""
        states, sent, joints = (
            self.recording.actuator_states,
            self.recording.reference,
            self.recording.joint_states,
        )
        row, order = row_at(states.t, self.time), self._order
        nothing = np.full(len(order), np.nan)
        position = states.position[row, order]
        if self._sent:
            at = row_at(sent.t, self.time)
            reference = [a[at, self._sent] for a in (sent.position, sent.velocity, sent.effort)]
        else:
            reference = [nothing, nothing, nothing]
        if len(joints) and len(self._joints) == len(self._hand.joint_names):
            joint_position = joints.position[row_at(joints.t, self.time), self._joints]
        else:
            joint_position = self._hand.transmission.joints(position)
        return State(
            tick=int(states.tick[row]),
            stamp=float(states.time[row]),
            wall_ns=int(states.wall[row]),
            names=self._hand.actuator_names,
            **{name: getattr(states, name)[row, order] for name in ACTUATOR_COLUMNS},
            reference_position=reference[0],
            reference_velocity=reference[1],
            reference_effort=reference[2],
            joint_names=self._hand.joint_names,
            joint_position=joint_position,
            channels={
                name: channel.values[row_at(channel.t, self.time)]
                for name, channel in self.recording.channels.items()
            },
        )

    def touch(self) -> list[TouchState]:
        """Return the last readings of the touch sensors at the displayed time."""
        series = self.recording.touch.values()
        known = [each for each in series if len(each) and each.t[0] <= self.time]
        return [each.state(row_at(each.t, self.time)) for each in known]

    def touch_windows(
        self, length: float
    ) -> dict[str, tuple[tuple[TouchSensor, ...], FloatArray, FloatArray]]:
        """Return the sums of touch sensors by device, thinned; see `TouchPanel`.

        The window is ``length`` [s] long and contains the displayed time.
        """
        windows = {}
        for device, each in self.recording.touch.items():
            begin, end = np.searchsorted(each.t, self._page(length), side="right")
            rows = np.arange(begin, end, stride(int(end - begin)))
            windows[device] = (each.sensors, each.t[rows], each.totals[rows])
        return windows

    def window(self, name: str, columns: Sequence[int], length: float) -> tuple[FloatArray, ...]:
        """Return times in the recording [s] and the columns of a quantity, thinned.

        The window is ``length`` [s] long and contains the displayed time.
        """
        time = self.recording.actuator_states.t
        start, end = np.searchsorted(time, self._page(length)).tolist()
        rows = slice(start, end, stride(end - start))
        return (time[rows], *self._lines(name, columns, rows))

    def _lines(self, name: str, columns: Sequence[int], rows: slice) -> list[FloatArray]:
        states = self.recording.actuator_states
        if name == "reference":
            if not self._sent:
                return [np.full(len(states.t[rows]), np.nan) for _ in columns]
            sent = self.recording.reference
            at = np.maximum(np.searchsorted(sent.t, states.t[rows], side="right") - 1, 0)
            return [sent.position[at, self._sent[c]] for c in columns]
        if name in JOINT_QUANTITIES:
            transmission = self._hand.transmission
            position, velocity = (
                values[rows][:, self._order] for values in (states.position, states.velocity)
            )
            lines = (
                transmission.joints(position)
                if name == "joint_position"
                else transmission.velocities(position, velocity)
            )
            return [lines[:, c] for c in columns]
        values = getattr(states, name)
        return [values[rows, self._order[c]] for c in columns]


def span_colour(span: Span) -> str:
    """Return the colour ``#rrggbb`` of an action by its outcome."""
    return _OUTCOMES.get(span.outcome, _OTHER)


def _bar(span: Span, duration: float, top: int, height: int) -> str:
    x, width = 100.0 * span.start / duration, 100.0 * (span.end - span.start) / duration
    text = escape(f"{span.name}: {span.start:.1f} s to {span.end:.1f} s, {span.outcome}")
    return (
        f'<rect x="{x:.2f}%" y="{top}" width="{max(width, 0.4):.2f}%" height="{height}" '
        f'fill="{span_colour(span)}" stroke="#fff" stroke-width="0.5"><title>{text}</title></rect>'
    )


def timeline(playback: Playback) -> str:
    """Return an SVG of the recording with actions, inner actions, marks and the displayed time."""
    duration = playback.duration
    shapes = []
    for span in playback.recording.spans:
        shapes.append(_bar(span, duration, 4, 12))
        shapes += [_bar(inner, duration, 18, 6) for inner in span.inner]
    for time, text in playback.marks:
        x = 100.0 * time / duration
        shapes.append(
            f'<rect x="{x:.2f}%" y="0" width="2" height="28" fill="#cc79a7">'
            f"<title>{escape(text)}</title></rect>"
        )
    x = 100.0 * playback.time / duration
    shapes.append(f'<rect x="{x:.2f}%" y="0" width="2" height="28" fill="#222"/>')
    return (
        '<div style="padding:0.25em 0.75em"><svg role="img" aria-label="actions over time" '
        f'width="100%" height="28" style="background:#eef0f2">{"".join(shapes)}</svg></div>'
    )
