"""What the fingers feel: the contact forces of a running simulation, by finger."""

from __future__ import annotations

import mujoco
import numpy as np

from rtee.drivers.mujoco.pairs import LINK
from rtee.hand.model import Hand
from rtee.sample import FloatArray


class FingerForces:
    """Reads the force on each finger.

    Contacts with things that are not the hand count at all links that belong to one finger, and
    those of two fingertips with one another. A finger that presses on the palm holds nothing.
    """

    def __init__(self, model: mujoco.MjModel, hand: Hand) -> None:
        """Look the links up.

        Args:
            model: The compiled model.
            hand: The hand in it.
        """
        tips = [finger.tip for finger in hand.fingers]
        owners: dict[str, set[int]] = {}
        for index, finger in enumerate(hand.fingers):
            for link in finger.links:
                owners.setdefault(link, set()).add(index)
        felt = [tip for tip in dict.fromkeys(tips) if tip is not None]
        self._tips = len(felt)
        # A link that several fingers share, such as the palm, belongs to none.
        felt += [n for n, own in owners.items() if len(own) == 1 and n not in felt]
        self._row_of_geom = np.full(model.ngeom, -1, dtype=np.intp)
        for row, link in enumerate(felt):
            self._row_of_geom[model.geom_bodyid == model.body(LINK + link).id] = row
        bodies = [model.body(int(body)).name for body in model.geom_bodyid]
        self._of_hand = np.array([name.startswith(LINK) for name in bodies], dtype=bool)
        self._rows = len(felt)
        self._belongs = np.zeros((len(hand.fingers), len(felt)))
        for index, tip in enumerate(tips):
            for row, link in enumerate(felt):
                alone = owners.get(link) == {index}
                self._belongs[index, row] = link == tip or (row >= self._tips and alone)

    def read(self, data: mujoco.MjData) -> FloatArray:
        """Return the sum of the forces on the links of each finger ``(fingers,)`` [N].

        Args:
            data: The state of the model.
        """
        forces = np.zeros((self._rows + 1, 3))  # the last row takes what no finger feels
        if data.ncon:
            contact = data.contact
            first = contact.efc_address
            rows = self._row_of_geom[contact.geom]
            seen = np.flatnonzero((first >= 0) & (rows >= 0).any(axis=1))
            if len(seen):
                rows = rows[seen]
                within = self._of_hand[contact.geom[seen]].all(axis=1)
                of_tips = ((rows >= 0) & (rows < self._tips)).all(axis=1)
                rows[within & ~of_tips] = -1
                # The first three rows of an elliptic contact are its force in its own frame.
                own = data.efc_force[first[seen, None] + np.arange(3)]
                world = np.einsum("kij,ki->kj", contact.frame[seen].reshape(-1, 3, 3), own)
                np.subtract.at(forces, rows[:, 0], world)
                np.add.at(forces, rows[:, 1], world)
        # Much faster than numpy.linalg.norm for so few rows, in every cycle.
        sizes = np.sqrt((forces[:-1] * forces[:-1]).sum(axis=1))
        return np.asarray(self._belongs @ sizes, dtype=np.float64)
