"""Taxels on the hand in the browser's scene, coloured by what they measure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Final

import numpy as np
import viser
from numpy.typing import NDArray

from rtee.gui.colours import ramp
from rtee.hand.model import Hand
from rtee.sample import FloatArray
from rtee.touch import NEWTON, TouchSensor, TouchState

_SHADES: Final = 32
"""Colours between nothing and the largest value: finer steps cannot be distinguished."""

_COLOURS: Final = np.array([ramp(k / (_SHADES - 1)) for k in range(_SHADES)], dtype=np.uint8)

_STALE: Final = np.array((150, 150, 150), dtype=np.uint8)
"""Taxels without fresh values: grey is not the colour of any measured value."""

_LIFT: Final = 0.0006
"""Height of the points above the surface [m], in which they would flicker."""

_LEAST: Final[Mapping[str, float]] = {NEWTON: 0.5}
"""Least value of the brightest colour by unit, so that noise stays dark."""

_POINT: Final = 0.6
"""Size of a point as a share of the distance to the next one, so that points stay apart."""

_ALONE: Final = 0.02
"""Size of the only taxel of a link, as a share of the hand's size: about that of a fingertip."""

Bytes = NDArray[np.uint8]


class TaxelView:
    """The taxels of a hand's touch sensors, as coloured points on its links, for its size [m]."""

    def __init__(
        self, scene: viser.SceneApi, hand: Hand, frames: Mapping[str, str], size: float
    ) -> None:
        self._scene, self._frames, self._size = scene, frames, size
        self._links = set(hand.urdf.links)
        self._sensors: dict[str, tuple[TouchSensor, ...]] = {}
        self._clouds: dict[str, viser.PointCloudHandle] = {}
        self._drawn: dict[str, Bytes] = {}
        self._most: dict[str, float] = {}

    @property
    def fingers(self) -> set[str]:
        """The fingers whose taxels are drawn."""
        placed = (
            s for sensors in self._sensors.values() for s in sensors if s.name in self._clouds
        )
        return {sensor.finger for sensor in placed if sensor.finger}

    def show(self, states: Iterable[TouchState]) -> None:
        """Colour the taxels by their values; without states, remove them."""
        states = tuple(states)
        names = [state.device for state in states]
        for device in [name for name in self._sensors if name not in names]:
            self._forget(device)
        for state in states:
            # Compare by identity: the states of one device share their tuple of sensors.
            if self._sensors.get(state.device) is not state.sensors:
                self._forget(state.device)
                self._add(state)
            for sensor in state.sensors:
                cloud = self._clouds.get(sensor.name)
                if cloud is not None:
                    self._colour(sensor, cloud, state)

    def _add(self, state: TouchState) -> None:
        self._sensors[state.device] = state.sensors
        for sensor in state.sensors:
            if sensor.placed and sensor.link in self._links:
                points = sensor.position
                if len(sensor.normal) == len(points):
                    points = points + _LIFT * sensor.normal
                self._clouds[sensor.name] = self._scene.add_point_cloud(
                    f"{self._frames[sensor.link]}/touch_{sensor.name}",
                    points.astype(np.float32),
                    np.tile(_COLOURS[0], (len(points), 1)),
                    point_size=_size(points, _ALONE * self._size),
                    point_shape="circle",
                    point_shading="flat",
                    precision="float32",
                )

    def _colour(
        self, sensor: TouchSensor, cloud: viser.PointCloudHandle, state: TouchState
    ) -> None:
        values = state.of(sensor.name)
        if state.stale:
            colours: Bytes = np.tile(_STALE, (sensor.taxels, 1))
        else:
            colours = _COLOURS[shades(values, self._brightest(sensor, values))]
        drawn = self._drawn.get(sensor.name)
        if drawn is None or not np.array_equal(colours, drawn):
            self._drawn[sensor.name] = cloud.colors = colours

    def _brightest(self, sensor: TouchSensor, values: FloatArray) -> float:
        """Return the value of the brightest colour: the largest one of its unit so far."""
        unit = sensor.unit
        largest = float(np.nanmax(values, initial=0.0))
        least = _LEAST.get(unit, 0.05 * sensor.full if math.isfinite(sensor.full) else 1.0)
        # One scale for all sensors of a unit. It never shrinks, so that released taxels turn dark.
        most = self._most[unit] = max(self._most.get(unit, least), largest)
        return most

    def _forget(self, device: str) -> None:
        for sensor in self._sensors.pop(device, ()):
            self._drawn.pop(sensor.name, None)
            cloud = self._clouds.pop(sensor.name, None)
            if cloud is not None:
                cloud.remove()

    def remove(self) -> None:
        """Remove all taxels from the scene."""
        self.show(())


def shades(values: FloatArray, most: float) -> NDArray[np.intp]:
    """Return the index of the colour of each value ``(n,)``, the brightest from ``most`` on.

    ``NaN`` counts as 0.
    """
    share = np.clip(np.nan_to_num(values) / most, 0.0, 1.0)
    return np.rint(share * (_SHADES - 1)).astype(np.intp)


def _size(points: FloatArray, alone: float) -> float:
    """Return the size of a sensor's points [m]."""
    if len(points) < 2:
        return alone
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    # The median, so that a few taxels close together do not shrink all points.
    return _POINT * float(np.median(apart.min(axis=1)))
