"""The values of a goal's options as people write them: checked and translated."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Final, SupportsFloat

from rtee.errors import GoalRejected, suggestion
from rtee.types import OnContact
from rtee.units import FORCE, LENGTH, SHARE, SPEED, TIME, quantity

QUANTITIES: Final[Mapping[str, tuple[Mapping[str, float], str]]] = {
    "intensity": (SHARE, "intensity"),
    "speed": (SHARE, "speed"),
    "opening": (LENGTH, "opening"),
    "force": (FORCE, "force"),
    "tip_speed": (SPEED, "speed"),
    "max_force": (FORCE, "largest force"),
    "timeout": (TIME, "timeout"),
}
"""Units and names, for people, of the options that may have units."""

_ALWAYS: Final = ("intensity", "speed")
"""Those of them that every goal has: ``None`` is no value of theirs."""


def finite(value: object, what: str) -> float:
    """Return a finite number; raises `GoalRejected` for anything else."""
    try:
        number = float(value) if isinstance(value, SupportsFloat) else math.nan
    except (TypeError, ValueError):  # such as an array of several numbers
        number = math.nan
    if not math.isfinite(number):
        raise GoalRejected(f"the {what} must be a finite number, not {value!r:.100}")
    return number


def numbers(values: object, what: str) -> dict[str, float]:
    """Return numbers by name; raises `GoalRejected` for anything else, naming what is wrong."""
    if not isinstance(values, Mapping):
        raise GoalRejected(
            f"each {what} is given by its name, as {{'thumb': 0.4}}, not {values!r:.100}"
        )
    if wrong := [name for name in values if not isinstance(name, str)]:
        raise GoalRejected(f"each {what} is given by its name, a text, not {wrong[0]!r:.100}")
    return {name: finite(value, f"{what} '{name}'") for name, value in values.items()}


def check_types(
    action: str, elements: Sequence[str], options: Mapping[str, Any], known: Collection[str]
) -> None:
    """Raise `GoalRejected` for what a message cannot carry: a text as a number, a list as a name.

    Values are for the hand to check, which knows its actions and limits; names of options must be
    known.
    """
    for name in (action, *elements):
        if not isinstance(name, str):
            raise GoalRejected(
                f"an action and its elements are names, one argument each, not {name!r:.100}"
            )
    if unknown := [name for name in options if name not in known]:
        raise GoalRejected(
            f"unknown option '{unknown[0]}' of a goal; {suggestion(unknown[0], known)}"
        )
    tolerance = options.get("tolerance", 0.0)
    if not isinstance(tolerance, SupportsFloat):
        raise GoalRejected(f"the tolerance must be a number, not {tolerance!r:.100}")
    effort = options.get("effort", {})
    efforts = effort.values() if isinstance(effort, Mapping) else [effort]
    if not all(isinstance(value, SupportsFloat) for value in efforts):
        raise GoalRejected(
            "the effort must be a share of all limits, such as 0.4, or a number for each "
            f"actuator, not {effort!r:.100}"
        )


def names(fingers: Sequence[str] | None) -> tuple[str, ...]:
    """Return the names of fingers; raises `GoalRejected` for a single text, a list of letters."""
    if isinstance(fingers, str):
        raise GoalRejected(f"the fingers are a list of names, such as [{fingers!r:.100}]")
    return tuple(fingers or ())


def tolerances(pair: tuple[float | str, float | str]) -> tuple[float, float]:
    """Return how much narrower and wider a width may be [m]; raises `GoalRejected`."""
    if isinstance(pair, str) or not isinstance(pair, Sequence) or len(pair) != 2:
        raise GoalRejected(
            f"the tolerance is two lengths, narrower and wider, such as ('5mm', '5mm'), "
            f"not {pair!r:.100}"
        )
    return quantity(pair[0], LENGTH, "tolerance"), quantity(pair[1], LENGTH, "tolerance")


def sizes(options: Mapping[str, Any]) -> dict[str, float]:
    """Return the quantities among the options in SI units; raises `GoalRejected`.

    Whether a number is possible is for the hand to say, which knows what is.
    """
    given = {
        option: options[option]
        for option in QUANTITIES
        if option in options and (options[option] is not None or option in _ALWAYS)
    }
    return {
        option: float(value)
        if isinstance(value, SupportsFloat)
        else quantity(value, *QUANTITIES[option])
        for option, value in given.items()
    }


def reactions(given: Mapping[str, OnContact | str] | OnContact | str) -> dict[str, OnContact]:
    """Return the reactions to contacts by finger; raises `GoalRejected` for unknown ones."""
    words = given if isinstance(given, Mapping) else {"": given}
    try:
        return {finger: OnContact(word) for finger, word in words.items()}
    except ValueError:
        wrong = next(word for word in words.values() if word not in list(OnContact))
        raise GoalRejected(
            f"unknown on_contact '{wrong}'; {suggestion(str(wrong), OnContact)}"
        ) from None
