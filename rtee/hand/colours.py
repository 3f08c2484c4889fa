"""A colour per finger, the same in every picture, plot and user interface.

The palette is that of Okabe and Ito (2008), whose colours people with the usual colour vision
deficiencies can distinguish; in this order, neighbours differ most.
"""

from __future__ import annotations

from typing import Final

from rtee.hand.model import Hand

PALETTE: Final = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#56b4e9", "#f0e442")
PALM: Final = "#9aa0a6"


def finger_colours(hand: Hand) -> dict[str, str]:
    """Return a colour ``#rrggbb`` per finger."""
    return {finger.name: PALETTE[i % len(PALETTE)] for i, finger in enumerate(hand.fingers)}


def finger_of_link(hand: Hand) -> dict[str, str]:
    """Return the finger of each link; links of the palm are missing.

    A link belongs to a finger if it, or a link above it, is in the finger's chain below the base.
    Links shared by several chains belong to no finger.
    """
    owners: dict[str, set[str]] = {}
    for finger in hand.fingers:
        for link in finger.body[1:] or finger.body:
            owners.setdefault(link, set()).add(finger.name)
    found: dict[str, str] = {}
    for joint in hand.urdf.joints.values():
        if joint.child in owners:
            names = owners[joint.child]
            if len(names) == 1:
                found[joint.child] = next(iter(names))
        elif joint.parent in found:
            # Joints are in the order of the tree, so the parent is already known.
            found[joint.child] = found[joint.parent]
    return found
