"""All local minima of a signed distance that are worth knowing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from rtee.extract.descent import Minimum, Objective, descend
from rtee.extract.space import Space, halton
from rtee.types import FloatArray

SCREENED: Final = 192
STARTS: Final = 12
KEPT: Final = 3
_QUICK: Final = 45
_THOROUGH: Final = 160
_SAME: Final = 0.02
_LINE: Final = 257


def minima(
    value: Callable[[FloatArray], float],
    objective: Objective,
    space: Space,
    warm: Sequence[FloatArray] = (),
    starts: int = STARTS,
) -> list[Minimum]:
    """Return distinct local minima, the deepest first.

    Args:
        value: The function alone.
        objective: The function with its derivative.
        space: Where to search.
        warm: Further starts, coordinates ``(k,)``.
        starts: Number of starts from the low-discrepancy sequence.
    """
    if space.size == 0:
        y = np.zeros(0)
        return [Minimum(y, value(y), 1)]
    if space.size == 1:
        return _on_a_line(value)
    points = np.concatenate([halton(space.size, max(SCREENED, starts)), _landmarks(space)])
    values = np.array([value(y) for y in points])
    order = np.argsort(values, kind="stable")[:starts]
    first = [
        descend(objective, y, evaluations=_QUICK) for y in (*warm, *(points[i] for i in order))
    ]
    best = _distinct(first)[:KEPT]
    done = [descend(objective, m.y, evaluations=_THOROUGH) for m in best]
    return _distinct([*done, *first])


def _landmarks(space: Space) -> FloatArray:
    """Return rest, the middle and the two far corners."""
    size = space.size
    return np.array([space.rest, np.full(size, 0.5), np.zeros(size), np.ones(size)])


def _distinct(found: Sequence[Minimum]) -> list[Minimum]:
    kept: list[Minimum] = []
    for minimum in sorted(found, key=lambda m: m.value):
        if all(np.abs(minimum.y - other.y).max() > _SAME for other in kept):
            kept.append(minimum)
    return kept


def _on_a_line(value: Callable[[FloatArray], float]) -> list[Minimum]:
    """Return all local minima over one coordinate, by a fine grid and golden sections."""
    grid = np.linspace(0.0, 1.0, _LINE)
    values = [value(np.array([t])) for t in grid]
    found = []
    for i, here in enumerate(values):
        left = values[i - 1] if i else np.inf
        right = values[i + 1] if i + 1 < _LINE else np.inf
        if here <= left and here <= right and not (here == left and i):
            low, high = grid[max(i - 1, 0)], grid[min(i + 1, _LINE - 1)]
            found.append(_golden(value, float(low), float(high), float(grid[i]), here))
    return sorted(found, key=lambda m: m.value)


def _golden(
    value: Callable[[FloatArray], float], low: float, high: float, t: float, least: float
) -> Minimum:
    ratio = (np.sqrt(5.0) - 1.0) / 2.0
    best, at = least, t
    count = 0
    while high - low > 1e-9:
        a, b = high - ratio * (high - low), low + ratio * (high - low)
        fa, fb = value(np.array([a])), value(np.array([b]))
        count += 2
        for point, here in ((a, fa), (b, fb)):
            if here < best:
                best, at = here, point
        if fa <= fb:
            high = b
        else:
            low = a
    return Minimum(np.array([at]), best, count)
