"""Touch sensors of a hand: their taxels, places and readings.

A driver declares its sensors in ``capabilities.touch`` and returns their readings in
``ActuatorState.touch``; the ``touch`` section of hand.yaml places them on links. The loop converts
each new reading to a `TouchState` for the recorder, the network and the GUI.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtee.values import Value

FloatArray = NDArray[np.float64]

NEWTON: Final = "N"
"""The unit of forces: only sensors with this unit count for the forces on fingers."""

STALE_AFTER: Final = 0.5
"""A reading older than this is stale [s]: even the slowest sensors measure several times in it."""


def _nowhere() -> FloatArray:
    return np.zeros((0, 3))


@dataclass(frozen=True, slots=True)
class TouchSensor(Value):
    """A contact sensor, or an array of taxels, on one link.

    Attributes:
        name: Its name, unique among the touch sensors of the hand.
        taxels: Number of its taxels ``n``, each with one value.
        unit: Unit of its values: ``N``, or the device's own, such as ``counts``.
        full: Largest value that it can measure; ``NaN``: not known.
        link: The link it is on; empty: not known.
        finger: The finger of that link; empty: none, or several.
        grid: Rows and columns of the taxels, which are in row-major order; ``None``: no grid.
        position: Positions of the taxels in the link's frame ``(n, 3)`` [m]; ``(0, 3)``: not known.
        normal: Unit normals out of the surface there ``(n, 3)``; ``(0, 3)``: not known.

    Raises:
        ValueError: if there are no taxels, or grid or positions do not match their number.
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
        """Check that grid and positions match the number of taxels."""
        if self.taxels < 1:
            raise ValueError(f"the touch sensor '{self.name}' has no taxels")
        if self.grid is not None and self.grid[0] * self.grid[1] != self.taxels:
            raise ValueError(f"the grid of the touch sensor '{self.name}' does not fit its taxels")
        shapes = {self.position.shape, self.normal.shape}
        if not shapes <= {(0, 3), (self.taxels, 3)}:
            raise ValueError(f"the touch sensor '{self.name}' needs a place for each taxel")

    @property
    def placed(self) -> bool:
        """Whether the positions of the taxels are known."""
        return bool(self.link) and len(self.position) == self.taxels


@dataclass(frozen=True, slots=True)
class TouchReading(Value):
    """A reading of all touch sensors of a device, as returned by its driver.

    Attributes:
        values: Values of all taxels of all sensors ``(n,)``, one sensor after the other, in the
            order of their declaration and in the sensors' units; ``NaN``: not measured. Drivers
            must not change the array afterwards.
        stamp: Time of the oldest value, CLOCK_MONOTONIC [s].
    """

    values: FloatArray
    stamp: float


# Without slots, since `cached_property` stores its values in the instance's dictionary.
@dataclass(frozen=True)
class TouchState(Value):
    """The newest reading of one device's touch sensors, with the sensors.

    Attributes:
        device: The device.
        sensors: Its sensors; the same object in every state, until the device is replaced.
        values: Values of all taxels ``(n,)``, one sensor after the other, in the sensors' units;
            ``NaN``: not measured.
        stamp: Time of the oldest value, CLOCK_MONOTONIC of the hand's computer [s].
        stale: Whether no newer reading arrived within `STALE_AFTER`, so that contacts are unknown.
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
        """Return the same state, marked as stale."""
        return replace(self, stale=True)


def totals(sensors: tuple[TouchSensor, ...], values: FloatArray) -> FloatArray:
    """Return the sum over the taxels of each sensor ``(sensors,)``, or ``(k, sensors)``.

    Args:
        sensors: The sensors, with at least one taxel each.
        values: Values of all their taxels ``(n,)``, or over time ``(k, n)``.
    """
    if not sensors:  # `reduceat` would refuse an empty array
        return np.zeros((*values.shape[:-1], 0))
    # `reduceat` sums from each start to the next one, and the last one to the end.
    starts = np.cumsum([0, *(sensor.taxels for sensor in sensors[:-1])])
    return np.add.reduceat(values, starts, axis=-1)
