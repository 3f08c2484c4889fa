"""Actions as words of a command line.

::

    trig:index            an action with its elements
    pinchTight:index,thumb*0.5       scaled
    grasp:before=0.5,after=0.2,alias=close       with margins [s] and a name, in a timed action
"""

from __future__ import annotations

from collections.abc import Sequence

from rtee.actions.build import StepPlan
from rtee.actions.types import ActionReference
from rtee.errors import ActionError


def read_use(word: str) -> ActionReference:
    """Read ``ACTION[:ELEMENT[,ELEMENT…]][*SCALE]``.

    Raises:
        ActionError: if the word is not like that.
    """
    body, star, factor = word.partition("*")
    scale = _number(factor, "scale", word) if star else 1.0
    name, colon, rest = body.partition(":")
    elements = tuple(rest.split(",")) if colon else ()
    if not name or not all(elements):
        raise ActionError(
            f"'{word}' is no action; it is written ACTION, ACTION:ELEMENT or "
            "ACTION:ELEMENT,ELEMENT*SCALE"
        )
    return ActionReference(name, elements, scale)


def read_step(word: str) -> StepPlan:
    """Read ``ACTION[:ELEMENT…][*SCALE][:before=SECONDS,after=SECONDS,alias=NAME]``.

    Raises:
        ActionError: if the word is not like that.
    """
    body, colon, options = word.rpartition(":")
    if not colon or "=" not in options:
        return StepPlan(read_use(word))
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
                f"'{option}' in '{word}' is no margin; there are before=SECONDS, after=SECONDS "
                "and alias=NAME"
            )
    return StepPlan(read_use(body + star + factor), alias, **margins)


def read_set_points(words: Sequence[str]) -> dict[str, float]:
    """Read ``ACTUATOR=VALUE`` words [rad | m].

    Raises:
        ActionError: if a word is not like that, or an actuator is given twice.
    """
    found: dict[str, float] = {}
    for word in words:
        name, equals, value = word.rpartition("=")
        if not equals or not name:
            raise ActionError(f"'{word}' is no set-point; it is written ACTUATOR=VALUE")
        if name in found:
            raise ActionError(f"the actuator '{name}' is given twice")
        found[name] = _number(value, f"set-point of '{name}'", word)
    return found


def _number(text: str, what: str, word: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ActionError(f"the {what} in '{word}' must be a number, not '{text}'") from None
