"""Trials and plans in a separate process, started by another program; needs no simulator.

The process, ``python -m rtee.trials``, reads one job as JSON from its standard input, and writes
lines of JSON: progress, results, and finally the end or an error. It ends with the process that
started it, when its standard input closes.
"""

from __future__ import annotations

import importlib.util
import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from rtee import child
from rtee.errors import ConfigError, MissingExtra
from rtee.hand.validation import validated
from rtee.objects.shape import Table

MESHES: Final = (".stl", ".obj")
"""Formats of meshes that can be planned for and tried."""

OBJECTS_FOLDER: Final = "objects"
"""Folder of meshes to grasp, in a hand's folder."""

MOST_VARIATIONS: Final = 100
"""Variations of one trial: some minutes."""

MOST_ACTIONS: Final = 500
"""Most actions of one job: more than any hand has, since numbers from outside must be bounded."""

LONGEST_LINE: Final = 1 << 24
"""Longest line that the process writes [bytes]: a ranking with all its contacts is 0.1 MB."""

_LIGHTEST, _HEAVIEST = 0.001, 100.0
"""Masses of objects [kg]: a simulation is stable with these, and no hand holds more."""


@dataclass(frozen=True, slots=True)
class TrialJob:
    """The task of a job.

    Attributes:
        folder: The hand's folder.
        object: The object as on the command line; a mesh is in the hand's folder.
        mass: Its mass [kg].
        friction: Friction between hand and object; ``None``: as usual.
        actions: Names and elements of the actions to be tried; ``None``: plan grasps instead.
        variations: How often each trial is varied.
        checked: How many of the planned grasps are tried in any case; further ones until one holds.
        table: The table on which the object of planned grasps stands.
    """

    folder: str
    object: str
    mass: float = 0.1
    friction: float | None = None
    actions: tuple[tuple[str, tuple[str, ...]], ...] | None = None
    variations: int = 20
    checked: int = 3
    table: Table | None = None

    def check(self) -> None:
        """Raise `ConfigError` if a value is invalid; checks of the object come later."""
        if not (math.isfinite(self.mass) and _LIGHTEST <= self.mass <= _HEAVIEST):
            raise ConfigError(
                f"the mass of an object must be {_LIGHTEST:g} to {_HEAVIEST:g} kg, not "
                f"{self.mass:g}"
            )
        if self.friction is not None and not 0.0 <= self.friction <= 10.0:
            raise ConfigError(f"a friction must be 0 to 10, not {self.friction:g}")
        if not 0 <= self.variations <= MOST_VARIATIONS:
            raise ConfigError(
                f"the number of variations must be 0 to {MOST_VARIATIONS}, not {self.variations}"
            )
        if self.actions is not None and not 0 < len(self.actions) <= MOST_ACTIONS:
            raise ConfigError("give an action to try")
        if not 0 < len(self.object) <= 500:
            raise ConfigError("which object? choose one")

    def to_json(self) -> str:
        """Return it as one line."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> TrialJob:
        """Return the job that `to_json` wrote."""
        return validated(cls, json.loads(text))


def command() -> tuple[list[str], dict[str, str]]:
    """Return the command line of the process, and its environment."""
    return child.python("-m", "rtee.trials"), child.environment()


def check_installed(*, planning: bool) -> None:
    """Raise `MissingExtra` if an extra for trying actions, or for planning grasps, is missing."""
    modules = {"coal": "extract", "pinocchio": "extract"}
    if not planning:
        # A trial needs them all: geometry ranks the places that dynamics tries.
        modules = {"mujoco": "sim", **modules}
    for module, extra in modules.items():
        if importlib.util.find_spec(module) is None:
            raise MissingExtra("planning a grasp" if planning else "trying an action", extra)


def meshes_of(folder: Path) -> dict[str, Path]:
    """Return the meshes to grasp that a hand's folder holds, by file name.

    Links that lead out of the folder do not count.
    """
    place = folder / OBJECTS_FOLDER
    try:
        home = place.resolve(strict=True)
        found = sorted(each for each in place.iterdir() if each.suffix.lower() in MESHES)
        return {each.name: each for each in found if each.resolve().is_relative_to(home)}
    except OSError:
        return {}


def read_line(line: bytes) -> dict[str, Any]:
    """Return the fields of a line of the process; empty if the line is malformed."""
    try:
        found = json.loads(line)
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}
