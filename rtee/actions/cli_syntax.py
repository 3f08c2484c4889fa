"""Syntax of actions on the command line.

::

    trig:index            an action with its elements
    pinchTight:index,thumb*0.5       scaled
    grasp:before=0.5,after=0.2,alias=close       with margins [s] and a name, in a timed action
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rtee.actions.build import StepPlan
from rtee.actions.types import ActionReference
from rtee.errors import ActionError


def read_step(word: str) -> StepPlan:
    """Read ``ACTION[:ELEMENT…][*SCALE][:before=SECONDS,after=SECONDS,alias=NAME]``.

    Raises:
        ActionError: if the word has another form.
    """
    # From the end, since elements follow a colon, too, but have no equals sign.
    body, colon, options = word.rpartition(":")
    if not colon or "=" not in options:
        return StepPlan(ActionReference.of(word))
    # A scale after the options belongs to the action, too.
    options, star, factor = options.partition("*")
    alias, margins = "", {"before": 0.0, "after": 0.0}
    for option in options.split(","):
        key, _, value = option.partition("=")
        if key == "alias" and value:
            alias = value
        elif key in margins:
            margins[key] = _number(value, key, word)
        else:
            raise ActionError(
                f"'{option}' in '{word}' is not a margin; write before=SECONDS, after=SECONDS "
                "and alias=NAME"
            )
    return StepPlan(ActionReference.of(body + star + factor), alias, **margins)


def read_set_points(words: Sequence[str]) -> dict[str, float]:
    """Read ``ACTUATOR=VALUE`` words [rad | m].

    Raises:
        ActionError: if a word has another form, or an actuator is given twice.
    """
    set_points: dict[str, float] = {}
    for word in words:
        name, equals, value = word.rpartition("=")
        if not equals or not name:
            raise ActionError(f"'{word}' is not a set-point; write ACTUATOR=VALUE")
        if name in set_points:
            raise ActionError(f"the actuator '{name}' is given twice")
        set_points[name] = _number(value, f"set-point of '{name}'", word)
    return set_points


@dataclass(frozen=True)
class Efforts:
    """Effort limits given on the command line.

    Attributes:
        share: Share of the limits of all actuators that are not named, above 0 up to 1; ``None``:
            the full limits.
        shares: Shares of the limits by actuator.
        limits: Limits by actuator [N·m | N].
    """

    share: float | None
    shares: Mapping[str, float]
    limits: Mapping[str, float]


def read_efforts(words: Sequence[str]) -> Efforts:
    """Read ``PERCENT%``, ``ACTUATOR=PERCENT%`` and ``ACTUATOR=VALUE`` words [N·m | N].

    Raises:
        ActionError: if a word has another form, or an actuator (or all of them) is given twice.
    """
    share: float | None = None
    shares: dict[str, float] = {}
    limits: dict[str, float] = {}
    for word in words:
        name, equals, value = word.rpartition("=")
        percent = value.endswith("%")
        if bool(name) != bool(equals) or not (name or percent):
            raise ActionError(
                f"'{word}' is not an effort limit; write PERCENT% for all actuators, "
                "ACTUATOR=PERCENT% or ACTUATOR=VALUE for one"
            )
        if name in shares or name in limits:
            raise ActionError(f"the actuator '{name}' is given twice")
        number = _number(value.removesuffix("%").rstrip(), "effort limit", word)
        if percent and not 0.0 < number <= 100.0:
            raise ActionError(f"the effort in '{word}' must be above 0 % and at most 100 %")
        if name:
            (shares if percent else limits)[name] = number / 100.0 if percent else number
        elif share is not None:
            raise ActionError(f"the effort of all actuators is given twice: '{word}'")
        else:
            share = number / 100.0
    return Efforts(share, shares, limits)


def _number(text: str, what: str, word: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ActionError(f"the {what} in '{word}' must be a number, not '{text}'") from None


def read_on_contact(texts: Sequence[str]) -> dict[str, Any]:
    """Return reactions to contact by finger, from texts such as ``hold`` or ``thumb=stop``.

    A text without a finger gets the name ``""`` and applies to all other fingers. The goal checks
    the words.
    """
    split = [text.rpartition("=") for text in texts]
    return {finger.strip(): word.strip() for finger, _, word in split}
