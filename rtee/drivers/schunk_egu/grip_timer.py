"""When to stop a grip so that it ends at a place: by its position, its speed and the wire."""

from __future__ import annotations

import math

_NEWER = 0.2
"""Share of the newest exchange in the usual duration of one."""
_MOVES = 20.0
"""Way after which a grip counts as begun [µm]: more than the noise of an encoder."""
_JITTER = 1e-3
"""Least time between two positions that give a speed [s]."""


class GripTimer:
    """Times a grip by the positions that are read of it.

    Attributes:
        reading: Usual duration of a reading [s].
        writing: Usual duration of a write [s].
    """

    def __init__(self) -> None:
        self.reading = self.writing = 0.0
        self._speed = 0.0  # [µm/s]
        self._from = 0.0
        self._seen: tuple[float, float] | None = None  # way closed [µm] and time [s]

    def begin(self, closed: float) -> None:
        """Note that a grip begins, and how far it is closed then [µm]."""
        self._seen, self._from = None, closed

    def see(self, closed: float, asked: float, answered: float) -> None:
        """Note how far it is closed [µm], measured between question and answer [s]."""
        at = 0.5 * (asked + answered)
        if self._seen is not None:
            self._speed = (closed - self._seen[0]) / max(at - self._seen[1], _JITTER)
        if self._seen is not None or closed - self._from > _MOVES:
            self._seen = closed, at

    def read(self, took: float) -> None:
        """Note how long a reading took [s]."""
        self.reading += _NEWER * (took - self.reading)

    def wrote(self, took: float) -> None:
        """Note how long a write took [s]."""
        self.writing += _NEWER * (took - self.writing)

    def due(self, left: float, writes: int) -> float:
        """Return when to begin the writes that stop it where it has so far to go [µm].

        Infinity if it does not move, or not yet.
        """
        if self._seen is None or self._speed <= 0.0:
            return math.inf
        return self._seen[1] + left / self._speed - writes * self.writing
