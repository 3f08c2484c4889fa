"""What each hand holds in simulation: tables made from the stored trials, ``config/*/trials.yaml``.

``python docs/trials_table.py`` writes the one in ``docs/hands/index.md`` and those of the hands'
own pages again; a test keeps them current.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rtee.actions.fingerprints import Fingerprints
from rtee.actions.library import ActionLibrary
from rtee.hand.load import load_configured
from rtee.trials.result import OBJECTS, TrialResult
from rtee.trials.store import FILE_NAME, read_results
from rtee.trials.variation import interval

ROOT = Path(__file__).parents[1]
PAGES = ROOT / "docs" / "hands"
BEGIN = "<!-- Trials: made by `python docs/trials_table.py`; a test keeps it current. -->"
END = "<!-- End of the trials. -->"

WANTED = 18
"""Of 20 variations, so many are wanted."""


@dataclass(frozen=True)
class Stored:
    """The stored trials of a hand.

    Attributes:
        name: The hand.
        results: The results.
        actions: How many actions the hand has.
        outdated: Some were made with other files of the hand, or by an earlier method.
    """

    name: str
    results: tuple[TrialResult, ...]
    actions: int
    outdated: bool

    def of(self, shape: str) -> list[TrialResult]:
        """Return the results with an object, those of variations that held most often first."""
        found = [one for one in self.results if one.trial.object == shape]
        return sorted(found, key=_order)


def _order(one: TrialResult) -> tuple[bool, bool, int, str]:
    return not one.fits, not one.trial.variations, -one.survived, one.trial.key


def stored() -> list[Stored]:
    """Return the stored trials of all hands that have some."""
    found = []
    for path in sorted((ROOT / "config").glob(f"*/{FILE_NAME}")):
        folder = path.parent
        results = read_results(path)
        library = ActionLibrary.load(load_configured(str(folder))[0], folder / "actions")
        current = read_results(path, Fingerprints.of(folder, library))
        outdated = len(current) < len(results)
        found.append(Stored(folder.name, tuple(results.values()), len(library), outdated))
    return found


def _best(results: list[TrialResult]) -> str:
    """Return how often the best action held an object, in a word."""
    if not results:
        return ""
    if not any(one.fits for one in results):
        return "unfit"
    best = results[0]
    if best.trial.variations and best.held:
        return str(best.survived)
    return "held once" if any(one.held for one in results) else "lost"


def _matrix(hands: list[Stored]) -> str:
    """Return the table of all hands: an object a row, a hand a column."""
    marks = [f"`{one.name}`{' (outdated)' if one.outdated else ''}" for one in hands]
    rows = [
        f"| object | {' | '.join(marks)} |",
        f"| --- |{' --- |' * len(hands)}",
        *(
            f"| `{shape}` | {' | '.join(_best(one.of(shape)) for one in hands)} |"
            for shape in OBJECTS
        ),
    ]
    return "\n".join(rows)


def _own(hand: Stored) -> str:
    """Return what a hand's own page says."""
    pairs = hand.actions * len(OBJECTS)
    varied = [one for one in hand.results if one.trial.variations or not one.fits]
    once = [one for one in hand.results if one.fits and not one.trial.variations]
    lines = [
        f"In simulation; {len(varied)} of {pairs} pairs of action and object with 20 variations."
    ]
    if once:
        held = sum(one.held for one in once)
        lines.append(f"Others were tried once, without variation: {held} of {len(once)} were held.")
    if len(varied) < pairs:
        lines.append(f"`rtee try {hand.name} --all` tries the rest, which takes a while.")
    if hand.outdated:
        lines.append(
            "**Outdated**: made with other files of this hand or by an earlier method; "
            f"`rtee try {hand.name} --all` makes them again."
        )
    rows = [
        f"| object | best action | held of 20 | 95 % | actions that held {WANTED} or more |",
        "| --- | --- | --- | --- | --- |",
    ]
    for shape in OBJECTS:
        results = hand.of(shape)
        fitting = [one for one in results if one.fits and one.trial.variations]
        word, action, share = _best(results), "", ""
        if fitting and fitting[0].held:
            best = fitting[0]
            low, high = interval(best.survived, best.trial.variations)
            action = best.trial.what
            share = f"{low * 100:.0f} to {high * 100:.0f} %"
        good = sum(one.survived >= WANTED for one in fitting)
        count = f"{good} of {len(fitting)} tried" if fitting else ""
        rows.append(f"| `{shape}` | {action} | {word or 'not tried'} | {share} | {count} |")
    return "\n\n".join(["\n".join(lines), "\n".join(rows)])


def written(text: str, made: str) -> str:
    """Return a page with what is between its marks made again."""
    head, begin, rest = text.partition(BEGIN)
    _, end, tail = rest.partition(END)
    if not (begin and end):
        raise ValueError("a page has lost its marks of the trials")
    return f"{head}{BEGIN}\n\n{made}\n\n{END}{tail}"


def pages() -> dict[Path, str]:
    """Return the pages with their tables made again."""
    hands = stored()
    made = {PAGES / f"{one.name}.md": _own(one) for one in hands}
    made[PAGES / "index.md"] = _matrix(hands)
    return {page: written(page.read_text(), text) for page, text in made.items()}


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text)
