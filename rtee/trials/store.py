"""The results of trials, kept beside a hand's actions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from rtee.actions.fingerprints import Fingerprints
from rtee.errors import ConfigError
from rtee.hand.files import write_atomically
from rtee.hand.own_copy import TRIALS
from rtee.hand.validation import validated
from rtee.hand.yamlfile import YamlDocument, emit, parse_yaml, read_yaml
from rtee.trials.result import CHOOSING, TrialResult
from rtee.trials.variation import interval

FILE_NAME = TRIALS
"""The file with the results in a hand's folder."""

MOST = 1500
"""Results that a file may hold: it is read up to 1 MB, and one takes up to 0.6 kB."""

METHOD = 4
"""How trials are made: raised whenever the draws, the physics or what counts as held change, so
that earlier results cannot be compared and count as outdated. A better search for places does not
raise it, since what was found at a place still holds there. 1: files that do not say; the place of
an object was chosen by the draws that were reported. 2: objects began 0.8 mm outside of their
surface, and linear motors carried tens of kilograms. 3: an object might slip by 60 mm."""


def to_document(result: TrialResult) -> dict[str, Any]:
    """Return a result as plain data."""
    trial = result.trial
    forces = {"forces": dict(result.forces)} if result.forces else {}
    return {
        "action": trial.action,
        "elements": list(trial.elements),
        "object": trial.object,
        "intensity": trial.intensity,
        "mass": trial.mass,
        **({} if trial.friction is None else {"friction": trial.friction}),
        "held": result.held,
        **({} if result.fits else {"fits": False}),
        "reason": result.reason,
        "outcome": result.outcome,
        "slip": result.slip,
        **forces,
        "peak": result.peak,
        "duration": result.duration,
        "places": result.places,
        "position": list(result.position),
        **_varied(result),
    }


def _varied(result: TrialResult) -> dict[str, Any]:
    """Return the result of a trial's variations; nothing without variations."""
    trial, tries = result.trial, result.tries
    if tries == 0:
        return {}
    low, high = interval(result.survived, tries)
    return {
        "variations": {
            "tried": tries,
            "held": result.survived,
            "interval": [round(low, 3), round(high, 3)],
            "seed": trial.seed,
            **({} if trial.choosing == CHOOSING else {"choosing": trial.choosing}),
            **({} if trial.wanted is None else {"of": trial.variations, "wanted": trial.wanted}),
        }
    }


def from_document(entry: Mapping[str, Any]) -> TrialResult:
    """Return a result from plain data.

    Raises:
        KeyError, TypeError, ValueError: if it is not one.
    """
    varied = entry.get("variations", {})
    tried = varied.get("tried", 0)
    # The number of places is that of the result, not the trial's limit.
    asked = {name: value for name, value in entry.items() if name != "places"}
    found = validated(
        TrialResult,
        {
            **entry,
            "trial": {**asked, **varied, "variations": varied.get("of", tried)},
            "forces": [*entry.get("forces", {}).items()],
            "survived": varied.get("held", 0),
            "left": varied.get("of", tried) - tried,
        },
    )
    if not 0 <= found.survived <= found.tries:
        raise ValueError(f"{found.survived} of {found.trial.variations} variations were held")
    return found


def write_results(path: Path, made_with: Fingerprints, results: Iterable[TrialResult]) -> None:
    """Write results, sorted; equal results give the same text.

    Raises:
        ConfigError: if it cannot be written.
    """
    ordered = sorted(results, key=lambda result: result.trial.key)
    entries = [to_document(result) for result in ordered]
    tried = {result.trial.what for result in ordered} & made_with.actions.keys()
    actions = {name: made_with.actions[name] for name in sorted(tried)}
    document = {
        "made_with": made_with.files,
        "method": METHOD,
        **({"model": made_with.model, "actions": actions} if actions else {}),
        "trials": entries,
    }
    head = (
        "# Results of `rtee try`; run it again when the hand, the action or the method changes.\n"
    )
    write_atomically(path, head + emit(document))


def read_results(path: Path, made_with: Fingerprints | None = None) -> dict[str, TrialResult]:
    """Read results by the keys of their trials.

    Args:
        path: The file; nothing is found where it does not exist.
        made_with: Results made with another model of the hand or other actions than these, or by
            an earlier method, are not given.

    Raises:
        ConfigError: if the file holds something else.
    """
    if not path.exists():
        return {}
    return _results(read_yaml(path, "the trials"), made_with)


def parse_results(text: str, path: Path) -> dict[str, TrialResult]:
    """Return the results that the text of such a file holds, by the keys of their trials.

    Raises:
        ConfigError: if the text is something else.
    """
    return _results(parse_yaml(text, path, "the trials"), None) if text else {}


def outdated(text: str, path: Path) -> frozenset[str]:
    """Return the keys of the trials that were made with other files, actions or methods than now.

    A running hand sends the text with what its files and actions are now, as ``present``,
    ``present_model`` and ``present_actions``.

    Raises:
        ConfigError: if the text is something else.
    """
    read = parse_yaml(text, path, "the trials") if text else None
    document = None if read is None else read.data
    if read is None or not isinstance(document, dict):
        return frozenset()
    if not {"present", "made_with"} <= document.keys():
        return frozenset()
    # An older hand sends only the fingerprint of all its files.
    model, actions = document.get("present_model", ""), document.get("present_actions")
    present = Fingerprints(str(document["present"]), model, actions or {})
    return frozenset(_results(read, None).keys() - _results(read, present).keys())


def _results(read: YamlDocument, made_with: Fingerprints | None) -> dict[str, TrialResult]:
    document = read.data
    try:
        results = [from_document(entry) for entry in document["trials"]]
        if made_with is not None:
            # Files that were written before the method was counted do not name it.
            current = document.get("method", 1) == METHOD
            results = [
                result
                for result in results
                if current and made_with.same(result.trial.what, document)
            ]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(
            f"these are not results of trials ({error}); remove the file to make them again",
            path=read.path,
        ) from error
    return {result.trial.key: result for result in results}
