"""Joint positions and velocities from those of the actuators, also where some are not measured."""

from __future__ import annotations

import math

import numpy as np

from rtee.hand.transmission import Transmission
from rtee.types import FloatArray


class Joints:
    """The joints of a hand as its actuators move them.

    An actuator that is not measured leaves only its own joints unknown, other than in a product
    with the transmission's matrix.
    """

    def __init__(self, transmission: Transmission) -> None:
        moved = [transmission.moves(row) for row in range(transmission.n_joints)]
        rows = np.arange(transmission.n_joints)
        self._still = np.array([actuator is None for actuator in moved], dtype=bool)
        self._follows = np.array([actuator or 0 for actuator in moved], dtype=np.intp)
        self._factor = transmission.matrix[rows, self._follows]
        self._offset = np.array(transmission.offset)
        self._curved = [
            (row, coupling.actuator, coupling)
            for row, coupling in enumerate(transmission.couplings)
            if coupling.actuator is not None and not coupling.linear
        ]

    def positions(self, u: FloatArray) -> FloatArray:
        """Return joint positions ``(m,)`` for actuator positions ``(n,)`` [rad | m]."""
        q: FloatArray = u[self._follows] * self._factor + self._offset
        q[self._still] = self._offset[self._still]
        for row, actuator, coupling in self._curved:
            value = float(u[actuator])
            q[row] = coupling.value(value) if math.isfinite(value) else math.nan
        return q

    def velocities(self, u: FloatArray, velocity: FloatArray) -> FloatArray:
        """Return joint velocities ``(m,)`` [rad/s | m/s]."""
        v: FloatArray = velocity[self._follows] * self._factor
        v[self._still] = 0.0
        for row, actuator, coupling in self._curved:
            value = float(u[actuator])
            slope = coupling.dual(value)[1] if math.isfinite(value) else math.nan
            v[row] = slope * velocity[actuator]
        return v
