"""From what the searches find to postures as they are stored."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rtee.extract.collision_free import ClearSearch, Patience
from rtee.extract.collisions import Watch
from rtee.extract.evidence import Inspector
from rtee.extract.goals import Goal, Placed
from rtee.extract.search import on_a_line
from rtee.extract.space import Space, rounded
from rtee.types import FloatArray


def stored(
    inspector: Inspector, goal: Goal, space: Space, found: Sequence[FloatArray]
) -> Iterator[FloatArray]:
    """Yield those postures, rounded as they are stored, in which the tips touch as wanted.

    Args:
        inspector: Measures postures.
        goal: What is wanted.
        space: The space that was searched.
        found: Coordinates ``(k,)`` in it.
    """
    scene = inspector.scene
    for y in found:
        u = rounded(scene.hand, space.posture(y))
        scene.place(u)
        if goal.touching():
            yield u


def clear_postures(
    inspector: Inspector,
    goal: Goal,
    space: Space,
    watch: Watch,
    starts: Sequence[FloatArray],
    patience: Patience,
) -> list[FloatArray]:
    """Return postures as stored that touch as wanted and in which nothing else collides.

    Args:
        inspector: Measures postures.
        goal: What is wanted.
        space: Where to search.
        watch: The links that may not collide.
        starts: Coordinates ``(k,)`` of good postures, the best first.
        patience: How much to try.
    """
    if space.size == 1:
        low, high = _free(inspector, space, watch)
        if high <= low:
            return []
        found = [m.y for m in on_a_line(Placed(inspector.scene, goal, space), low, high)]
    else:
        search = ClearSearch(inspector.scene, inspector.motion, goal, space, watch, patience)
        found = search.run(starts)
    return list(stored(inspector, goal, space, found))


def _free(inspector: Inspector, space: Space, watch: Watch) -> tuple[float, float]:
    """Return the coordinates around rest up to the first collision, of a space of one actuator."""
    rest = float(space.rest[0])
    ends = []
    for bound in (0.0, 1.0):
        u = space.base.copy()
        u[space.index] = space.lower + bound * space.extent
        blocked = watch.first(inspector.motion.way(u), watch.pairs)
        # A blocked way ends before the collision begins, by more than rounding moves it.
        share = 1.0 if blocked is None else max(0.0, blocked.at - 1e-4)
        ends.append(rest + share * (bound - rest))
    return ends[0], ends[1]
