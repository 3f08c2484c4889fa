"""Compose an action of scaled primitives for an object that no single action grasps well.

As in the paper, an action is composed of others, each scaled from rest. Fingers that close alone
(Trig) are combined, and pinches with the fingers that they leave out. The scale of each part
follows from where its links stop at the object.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from itertools import combinations, islice
from typing import Final

import numpy as np

from rtee.actions.library import ActionLibrary
from rtee.actions.types import ActionReference, Composed, Primitive, PrimitiveKind
from rtee.planning.planner import Planner, squeeze
from rtee.planning.result import GraspPlan

DRAFT: Final = "Planned"
"""Name of a composed action until it is stored under another one."""

_TRIES: Final = 12
"""Combinations that are tried: all of three to five fingers, and some pinches with others."""

_POSES: Final = 3
"""Poses of the object that are tried for each."""

_LEAST: Final = 0.05
"""A part with a smaller scale does not contribute to the grasp and is left out."""


def composed_for(planner: Planner, library: ActionLibrary) -> GraspPlan | None:
    """Return the best grasp by an action composed for the object, or ``None`` if there is none."""
    drafts = [_draft(library, parts) for parts in islice(_combinations(library), _TRIES)]
    found = planner.best(drafts, _POSES)
    if found is None:
        return None
    chosen, best = drafts[found[0]], found[1]
    scaled = _draft(library, _scaled(planner, library, chosen, best))
    # With as many poses as a stored action gets: with fewer, a worse place may be chosen.
    again = planner.best([scaled])
    if again is not None and again[1].score >= 0.9 * best.score:
        chosen, best = scaled, again[1]
    return dataclasses.replace(best, action="", parts=chosen.parts)


def action_of(library: ActionLibrary, name: str, plan: GraspPlan, description: str) -> Composed:
    """Return the action of a plan under a new name, scaled as planned.

    Args:
        library: The hand's actions.
        name: The new action's name.
        plan: The plan.
        description: One sentence for people.

    Raises:
        ActionError: if the name is invalid, or the plan's action is timed.
    """
    parts = plan.parts or (ActionReference(plan.action, plan.elements),)
    scaled = [dataclasses.replace(p, scale=round(p.scale * plan.intensity, 3)) for p in parts]
    return library.compose(name, scaled, description=description)


def _draft(library: ActionLibrary, parts: tuple[ActionReference, ...]) -> Composed:
    return library.compose(DRAFT, parts)


def _combinations(library: ActionLibrary) -> Iterator[tuple[ActionReference, ...]]:
    """Yield combinations: of all fingers first, then fewer; of pinches with other fingers."""
    primitives = [a for a in library.all("primitive") if isinstance(a, Primitive)]
    trigs = [a for a in primitives if a.kind is PrimitiveKind.TRIG]
    if len(trigs) < 2:
        return
    pinches = [a for a in primitives if a.kind.pinch and a.kind is not PrimitiveKind.PINCH_LOOSE]
    mixed = [
        (_use(pinch), *(_use(t) for t in trigs if not set(t.fingers) & set(pinch.fingers)))
        for pinch in pinches
    ]
    # A pinch that leaves no other finger out is the stored action itself.
    mixed = [parts for parts in mixed if len(parts) > 1]
    alone = [
        tuple(_use(trig) for trig in chosen)
        for size in range(len(trigs), 1, -1)
        for chosen in combinations(trigs, size)
    ]
    # Alternate, so that both kinds are among those tried.
    for first, second in zip(alone, mixed, strict=False):
        yield first
        yield second
    yield from alone[len(mixed) :]
    yield from mixed[len(alone) :]


def _use(action: Primitive) -> ActionReference:
    return ActionReference(action.name, action.elements)


def _scaled(
    planner: Planner, library: ActionLibrary, draft: Composed, plan: GraspPlan
) -> tuple[ActionReference, ...]:
    """Return the parts of a grasp, each scaled to where its links press on the object."""
    hand = planner.hand
    rest = np.array(hand.rest)
    closure = planner.closed(draft, plan)
    if closure is None:
        return draft.parts
    target = closure.u
    scales = []
    for part in draft.parts:
        posture = library.find(part.action, part.elements).waypoints[-1]
        wanted = 0.0
        for name in posture.involved:
            index = hand.actuator_index(name)
            travel = posture.position[name] - rest[index]
            if abs(travel) < 1e-6:
                continue
            beyond = squeeze(hand.actuators[index]) if closure.blocked[index] else 0.0
            # One scale serves all of a part's actuators: the one with the farthest to go decides.
            wanted = max(wanted, (target[index] - rest[index]) / travel + beyond / abs(travel))
        # Rounded up: rounded down, the part might no longer press.
        scales.append(min(1.0, math.ceil(20.0 * wanted) / 20.0))
    parts = (
        dataclasses.replace(part, scale=scale)
        for part, scale in zip(draft.parts, scales, strict=True)
        if scale >= _LEAST
    )
    return tuple(parts) or draft.parts
