"""Abduction in a Trig, in addition to the flexion of its finger."""

from __future__ import annotations

from rtee.actions.types import Action, Primitive, PrimitiveKind
from rtee.hand.abduction import abduction
from rtee.hand.model import Hand


def abduction_actuators(hand: Hand, action: Action) -> tuple[str, ...]:
    """Return the abduction actuators of a Trig; none of other actions.

    A Trig moves all actuators that move only its finger, including abduction.
    """
    if not isinstance(action, Primitive) or action.kind is not PrimitiveKind.TRIG:
        return ()
    swinging = dict.fromkeys(
        a for name in action.fingers for a in abduction(hand, hand.finger(name))
    )
    return tuple(name for name in swinging if name in action.posture.involved)


def abduction_sentence(hand: Hand, action: Action, prefix: str = "") -> str:
    """Return a sentence about a Trig's abduction, without a prefix of names, or ``""``."""
    names = [name.removeprefix(prefix) for name in abduction_actuators(hand, action)]
    return f"also swings sideways (abduction): {', '.join(names)}" if names else ""
