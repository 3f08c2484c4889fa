"""What contact sensors and taxels of a hand measure, and where on its links they are.

A driver declares its sensors in ``capabilities.touch`` and hands readings over in
``ActuatorState.touch``; the ``touch`` section of hand.yaml places them. The loop makes a
`TouchState` of each new reading, which the recorder, the network and the GUI pass on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

NEWTON: Final = "N"
"""The unit of forces: only sensors that measure in it count for what a finger feels."""

STALE_AFTER: Final = 0.5
"""A reading older than this is stale [s]: the slowest sensors read give a few in this time."""


def _nowhere() -> FloatArray:
    return np.zeros((0, 3))


@dataclass(frozen=True, slots=True, eq=False)
class TouchSensor:
    """A contact sensor, or an array of taxels, on one link.

    Attributes:
        name: Its name, which no other touch sensor of the hand has.
        taxels: Number of its values ``n``.
        unit: Unit of its values: ``N``, or the device's own, such as ``counts``.
        full: Largest value that it can measure; ``NaN``: not known.
        link: The link it is on; empty: not known.
        finger: The finger that the link belongs to; empty: none, or several.
        grid: Rows and columns, where the taxels come row by row; ``None``: they form no grid.
        position: Where the taxels are in the link's frame ``(n, 3)`` [m]; ``(0, 3)``: not known.
        normal: Unit normals out of the surface there ``(n, 3)``; ``(0, 3)``: not known.

    Raises:
        ValueError: if it has no taxels, or the grid or the places are not those of its taxels.
    """

    name: str
    taxels: int = 1
    unit: str = NEWTON
    full: float = math.nan
    link: str = ""
    finger: str = ""
    grid: tuple[int, int] | None = None
    position: FloatArray = field(default_factory=_nowhere)
    normal: FloatArray = field(default_factory=_nowhere)

    def __post_init__(self) -> None:
        """Check that all is about the same taxels."""
        if self.taxels < 1:
            raise ValueError(f"the touch sensor '{self.name}' has no taxels")
        if self.grid is not None and self.grid[0] * self.grid[1] != self.taxels:
            raise ValueError(f"the touch sensor '{self.name}' has not the taxels of its grid")
        shapes = {self.position.shape, self.normal.shape}
        if not shapes <= {(0, 3), (self.taxels, 3)}:
            raise ValueError(f"the touch sensor '{self.name}' has not a place for each taxel")

    @property
    def placed(self) -> bool:
        """Whether it is known where the taxels are."""
        return bool(self.link) and len(self.position) == self.taxels


@dataclass(frozen=True, slots=True, eq=False)
class TouchReading:
    """What the touch sensors of a device measured, as its driver hands it over.

    Attributes:
        values: Values of all taxels of all sensors ``(n,)``, one sensor after the other, in the
            order in which the driver declared them and in the sensors' units; ``NaN``: not
            measured. A driver never changes it afterwards.
        stamp: When the oldest of them was measured, CLOCK_MONOTONIC [s].
    """

    values: FloatArray
    stamp: float


@dataclass(frozen=True, eq=False)
class TouchState:
    """What the touch sensors of one device measured last.

    Attributes:
        device: The device.
        sensors: Its sensors; the same object in every state, until the device is another one.
        values: Values of all taxels ``(n,)``, one sensor after the other, in the sensors' units;
            ``NaN``: not measured.
        stamp: When the oldest of them was measured, CLOCK_MONOTONIC of the hand's computer [s].
        stale: No newer reading came within `STALE_AFTER`: what is touched now is not known.
    """

    device: str
    sensors: tuple[TouchSensor, ...]
    values: FloatArray
    stamp: float
    stale: bool = False

    @cached_property
    def _slices(self) -> dict[str, slice]:
        ends = np.cumsum([sensor.taxels for sensor in self.sensors]).tolist()
        return {
            s.name: slice(end - s.taxels, end) for s, end in zip(self.sensors, ends, strict=True)
        }

    def of(self, name: str) -> FloatArray:
        """Return the values of a sensor's taxels ``(n,)`` in its unit.

        Raises:
            KeyError: if the device has no such sensor.
        """
        return self.values[self._slices[name]]

    @cached_property
    def totals(self) -> FloatArray:
        """The sum over the taxels of each sensor ``(sensors,)``, in its unit."""
        return totals(self.sensors, self.values)

    def outdated(self) -> TouchState:
        """Return the same as stale."""
        return replace(self, stale=True)


def totals(sensors: tuple[TouchSensor, ...], values: FloatArray) -> FloatArray:
    """Return the sum over the taxels of each sensor ``(sensors,)``, or ``(k, sensors)``.

    Args:
        sensors: The sensors, with at least one taxel each.
        values: Values of all their taxels ``(n,)``, or over time ``(k, n)``.
    """
    if not sensors:
        return np.zeros((*values.shape[:-1], 0))
    starts = np.cumsum([0, *(sensor.taxels for sensor in sensors[:-1])])
    found: FloatArray = np.add.reduceat(values, starts, axis=-1)
    return found
