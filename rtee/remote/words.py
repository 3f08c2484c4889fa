"""The result of a goal in words for people."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from rtee.types import Aim, Outcome, Result
from rtee.units import grip_words

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
    return words if result.opening is None else f"{words} at {grip_words(result)}"


def sentence(result: Result, elements: Sequence[str] = ()) -> str:
    """Describe the result of a goal, and the elements of its action, in a sentence."""
    name = " ".join((result.action, *elements))
    return f"{name}: {ending(result)} (error {result.error:.3g}, {result.duration:.2f} s)"


def _by(fingers: tuple[str, ...]) -> str:
    return f" by {', '.join(fingers)}" if fingers else ""
