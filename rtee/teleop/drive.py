"""Samples for a stream, from an input device or a recording."""

from __future__ import annotations

import csv
import math
from collections.abc import AsyncIterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final, Protocol

import anyio

from rtee import monotonic
from rtee.commands import StreamSample
from rtee.errors import ConfigError, LogError
from rtee.hand.files import reason
from rtee.log import read
from rtee.loop.streams.targets import FAR
from rtee.messages import topics
from rtee.teleop.inputs import Input

RATE: Final = 50.0
"""Sample rate [Hz]: several times the bandwidth of a person's hand."""

_LONGEST: Final = 10_000_000
"""Largest table to read [bytes]: an hour of a glove's twenty joints takes less."""

_SLOWEST: Final = 0.5
"""Lowest rate of a table [Hz]: times in milliseconds would appear slower."""

_LONGEST_GAP: Final = 0.08
"""Gap between samples of a recording above which the previous sample is repeated [s], since the
person did not move."""


_PAUSE: Final = 1.5
"""Gap between samples of a slow recording, in periods, above which the previous sample is repeated:
shorter gaps are jitter, and with `rtee stream play`, the hand waits for three periods."""


class Sink(Protocol):
    """A receiver of samples, such as `rtee.remote.stream.Stream`."""

    async def send(
        self,
        targets: Mapping[str, float],
        velocity: Mapping[str, float] = ...,
        stamp: float | None = ...,
    ) -> None:
        """Send a sample."""


def assigned(actions: Sequence[str], axes: Sequence[str]) -> dict[str, str]:
    """Return the actions by axis.

    An action includes its elements, as in ``PinchTight index thumb``. An axis may precede it, as in
    ``lt=Trig ring``; other actions get the next free axes. Raises `ConfigError` if an axis does not
    exist, an axis or action is given twice, or there are too few axes.
    """
    by_axis: dict[str, str] = {}
    given = [action.partition("=") for action in actions]
    for axis, mark, action in given:
        if not mark:
            continue
        if axis not in axes:
            raise ConfigError(f"unknown axis '{axis}'; valid: {', '.join(axes)}")
        if axis in by_axis:
            raise ConfigError(f"the axis '{axis}' is given twice")
        by_axis[axis] = action.strip()
    left = [axis for axis in axes if axis not in by_axis]
    for action, mark, _ in given:
        if not mark:
            if not left:
                raise ConfigError(f"no axis is left for '{action}'")
            by_axis[left.pop(0)] = action.strip()
    if len(set(by_axis.values())) != len(by_axis):
        raise ConfigError("an action is given twice")
    return by_axis


async def samples_of(
    source: Input, actions: Mapping[str, str], rate: float = RATE
) -> AsyncIterator[dict[str, float]]:
    """Yield the targets of an input device at a rate [Hz]; ``actions`` has the action of each axis.

    Yields nothing until the person moves an axis, so that the hand stays as it is until then.
    """
    due = monotonic.now()
    while True:
        moved = source.read()
        if any(axis in moved for axis in actions):
            yield {action: moved.get(axis, 0.0) for axis, action in actions.items()}
        # After a stall, skip the missed samples, which would be sent in a burst.
        due = max(due + 1.0 / rate, monotonic.now() - 1.0 / rate)
        await anyio.sleep(max(0.0, due - monotonic.now()))


@dataclass(frozen=True, slots=True)
class Played:
    """A recorded sample: targets and velocities as for `rtee.remote.stream.Stream.send`.

    ``time`` is the time since the first sample [s].
    """

    time: float
    targets: Mapping[str, float]
    velocity: Mapping[str, float]


def recorded(path: Path) -> list[Played]:
    """Return the samples in a recording (MCAP, or a folder of recordings) or in a table (CSV).

    The first line of a table has the names: ``t``, the time [s], and the targets. An empty cell
    omits a target. Uses the newest recording of a folder, and the newest stream of a recording.
    Raises `LogError` if the file cannot be read or contains no samples.
    """
    samples = _of_table(path) if path.suffix.lower() == ".csv" else _of_recording(path)
    if not samples:
        raise LogError("contains no samples of a stream", path=path)
    begin = samples[0].time
    return [Played(each.time - begin, each.targets, each.velocity) for each in samples]


