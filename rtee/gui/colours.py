"""Colours of the browser's scene; fingers have the same colours as in reports and plots."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Final

from rtee.hand import colours
from rtee.hand.model import Hand

Colour = tuple[int, int, int]


def rgb(colour: str) -> Colour:
    """Return the red, green and blue components of ``#rrggbb``."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


PALM: Final = rgb(colours.PALM)
"""Colour of links that belong to no single finger."""

REFERENCE: Final[Colour] = (120, 120, 130)
PREVIEW: Final = rgb("#56b4e9")
CONTACT: Final = rgb("#d55e00")
OBJECT: Final[Colour] = (189, 153, 112)
"""Colour of the grasped object: the same as in the pictures of trials."""

FORCE: Final = rgb("#a3195b")
"""Colour of contact forces: unlike any other colour of the scene."""

BAR: Final = rgb("#0072b2")
APPROVE: Final = rgb("#00795c")

GOOD: Final = "var(--rtee-good)"
WARN: Final = "var(--rtee-warn)"
BAD: Final = "var(--rtee-bad)"
OLD: Final = "var(--rtee-faint)"
"""Colours of text, which follow the light or dark theme; the words alone carry the meaning, too."""

# Five samples of the colour map viridis, which is uniform to the eye and safe for colour blindness.
_RAMP: Final[tuple[Colour, ...]] = (
    (68, 1, 84),
    (59, 82, 139),
    (33, 145, 140),
    (94, 201, 98),
    (253, 231, 37),
)


def line_colour(index: int) -> str:
    """Return the colour ``#rrggbb`` of a plot's line; colours repeat after the seventh line."""
    return colours.PALETTE[index % len(colours.PALETTE)]


def line_dash(index: int) -> tuple[int, ...]:
    """Return the dashes that distinguish lines of the same colour; the first seven have none."""
    return ((), (8, 3), (2, 3), (8, 3, 2, 3))[index // len(colours.PALETTE) % 4]


def line_numbers(hand: Hand, owners: Iterable[str]) -> list[int]:
    """Return the index of each line, which gives it the colour of its finger in the scene.

    ``owners`` has the name of each line's finger; a finger's second line is dashed.
    """
    count: Counter[int] = Counter()
    numbers = []
    for owner in owners:
        # Links that belong to no finger come after the last finger.
        finger = (*hand.finger_names, owner).index(owner) % len(colours.PALETTE)
        numbers.append(finger + len(colours.PALETTE) * count[finger])
        count[finger] += 1
    return numbers


def lines_of(hand: Hand) -> tuple[list[int], list[int]]:
    """Return the indices of the lines of all actuators, and of all joints; see `line_numbers`."""
    owner = colours.finger_of_link(hand)
    return (
        line_numbers(hand, ["".join(actuator.fingers[:1]) for actuator in hand.actuators]),
        line_numbers(hand, [owner.get(joint.child, "") for joint in hand.joints]),
    )


def link_colours(hand: Hand) -> dict[str, Colour]:
    """Return the colour of each link: that of its finger, or the palm's."""
    of_finger = colours.finger_colours(hand)
    owner = colours.finger_of_link(hand)
    return {
        link: rgb(of_finger[owner[link]]) if link in owner else PALM for link in hand.urdf.links
    }


def blend(first: Colour, second: Colour, share: float) -> Colour:
    """Return a mixture of two colours: a share of 0 gives ``first``, 1 gives ``second``."""
    s = min(max(share, 0.0), 1.0)
    return (
        round(first[0] + s * (second[0] - first[0])),
        round(first[1] + s * (second[1] - first[1])),
        round(first[2] + s * (second[2] - first[2])),
    )


def ramp(share: float) -> Colour:
    """Return the colour of a value between 0 (dark) and 1 (bright)."""
    s = min(max(share, 0.0), 1.0) * (len(_RAMP) - 1)
    index = min(int(s), len(_RAMP) - 2)
    return blend(_RAMP[index], _RAMP[index + 1], s - index)
