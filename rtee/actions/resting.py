"""A rest posture that is a pinch, told from the stored primitives alone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final

from rtee.actions.types import Primitive, PrimitiveKind
from rtee.hand.lines import rest_line
from rtee.hand.model import Hand

_PINCHES: Final = (PrimitiveKind.PINCH_TIGHT, PrimitiveKind.PINCH_LOOSE)

_NEAR: Final = 0.002
"""Tips nearer than this nearly touch [m]."""

_HERE: Final = 0.1
"""A pinch is at rest if no actuator travels farther than this share of its range to it."""

_MEETING: Final = 0.02
"""Tips meet at once if no actuator has travelled this share of its range at the first contact."""

_END: Final = 0.25
"""An actuator rests at an end of its range within this share of it."""


def pinch_at_rest(hand: Hand, primitives: Iterable[Primitive]) -> str:
    """Return what is wrong with a rest posture that is a pinch, and what to type; else nothing.

    No geometry is needed: a stored pinch of two fingers lies at the rest posture itself, and its
    evidence says that the tips meet there, or nearly do. Where all actuators that take part rest in
    the middle of their range, no way out can be told.

    Args:
        hand: The hand.
        primitives: Its stored primitives.
    """
    closed = [p for p in primitives if p.kind in _PINCHES and _is_at_rest(hand, p)]
    opened: dict[str, float] = {}
    for primitive in closed:
        opened |= _opened(hand, primitive)
    if not opened:
        return ""
    given = {
        spec.name: opened.get(spec.name, spec.rest)
        for spec in hand.actuators
        if spec.name in opened or spec.rest != min(max(0.0, spec.lower), spec.upper)
    }
    pairs = ", ".join(" and ".join(f"'{element}'" for element in p.elements) for p in closed)
    return (
        f"the rest posture is a pinch: the tips of {pairs} touch or nearly do there, so that "
        f"opening closes; type into hand.yaml: {rest_line(given)} and extract again: "
        f"rtee extract {hand.name} --save"
    )


def _is_at_rest(hand: Hand, pinch: Primitive) -> bool:
    travel = max(_travel(hand, pinch).values(), default=0.0)
    if not pinch.evidence or travel > _HERE:
        return False
    evidence = pinch.evidence[0]
    if evidence.contact_at is None:
        return pinch.kind is PrimitiveKind.PINCH_LOOSE and evidence.distance <= _NEAR
    return evidence.contact_at * travel <= _MEETING


def _travel(hand: Hand, pinch: Primitive) -> Mapping[str, float]:
    """Return how far the actuators travel from rest, as shares of their ranges."""
    specs = [hand.actuator(name) for name in pinch.posture.involved]
    return {
        spec.name: abs(pinch.posture.position[spec.name] - spec.rest) / (spec.upper - spec.lower)
        for spec in specs
    }


def _opened(hand: Hand, pinch: Primitive) -> dict[str, float]:
    """Return the other ends of the ranges of the actuators that rest at one [rad | m]."""
    found = {}
    for name in pinch.posture.involved:
        spec = hand.actuator(name)
        span = spec.upper - spec.lower
        if spec.rest - spec.lower <= _END * span:
            found[name] = spec.upper
        elif spec.upper - spec.rest <= _END * span:
            found[name] = spec.lower
    return found
