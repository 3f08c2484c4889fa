"""Signals of a recording at given times, from earlier measurements only, without interpolation."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtee.commands import Cancel, EndStream, Freeze, Hold, Jog, StreamSample
from rtee.errors import RteeError
from rtee.hand.files import temporary_folder
from rtee.hand.load import load_hand
from rtee.log.playback import write_hand
from rtee.log.recording import JointSeries, Recording
from rtee.loop.measured import TIP_FORCE, tip_forces
from rtee.messages.codec import SECOND
from rtee.messages.features import ObservedQuantity, feature, taxels
from rtee.sample import FloatArray
from rtee.touch import STALE_AFTER
from rtee.types import Goal, Intensity, Named

Times = NDArray[np.int64]

_PERIODS: Final = 3.0
"""Periods of the recording, or of the dataset if those are longer, for which a value counts as
current: one or two values may be lost, and one or two frames may repeat what is known."""

_AT_LEAST: Final = 0.03
"""But at least this time [s]: a busy computer misses ticks."""


@dataclass(frozen=True, eq=False)
class Signal:
    """Numbers that were measured together.

    Attributes:
        names: Their names ``(n,)``.
        wall: When they became known ``(k,)``, rising [ns since 1970].
        values: The values ``(k, n)``; ``NaN``: not known.
        longest: Time for which a value stays valid [s].
    """

    names: tuple[str, ...]
    wall: Times
    values: FloatArray
    longest: float = math.inf

    def at(self, when: Times) -> FloatArray:
        """Return the newest values at times ``(m,)`` as ``(m, n)``; ``NaN`` where not known."""
        found = np.full((len(when), len(self.names)), math.nan)
        for column, values in enumerate(self.values.T):
            known = np.isfinite(values)
            wall = self.wall[known]
            place = np.searchsorted(wall, when, side="right") - 1
            there = place >= 0
            there[there] &= when[there] - wall[place[there]] <= self.longest * SECOND
            found[there, column] = values[known][place[there]]
        return found

    def row_at(self, when: Times) -> FloatArray:
        """Return the newest rows at times ``(m,)``; a row of ``NaN`` ends the previous value."""
        before = np.full((1, len(self.names)), math.nan)
        rows: FloatArray = np.vstack([before, self.values])
        return rows[np.searchsorted(self.wall, when, side="right")]


def lasting(wall: Times, fps: float) -> float:
    """Return how long a value measured at the given times counts as current [s].

    The dataset has ``fps`` frames a second.
    """
    typical = float(np.median(np.diff(wall))) / SECOND if len(wall) > 1 else 0.0
    return max(_PERIODS * max(typical, 1.0 / fps), _AT_LEAST)


def observed(recording: Recording, fps: float) -> Iterator[tuple[ObservedQuantity, Signal]]:
    """Yield the measurements, in the order and by the names of `rtee.messages.features`.

    The dataset has ``fps`` frames a second.
    """
    states, joints = recording.actuator_states, recording.joint_states

    def of_series(quantity: ObservedQuantity, series: JointSeries, names: Sequence[str]) -> Signal:
        values = series.effort if quantity is ObservedQuantity.EFFORT else series.position
        columns = [series.index(name) for name in names]
        labels = tuple(feature(quantity, name) for name in names)
        return Signal(labels, series.wall, values[:, columns], lasting(series.wall, fps))

    yield ObservedQuantity.POSITION, of_series(ObservedQuantity.POSITION, states, states.names)
    followers = [name for name in joints.names if name not in states.names]
    yield ObservedQuantity.JOINT, of_series(ObservedQuantity.JOINT, joints, followers)
    yield ObservedQuantity.EFFORT, of_series(ObservedQuantity.EFFORT, states, states.names)
    wall = np.array([entry.wall for entry in recording.grip], dtype=np.int64)
    widths = np.array([[entry.value.opening] for entry in recording.grip]).reshape(-1, 1)
    yield (
        ObservedQuantity.OPENING,
        Signal((feature(ObservedQuantity.OPENING),), wall, widths, lasting(wall, fps)),
    )
    yield ObservedQuantity.FORCE, _forces(recording)
    for device in recording.touch.values():
        names = tuple(feature(ObservedQuantity.TOUCH, sensor.name) for sensor in device.sensors)
        stale = device.stale[:, np.newaxis]
        totals = np.where(stale, math.nan, device.totals)
        yield ObservedQuantity.TOUCH, Signal(names, device.wall, totals, STALE_AFTER)
        cells = tuple(n for sensor in device.sensors for n in taxels(sensor.name, sensor.taxels))
        values = np.where(stale, math.nan, device.values)
        yield ObservedQuantity.TAXEL, Signal(cells, device.wall, values, STALE_AFTER)


def _forces(recording: Recording) -> Signal:
    """Return the forces on the fingertips, merged from all devices that measure them."""
    series = [c for name, c in recording.channels.items() if name.endswith(f"/{TIP_FORCE}")]
    changes = sorted(
        (t, device, values)
        for device, channel in enumerate(series)
        for t, values in zip(channel.t.tolist(), [v.tolist() for v in channel.values], strict=True)
    )
    newest: dict[int, FloatArray] = {}
    rows = []
    for _, device, values in changes:
        newest[device] = np.array(values)
        rows.append(tip_forces(list(newest.values())))
    count = len(rows[-1]) if rows else 0
    names = [
        finger or f"finger{number + 1}"
        for number, (finger, _) in enumerate(zip_longest(_fingers(recording, count), range(count)))
    ]
    labels = tuple(feature(ObservedQuantity.FORCE, name) for name in names[:count])
    wall = np.array([recording.start + round(t * SECOND) for t, *_ in changes], dtype=np.int64)
    # A channel is recorded when it changes, and holds until then.
    return Signal(labels, wall, np.array(rows).reshape(len(rows), count))


def _fingers(recording: Recording, count: int) -> Sequence[str]:
    """Return the names of the hand's fingers, in its order."""
    if not count:
        return ()
    try:
        with temporary_folder(None) as folder:
            return [finger.name for finger in load_hand(write_hand(recording, folder)).fingers]
    except RteeError:
        return ()


