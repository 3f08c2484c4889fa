"""Search for the relevant local minima of a signed distance."""

from __future__ import annotations

import math
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
        parents: Number of minima to combine.
        children: Number of best combinations from which descents start.
    """

    parents: int
    children: int


@dataclass(frozen=True, slots=True)
class Moving:
    """Descents from the deepest minimum with one finger moved elsewhere.

    Attributes:
        places: Number of places to try for each finger.
        moved: Number of best poses from which descents start.
    """

    places: int
    moved: int


@dataclass(frozen=True, slots=True)
class SearchEffort:
    """Limits of a search.

    Attributes:
        screened: Number of points of the low-discrepancy sequence evaluated first.
        starts: Number of the best of these points from which descents start.
        quick: Maximum number of evaluations of each of these descents.
        rounds: Rounds of stages after these descents; from the second round on, a round that finds
            no deeper minimum is the last.
        kept: Number of distinct minima to polish.
        polish: Maximum number of evaluations for polishing a minimum.
        again: Maximum number of further polishings of each finalist.
        finalists: Number of the deepest polished minima that may be polished again.
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
"""Largest difference in each coordinate, as a share of its range, of equal minima."""

_LITTLE: Final = 0.002
"""Share of the value that a polish must gain before another one follows."""

_FURTHER: Final = 64
"""Number of further points of the low-discrepancy sequence."""

_USED: Final = 192
"""Number of points of the low-discrepancy sequence that other searches use, at most."""

_POINTS: Final = 12
_DESCENTS: Final = 1.5
"""Numbers of new points, and of descents from the best of them, per coordinate: valleys multiply
with the coordinates."""

_DESCENT: Final = 40
"""Maximum number of evaluations of such a descent."""

_NEARLY: Final = 0.06
"""Largest excess over the deepest minimum, as a share of its value, of another minimum that is
worth polishing, which gains up to as much."""

_LAST: Final = 8
"""Maximum number of evaluations of the last polish, on the full convex parts at the finest
resolution."""

_ALIKE: Final = 2
"""Decimals for comparing combined starts: 1 % of a range."""

_LINE: Final = 257
"""Number of grid points over a single actuator; minima of the hands in the tests are wider than a
step of the grid."""

_LINE_PRECISION: Final = 1e-8
"""Precision of golden-section searches, as a share of the range; postures are stored to 1e-6."""


Block = NDArray[np.intp]
"""Indices of related coordinates: those of a finger, or those that move several fingers."""


