"""The grasps of an object by a hand, ranked: geometry and forces, no dynamics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from rtee.actions.library import ActionLibrary, load_actions
from rtee.errors import ConfigError
from rtee.hand.model import Hand
from rtee.objects.shape import Table
from rtee.planning.composition import composed_for
from rtee.planning.objects import GraspObject, read_object
from rtee.planning.planner import FRICTION, JAWS, Planner
from rtee.planning.result import GraspPlan, Ranking
from rtee.planning.table import ClosingKind

GOOD: Final = 0.6
"""Score of a grasp that is good enough: above, nothing is composed for the object."""


def grasp_plan(
    hand: Hand | str | Path,
    object: str | GraspObject,  # noqa: A002 - as on the command line
    *,
    mass: float = 0.1,
    friction: float = FRICTION,
    weight_axis: Sequence[float] | None = None,
    table: Table | None = None,
) -> Ranking:
    """Rank the stored actions of a hand for an object; see `plan_grasps`.

    Args:
        hand: The hand; or its name, or the path of its folder.
        object: The object: as on the command line, or one that was read.
        mass: Mass of an object that is given as text [kg].
        friction: Coefficient of friction between hand and object.
        weight_axis: Direction of the object's weight, a vector in the hand's base frame.
        table: The table on which the object stands.

    Raises:
        UserError: if the hand, its actions, the object or an argument can't be used.
    """
    library = load_actions(hand)
    found = object if isinstance(object, GraspObject) else read_object(object, mass)
    return plan_grasps(
        library.hand, library, found, friction=friction, weight_axis=weight_axis, table=table
    )


def plan_grasps(
    hand: Hand,
    library: ActionLibrary,
    obj: GraspObject,
    *,
    friction: float = FRICTION,
    weight_axis: Sequence[float] | None = None,
    table: Table | None = None,
    compose: bool = True,
) -> Ranking:
    """Rank the actions of a hand for an object.

    The result is deterministic.

    Args:
        hand: The hand.
        library: Its actions.
        obj: The object.
        friction: Coefficient of friction between hand and object.
        weight_axis: Direction of the object's weight, a vector in the hand's base frame; along its
            reach, as of a hand that points down, unless given.
        table: The table on which the object stands: the hand keeps clear of it on its way, and as
            it closes and opens. What can't be grasped there has to stand out over its edge.
        compose: Compose an action of primitives where no single one is good.

    Raises:
        ConfigError: if the object fits into no opening of the hand, the hand has no opening, or an
            argument is invalid.
        ModelError: if a mesh of the hand cannot be read.
    """
    planner = Planner(hand, obj, friction, weight_axis, table, library.openings)
    if not len(library):
        raise ConfigError(
            f"hand '{hand.name}' has no actions; find its primitives first: "
            f"rtee extract {hand.name} --save"
        )
    # Said before planning, which would call the missing opening one of 0 mm.
    if planner.no_opening:
        raise ConfigError(f"'{obj.name}' does not fit: {planner.no_opening}")
    plans, rejected = _planned(planner, library, compose)
    if planner.ground is not None and not plans:
        planner.ground.edge = True
        plans, rejected = _planned(planner, library, compose)
    if planner.ground is not None:
        uneven = any(planner.sides_wait(action) for action in library)
        closings = [_closing(hand, plan, uneven=uneven) for plan in plans]
        plans = [
            replace(plan, score=closing.share_held(plan.score))
            for plan, closing in zip(plans, closings, strict=True)
        ]
        # The order within each kind of closing stays.
        if uneven:
            plans.sort(key=lambda plan: -plan.score)
    if not plans and planner.too_wide:
        raise ConfigError(
            f"'{obj.name}' does not fit: width {planner.narrowest * 1e3:.0f} mm, the hand opens "
            f"to {planner.widest * 1e3:.0f} mm"
        )
    return planner.ranking(plans, rejected)


def _closing(hand: Hand, plan: GraspPlan, *, uneven: bool) -> ClosingKind:
    if plan.force is not None:
        return ClosingKind.WAITING
    if uneven:
        return ClosingKind.UNEVEN
    return ClosingKind.JAWS if len(hand.fingers) <= JAWS else ClosingKind.FINGERS


def _planned(
    planner: Planner, library: ActionLibrary, compose: bool
) -> tuple[list[GraspPlan], list[tuple[str, str]]]:
    """Return the grasps, the best first, and why the other actions can't be used."""
    plans, rejected = planner.plan(library)
    # Composing takes about as long again, so only where no stored action is good enough.
    if compose and (not plans or plans[0].score < GOOD):
        made = composed_for(planner, library)
        if made is not None and (not plans or made.score > plans[0].score):
            plans.insert(0, made)
    return plans, rejected
