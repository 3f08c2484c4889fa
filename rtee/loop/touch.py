"""Gather the readings of the devices' touch sensors, and derive the forces on the fingers."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from rtee.drivers.capabilities import Capabilities
from rtee.hand.model import Hand
from rtee.hand.touch import on_hand, scale_of
from rtee.sample import NOTHING, FloatArray
from rtee.touch import NEWTON, STALE_AFTER, TouchReading, TouchSensor, TouchState


@dataclass(slots=True)
class _Device:
    """The layout and the newest reading of one device's touch sensors.

    Attributes:
        declared: The sensors as declared by the driver; the fields below follow from them.
        sensors: The sensors with their places on the hand.
        scale: Factors on the values ``(n,)``; ``None``: all are 1.
        weights: Matrix that sums the taxels of each finger ``(fingers, n)``; ``None``: no finger
            has forces.
        blank: ``NaN`` for the fingers without forces, else 0 ``(fingers,)``.
        reading: The newest reading.
    """

    declared: tuple[TouchSensor, ...] = ()
    sensors: tuple[TouchSensor, ...] = ()
    scale: FloatArray | None = None
    weights: FloatArray | None = None
    blank: FloatArray | None = None
    reading: TouchReading | None = None


class TouchGatherer:
    """Converts the readings of drivers to states; does nothing while no reading is new.

    Args:
        hand: The hand.
        on_refused: Called with the device and a sentence when a reading cannot be used.

    Attributes:
        states: The newest states by device; never changed, but replaced.
        forces: Force on each finger ``(fingers,)`` [N], by device; ``NaN``: no sensor measures it,
            or its reading is stale.
    """

    def __init__(self, hand: Hand, on_refused: Callable[[str, str], None]) -> None:
        self._hand = hand
        self._on_refused = on_refused
        self._devices: dict[str, _Device] = {}
        self._next_stale = math.inf
        self.states: Mapping[str, TouchState] = NOTHING
        self.forces: Mapping[str, FloatArray] = NOTHING

    def take(self, name: str, can: Capabilities, reading: TouchReading) -> bool:
        """Accept a device's newest reading; return whether it is new and can be used."""
        device = self._devices.get(name)
        if device is None:
            device = self._devices[name] = _Device()
        if reading is device.reading:
            return False
        device.reading = reading
        if device.declared is not can.touch:
            self._lay_out(name, device, can.touch)
        values = np.asarray(reading.values, dtype=np.float64)
        if values.shape != (sum(sensor.taxels for sensor in device.sensors),):
            self._refuse(name, f"gave {values.size} values of touch, which its sensors do not have")
            return False
        if device.scale is not None:
            values = values * device.scale
        self.states = {
            **self.states,
            name: TouchState(name, device.sensors, values, reading.stamp),
        }
        if device.weights is not None and device.blank is not None:
            self.forces = {**self.forces, name: _felt(device.weights, values) + device.blank}
        self._next_stale = min(self._next_stale, reading.stamp + STALE_AFTER)
        return True

    def _lay_out(self, name: str, device: _Device, declared: tuple[TouchSensor, ...]) -> None:
        """Determine the places of the sensors, and the taxels of each finger."""
        device.declared = declared
        placed, scales = [], []
        for sensor in declared:
            try:
                placed.append(on_hand(sensor, self._hand))
                scales.append(scale_of(sensor, self._hand))
            except ValueError as error:
                self._refuse(name, f"{error}; its place is not known")
                placed.append(sensor)
                scales.append(1.0)
        taxels = [sensor.taxels for sensor in placed]
        device.sensors = tuple(placed)
        device.scale = np.repeat(scales, taxels) if any(s != 1.0 for s in scales) else None
        forces = [sensor.finger if sensor.unit == NEWTON else "" for sensor in placed]
        names = self._hand.finger_names
        rows = [np.repeat([finger == name for finger in forces], taxels) for name in names]
        weights = np.array(rows, dtype=np.float64).reshape(len(names), sum(taxels))
        device.weights = weights if weights.any() else None
        device.blank = np.where(weights.any(axis=1), 0.0, math.nan)

    def _refuse(self, name: str, text: str) -> None:
        self._on_refused(name, f"device '{name}': {text}")

    def outdate(self, now: float) -> list[str]:
        """Mark states that are stale now; return the devices whose forces became unknown."""
        if now <= self._next_stale:
            return []
        gone = []
        self._next_stale = math.inf
        for name, state in self.states.items():
            if state.stale:
                continue
            if now <= state.stamp + STALE_AFTER:
                self._next_stale = min(self._next_stale, state.stamp + STALE_AFTER)
                continue
            self.states = {**self.states, name: state.outdated()}
            if name in self.forces:
                self.forces = {**self.forces, name: self.forces[name] * math.nan}
                gone.append(name)
        return gone


def _felt(weights: FloatArray, values: FloatArray) -> FloatArray:
    """Return the sum of the taxels of each finger ``(fingers,)`` [N]; ``NaN``: none measured."""
    sums: FloatArray = weights @ values
    total = float(sums.sum())
    if total - total != 0.0:  # a value is not finite, which is rare
        measured = np.isfinite(values).astype(np.float64)
        # A taxel without a value must not hide the other taxels of its finger.
        sums = weights @ np.where(measured > 0.0, values, 0.0)
        sums[weights @ measured == 0.0] = math.nan
    return sums
