"""How a carried hand comes to an object that stands on a table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtee.sample import FloatArray


@dataclass(frozen=True, slots=True)
class Stance:
    """How the hand comes to the object that stands on the table.

    Attributes:
        place: Pose ``(4, 4)`` in the hand's base frame where the object would be after the approach
            if nothing touched it; the palm pushes one that would be inside it.
        mount: How the hand is turned in the world ``(3, 3)``.
        way: The unit vector ``(3,)`` in the base frame along which the hand comes.
        lands: Where the object is left ``(3,)`` [m], in the base frame of the hand that opens; at
            its place unless given.
    """

    place: FloatArray
    mount: FloatArray
    way: FloatArray
    lands: FloatArray | None = None


def standing(position: FloatArray, up: FloatArray, way: FloatArray) -> Stance:
    """Return the stance in which an upright object is somewhere in the hand.

    Args:
        position: Where it is in the hand's base frame ``(3,)`` [m].
        up: Its upward axis ``(3,)`` in the base frame.
        way: About where the hand moves ``(3,)`` in the base frame as it comes; only what is
            horizontal of it counts.
    """
    up = up / np.linalg.norm(up)
    along = way - (way @ up) * up
    along = along / np.linalg.norm(along)
    place = np.eye(4)
    place[:3, :3] = np.stack([along, np.cross(up, along), up], axis=1)
    place[:3, 3] = position
    return Stance(place, np.array(place[:3, :3].T), along)
