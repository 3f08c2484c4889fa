"""Primitives that follow from kinematics alone: Trig, TipFlex, FingFlex and single joints."""

from __future__ import annotations

import math

from rtee.actions.types import Posture, Primitive, PrimitiveKind
from rtee.hand.abduction import abduction
from rtee.hand.model import Hand


def kinematic_primitives(hand: Hand) -> list[Primitive]:
    """Return the primitives that need no geometry.

    Leave out continuous actuators, which have no bound to move to, and fingers without a fingertip.
    FingFlex uses an actuator that bends the finger, not one that swings it sideways.
    """
    primitives: list[Primitive] = []
    bounded = {
        finger.name: tuple(n for n in finger.own if _has_bounds(hand, hand.actuator_index(n)))
        for finger in hand.fingers
        if finger.tip
    }
    for name, own in bounded.items():
        if own:
            primitives.append(_flex(hand, PrimitiveKind.TRIG, name, own))
    several = {name: own for name, own in bounded.items() if len(own) >= 2}
    for name, own in several.items():
        primitives.append(_flex(hand, PrimitiveKind.TIP_FLEX, name, own[-1:]))
    for name, own in several.items():
        sideways = abduction(hand, hand.finger(name))
        # If the innermost actuator swings the finger sideways, the next one bends it.
        first = next((a for a in own if a not in sideways), own[0])
        primitives.append(_flex(hand, PrimitiveKind.FING_FLEX, name, (first,)))
    primitives += [
        _single_joint(hand, i)
        for i, actuator in enumerate(hand.actuators)
        if len(actuator.fingers) >= 2 and _has_bounds(hand, i)
    ]
    return primitives


def _has_bounds(hand: Hand, actuator: int) -> bool:
    spec = hand.actuators[actuator]
    return math.isfinite(spec.lower) and math.isfinite(spec.upper)


def _posture(hand: Hand, targets: dict[str, float]) -> Posture:
    position = {spec.name: targets.get(spec.name, spec.rest) for spec in hand.actuators}
    return Posture(position, tuple(name for name in position if name in targets))


def _flex(hand: Hand, kind: PrimitiveKind, finger: str, actuators: tuple[str, ...]) -> Primitive:
    targets = {name: hand.actuators[hand.actuator_index(name)].farthest for name in actuators}
    return Primitive(kind, (finger,), (_posture(hand, targets),), fingers=(finger,))


def _single_joint(hand: Hand, actuator: int) -> Primitive:
    spec = hand.actuators[actuator]
    # First the bound farther from rest, which closes the hand.
    bounds = sorted((spec.upper, spec.lower), key=lambda bound: bound != spec.farthest)
    postures = tuple(_posture(hand, {spec.name: bound}) for bound in bounds)
    return Primitive(
        PrimitiveKind.SINGLE_JOINT_MULTIPLE_TIPS,
        (spec.name,),
        postures,
        tips=len(spec.fingers),
        fingers=spec.fingers,
    )
