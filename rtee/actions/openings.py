"""How far an action's fingertips are apart, and what force of theirs its actuators make: as tables.

The *opening* of an action is the least distance between its opposing tips. Its table holds, over
intensity, the opening and the actuators' *levers*: how much nearer the tips come for a unit of each
actuator, which by virtual work is also the effort that a unit of force between the tips takes. The
offline half makes the tables (`rtee.extract.openings`), and a file beside the actions keeps them,
so that running a hand takes neither Pinocchio nor Coal.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtee.actions.naming import label, normalise
from rtee.actions.types import Action, Primitive, Timed
from rtee.errors import ActionError, ConfigError
from rtee.hand.files import write_atomically
from rtee.hand.model import Hand
from rtee.hand.yamlfile import parse_yaml, read_text
from rtee.hand.yamlwrite import emit
from rtee.sample import FloatArray
from rtee.types import readonly

FILE_NAME: Final = "openings.yaml"
"""Where the tables stand in a hand's folder."""

FORMAT: Final = 1
"""Version of the file."""

_WORD: Final = 16
"""Characters of a fingerprint: 64 bits."""

_WHAT: Final = "the openings"

MARGIN: Final = 0.01
"""Before it closes, a hand opens wider than the object by this, or as far as it can [m]."""

_SQUARE: Final = 0.1
"""Actions whose tips move to the object at angles that differ by less than this are as good as one
another [rad]."""

_STRONGER: Final = 1.5
"""An action that gives less than this many times the force of another is as good: other things then
matter more."""

_WEAKEST: Final = 1e-3
"""Forces are compared from here [N] to its reciprocal: actuators without limits know none."""

_TAKES_PART: Final = 0.1
"""Actuators whose lever is smaller than this share of the largest one do not press."""


@dataclass(frozen=True)
class Opening:
    """The opening of one action over its intensity.

    Attributes:
        action: Name of the action.
        elements: Elements of a primitive.
        posture: Fingerprint of the posture, and the way to it, that the table was made for.
        sides: The fingers that oppose each other: those of one side, those of the other; or, where
            they close on a middle from all around, each finger for itself.
        actuators: The actuators that move on the way, in the hand's order.
        intensity: Intensities at which the table was made ``(k,)``, rising.
        width: The opening there ``(k,)`` [m], falling.
        lever: What the opening loses by a unit of each actuator ``(k, a)`` [m/rad | 1]; by virtual
            work also the effort of each that a force of 1 N between the sides takes.
        angle: Largest angle between a tip's motion and the line to those that oppose it ``(k,)``
            [rad].
        note: What is unusual about the way, in words.
    """

    action: str
    elements: tuple[str, ...]
    posture: str
    sides: tuple[tuple[str, ...], ...]
    actuators: tuple[str, ...]
    intensity: FloatArray
    width: FloatArray
    lever: FloatArray
    angle: FloatArray
    note: str = ""

    @property
    def label(self) -> str:
        """How the action is called in a sentence."""
        return label(self.action, self.elements)

    @property
    def fingers(self) -> tuple[str, ...]:
        """The fingers whose tips oppose each other."""
        return tuple(finger for side in self.sides for finger in side)

    @property
    def around(self) -> bool:
        """Whether the tips close on a middle from more than two sides."""
        return len(self.sides) > 2

    @property
    def widest(self) -> float:
        """The largest opening [m]."""
        return float(self.width[0])

    @property
    def narrowest(self) -> float:
        """The smallest opening [m]."""
        return float(self.width[-1])

    def at(self, intensity: float) -> float:
        """Return the opening at an intensity [m]; beyond the table, that at its end."""
        return float(np.interp(intensity, self.intensity, self.width))

    def intensity_at(self, width: float) -> float:
        """Return the intensity of an opening [m]; beyond the table, that at its end."""
        # np.interp needs rising abscissae, and the width falls.
        return float(np.interp(-width, -self.width, self.intensity))

    def levers_at(self, intensity: float) -> dict[str, float]:
        """Return the levers of the actuators [m/rad | 1] at an intensity."""
        columns = (np.interp(intensity, self.intensity, column) for column in self.lever.T)
        return dict(zip(self.actuators, map(float, columns), strict=True))

    def angle_at(self, intensity: float) -> float:
        """Return how squarely the tips move towards each other at an intensity [rad]."""
        return float(np.interp(intensity, self.intensity, self.angle))

    def strongest(self, hand: Hand, intensity: float) -> float:
        """Return the force that the effort limits allow at an intensity [N], by virtual work.

        Args:
            hand: The hand.
            intensity: The intensity.
        """
        levers = {name: abs(lever) for name, lever in self.levers_at(intensity).items()}
        most = max(levers.values())
        # A lever is the effort that one newton takes: the weakest actuator limits the force.
        forces = [
            hand.actuator(name).effort / lever
            for name, lever in levers.items()
            if lever > _TAKES_PART * most
        ]
        return min(forces, default=0.0)

    def corrected(self, pairs: Iterable[tuple[float, float]]) -> Opening:
        """Return the table with what was measured on the real hand.

        Between two measured pairs the difference from the model is interpolated; beyond them it is
        that of the nearest pair. Points at which the corrected table would not fall are left out.

        Args:
            pairs: Intensities and the openings measured there [m].

        Raises:
            ActionError: if the corrected table does not fall anywhere.
        """
        measured = sorted(pairs)
        if not measured:
            return self
        at = [pair[0] for pair in measured]
        off = [width - self.at(intensity) for intensity, width in measured]
        # The measured intensities become points of the table, so that it is exact there.
        grid = np.unique(np.concatenate([self.intensity, at]))
        grid = grid[(grid >= self.intensity[0]) & (grid <= self.intensity[-1])]
        width = np.interp(grid, self.intensity, self.width) + np.interp(grid, at, off)
        keep = [0]
        for i in range(1, len(grid)):
            # Only a falling table has one intensity for each width, and no width is below 0.
            if width[i] < width[keep[-1]] and width[keep[-1]] > 0.0:
                keep.append(i)
        # A single point has no way from it to another opening.
        if len(keep) < 2:
            raise ActionError(
                f"the openings of {self.label} measured in hand.yaml do not fall with its "
                "intensity; mend or delete them there: each is [intensity, opening in metres]"
            )
        lever = np.array([np.interp(grid[keep], self.intensity, c) for c in self.lever.T]).T
        return Opening(
            self.action,
            self.elements,
            self.posture,
            self.sides,
            self.actuators,
            readonly(grid[keep]),
            readonly(np.maximum(width[keep], 0.0)),
            readonly(lever.reshape(len(keep), -1)),
            readonly(np.interp(grid[keep], self.intensity, self.angle)),
            self.note,
        )


