"""Decomposition of set-points into the actions that they were composed of."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Final

from rtee.actions.build import SLACK
from rtee.actions.types import Action, ActionReference, Posture, Timed
from rtee.hand.model import Hand
from rtee.types import from_rest

CLOSE: Final = 1e-4
"""Set-points no farther apart than this are the same [rad | m]."""


def scale_of(hand: Hand, posture: Posture, set_points: Mapping[str, float]) -> float | None:
    """Return the scale from rest at which a posture has set-points [rad | m], or ``None``."""
    if set(posture.involved) != set(set_points):
        return None
    rest = dict(zip(hand.actuator_names, hand.rest.tolist(), strict=True))
    whole = {name: posture.position[name] - rest[name] for name in set_points}
    # The rounding of stored set-points matters least for the longest travel.
    widest = max(whole, key=lambda name: abs(whole[name]))
    # The rest posture is the same at every scale.
    scale = 1.0
    if abs(whole[widest]) > SLACK:
        # Rounded, since the stored set-points are rounded, too.
        scale = round((set_points[widest] - rest[widest]) / whole[widest], 4)
    scaled = {name: from_rest(rest[name], posture.position[name], scale) for name in whole}
    close = all(abs(scaled[name] - set_points[name]) <= CLOSE for name in scaled)
    return scale if scale >= 0.0 and close else None


def find_parts(
    hand: Hand,
    choices: Sequence[Sequence[Action]],
    set_points: Mapping[str, float],
    fingers: Collection[str] = (),
) -> list[ActionReference] | None:
    """Return actions without common actuators that have these set-points together, or ``None``.

    Args:
        hand: The hand.
        choices: Candidates for each part; parts with the same candidates are adjacent.
        set_points: Positions by actuator [rad | m].
        fingers: Fingers allowed in primitives; any if empty.
    """
    return _find(hand, choices, set_points, set(fingers), 0)


def _find(
    hand: Hand,
    choices: Sequence[Sequence[Action]],
    left: Mapping[str, float],
    fingers: set[str],
    start: int,
) -> list[ActionReference] | None:
    if not choices:
        return None if left else []
    for i, action in enumerate(choices[0]):
        if i < start or isinstance(action, Timed):
            continue
        own = {name: left[name] for name in action.posture.involved if name in left}
        scale = scale_of(hand, action.posture, own)
        if scale is None or (fingers and not fingers.issuperset(action.fingers)):
            continue
        others = {name: value for name, value in left.items() if name not in own}
        # Parts with the same candidates give combinations instead of permutations.
        again = i + 1 if list(choices[1:2]) == [choices[0]] else 0
        more = _find(hand, choices[1:], others, fingers, again)
        if more is not None:
            return [ActionReference(action.name, action.elements, scale), *more]
    return None
