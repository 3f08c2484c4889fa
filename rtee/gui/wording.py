"""How things are said in the GUI: results, uses of actions, small print."""

from __future__ import annotations

from rtee.actions.types import ActionReference
from rtee.gui.colours import BAD, GOOD, WARN
from rtee.types import Result


def said(result: Result) -> tuple[str, str]:
    """Return how a goal ended, in words, and the colour that goes with it."""
    if result.grasped:
        return f"grasped with {', '.join(result.grasped_fingers) or 'the hand'}", GOOD
    if result.reached:
        return "reached", GOOD
    for ended, words in (
        (result.preempted, "replaced by another goal"),
        (result.cancelled, "cancelled"),
        (result.timed_out, "timed out"),
        (result.stalled, "stalled"),
    ):
        if ended:
            return words, WARN
    return f"aborted: {result.reason}", BAD


def described(use: ActionReference) -> str:
    """Return a use of an action as people write it: ``Trig thumb × 0.3``."""
    name = " ".join((use.action, *use.elements))
    return name if use.scale == 1.0 else f"{name} × {use.scale:g}"


def small(html: str) -> str:
    """Return HTML in small print."""
    return f'<div style="font-size:0.8em;padding:0 0.75em">{html}</div>'
