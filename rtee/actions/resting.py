"""Detect a rest posture that is a pinch, from the stored primitives alone."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np

from rtee.actions.types import Primitive, PrimitiveKind
from rtee.hand.frames import tip_pose_and_jacobian
from rtee.hand.model import Hand
from rtee.hand.resting import APART, NEAR, OWN
from rtee.hand.yamlfile import rest_line
from rtee.sample import FloatArray

_HERE: Final = 0.1
"""Largest travel to a pinch that still counts as at rest, as a share of an actuator's range."""

_MEETING: Final = 0.02
"""Largest travel to the first contact, as a share of the range, at which tips touch at rest."""


def pinch_at_rest(hand: Hand, primitives: Iterable[Primitive]) -> str:
    """Return a sentence about a rest posture that is a pinch, with a remedy; otherwise ``""``.

    Needs no shapes. The rest posture is a pinch if a stored pinch of two fingers lies at it, its
    evidence says that the tips touch there or nearly do, and the motion that moves the tips
    farthest past each other is along the contact normal.
    """
    at_rest = (p for p in primitives if p.kind.pinch and _is_at_rest(hand, p))
    ways = [(p, _opened(hand, p)) for p in at_rest]
    closed = [p for p, way in ways if way]
    if not closed:
        return ""
    opened = {name: bound for _, way in ways for name, bound in way.items()}
    # The suggested line replaces the one in hand.yaml, so it repeats the rest positions given
    # there.
    given = {
        spec.name: opened.get(spec.name, spec.rest)
        for spec in hand.actuators
        if spec.name in opened or spec.rest != min(max(0.0, spec.lower), spec.upper)
    }
    pairs = ", ".join(" and ".join(f"'{element}'" for element in p.elements) for p in closed)
    return (
        f"the rest posture is a pinch: the tips of {pairs} touch or nearly do there, so "
        f"`rtee open` closes the hand; type into hand.yaml: {rest_line(given)} and extract again: "
        f"rtee extract {hand.name} --save"
    )


def _is_at_rest(hand: Hand, pinch: Primitive) -> bool:
    travel = max(_travel(hand, pinch).values(), default=0.0)
    if not pinch.evidence or travel > _HERE:
        return False
    evidence = pinch.evidence[0]
    if evidence.contact_at is None:
        return pinch.kind is PrimitiveKind.PINCH_LOOSE and evidence.distance <= NEAR
    return evidence.contact_at * travel <= _MEETING


def _travel(hand: Hand, pinch: Primitive) -> dict[str, float]:
    """Return the travel of the actuators from rest, as shares of their ranges."""
    specs = [hand.actuator(name) for name in pinch.posture.involved]
    return {
        spec.name: abs(pinch.posture.position[spec.name] - spec.rest) / (spec.upper - spec.lower)
        for spec in specs
    }


def _opened(hand: Hand, pinch: Primitive) -> dict[str, float]:
    """Return the limits that separate the tips of a pinch at rest, by actuator [rad | m].

    Empty if none does. Decides like `closed_rest` whether the tips oppose each other.
    """
    evidence = pinch.evidence[0]
    if evidence.point is None or evidence.normal is None:
        return {}
    past = _past(hand, pinch.fingers, np.array(evidence.point))
    spans = hand.upper - hand.lower
    spans = np.where(np.isfinite(spans), spans, 0.0)  # a continuous actuator has no limit
    own = {name for finger in pinch.fingers for name in hand.finger(finger).own}
    speeds = np.linalg.norm(past, axis=0)
    moved = speeds * spans
    parting = np.array(evidence.normal) @ past
    opposed = np.abs(parting) >= APART * speeds
    first = np.array([name in own for name in hand.actuator_names]) & (moved >= OWN * moved.max())
    farthest = int(np.argmax(np.where(first, moved, 0.0) if first.any() else moved))
    # If the largest motion slides the tips along each other, they lie side by side.
    if moved[farthest] == 0.0 or not opposed[farthest]:
        return {}
    bounds = {}
    for i, spec in enumerate(hand.actuators):
        bound = spec.upper if parting[i] > 0.0 else spec.lower
        if moved[i] > 0.0 and opposed[i] and abs(bound - spec.rest) > _HERE * spans[i]:
            bounds[spec.name] = bound
    return bounds


def _past(hand: Hand, fingers: Sequence[str], point: FloatArray) -> FloatArray:
    """Return how the second tip moves past the first, per unit of each actuator ``(3, n)``.

    At their contact point [m], in the base frame, and at rest.
    """
    velocities = []
    for name in fingers:
        tip = hand.finger(name).tip
        assert tip is not None  # noqa: S101 - a finger without a fingertip has no pinch
        pose, jacobian = tip_pose_and_jacobian(hand, tip, hand.rest)
        # Velocities at the point of contact instead of the frames' origins: v + ω x r.
        arm = point - pose[:3, 3]
        velocities.append(jacobian[:3] + np.cross(jacobian[3:], arm, axis=0))
    return velocities[1] - velocities[0]
