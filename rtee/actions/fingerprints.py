"""Fingerprints of a hand's files and actions, which show whether results are outdated."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from rtee.actions.library import ActionLibrary
from rtee.actions.types import Action, Timed
from rtee.hand.catalog import fingerprint, model_fingerprint

_DECIMALS = 9
"""Decimals of set-points that count, as files have them: a nanoradian."""


@dataclass(frozen=True, slots=True)
class Fingerprints:
    """Fingerprints that change with a hand's files, and with the motion of each action.

    Attributes:
        files: Changes with any of the files.
        model: Changes with the model or the configuration.
        actions: By name and elements of an action; a fingerprint changes with the action's effect.
    """

    files: str
    model: str = ""
    actions: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, folder: Path, library: ActionLibrary) -> Self:
        """Return the fingerprints of a hand."""
        actions = {" ".join((a.name, *a.elements)): _fingerprint_of(a) for a in library}
        return cls(fingerprint(folder), model_fingerprint(folder), actions)

    def same(self, action: str, made_with: Mapping[str, Any]) -> bool:
        """Return whether stored results of an action were made with the same model and action.

        Args:
            action: Name and elements of the action.
            made_with: The fingerprints stored with the results: ``made_with`` of all files, and
                ``model`` and ``actions``, which results of older versions of rtee lack.
        """
        if made_with["made_with"] == self.files:
            return True
        # Some file has changed, but perhaps none that matters to this action.
        present = self.actions.get(action)
        then = made_with.get("model"), made_with.get("actions", {}).get(action)
        return present is not None and then == (self.model, present)


def _fingerprint_of(action: Action) -> str:
    """Return a fingerprint of an action's motion, independent of the form of its file."""
    does: list[Any] = [
        # Sorted: the order in the file has no effect on the action.
        [[name, round(posture.position[name], _DECIMALS)] for name in sorted(posture.involved)]
        for posture in action.waypoints
    ]
    # Trials place the object between these fingers.
    does.append(action.fingers)
    if isinstance(action, Timed):
        does.append([[step.before, step.after] for step in action.steps])
    return hashlib.sha256(json.dumps(does).encode()).hexdigest()[:16]