def doubtful(action: Action) -> bool:
    """Return whether links collide at a primitive's posture, or its tips would not hold a ball."""
    if not (isinstance(action, Primitive) and action.evidence):
        return False
    evidence = action.evidence[0]
    opposed = evidence.opposition is None or evidence.opposition.force_closure
    return not (evidence.clear and opposed)


def suitability(
    hand: Hand, action: Action, opening: Opening, width: float, margin: float = MARGIN
) -> tuple[float, ...]:
    """Return how well an action suits an object of a width [m]; the least suits best.

    What was found clear and in force closure comes first; then where the hand opens by the whole
    margin; then, in coarse classes, the strongest force in the direction in which the tips are to
    press; then the tips that meet the object most squarely; then the fewest actuators.

    Args:
        hand: The hand.
        action: The action.
        opening: Its opening.
        width: The width [m], inside of the opening's range.
        margin: How much wider the hand is to open before it closes [m].
    """
    at = opening.intensity_at(width)
    angle = opening.angle_at(at)
    # A tip that moves at more than a right angle to the line of closing does not press.
    force = opening.strongest(hand, at) * math.cos(min(angle, math.pi / 2.0))
    force = min(max(force, _WEAKEST), 1.0 / _WEAKEST)
    # A logarithm, so that a class is a ratio of forces, whatever their size.
    strength = math.log(force) / math.log(_STRONGER)
    return (
        doubtful(action),
        width + margin > opening.widest,
        -round(strength),
        round(angle / _SQUARE),
        len(opening.actuators),
    )


def fingerprint_of(hand: Hand, action: Action) -> str:
    """Return a word that changes with the way of an action: its posture, or the hand's rest."""
    digest = hashlib.sha256()
    for name, rest in zip(hand.actuator_names, hand.rest.tolist(), strict=True):
        # To the decimals that files keep: what is read again has the same fingerprint.
        digest.update(f"{name} {rest:.9f}\n".encode())
    for posture in action.waypoints:
        for name in posture.involved:
            digest.update(f"{name} {posture.position[name]:.9f}\n".encode())
    return digest.hexdigest()[:_WORD]


def model_of(hand: Hand) -> str:
    """Return a word that changes with the hand's URDF."""
    return hashlib.sha256(hand.urdf.text.encode()).hexdigest()[:_WORD]


