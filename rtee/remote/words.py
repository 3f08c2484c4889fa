"""The result of a goal as a sentence for people."""

from __future__ import annotations

from collections.abc import Sequence

from rtee.types import Result
from rtee.units import MAY_BE_NOTHING, grip_words


def sentence(result: Result, elements: Sequence[str] = ()) -> str:
    """Return the result of a goal with some elements as a sentence."""
    why = f": {result.reason}" if result.reason else ""
    ends = [
        words
        for true, words in (
            (result.reached, "reached"),
            (result.grasped, "grasped" + _by(result.grasped_fingers)),
            (bool(result.touched) and not result.grasped, "touched" + _by(result.touched)),
            (result.unknown, MAY_BE_NOTHING),
            (
                result.stalled and not (result.grasped or result.touched or result.unknown),
                "stalled",
            ),
            (result.preempted, "pre-empted by another goal"),
            (result.cancelled, f"cancelled{why}"),
            (result.timed_out, "timed out"),
            (result.aborted, f"aborted{why}"),
        )
        if true
    ]
    how = ", ".join(ends) or "ended"
    name = " ".join((result.action, *elements))
    if result.opening is not None:
        how += f" at {grip_words(result)}"
    return f"{name}: {how} (error {result.error:.3g}, {result.duration:.2f} s)"


def _by(fingers: tuple[str, ...]) -> str:
    return f" by {', '.join(fingers)}" if fingers else ""