@dataclass(frozen=True, slots=True)
class Minima:
    """Distinct local minima.

    Attributes:
        polished: All minima, with the best ones polished, the deepest first.
        explored: Minima before polishing, the deepest first. Other searches start from these, since
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
        # Other searches start from these, too, if one of them is deeper.
        if any(_gains(m.value, min(m.value for m in done)) for m in polished):
            first, done = [*first, *others], [*done, *polished]
    deepest = min(done, key=lambda m: m.value)
    # Take the last steps on the full parts, since coarse shapes are up to 0.1 mm thinner.
    with function.fine():
        done.append(polish(function, deepest.y, evaluations=_LAST, resolution=FINE))
    return Minima(distinct([*done, *first]), distinct(first))


def _elsewhere(
    function: GoalFunction, known: Sequence[Minimum], effort: SearchEffort
) -> list[Minimum]:
    """Return further minima that may become deeper than the known ones, the deepest first.

    Combinations of known minima hardly leave the valleys of these.
    """
    points = halton(function.space.size, effort.screened + _FURTHER)[effort.screened :]
    found = _descents(function, points, effort.elsewhere, effort.quick)
    enough = known[0].value + _NEARLY * abs(known[0].value)
    return [
        m for m in found if m.value < enough and all(np.abs(m.y - o.y).max() > _SAME for o in known)
    ]


def fresh_minima(function: GoalFunction) -> list[FloatArray]:
    """Return coordinates ``(k,)`` of minima found from new points, the deepest first."""
    size = function.space.size
    points = halton(size, _USED + _POINTS * size)[_USED:]
    found = _descents(function, points, math.ceil(_DESCENTS * size), _DESCENT)
    return [minimum.y for minimum in found]


def _descents(
    function: GoalFunction, points: FloatArray, starts: int, evaluations: int
) -> list[Minimum]:
    """Return distinct ends of descents from the best points, the deepest first."""
    best = nearest(function, [*points], starts)
    return distinct([descend(function, y, evaluations=evaluations) for y in best])


def _deepened(
    function: GoalFunction, ends: Sequence[Minimum], effort: SearchEffort
) -> list[Minimum]:
    """Return polished minima; polish the deepest of them until they gain little."""
    done, deepest = [_polished(function, m, effort.polish) for m in ends], np.inf
    for end in sorted(done, key=lambda m: m.value)[: effort.finalists]:
        chain = [end]
        # A polish that did not use up its evaluations has converged; another one is useless.
        while len(chain) <= effort.again and chain[-1].evaluations >= effort.polish:
            chain.append(_polished(function, chain[-1], effort.polish))
            if not _gains(chain[-1].value, chain[-2].value):
                break
        if _gains(chain[-1].value, deepest):
            deepest = chain[-1].value
            done += chain[1:]
    return done


def _gains(value: float, before: float) -> bool:
    """Return whether a value is less than the value before by a relevant amount."""
    return before - value >= _LITTLE * abs(value)


def _polished(function: GoalFunction, minimum: Minimum, evaluations: int) -> Minimum:
    return polish(function, minimum.y, evaluations=evaluations, resolution=MEDIUM)


def _screened(function: GoalFunction, effort: SearchEffort) -> list[FloatArray]:
    """Return the best points of the low-discrepancy sequence and the landmarks."""
    points = halton(function.space.size, max(effort.screened, effort.starts))
    return nearest(function, [*points, *_landmarks(function.space)], effort.starts)


def nearest(function: GoalFunction, points: Sequence[FloatArray], count: int) -> list[FloatArray]:
    """Return the points with the least values of a function, the best first."""
    # Round and sort stably, so that the order does not depend on last digits.
    values = [COARSE.rounded_value(function.value(y)) for y in points]
    return [points[i] for i in np.argsort(values, kind="stable")[:count]]


def _landmarks(space: Space) -> FloatArray:
    """Return the rest posture, the middle of the box and two opposite corners."""
    size = space.size
    return np.array([space.rest, np.full(size, 0.5), np.zeros(size), np.ones(size)])


def distinct(found: Sequence[Minimum]) -> list[Minimum]:
    """Return distinct minima, the deepest first."""
    ordered = sorted(found, key=lambda m: m.value)
    places = np.array([minimum.y for minimum in ordered])
    kept, new = list[Minimum](), np.ones(len(ordered), dtype=bool)
    for i, minimum in enumerate(ordered):
        if new[i]:
            kept.append(minimum)
            new &= np.abs(places - minimum.y).max(axis=1) > _SAME
    return kept


def recombined(
    found: Sequence[Minimum], blocks: Sequence[Block], seen: set[bytes]
) -> list[FloatArray]:
    """Return minima ``(k,)`` with one block of coordinates taken from another minimum.

    The goal is a sum whose terms depend on few coordinates: those of two fingers, and those that
    move all fingers. Minima of the sum therefore often combine parts of different minima.

    Args:
        found: Minima.
        blocks: Related coordinates: each finger's, and the others.
        seen: Rounded poses returned before, which are skipped; new ones are added to it.
    """
    new = []
    for one, other in permutations(found, 2):
        for block in blocks:
            if np.abs(one.y[block] - other.y[block]).max() < _SAME:
                continue
            y = one.y.copy()
            y[block] = other.y[block]
            # Many minima are the same as in the previous round.
            key = y.round(_ALIKE).tobytes()
            if key not in seen:
                seen.add(key)
                new.append(y)
    return new


def moved_blocks(minimum: Minimum, blocks: Sequence[Block], places: int) -> list[FloatArray]:
    """Return poses ``(k,)`` that differ from a minimum in one block of coordinates.

    A descent moves all fingers at once, and stops at a kink even if one finger could get deeper
    elsewhere. A finger has so few coordinates that a few points cover them.

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
    """Return all local minima over one coordinate, by a fine grid and golden-section searches."""
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
    """Return the minimum in a bracket, by golden-section search (Kiefer, 1953)."""
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