@dataclass(frozen=True)
class Openings:
    """The openings of a hand's actions.

    Attributes:
        hand: The hand.
        tables: The tables as they are stored.
        made: Whether there are tables at all.
        outdated: Whether they were made for another model of the hand.
    """

    hand: Hand
    tables: tuple[Opening, ...] = ()
    made: bool = True
    outdated: bool = False

    @cached_property
    def _by_key(self) -> dict[tuple[str, frozenset[str]], Opening]:
        return {_key(table.action, table.elements): table for table in self.tables}

    def of(self, action: Action) -> Opening:
        """Return the opening of an action, corrected by what hand.yaml says was measured.

        Raises:
            ActionError: if it has none, or none that is up to date; the message says what to do.
        """
        name = label(action.name, action.elements)
        if isinstance(action, Timed):
            raise ActionError(f"{name} is a timed action, which has no opening")
        remedy = f"`rtee openings {self.hand.name} --save` makes the tables"
        if not self.made:
            raise ActionError(f"the openings of '{self.hand.name}' are not known; {remedy}")
        found = self._by_key.get(_key(action.name, action.elements))
        if self.outdated:
            raise ActionError(
                f"the openings of '{self.hand.name}' were made for another model of it; {remedy}"
            )
        if found is None:
            raise ActionError(
                f"{name} has no opening: no two fingertips oppose each other on its way, or it is "
                f"newer than the tables; {remedy}"
            )
        if found.posture != fingerprint_of(self.hand, action):
            raise ActionError(f"the opening of {name} was made for another posture; {remedy}")
        return found.corrected(self.measured(action))

    def measured(self, action: Action) -> tuple[tuple[float, float], ...]:
        """Return the pairs of intensity and opening [m] that hand.yaml has for an action."""
        wanted = _key(action.name, action.elements)
        for words, pairs in self.hand.openings.items():
            name, *elements = words.split()
            if _key(name, tuple(elements)) == wanted:
                return pairs
        return ()


def _key(action: str, elements: tuple[str, ...]) -> tuple[str, frozenset[str]]:
    return normalise(action), frozenset(elements)


# --- the file --------------------------------------------------------------------------------


def to_document(hand: Hand, tables: Iterable[Opening]) -> dict[str, Any]:
    """Return tables as plain data; the same tables give the same data."""
    entries = [
        {
            "action": table.action,
            "elements": list(table.elements),
            "posture": table.posture,
            "sides": [list(side) for side in table.sides],
            **({"note": table.note} if table.note else {}),
            "actuators": list(table.actuators),
            "intensity": _rounded(table.intensity),
            "opening": _rounded(table.width),
            "lever": [_rounded(row) for row in table.lever],
            "angle": [round(float(a), 3) for a in table.angle],
        }
        for table in tables
    ]
    return {"format": FORMAT, "model": model_of(hand), "openings": entries}


def _rounded(values: FloatArray) -> list[float]:
    """Return numbers rounded to what matters: 1 µm, 1 µm/rad."""
    return [round(float(value), 6) for value in values]


def write_openings(folder: Path, hand: Hand, tables: Iterable[Opening]) -> Path:
    """Write the tables into a hand's folder; returns the file.

    Raises:
        ConfigError: if it cannot be written.
    """
    path = folder / FILE_NAME
    lines = (f"Openings of the actions, made by `rtee openings {hand.name} --save`.",)
    write_atomically(path, emit(to_document(hand, tables), lines))
    return path


def read_openings(folder: Path, hand: Hand) -> Openings:
    """Return the tables stored in a hand's folder.

    Raises:
        ConfigError: if the file holds something else.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        return Openings(hand, made=False)
    text = read_text(path, _WHAT)
    data = parse_yaml(text, path, _WHAT).data
    try:
        if data["format"] != FORMAT:
            raise ConfigError(
                f"has format {data['format']}, not {FORMAT}; "
                f"`rtee openings {hand.name} --save` makes it again",
                path=path,
            )
        tables = tuple(_table(entry) for entry in data["openings"])
        return Openings(hand, tables, outdated=data["model"] != model_of(hand))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(
            f"these are not openings ({error}); `rtee openings {hand.name} --save` makes them"
            " again",
            path=path,
        ) from error


def _table(entry: Mapping[str, Any]) -> Opening:
    """Return a table from plain data; raises `ValueError` and the like if it is none."""
    intensity, width = readonly(entry["intensity"]), readonly(entry["opening"])
    lever, angle = readonly(entry["lever"]), readonly(entry["angle"])
    actuators = tuple(str(name) for name in entry["actuators"])
    shaped = (
        len(intensity) >= 2
        and width.shape == angle.shape == intensity.shape
        and lever.shape == (len(intensity), len(actuators))
    )
    if not shaped or not all(map(math.isfinite, (*intensity, *width, *lever.ravel(), *angle))):
        raise ValueError(f"the columns of '{entry['action']}' do not fit each other")
    # Both are looked up by interpolation, which silently fails on what is not monotonic.
    if not (np.all(np.diff(intensity) > 0.0) and np.all(np.diff(width) < 0.0)):
        raise ValueError(f"the opening of '{entry['action']}' does not fall")
    return Opening(
        str(entry["action"]),
        tuple(str(name) for name in entry["elements"]),
        str(entry["posture"]),
        tuple(tuple(str(name) for name in side) for side in entry["sides"]),
        actuators,
        intensity,
        width,
        lever,
        angle,
        str(entry.get("note", "")),
    )
