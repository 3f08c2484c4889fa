"""The episodes of a recording: between marks, or those of its goals."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from rtee.errors import LogError
from rtee.log.recording import Recording
from rtee.messages.codec import SECOND

BEGIN: Final = "episode:"
"""What a mark begins with that begins an episode; the task follows."""

END, DISCARD = "end", "discard"
"""What follows it in a mark that ends the episode, or throws it away."""


class EpisodeBoundary(StrEnum):
    """How episodes are delimited."""

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

    By goals, those are episodes that came to what was wanted.

    Raises:
        LogError: There are none.
    """
    found = list(_by_marks(recording) if by is EpisodeBoundary.MARKS else _by_goals(recording))
    if not found:
        why = (
            f"has no episodes: no mark begins with '{BEGIN}' (rtee log mark \"{BEGIN} the task\");"
            " give --episodes goals to take each goal for one"
            if by is EpisodeBoundary.MARKS
            else "has no episodes: no goal in it was reached, or grasped something"
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
        # The next one's beginning is an end, too.
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