def sent(recording: Recording, fps: float) -> Signal:
    """Return the references sent to the devices, by actuator [rad | m]; see `observed`."""
    series = recording.reference
    names = tuple(feature(ObservedQuantity.POSITION, name) for name in series.names)
    return Signal(names, series.wall, series.position, lasting(series.wall, fps))


def asked(recording: Recording) -> Signal:
    """Return the set-points of streams and jogs, by actuator [rad | m].

    ``NaN`` where there was no stream or jog. The loop plans the path of a goal itself; `sent` has
    its references.
    """
    names = recording.reference.names

    def row(targets: Mapping[str, float]) -> FloatArray:
        return np.array([targets.get(name, math.nan) for name in names])

    rows = {
        entry.wall: row(command.positions)
        for entry in (*recording.stream_samples, *recording.commands)
        if isinstance(command := entry.value.command, StreamSample | Jog)
    }
    labels = tuple(feature(ObservedQuantity.POSITION, name) for name in names)
    return _filled(labels, rows, _takeovers(recording))


def intensities(recording: Recording, actions: Sequence[str]) -> Signal:
    """Return the intensities of actions that streams and goals asked for."""

    def row(targets: Mapping[str, float]) -> FloatArray:
        said = {spelled(name): value for name, value in targets.items()}
        return np.array([said.get(spelled(name), math.nan) for name in actions])

    rows = {wall: row(targets) for wall, targets in _targets(recording)}
    return _filled(tuple(actions), rows, _takeovers(recording))


def asked_by_name(recording: Recording) -> set[str]:
    """Return the names that targets of streams and goals have: actions, actuators."""
    return {name for _, targets in _targets(recording) for name in targets}


def _targets(recording: Recording) -> Iterator[tuple[int, Mapping[str, float]]]:
    """Yield the targets of streams, then of goals, each with its time [ns]."""
    for entry in recording.stream_samples:
        if isinstance(command := entry.value.command, StreamSample):
            yield entry.wall, command.targets
    for goal in recording.goals:
        match goal.value:
            case Goal(what=Named(action, elements), to=Intensity(share)):
                yield goal.wall, {" ".join((action, *elements)): share}
            case _:
                yield goal.wall, {}


def spelled(action: str) -> str:
    """Return an action's name with its elements, in the form that the library compares."""
    name, *elements = action.split()
    return " ".join((name.replace("_", "").lower(), *elements))


def _takeovers(recording: Recording) -> set[int]:
    """Return the times from which earlier targets no longer apply [ns]."""
    ends = (Cancel, Hold, Freeze, EndStream)
    goals = {entry.wall for entry in recording.goals}
    return goals | {e.wall for e in recording.commands if isinstance(e.value.command, ends)}


def _filled(names: tuple[str, ...], rows: Mapping[int, FloatArray], ends: set[int]) -> Signal:
    """Return targets over time; where a target has no value, the previous one continues."""
    wall = sorted(rows.keys() | ends)
    values = np.full((len(wall), len(names)), math.nan)
    last = np.full(len(names), math.nan)
    for number, when in enumerate(wall):
        if when in ends:
            last = np.full(len(names), math.nan)
        if when in rows:
            last = np.where(np.isfinite(rows[when]), rows[when], last)
        values[number] = last
    return Signal(names, np.array(wall, dtype=np.int64), values)
