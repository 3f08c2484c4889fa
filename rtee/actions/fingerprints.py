"""Which files and actions of a hand something was made with, action by action."""

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
    """Words that change with a hand's files and with what its actions do.

    Attributes:
        files: Changes with any of the files.
        model: Changes with the model, the configuration or the primitives.
        actions: By name and elements of an action: changes with what it does.
    """

    files: str
    model: str = ""
    actions: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, folder: Path, library: ActionLibrary) -> Self:
        """Return those of a hand.

        Args:
            folder: The hand's folder.
            library: Its actions.
        """
        actions = {" ".join((one.name, *one.elements)): _word(one) for one in library}
        return cls(fingerprint(folder), model_fingerprint(folder), actions)

    def same(self, action: str, made_with: Mapping[str, Any]) -> bool:
        """Return whether what an action was made with is still as it was.

        Args:
            action: Name and elements of the action.
            made_with: ``made_with``, the word of all files then; ``model`` and ``actions``, the
                other ones, which older versions of rtee did not note.
        """
        if made_with["made_with"] == self.files:
            return True
        word = self.actions.get(action)
        then = made_with.get("model"), made_with.get("actions", {}).get(action)
        return word is not None and then == (self.model, word)


def _word(action: Action) -> str:
    """Return a word that changes with what an action does, and not with how it is written."""
    does: list[Any] = [
        [[name, round(posture.position[name], _DECIMALS)] for name in sorted(posture.involved)]
        for posture in action.waypoints
    ]
    # The fingers tell between what an object is put.
    does.append(action.fingers)
    if isinstance(action, Timed):
        does.append([[step.before, step.after] for step in action.steps])
    return hashlib.sha256(json.dumps(does).encode()).hexdigest()[:16]
