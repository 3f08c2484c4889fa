"""What trials in simulation found about actions: which objects each of them held."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from rtee.actions.types import Action, Primitive
from rtee.trials.result import TrialResult
from rtee.trials.store import FILE_NAME, parse_results

Key = tuple[str, tuple[str, ...]]
"""Name and elements of an action."""

Tried = Mapping[Key, Sequence[TrialResult]]
"""The results of trials by action."""

_CELL = "padding:0 0.5em 0 0;text-align:left;vertical-align:top"


def key_of(action: Action) -> Key:
    """Return the name and elements of an action."""
    return action.name, action.elements if isinstance(action, Primitive) else ()


def tried_in(text: str) -> Tried:
    """Return the results that the text of a hand's file of trials holds, by action.

    Raises:
        ConfigError: if the text is something else.
    """
    found: dict[Key, list[TrialResult]] = {}
    for result in parse_results(text, Path(FILE_NAME)).values():
        trial = result.trial
        found.setdefault((trial.action, trial.elements), []).append(result)
    return found


def line(results: Sequence[TrialResult]) -> str:
    """Return what trials of an action came to: ``held 7 of 12 objects``."""
    held = sum(result.held for result in results)
    return f"held {held} of {len(results)} object{'s' if len(results) != 1 else ''}"


def table(results: Sequence[TrialResult]) -> str:
    """Return an HTML table of the objects with a sign, and why one was lost."""
    rows = "".join(
        f'<tr><td style="{_CELL};white-space:nowrap">{"●" if result.held else "○"} '
        f'{escape(result.trial.object)}</td><td style="{_CELL}">'
        f"{escape('held' if result.held else result.reason or 'lost')}</td></tr>"
        for result in sorted(results, key=lambda each: (not each.held, each.trial.object))
    )
    return f'<table style="border-collapse:collapse">{rows}</table>'
