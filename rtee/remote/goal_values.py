"""The values of a goal's options as people write them: checked and translated."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, Final, SupportsFloat

from rtee.errors import GoalRejected, suggestion
from rtee.types import OnContact
from rtee.units import FORCE, LENGTH, SPEED

QUANTITIES: Final[Mapping[str, tuple[Mapping[str, float], str]]] = {
    "opening": (LENGTH, "opening"),
    "force": (FORCE, "force"),
    "tip_speed": (SPEED, "speed"),
    "max_force": (FORCE, "largest force"),
}
"""Units and names, for people, of the options that may have units."""

_NUMBERS: Final = ("intensity", "tolerance", "speed", "timeout")
"""Options that are plain numbers."""


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
    for name in _NUMBERS:
        value = options.get(name, 0.0)
        if not (isinstance(value, SupportsFloat) or (value is None and name == "timeout")):
            unit = " of seconds" if name == "timeout" else ""
            raise GoalRejected(f"the {name} must be a number{unit}, not {value!r:.100}")
    effort = options.get("effort", {})
    efforts = effort.values() if isinstance(effort, Mapping) else [effort]
    if not all(isinstance(value, SupportsFloat) for value in efforts):
        raise GoalRejected(
            "the effort must be a share of all limits, such as 0.4, or a number for each "
            f"actuator, not {effort!r:.100}"
        )


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
