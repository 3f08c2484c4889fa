"""What a Trig does besides bending its finger."""

from __future__ import annotations

from rtee.actions.types import Action, Primitive, PrimitiveKind
from rtee.hand.abduction import abduction
from rtee.hand.model import Hand


def sideways(hand: Hand, action: Action) -> tuple[str, ...]:
    """Return the actuators by which a Trig also swings its finger sideways; none of other actions.

    A Trig moves all that moves its finger only, so abduction, too.
    """
    if not isinstance(action, Primitive) or action.kind is not PrimitiveKind.TRIG:
        return ()
    found = dict.fromkeys(a for name in action.fingers for a in abduction(hand, hand.finger(name)))
    return tuple(name for name in found if name in action.posture.involved)


def sideways_words(hand: Hand, action: Action, prefix: str = "") -> str:
    """Return in words how a Trig swings its finger sideways; nothing where it does not.

    Args:
        hand: The hand.
        action: Any action.
        prefix: What to leave out where names of actuators begin with it.
    """
    names = [name.removeprefix(prefix) for name in sideways(hand, action)]
    return f"also swings sideways (abduction): {', '.join(names)}" if names else ""
