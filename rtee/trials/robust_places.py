"""Places for an object in simulation: those that an action holds even if the object is moved."""

from __future__ import annotations

import itertools
from typing import Final

import numpy as np

from rtee.actions.library import ActionLibrary
from rtee.actions.types import Action, Primitive
from rtee.drivers.mujoco.simulation import Simulation
from rtee.planning.approaches import PoseCandidate
from rtee.planning.objects import GraspObject
from rtee.planning.planner import Planner
from rtee.planning.robust import robust_poses, too_wide
from rtee.trials.grasp_placement import Place, Places, fingers_of
from rtee.trials.variation import MASS, SIZE

_APART: Final = 0.012
"""Places whose outlines differ by less count as one [m]: objects are moved about as far."""

_FROM_TIPS: Final = 6
"""Number of places found from the middle of the fingertips."""


_OUTLOOK: Final = np.array(
    [np.array(v) / np.linalg.norm(v) for v in itertools.product((-1, 0, 1), repeat=3) if any(v)]
)
"""Directions in which outlines are compared."""


def robust_places(
    simulation: Simulation, library: ActionLibrary, action: Action, obj: GraspObject, most: int
) -> list[Place]:
    """Return places for an object, the most robust ones first, each well apart from the others.

    Places between the fingertips, between those of fewer fingers, and in the palm's front are
    compared. If no place holds by geometry, only those between the fingertips remain.

    Args:
        simulation: The hand with its object and carrier.
        library: The hand's actions; its pinches say which fingers meet.
        action: The action to grasp the object with.
        obj: The object.
        most: How many places are wanted.
    """
    hand = library.hand
    tips = Places(simulation, hand, action).find(_FROM_TIPS)
    others = [PoseCandidate(place.pose, place.approach_from, 0.0, 0.0) for place in tips]
    found = robust_poses(Planner(hand, obj), action, groups_of(library, action), others)
    places = [
        Place(pose.candidate.pose, pose.first, pose.candidate.approach_from) for pose in found
    ]
    chosen: list[Place] = []
    # Where too few places are robust, those between the fingertips make up the number.
    for place in (*places, *tips):
        if all(_differ(place, other, obj) for other in chosen):
            chosen.append(place)
            if len(chosen) == most:
                break
    return chosen


def groups_of(library: ActionLibrary, action: Action) -> list[Primitive]:
    """Return the pinches of some of the fingers that an action moves."""
    moved = set(fingers_of(library.hand, action))
    return [
        pinch
        for pinch in library.all("primitive")
        # Not all of the fingers: places between all of them come from `Places`.
        if isinstance(pinch, Primitive) and pinch.kind.pinch and set(pinch.fingers) < moved
    ]


def misfit(library: ActionLibrary, action: Action, obj: GraspObject, variations: int) -> str:
    """Return why an object does not fit a hand; empty if it does.

    With variations, the largest and the heaviest one must fit.
    """
    hand = library.hand
    mass = obj.mass * (1.0 + MASS if variations else 1.0)
    if mass > hand.payload:
        return f"{mass:.3g} kg, the hand may hold {hand.payload:.3g} kg"
    if variations:
        obj = obj.scaled(1.0 + SIZE)
    planner = Planner(hand, obj)
    if planner.no_opening:
        return planner.no_opening
    reason = too_wide(planner, action, groups_of(library, action))
    return f"{reason}, {1.0 + SIZE:g} times as large" if reason and variations else reason


def _differ(one: Place, other: Place, obj: GraspObject) -> bool:
    """Return whether two places differ, as far as the object's outline shows."""
    shift = float(np.linalg.norm(one.pose[:3, 3] - other.pose[:3, 3]))
    outlines = [
        obj.support(_OUTLOOK @ place.pose[:3, :3]) - _OUTLOOK @ place.pose[:3, :3] @ obj.box[0]
        for place in (one, other)
    ]
    return shift > _APART or float(np.abs(outlines[0] - outlines[1]).max()) > _APART
