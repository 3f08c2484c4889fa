"""Points spread evenly over a cube: the Halton sequence."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from rtee.sample import FloatArray


@lru_cache(maxsize=32)
def halton(size: int, count: int) -> FloatArray:
    """Return the first points of the Halton sequence in the unit cube ``(count, size)``.

    Halton (1960), with the digits of every base permuted by a fixed multiplier against the
    correlations between large bases (Faure and Lemieux, 2009, in the simplest form).
    """
    points = np.empty((count, size))
    numbers = np.arange(1, count + 1)
    for column, base in enumerate(_primes(size)):
        # Near the golden section of the prime, which spreads the digits well.
        multiplier = max(1, round(base * (math.sqrt(5.0) - 1.0) / 2.0)) if base > 3 else 1
        value, weight, rest = np.zeros(count), 1.0 / base, numbers.copy()
        while rest.any():
            value += weight * ((rest % base) * multiplier % base)
            rest //= base
            weight /= base
        points[:, column] = value
    # The result is cached, so callers must not change it.
    points.flags.writeable = False
    return points


def _primes(count: int) -> list[int]:
    found: list[int] = []
    number = 2
    while len(found) < count:
        if all(number % p for p in found):
            found.append(number)
        number += 1
    return found
