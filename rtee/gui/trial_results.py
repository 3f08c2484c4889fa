"""Results of trials in simulation: which objects each action held."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path

from rtee.actions.types import Action
from rtee.trials.result import TrialResult
from rtee.trials.store import FILE_NAME, outdated, parse_results
from rtee.trials.variation import rate_text

Key = tuple[str, tuple[str, ...]]
"""Name and elements of an action."""

_CELL = "padding:0 0.5em 0 0;text-align:left;vertical-align:top"


@dataclass(frozen=True)
class Tried:
    """Results of trials by action: the stored ones, and those started in this page, newest last.

    ``outdated`` has the keys of trials made before the hand, the action or the way trials are made
    changed.
    """

    results: Mapping[Key, Sequence[TrialResult]] = field(default_factory=dict)
    outdated: frozenset[str] = frozenset()
    own: Mapping[Key, Sequence[TrialResult]] = field(default_factory=dict)

    def with_own(self, result: TrialResult) -> Tried:
        """Return a copy with a result of this page, which replaces an earlier one on the object."""
        trial = result.trial
        key = (trial.action, trial.elements)
        others = [other for other in self.own.get(key, ()) if other.trial.object != trial.object]
        return replace(self, own={**self.own, key: [*others, result]})


def key_of(action: Action) -> Key:
    """Return the name and elements of an action."""
    return action.name, action.elements


def tried_in(text: str) -> Tried:
    """Return the results in the text of a file of trials, by action.

    Raises `ConfigError` if the text is not that of a file of trials.
    """
    by_action: dict[Key, list[TrialResult]] = {}
    for result in parse_results(text, Path(FILE_NAME)).values():
        trial = result.trial
        by_action.setdefault((trial.action, trial.elements), []).append(result)
    return Tried(by_action, outdated(text, Path(FILE_NAME)))


def object_name(text: str) -> str:
    """Return the name of an object; a mesh is named without its folder."""
    return text.rpartition("/")[2]


def verdict(result: TrialResult) -> str:
    """Return the outcome of a trial as text: held, with the rate of variations, or the reason."""
    if not result.held:
        return result.reason or "lost"
    return ", ".join(filter(None, ("held", rate_text(result))))


def line(results: Sequence[TrialResult], *, outdated: bool = False) -> str:
    """Return the summary of an action's trials: ``held 7 of 12 objects``."""
    held = sum(result.held for result in results)
    fitting = sum(result.fits for result in results)
    if not fitting:
        return "not tried: no object fits"
    words = f"in simulation: held {held} of {fitting} object{'s' if fitting != 1 else ''}"
    words += " that fit" if fitting < len(results) else ""
    return f"{words}, outdated" if outdated else words


def table(results: Sequence[TrialResult]) -> str:
    """Return an HTML table with the verdict of each object."""
    rows = "".join(
        f'<tr><td style="{_CELL};white-space:nowrap">{"●" if result.held else "○"} '
        f'{escape(object_name(result.trial.object))}</td><td style="{_CELL}">'
        f"{escape(verdict(result))}</td></tr>"
        for result in sorted(results, key=lambda each: (not each.held, each.trial.object))
    )
    return f'<table style="border-collapse:collapse">{rows}</table>'
