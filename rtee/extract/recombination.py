"""New starts for a search, put together from the minima that it has found."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtee.extract.descent import Minimum
from rtee.hand.halton import halton
from rtee.types import FloatArray

Block = NDArray[np.intp]
"""Coordinates that go together, by their numbers."""

_SAME: Final = 0.02
_DECIMALS: Final = 2


def recombined(
    found: Sequence[Minimum], blocks: Sequence[Block], seen: set[bytes]
) -> list[FloatArray]:
    """Return poses in which one block of coordinates is another minimum's.

    What is pressed together is a sum, and each of its terms depends on few coordinates: those of
    two fingers and what moves all of them. So minima of the sum are often made of parts that were
    found apart from each other.

    Args:
        found: Minima.
        blocks: Which coordinates go together; each finger's, and the others.
        seen: What was returned before, about; it is not returned again, and what is is added.

    Returns:
        Coordinates ``(k,)``.
    """
    new = []
    for one, other in permutations(found, 2):
        for block in blocks:
            if np.abs(one.y[block] - other.y[block]).max() < _SAME:
                continue
            y = one.y.copy()
            y[block] = other.y[block]
            key = y.round(_DECIMALS).tobytes()
            if key not in seen:
                seen.add(key)
                new.append(y)
    return new


def elsewhere(minimum: Minimum, blocks: Sequence[Block], places: int) -> list[FloatArray]:
    """Return poses in which one block of coordinates stands elsewhere than at a minimum.

    A descent moves all fingers at once and stops at the first kink that none can leave alone; a
    finger's own coordinates are so few that some points fill them.

    Args:
        minimum: The minimum.
        blocks: Which coordinates go together; each finger's, and the others.
        places: Points of the low-discrepancy sequence for each block.

    Returns:
        Coordinates ``(k,)``.
    """
    new = []
    for block in blocks:
        for place in halton(len(block), places):
            y = minimum.y.copy()
            y[block] = place
            new.append(y)
    return new
