"""Search for the relevant local minima of a signed distance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtee.extract.descent import Minimum, descend
from rtee.extract.goals import GoalFunction
from rtee.extract.polish import polish
from rtee.extract.resolution import COARSE, FINE, MEDIUM
from rtee.extract.space import Space
from rtee.hand.halton import halton
from rtee.sample import FloatArray


@dataclass(frozen=True, slots=True)
class Combining:
    """Descents from combinations of the deepest minima.

    Attributes:
        parents: Number of minima that are combined.
        children: Number of the best combinations from which descents start.
    """

    parents: int
    children: int


@dataclass(frozen=True, slots=True)
class Moving:
    """Descents from the deepest minimum with one finger elsewhere.

    Attributes:
        places: Number of places at which each finger is tried.
        moved: Number of the best of these poses from which descents start.
    """

    places: int
    moved: int


@dataclass(frozen=True, slots=True)
class SearchEffort:
    """Limits of a search.

    Attributes:
        screened: Number of points of the low-discrepancy sequence evaluated first.
        starts: Number of the best of them from which descents start.
        quick: Most evaluations of each of these descents.
        rounds: What follows these descents, stage after stage; of the rounds after the second one
            only as many as the last one has found a deeper minimum.
        kept: Number of distinct ends that are polished.
        polish: Most evaluations of polishing one of them.
        again: Most further polishings of one of the deepest ends, if the first did not suffice.
        finalists: Number of these ends.
        elsewhere: Number of descents that start from further points of the sequence.
    """

    screened: int = 192
    starts: int = 20
    quick: int = 28
    rounds: tuple[tuple[Combining | Moving, ...], ...] = ()
    kept: int = 5
    polish: int = 40
    again: int = 3
    finalists: int = 1
    elsewhere: int = 0


PAIR: Final = SearchEffort()
SEVERAL: Final = SearchEffort(
    screened=32,
    starts=3,
    quick=90,
    rounds=(
        (Combining(6, 4), Combining(6, 4), Moving(16, 2)),
        (Combining(10, 12), Moving(48, 6)),
        (Combining(10, 12), Moving(48, 6)),
    ),
    kept=6,
    polish=60,
    again=2,
    finalists=3,
    elsewhere=3,
)
"""Limits for several tips, whose minima are many and shallow."""

_SAME: Final = 0.02
"""Difference in every coordinate, as a share of its range, below which minima are equal."""

_LITTLE: Final = 0.002
"""Share of the value that a polish must gain for another one to follow."""

_FURTHER: Final = 64
"""Number of the further points of the low-discrepancy sequence."""

_NEARLY: Final = 0.06
"""Share of the value by which a minimum may be above the deepest one to be polished, which gains up
to as much."""

_LAST: Final = 8
"""Evaluations of the last polish, on the full convex parts and with the finest resolution."""

_ALIKE: Final = 2
"""Decimals for comparing combined starts: 1 % of a range."""

_LINE: Final = 257
"""Points of the grid over a single actuator; minima of the hands in the tests are wider."""

_LINE_PRECISION: Final = 1e-8
"""Precision of golden sections, as a share of the range; postures are stored to 1e-6."""


Block = NDArray[np.intp]
"""Indices of related coordinates: those of a finger, or those that move several fingers."""


@dataclass(frozen=True, slots=True)
class Minima:
    """Distinct local minima.

    Attributes:
        polished: Minima with the best ones polished, the deepest first.
        explored: Minima before polishing, the deepest first, from which other searches start:
            polished coordinates depend on digits that descents ignore.
    """

    polished: Sequence[Minimum]
    explored: Sequence[Minimum]


def minima(
    function: GoalFunction,
    warm: Sequence[FloatArray] = (),
    effort: SearchEffort = PAIR,
    blocks: Sequence[Block] = (),
) -> Minima:
    """Return distinct local minima.

    Args:
        function: The function to minimise over its space.
        warm: Coordinates ``(k,)`` of known starts.
        effort: Limits of the search.
        blocks: Related coordinates, for combining starts from minima.
    """
    space = function.space
    if space.size == 0:  # all actuators of the tips are fixed: the rest posture is the only one
        y = np.zeros(0)
        here = [Minimum(y, function.value(y), 1)]
        return Minima(here, here)
    if space.size == 1:
        line = minima_on_line(function)
        return Minima(line, line)
    # Known starts, such as pinches of two fingers, and points spread evenly over the box.
    starts = [*warm, *_screened(function, effort)]
    first = [descend(function, y, evaluations=effort.quick) for y in starts]
    seen: set[bytes] = set()
    for number, stages in enumerate(effort.rounds):
        before = distinct(first)[0]
        for stage in stages:
            found = distinct(first)
            if isinstance(stage, Combining):
                new, count = recombined(found[: stage.parents], blocks, seen), stage.children
            else:
                new, count = moved_blocks(found[0], blocks, stage.places), stage.moved
            # One evaluation each, to choose the starts of descents.
            best = nearest(function, new, count)
            first += [descend(function, y, evaluations=effort.quick) for y in best]
        if number and distinct(first)[0].value >= before.value:
            break
    done = _deepened(function, distinct(first)[: effort.kept], effort)
    if effort.elsewhere:
        others = _elsewhere(function, distinct(first), effort)
        polished = _deepened(function, others[:1], effort)
        # Other searches start from these, too, if they have found a deeper one.
        if any(_gains(m.value, min(m.value for m in done)) for m in polished):
            first, done = [*first, *others], [*done, *polished]
    deepest = min(done, key=lambda m: m.value)
    # The last steps on the full parts, since coarse shapes are up to 0.1 mm thinner.
    with function.fine():
        done.append(polish(function, deepest.y, evaluations=_LAST, resolution=FINE))
    return Minima(distinct([*done, *first]), distinct(first))


def _elsewhere(
    function: GoalFunction, known: Sequence[Minimum], effort: SearchEffort
) -> list[Minimum]:
    """Return other minima than the known ones that may become deeper, the deepest first.

    Combinations of known minima hardly leave their valleys.
    """
    points = halton(function.space.size, effort.screened + _FURTHER)[effort.screened :]
    best = nearest(function, [*points], effort.elsewhere)
    found = distinct([descend(function, y, evaluations=effort.quick) for y in best])
    enough = known[0].value + _NEARLY * abs(known[0].value)
    return [
        m for m in found if m.value < enough and all(np.abs(m.y - o.y).max() > _SAME for o in known)
    ]


def _deepened(
    function: GoalFunction, ends: Sequence[Minimum], effort: SearchEffort
) -> list[Minimum]:
    """Return polished minima, the deepest of which are polished until they gain little."""
    done, deepest = [_polished(function, m, effort.polish) for m in ends], np.inf
    for end in sorted(done, key=lambda m: m.value)[: effort.finalists]:
        chain = [end]
        # A polish that ended by itself is at a minimum, which another one would not change.
        while len(chain) <= effort.again and chain[-1].evaluations >= effort.polish:
            chain.append(_polished(function, chain[-1], effort.polish))
            if not _gains(chain[-1].value, chain[-2].value):
                break
        if _gains(chain[-1].value, deepest):
            deepest = chain[-1].value
            done += chain[1:]
    return done


def _gains(value: float, before: float) -> bool:
    """Return whether a value is less than another one by more than a little."""
    return before - value >= _LITTLE * abs(value)


def _polished(function: GoalFunction, minimum: Minimum, evaluations: int) -> Minimum:
    return polish(function, minimum.y, evaluations=evaluations, resolution=MEDIUM)


def _screened(function: GoalFunction, effort: SearchEffort) -> list[FloatArray]:
    """Return the best of the points of the low-discrepancy sequence and the landmarks."""
    points = halton(function.space.size, max(effort.screened, effort.starts))
    return nearest(function, [*points, *_landmarks(function.space)], effort.starts)


def nearest(function: GoalFunction, points: Sequence[FloatArray], count: int) -> list[FloatArray]:
    """Return the points with the least values of a function, the best first."""
    # Rounded and sorted stably, so that the order does not depend on last digits.
    values = [COARSE.rounded_value(function.value(y)) for y in points]
    return [points[i] for i in np.argsort(values, kind="stable")[:count]]


def _landmarks(space: Space) -> FloatArray:
    """Return rest, the middle and the two far corners."""
    size = space.size
    return np.array([space.rest, np.full(size, 0.5), np.zeros(size), np.ones(size)])


def distinct(found: Sequence[Minimum]) -> list[Minimum]:
    """Return distinct minima, the deepest first."""
    kept: list[Minimum] = []
    for minimum in sorted(found, key=lambda m: m.value):
        if all(np.abs(minimum.y - other.y).max() > _SAME for other in kept):
            kept.append(minimum)
    return kept


def recombined(
    found: Sequence[Minimum], blocks: Sequence[Block], seen: set[bytes]
) -> list[FloatArray]:
    """Return poses ``(k,)`` in which one block of coordinates is another minimum's.

    The goal is a sum whose terms depend on few coordinates: those of two fingers and those that
    move all of them. Minima of the sum therefore often combine parts of different minima.

    Args:
        found: Minima.
        blocks: Related coordinates: each finger's, and the others.
        seen: Rounded poses returned before, which are skipped; the new ones are added.
    """
    new = []
    for one, other in permutations(found, 2):
        for block in blocks:
            if np.abs(one.y[block] - other.y[block]).max() < _SAME:
                continue
            y = one.y.copy()
            y[block] = other.y[block]
            # Many of the minima are the same as in the previous round.
            key = y.round(_ALIKE).tobytes()
            if key not in seen:
                seen.add(key)
                new.append(y)
    return new


def moved_blocks(minimum: Minimum, blocks: Sequence[Block], places: int) -> list[FloatArray]:
    """Return poses ``(k,)`` that differ from a minimum in one block of coordinates.

    A descent moves all fingers at once and stops at the first kink that no finger can leave alone.
    A finger has so few coordinates that a few points cover them.

    Args:
        minimum: The minimum.
        blocks: Related coordinates: each finger's, and the others.
        places: Number of points of the low-discrepancy sequence for each block.
    """
    new = []
    for block in blocks:
        for place in halton(len(block), places):
            y = minimum.y.copy()
            y[block] = place
            new.append(y)
    return new


def minima_on_line(function: GoalFunction, low: float = 0.0, high: float = 1.0) -> list[Minimum]:
    """Return all local minima over one coordinate, by a fine grid and golden sections."""
    grid = np.linspace(low, high, _LINE)
    values = [function.value(np.array([t])) for t in grid]
    results = []
    for i, here in enumerate(values):
        left = values[i - 1] if i else np.inf
        right = values[i + 1] if i + 1 < _LINE else np.inf
        # "<" on one side only, so that equal neighbours count once.
        if here < left and here <= right:
            a, b = float(grid[max(i - 1, 0)]), float(grid[min(i + 1, _LINE - 1)])
            results.append(_golden(function, (a, b), float(grid[i]), here))
    return sorted(results, key=lambda m: m.value)


def _golden(
    function: GoalFunction, bracket: tuple[float, float], at: float, least: float
) -> Minimum:
    """Return the minimum in a bracket; Kiefer (1953)."""
    low, high = bracket
    ratio = (np.sqrt(5.0) - 1.0) / 2.0
    inner = [high - ratio * (high - low), low + ratio * (high - low)]
    values = [function.value(np.array([t])) for t in inner]
    count = 2
    while high - low > _LINE_PRECISION:
        for t, here in zip(inner, values, strict=True):
            if here < least:
                least, at = here, t
        if values[0] <= values[1]:
            high = inner[1]
            inner = [high - ratio * (high - low), inner[0]]
            values = [function.value(np.array([inner[0]])), values[0]]
        else:
            low = inner[0]
            inner = [inner[1], low + ratio * (high - low)]
            values = [values[1], function.value(np.array([inner[1]]))]
        count += 1
    return Minimum(np.array([at]), least, count)
