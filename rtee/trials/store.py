"""The results of trials, kept beside a hand's actions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from rtee.errors import ConfigError
from rtee.hand.catalog import fingerprint as fingerprint
from rtee.hand.files import write_atomically
from rtee.hand.own_copy import TRIALS
from rtee.hand.yamlfile import YamlDocument, parse_yaml, read_yaml
from rtee.hand.yamlwrite import emit
from rtee.trials.result import CHOOSING, Trial, TrialResult
from rtee.trials.variation import interval

FILE_NAME = TRIALS
"""The file with the results in a hand's folder."""

METHOD = 2
"""How trials are made: raised whenever the choice of places, the draws or the physics change what
they find, so that earlier results count as outdated. 1: files that do not say; the place of an
object was chosen by the draws that were reported."""


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
    """Return what a trial's variations showed; nothing where there were none."""
    tries = result.trial.variations
    if tries == 0:
        return {}
    low, high = interval(result.survived, tries)
    return {
        "variations": {
            "tried": tries,
            "held": result.survived,
            "interval": [round(low, 3), round(high, 3)],
            "seed": result.trial.seed,
            **({} if result.trial.choosing == CHOOSING else {"choosing": result.trial.choosing}),
        }
    }


def from_document(entry: Mapping[str, Any]) -> TrialResult:
    """Return a result from plain data.

    Raises:
        KeyError, TypeError, ValueError: if it is none.
    """
    varied = entry.get("variations")
    trial = Trial(
        str(entry["action"]),
        tuple(str(name) for name in entry["elements"]),
        str(entry["object"]),
        float(entry["intensity"]),
        float(entry["mass"]),
        friction=None if "friction" not in entry else float(entry["friction"]),
        variations=int(varied["tried"]) if varied else 0,
        seed=int(varied["seed"]) if varied else 0,
        choosing=int(varied.get("choosing", CHOOSING)) if varied else CHOOSING,
    )
    survived = int(varied["held"]) if varied else 0
    if not 0 <= survived <= trial.variations:
        raise ValueError(f"{survived} of {trial.variations} variations are held")
    x, y, z = (float(value) for value in entry["position"])
    return TrialResult(
        trial,
        bool(entry["held"]),
        str(entry["reason"]),
        str(entry["outcome"]),
        float(entry["slip"]),
        tuple((str(name), float(force)) for name, force in entry.get("forces", {}).items()),
        float(entry["peak"]),
        float(entry["duration"]),
        int(entry["places"]),
        (x, y, z),
        survived,
        bool(entry.get("fits", True)),
    )


def write_results(path: Path, made_with: str, results: Iterable[TrialResult]) -> None:
    """Write results, sorted; the text depends on nothing else.

    Args:
        path: The file.
        made_with: The fingerprint of the hand's files.
        results: The results.

    Raises:
        ConfigError: if it cannot be written.
    """
    ordered = sorted(results, key=lambda result: result.trial.key)
    entries = [to_document(result) for result in ordered]
    document = {"made_with": made_with, "method": METHOD, "trials": entries}
    head = "# What `rtee try` found; made anew when the hand's files or the method change.\n"
    write_atomically(path, head + emit(document))


def read_results(path: Path, made_with: str | None = None) -> dict[str, TrialResult]:
    """Read results by the keys of their trials.

    Args:
        path: The file; nothing is found where it does not exist.
        made_with: Results made with other files of the hand, or by an earlier method, are not
            given.

    Raises:
        ConfigError: if the file holds something else.
    """
    if not path.exists():
        return {}
    return _results(read_yaml(path, "the trials"), made_with)


def parse_results(text: str, path: Path) -> dict[str, TrialResult]:
    """Return the results that the text of such a file holds, by the keys of their trials.

    Args:
        text: The text; nothing is found in an empty one.
        path: Where it is from, for messages.

    Raises:
        ConfigError: if the text is something else.
    """
    return _results(parse_yaml(text, path, "the trials"), None) if text else {}


def outdated(text: str, path: Path) -> bool:
    """Return whether the hand's files or the method have changed since the text was written.

    A running hand sends the text with the fingerprint of its present files, as ``present``.

    Args:
        text: The text.
        path: The file it is from, for messages.

    Raises:
        ConfigError: if the text is something else.
    """
    document = parse_yaml(text, path, "the trials").data if text else {}
    if not isinstance(document, dict) or not {"present", "made_with"} <= document.keys():
        return False
    return not _current(document, str(document["present"]))


def _current(document: Mapping[str, Any], present: str) -> bool:
    """Return whether results were made with the present files, by the present method."""
    # Files that were written before the method was counted do not name it.
    made = document["made_with"], document.get("method", 1)
    return bool(made == (present, METHOD))


def _results(read: YamlDocument, made_with: str | None) -> dict[str, TrialResult]:
    document = read.data
    try:
        if made_with is not None and not _current(document, made_with):
            return {}
        results = [from_document(entry) for entry in document["trials"]]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(
            f"these are not results of trials ({error}); remove the file to make them anew",
            path=read.path,
        ) from error
    return {result.trial.key: result for result in results}
