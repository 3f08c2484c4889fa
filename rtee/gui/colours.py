"""Colours that people with any colour vision tell apart: Okabe and Ito's palette, and a ramp."""

from __future__ import annotations

from typing import Final

Colour = tuple[int, int, int]

PALM: Final[Colour] = (158, 163, 170)
"""Links that belong to no single finger."""

FINGERS: Final[tuple[Colour, ...]] = (
    (0, 114, 178),
    (230, 159, 0),
    (0, 158, 115),
    (204, 121, 167),
    (86, 180, 233),
    (240, 228, 66),
    (213, 94, 0),
)
"""One per finger, used again from the start when there are more fingers."""

REFERENCE: Final[Colour] = (120, 120, 130)
PREVIEW: Final[Colour] = (86, 180, 233)
CONTACT: Final[Colour] = (213, 94, 0)
STOP: Final[Colour] = (201, 42, 42)

_RAMP: Final[tuple[Colour, ...]] = (
    (68, 1, 84),
    (59, 82, 139),
    (33, 145, 140),
    (94, 201, 98),
    (253, 231, 37),
)


def finger_colour(index: int) -> Colour:
    """Return the colour of the finger at an index."""
    return FINGERS[index % len(FINGERS)]


def blend(first: Colour, second: Colour, share: float) -> Colour:
    """Return a mixture: 0 gives ``first``, 1 gives ``second``."""
    s = min(max(share, 0.0), 1.0)
    return (
        round(first[0] + s * (second[0] - first[0])),
        round(first[1] + s * (second[1] - first[1])),
        round(first[2] + s * (second[2] - first[2])),
    )


def ramp(share: float) -> Colour:
    """Return the colour of a quantity between 0 and 1, dark to bright."""
    s = min(max(share, 0.0), 1.0) * (len(_RAMP) - 1)
    index = min(int(s), len(_RAMP) - 2)
    return blend(_RAMP[index], _RAMP[index + 1], s - index)
