"""Trials and their results; needs no simulator."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from rtee.errors import ConfigError
from rtee.values import number

OBJECTS: Final = (
    "sphere:0.01",
    "sphere:0.02",
    "sphere:0.03",
    "sphere:0.04",
    "sphere:0.05",
    "cylinder:0.01x0.12",
    "cylinder:0.02x0.12",
    "cylinder:0.035x0.12",
    "box:0.02x0.02x0.1",
    "box:0.04x0.04x0.1",
    "box:0.06x0.06x0.1",
    "drill",
)
"""The standard objects: spheres of 20 to 100 mm, cylinders, boxes, and a drill-like body."""

_MASS: Final = 0.1  # mass of a standard object [kg]: a full yoghurt pot
_DRILL_MASS: Final = 0.4  # mass of the drill-like body [kg]: half of a small cordless one


CHOOSING: Final = 10
"""Default number of tries to choose a place: their rate is accurate to about 10 %."""


_RANGES: Final = (
    ("intensity", 0.0, 1.0),
    ("mass", 1e-6, 100.0),  # [kg]: a milligram
    ("places", 1, math.inf),
    ("friction", 0.0, math.inf),
    ("variations", 0, math.inf),
    ("seed", 0, math.inf),
    ("choosing", 0, math.inf),
    ("wanted", 0.0, 1.0),
)
"""The numbers of a trial, with their least and largest value; a least one without a decimal point
belongs to a whole number."""

_OPTIONAL: Final = ("friction", "wanted")
"""Those that may be ``None``."""


def mass_of(shape: str) -> float:
    """Return the mass of a standard object [kg]."""
    return _DRILL_MASS if shape == "drill" else _MASS


@dataclass(frozen=True, slots=True)
class Trial:
    """Definition of a trial.

    Attributes:
        action: Name of the action.
        elements: Its elements.
        object: The object, as on the command line.
        intensity: How far the action goes.
        mass: Mass of the object [kg].
        places: How many places are tried at most.
        friction: Friction between hand and object; ``None``: that of the simulation.
        variations: How often it is tried with variations of object, place and friction.
        seed: Seed of the variations.
        choosing: Number of tries with variation by which a place is chosen.
        wanted: The rate of success that is asked for: variations are left out once the interval of
            the rate lies to one side of it; ``None``: all are tried.

    Raises:
        ConfigError: if a number is out of its range, or a whole one is not whole.
    """

    action: str
    elements: tuple[str, ...] = ()
    object: str = "sphere:0.03"
    intensity: float = 1.0
    mass: float = 0.1
    places: int = 5
    friction: float | None = None
    variations: int = 0
    seed: int = 0
    choosing: int = CHOOSING
    wanted: float | None = None

    def __post_init__(self) -> None:
        for name, least, most in _RANGES:
            value, whole = getattr(self, name), isinstance(least, int)
            if value is None and name in _OPTIONAL:
                continue
            plain = number(value)
            if plain is None or not least <= plain <= most:
                limits = f"from {least:g} to {most:g}" if most < math.inf else f"at least {least:g}"
                raise ConfigError(f"the {name} of a trial must be {limits}, not {value!r:.100}")
            if whole and not plain.is_integer():
                raise ConfigError(f"the {name} of a trial must be whole, not {value!r:.100}")
            # A trial is sent to other processes as JSON, which has no numbers of NumPy.
            object.__setattr__(self, name, int(value) if whole else plain)

    @property
    def what(self) -> str:
        """Name and elements of the action."""
        return " ".join((self.action, *self.elements))

    @property
    def key(self) -> str:
        """Key that is unique among all trials of the hand."""
        return f"{self.what} @ {self.object}"


@dataclass(frozen=True, slots=True)
class TrialResult:
    """Result of a trial.

    Attributes:
        trial: The trial.
        held: Whether the object was lifted, held and shaken and is where it was in the hand, within
            5 mm and 10 degrees, and the hand has not reported a loss.
        reason: Why not, in words; empty if it was held.
        outcome: How the goal ended: ``grasped``, ``reached`` and so on; empty if it never began.
        slip: How far the object moved in the hand from the grasp to the end [m].
        forces: Contact force per finger after the grasp [N].
        peak: The largest contact force on a finger while it was lifted and shaken [N].
        duration: Simulated time of the trial [s].
        places: How many places were tried.
        position: Where the object was put in the hand's base frame [m].
        survived: Number of the trial's variations in which it was held, too; an object that is lost
            without variation is not varied, and counts as lost in all of them.
        fits: Whether the object is neither too wide nor too heavy for the hand.
        left: How many variations were left out, since the others had decided.
    """

    trial: Trial
    held: bool
    reason: str = ""
    outcome: str = ""
    slip: float = 0.0
    forces: tuple[tuple[str, float], ...] = ()
    peak: float = 0.0
    duration: float = 0.0
    places: int = 0
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    survived: int = 0
    fits: bool = True
    left: int = 0

    @property
    def tries(self) -> int:
        """How many variations were tried."""
        return self.trial.variations - self.left
