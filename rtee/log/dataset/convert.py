"""Recordings of a hand as a LeRobot dataset."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtee.errors import LogError, needing_extra, suggestion
from rtee.log.brief import check_hands
from rtee.log.dataset.cameras import CameraTopic, cameras_in
from rtee.log.dataset.signals import (
    Signal,
    Times,
    asked,
    asked_by_name,
    intensities,
    observed,
    sent,
)
from rtee.log.export import replacing
from rtee.log.file_index import FileIndex, index_file
from rtee.log.reader import read
from rtee.log.recording import Recording
from rtee.log.rotation import paths_of
from rtee.messages.codec import SECOND
from rtee.messages.features import USUAL, ObservedQuantity
from rtee.sample import FloatArray

BEGIN: Final = "episode:"
"""Beginning of a mark that starts an episode; the task follows."""

END, DISCARD = "end", "discard"
"""Words that follow it in a mark that ends an episode, or discards it."""


class EpisodeBoundary(StrEnum):
    """Delimiters of episodes."""

    MARKS = "marks"
    GOALS = "goals"


@dataclass(frozen=True, slots=True)
class Episode:
    """A demonstration: the task in words, and when it began and ended [ns since 1970]."""

    task: str
    start: int
    end: int


def episodes_of(recording: Recording, by: EpisodeBoundary) -> list[Episode]:
    """Return the episodes of a recording, in order.

    By goals, only the successful ones are episodes.

    Raises:
        LogError: if there are none.
    """
    found = list(_by_marks(recording) if by is EpisodeBoundary.MARKS else _by_goals(recording))
    if not found:
        why = (
            f"has no episodes: no mark begins with '{BEGIN}' (rtee log mark \"{BEGIN} the task\");"
            " give --episodes goals to make each goal one"
            if by is EpisodeBoundary.MARKS
            else "has no episodes: no goal in it was reached or grasped anything"
        )
        raise LogError(why, path=recording.paths[0])
    return found


def _by_marks(recording: Recording) -> Iterator[Episode]:
    task, start = "", 0
    for entry in recording.marks:
        text = entry.value.text.strip()
        if not text.lower().startswith(BEGIN):
            continue
        word = text[len(BEGIN) :].strip()
        # The beginning of the next episode ends this one, too.
        if task and word.lower() != DISCARD:
            yield Episode(task, start, entry.wall)
        task, start = ("" if word.lower() in (END, DISCARD) else word), entry.wall
    if task:
        yield Episode(task, start, recording.end)


def _by_goals(recording: Recording) -> Iterator[Episode]:
    succeeded = {entry.value.goal_id for entry in recording.results if entry.value.succeeded}
    for span in recording.spans:
        if span.goal_id in succeeded:
            at = [recording.start + round(t * SECOND) for t in (span.start, span.end)]
            yield Episode(span.name, *at)


STATE, ACTION, SENT = "observation.state", "action", "sent_action"
"""Features of a frame. The last one has no prefix that LeRobot takes for an input or an output."""


@dataclass(frozen=True, slots=True)
class Choice:
    """Selection of the content of recordings for a dataset.

    Attributes:
        fps: Frames per second [Hz].
        by: The event that separates episodes.
        task: The task of all episodes; empty: each has its own.
        actions: Actions whose intensities are the dataset's action; none: the actuators' targets.
        observe: Observed quantities, all of which must be known; none: all known ones.
        cameras: Cameras by ``[NAME=]TOPIC``; none: all.
    """

    fps: int = 30
    by: EpisodeBoundary = EpisodeBoundary.MARKS
    task: str = ""
    actions: tuple[str, ...] = ()
    observe: tuple[ObservedQuantity, ...] = ()
    cameras: tuple[str, ...] = ()


@dataclass(frozen=True)
class Made:
    """A written dataset: episodes, frames, names by feature, and sentences on omitted data."""

    episodes: int
    frames: int
    names: Mapping[str, Sequence[str]]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Shot:
    """An episode at the times of its frames, and how long its values count as current [s]."""

    episode: Episode
    when: Times
    state: Mapping[ObservedQuantity, Mapping[str, FloatArray]]
    action: FloatArray
    sent: FloatArray
    longest: Mapping[str, float]
    path: Path


def write_dataset(paths: Sequence[Path], output: Path, choice: Choice) -> Made:
    """Write a dataset, in a folder that does not exist yet.

    Each frame has the values known at its time, never later ones. An episode in which nothing is
    known for a while, such as a camera that stopped, is left out.

    Args:
        paths: Recordings of one hand, or folders with them, and files with images of cameras.
        output: The folder.
        choice: How its episodes are selected.

    Raises:
        LogError: if a file cannot be read or written or has no episodes, or a selected quantity is
            unknown.
        MissingExtra: if pyarrow or PyAV is not installed.
    """
    with needing_extra("a LeRobot dataset", "lerobot"):
        import av
        import pyarrow.parquet  # noqa: F401 - before anything is written

        # PyAV's own messages are suppressed: rtee reports failures.
        av.logging.set_level(av.logging.PANIC)
    if output.exists():
        raise LogError("exists already; give a new folder for the dataset", path=output)
    indexes = {part: index_file(part) for path in paths for part in paths_of(path)}
    cameras = cameras_in(indexes, choice.cameras)
    files = _joined(indexes)
    hands = [parts for parts in files if any(_has_hand(indexes[path]) for path in parts)]
    if not hands:
        raise LogError("contains no recording of a hand", path=paths[0])
    check_hands({parts[0]: indexes[parts[0]].hand for parts in hands})
    shots = sorted(
        (shot for parts in hands for shot in _shots(read(parts), choice)),
        key=lambda shot: shot.episode.start,
    )
    notes: list[str] = []
    shots = list(_distinct(shots, notes))
    kept = list(_kept(shots, [(c, c.availability(choice.fps)) for c in cameras], notes))
    if not kept:
        raise LogError(f"no episode remains: {notes[0]}", path=hands[0][0])
    features = _features(kept, choice, notes)
    with replacing(output) as folder:
        _write(folder, kept, features, cameras, choice)
    return Made(len(kept), sum(len(shot.when) for shot in kept), features, tuple(notes))


def _joined(indexes: Mapping[Path, FileIndex]) -> list[list[Path]]:
    """Return the files by recording, whose parts may be given one by one, in any order, or twice.

    Otherwise an episode would end with the part in which it began.
    """
    recordings: dict[tuple[str, str], dict[int, Path]] = {}
    for path, index in indexes.items():
        # Only recordings on the disk have a session: not the flight recorder's, nor other software.
        session = index.values.get("session")
        key = (str(path.resolve()), "") if session is None else (index.hand, session)
        recordings.setdefault(key, {}).setdefault(int(index.values.get("part", 0)), path)
    return [[parts[number] for number in sorted(parts)] for parts in recordings.values()]


_SAME: Final = SECOND // 1000
"""Difference of the starts of the same episode in two files [ns]: its times are rounded."""


def _distinct(shots: Iterable[_Shot], notes: list[str]) -> Iterator[_Shot]:
    """Yield the episodes in order of time, each once, the longest of several.

    A flight recorder's file repeats the last half minute of a recording.
    """
    last: _Shot | None = None
    repeated = 0
    for shot in shots:
        if last is not None:
            one, other = last.episode, shot.episode
            if one.task == other.task and other.start - one.start < _SAME:
                repeated += 1
                last = max(last, shot, key=lambda each: each.episode.end)
                continue
            yield last
        last = shot
    if last is not None:
        yield last
    if repeated:
        notes.append(f"{repeated} episodes are in several files, and taken once")


def _has_hand(index: FileIndex) -> bool:
    return bool(index.values) or any(
        channel.topic.endswith("/actuator_states") for channel in index.channels.values()
    )


def _shots(recording: Recording, choice: Choice) -> Iterator[_Shot]:
    """Yield the episodes of a recording, each at the times of its frames."""
    path, rate = recording.paths[0], recording.rate
    if not len(recording.actuator_states):
        raise LogError("contains no states of actuators", path=path)
    if not 1 <= choice.fps <= max(rate, 1.0):
        raise LogError(
            f"has {rate:g} states a second: a dataset of it can have 1 to {rate:g} frames "
            f"a second, not {choice.fps}",
            path=path,
        )
    signals, reference = list(observed(recording, choice.fps)), sent(recording, choice.fps)
    longest = {SENT: reference.longest, STATE: signals[0][1].longest}
    wanted = intensities(recording, choice.actions) if choice.actions else asked(recording)
    for name, column in zip(choice.actions, wanted.values.T, strict=False):
        if not np.isfinite(column).any():
            hint = suggestion(name, asked_by_name(recording))
            raise LogError(f"has no stream with targets for {name}; {hint}", path=path)
    for episode in episodes_of(recording, choice.by):
        count = int((episode.end - episode.start) * choice.fps // SECOND) + 1
        when = episode.start + np.arange(count, dtype=np.int64) * SECOND // choice.fps
        action = wanted.row_at(when)
        if choice.actions:
            # A person marks an episode before the stream begins, and after it has ended.
            known = np.flatnonzero(np.isfinite(action).all(axis=1))
            first, last = (known[0], known[-1] + 1) if len(known) else (0, len(when))
            when, action = when[first:last], action[first:last]
        state: dict[ObservedQuantity, dict[str, FloatArray]] = {}
        for quantity, signal in signals:
            columns = dict(zip(signal.names, signal.at(when).T, strict=True))
            state.setdefault(quantity, {}).update(columns)
        went = reference.at(when)
        if not choice.actions:
            action = np.where(np.isfinite(action), action, went)
        yield _Shot(episode, when, state, action, went, longest, path)


def _kept(
    shots: Iterable[_Shot], images: Sequence[tuple[CameraTopic, Signal]], notes: list[str]
) -> Iterator[_Shot]:
    """Yield the episodes in which action, positions and images are known throughout."""
    for number, shot in enumerate(shots, start=1):
        position = np.array([*shot.state[ObservedQuantity.POSITION].values()]).T
        needed = [
            ("the position of the actuators", position, shot.longest[STATE]),
            ("what was sent", shot.sent, shot.longest[SENT]),
            ("what was asked for", shot.action, math.inf),
            *((f"the image of '{c.topic}'", s.at(shot.when), s.longest) for c, s in images),
        ]
        for what, values, longest in needed:
            unknown = ~np.isfinite(values).all(axis=1)
            if unknown.any():
                after = (shot.when[unknown][0] - shot.when[0]) / SECOND
                notes.append(
                    f"episode {number}, '{shot.episode.task}', is left out: {after:.2f} s after "
                    f"its beginning, {what} is not known"
                    + (f" (for longer than {longest * 1000:.0f} ms)" if longest < math.inf else "")
                )
                break
        else:
            yield shot


def _features(shots: Sequence[_Shot], choice: Choice, notes: list[str]) -> dict[str, list[str]]:
    """Return the names of the numbers by feature: those that are known throughout."""
    state: list[str] = []
    for quantity in choice.observe or USUAL:
        names = dict.fromkeys(name for shot in shots for name in shot.state.get(quantity, {}))
        known = [
            name
            for name in names
            if all(
                name in shot.state[quantity] and np.isfinite(shot.state[quantity][name]).all()
                for shot in shots
            )
        ]
        left = [name for name in names if name not in known]
        if choice.observe and (left or not names):
            raise LogError(
                f"the {quantity} is not known throughout: {', '.join(left) or 'not recorded'}; "
                "observe something else",
                path=shots[0].path,
            )
        if left:
            notes.append(f"{', '.join(left)}: left out, since not known throughout")
        state += known
    actuators = list(shots[0].state[ObservedQuantity.POSITION])
    if any(list(shot.state[ObservedQuantity.POSITION]) != actuators for shot in shots):
        raise LogError("the recordings are of hands with different actuators", path=shots[-1].path)
    return {STATE: state, ACTION: list(choice.actions) or actuators, SENT: actuators}


def _write(
    folder: Path,
    shots: Sequence[_Shot],
    features: Mapping[str, Sequence[str]],
    cameras: Sequence[CameraTopic],
    choice: Choice,
) -> None:
    from rtee.log.dataset.files import DatasetFiles

    folder.mkdir()
    files = DatasetFiles(folder, choice.fps, features, [each.name for each in cameras])
    every = np.concatenate([shot.when for shot in shots])
    # One pass over the images of each camera, since the episodes follow each other.
    images: dict[str, Iterator[Any]] = {each.name: each.newest(every) for each in cameras}
    for shot in shots:
        columns = {name: values for each in shot.state.values() for name, values in each.items()}
        vectors = {
            STATE: np.stack([columns[name] for name in features[STATE]], axis=1),
            ACTION: shot.action,
            SENT: shot.sent,
        }
        files.add(choice.task or shot.episode.task, vectors, images)
    files.finish()