def _of_recording(path: Path) -> list[Played]:
    entries = read(path, only=[topics.STREAM_SAMPLES]).stream_samples
    taken = [e.value.command for e in entries if isinstance(e.value.command, StreamSample)]
    last = taken[-1].stream if taken else ""
    played: list[Played] = []
    for sample in taken:
        # Skip duplicates and samples out of order.
        if sample.stream == last and not (played and sample.stamp <= played[-1].time):
            played.append(Played(sample.stamp, sample.targets, sample.velocity))
    return played


def _of_table(path: Path) -> list[Played]:
    try:
        if path.stat().st_size > _LONGEST:
            raise LogError(f"is longer than {_LONGEST // 1_000_000} MB", path=path)
        # Spreadsheets write a byte-order mark, and semicolons if numbers have a decimal comma.
        with path.open(newline="", encoding="utf-8-sig") as file:
            delimiter = ";" if ";" in file.readline() else ","
            file.seek(0)
            rows = list(csv.reader(file, delimiter=delimiter))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise LogError(f"cannot be read: {reason(error)}", path=path) from None
    names = [name.strip() for name in rows[0]] if rows else []
    if names[:1] != ["t"] or len(names) < 2:
        raise LogError("should begin with a line of names, the first of them 't'", path=path)
    played: list[Played] = []
    for number, row in enumerate(rows[1:], start=2):
        try:
            if len(row) != len(names):
                raise ValueError(f"{len(row)} cells for {len(names)} names")
            cells = zip(names, row, strict=True)
            values = {n: _number(n, cell, delimiter) for n, cell in cells if cell.strip()}
            when = values.pop("t", math.nan)
            if not when > (played[-1].time if played else -math.inf):
                raise ValueError("the times must increase")
            if not values:
                raise ValueError(f"it has no value in the columns {', '.join(names[1:])}")
        except ValueError as error:
            raise LogError(f"is not valid: {error}", path=path, line=number) from None
        played.append(Played(when, values, {}))
    if rate_of(played) < _SLOWEST:
        apart = 1.0 / rate_of(played)
        raise LogError(f"has rows {apart:g} s apart; times must be in seconds", path=path, line=3)
    return played


def _number(column: str, cell: str, delimiter: str) -> float:
    try:
        value = float(cell.replace(",", ".") if delimiter == ";" else cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"'{cell.strip()}' in the column '{column}' is not a finite number")
    return value


def check_units(samples: Sequence[Played], limits: Mapping[str, tuple[float, float]]) -> None:
    """Raise `ConfigError` if targets are in another unit, such as degrees.

    This applies the hand's own rule early: the hand would refuse such targets only during motion.

    Args:
        samples: The samples.
        limits: Lower and upper limit of the actuators [rad | m]; other targets are intensities.
    """
    for sample in samples:
        for name, value in sample.targets.items():
            lower, upper = limits.get(name, (0.0, 1.0))
            span = FAR * (upper - lower)
            if not lower - span <= value <= upper + span:
                unit = "radians or metres" if name in limits else "intensities from 0 to 1"
                raise ConfigError(
                    f"'{name}' goes to {value:g} after {sample.time:g} s, far beyond {lower:.3g} "
                    f"to {upper:.3g}; targets are {unit}"
                )


def rate_of(samples: Sequence[Played]) -> float:
    """Return the rate of recorded samples [Hz], from the median time between them."""
    steps = sorted(b.time - a.time for a, b in pairwise(samples))
    # The mean would include pauses, in which nothing was sent.
    return 1.0 / steps[len(steps) // 2] if steps else RATE


async def play(samples: Sequence[Played], stream: Sink, speed: float = 1.0) -> None:
    """Send recorded samples when they are due, with their recorded stamps.

    Time passes ``speed`` times as fast. Raises `ConfigError` if ``speed`` is not above 0.
    """
    if not 0.0 < speed < math.inf:
        raise ConfigError(f"the speed must be above 0, not {speed:g}")
    begin = monotonic.now()
    # The samples of a slow recording are far apart without being pauses.
    longest = max(_LONGEST_GAP, _PAUSE / (rate_of(samples) * speed))
    before: Played | None = None
    for sample in samples:
        stamp = begin + sample.time / speed
        while (left := stamp - monotonic.now()) > 0.0:
            await anyio.sleep(min(left, longest))
            now = monotonic.now()
            # After a late wake-up, the next sample itself is due and must not follow a newer stamp.
            if before is not None and left > longest and now < stamp:
                # Without velocity, which would keep the hand moving during the pause.
                await stream.send(before.targets, {}, now)
        velocity = {name: speed * value for name, value in sample.velocity.items()}
        await stream.send(sample.targets, velocity, stamp)
        before = sample
