"""The result of a goal in words for people."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from rtee.types import Aim, Outcome, Result, Shortfall

_CLOSED: Final = "closed on something thin or on nothing (unknown which)"

_WORDS: Final = {
    Outcome.HELD: "held",
    Outcome.WRONG_WIDTH: "something of another width is held",
    Outcome.UNKNOWN: _CLOSED,
    Outcome.CLOSED: _CLOSED,
    Outcome.TOUCHED: "touched",
    Outcome.REACHED: "reached",
    Outcome.STALLED: "stalled",
    Outcome.PREEMPTED: "pre-empted by another goal",
    Outcome.CANCELLED: "cancelled",
    Outcome.TIMED_OUT: "timed out",
    Outcome.ABORTED: "aborted",
}

_WHY_LESS: Final = {
    Shortfall.END_OF_MOTION: "the fingers are at the end of their motion",
    Shortfall.EFFORT_LIMIT: "the actuators are at their effort limits",
    Shortfall.UNKNOWN: "it is not known why it is less",
}
"""Why a force is less than the requested one, in words."""


def ending(result: Result) -> str:
    """Return the outcome of a goal in words: fingers, reason, opening and force."""
    outcome = result.outcome
    if outcome is Outcome.EMPTY:
        words = "nothing was touched" if result.aim is Aim.CONTACT else "nothing is held"
    else:
        words = _WORDS[outcome]
    if outcome in (Outcome.HELD, Outcome.WRONG_WIDTH):
        words += _by(result.grasped_fingers)
    elif outcome is Outcome.TOUCHED:
        words += _by(result.touched)
    elif result.grasped:
        words += ", held" + _by(result.grasped_fingers)
    if result.reason:
        words += f": {result.reason}"
    return words + _grip(result)


def sentence(result: Result, elements: Sequence[str] = ()) -> str:
    """Describe the result of a goal, and the elements of its action, in a sentence."""
    name = " ".join((result.action, *elements))
    return f"{name}: {ending(result)} (error {result.error:.3g}, {result.duration:.2f} s)"


def _grip(result: Result) -> str:
    """Return the opening of a result in words, and the force on what is held; with errors.

    Both are left out where they are not known. A force that is less than the requested one is
    compared with it.
    """
    words = ""
    if result.opening is not None:
        words += f" at {1e3 * result.opening:.1f}"
        if result.grasped and result.opening_error is not None:
            words += f" ± {1e3 * result.opening_error:.1f}"
        words += " mm"
    if result.force is not None and result.grasped:
        error = 0.0 if result.force_error is None else result.force_error
        words += f" with {result.force:.1f} ± {error:.1f} N"
        words += f"{asked(result)}, by the {result.force_source}"
        if result.shortfall:
            words += f": {_WHY_LESS[result.shortfall]}"
    return words


def asked(result: Result) -> str:
    """Return the force that was asked for, if the one on what is held is less."""
    less = result.shortfall and result.force_asked is not None
    return f" of {result.force_asked:.1f} N asked" if less else ""


def _by(fingers: tuple[str, ...]) -> str:
    return f" by {', '.join(fingers)}" if fingers else ""
