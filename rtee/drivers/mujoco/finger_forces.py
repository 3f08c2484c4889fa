"""The contact forces on the fingers of a running simulation, by finger."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from rtee.drivers.mujoco.pairs import LINK
from rtee.hand.model import Hand
from rtee.sample import FloatArray

_NONE = 0.0, 0.0, 0.0


class FingerForces:
    """Reads the normal force on each finger, as pads that measure pressure do.

    It counts contacts of links that belong to one finger with anything outside the hand, and
    contacts between two fingertips. A finger that presses on the palm holds nothing.
    """

    def __init__(self, model: mujoco.MjModel, hand: Hand) -> None:
        tips = [finger.tip_links for finger in hand.fingers]
        owners: dict[str, set[int]] = {}
        for index, finger in enumerate(hand.fingers):
            for link in finger.body:
                owners.setdefault(link, set()).add(index)
        felt = [tip for tip in dict.fromkeys(tips) if tip]
        self._tips = len(felt)
        # A link that several fingers share, such as the palm, belongs to none.
        felt += [(n,) for n, own in owners.items() if len(own) == 1 and n not in hand.tip_links]
        row_of_geom = np.full(model.ngeom, -1, dtype=np.intp)
        for row, links in enumerate(felt):
            for link in links:
                row_of_geom[model.geom_bodyid == model.body(LINK + link).id] = row
        self._row_of_geom: list[int] = row_of_geom.tolist()
        bodies = [model.body(int(body)).name for body in model.geom_bodyid]
        self._of_hand = [name.startswith(LINK) for name in bodies]
        self._rows = len(felt)
        self._belongs = np.zeros((len(hand.fingers), len(felt)))
        for index, tip in enumerate(tips):
            for row, links in enumerate(felt):
                alone = owners.get(links[0]) == {index}
                self._belongs[index, row] = links == tip or (row >= self._tips and alone)

    def read(self, data: mujoco.MjData) -> FloatArray:
        """Return the sum of the normal forces on each finger's links ``(fingers,)`` [N]."""
        felt = self._felt(data) if data.ncon else []
        if not felt:
            return np.zeros(len(self._belongs))
        # Plain numbers: for so few contacts, in every cycle, numpy takes several times as long.
        forces: dict[int, tuple[float, float, float]] = {}
        for row, x, y, z in felt:
            a, b, c = forces.get(row, _NONE)
            forces[row] = a + x, b + y, c + z
        sizes = np.zeros(self._rows)
        for row, (x, y, z) in forces.items():
            sizes[row] = math.sqrt(x * x + y * y + z * z)
        return np.asarray(self._belongs @ sizes)

    def _felt(self, data: mujoco.MjData) -> list[tuple[int, float, float, float]]:
        """Return the row of each side of a contact that is felt, and the normal force on it [N].

        Forces are along the world's axes; those on the first sides come first.
        """
        contact = data.contact
        rows, of_hand, tips = self._row_of_geom, self._of_hand, self._tips
        firsts, seconds = [], []
        frames, forces = contact.frame.tolist(), data.efc_force.tolist()
        starts = contact.efc_address.tolist()
        for number, (one, other) in enumerate(contact.geom.tolist()):
            start, first, second = starts[number], rows[one], rows[other]
            # A contact that is only within the margin has no rows in the solver, and no force.
            if start < 0 or (first < 0 and second < 0):
                continue
            # Within the hand, only two fingertips feel each other.
            if of_hand[one] and of_hand[other] and not (0 <= first < tips and 0 <= second < tips):
                continue
            a, b, c = frames[number][:3]
            # The first row of an elliptic contact is its normal force.
            normal = forces[start]
            x, y, z = a * normal, b * normal, c * normal
            if first >= 0:
                firsts.append((first, -x, -y, -z))
            if second >= 0:
                seconds.append((second, x, y, z))
        return firsts + seconds
