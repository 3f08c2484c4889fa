"""Merge the states of a hand's devices into the state of the hand."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtee.drivers.capabilities import Capabilities
from rtee.hand.model import Hand
from rtee.hand.touch import on_hand, scale_of
from rtee.loop.measured import TIP_FORCE, Measured, tip_forces
from rtee.loop.supervisor import Supervisor
from rtee.sample import (
    MEASURED,
    NOTHING,
    ActuatorState,
    BoolArray,
    FloatArray,
    Measurements,
    measured_arrays,
)
from rtee.touch import NEWTON, STALE_AFTER, TouchReading, TouchSensor, TouchState
from rtee.types import readonly


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
            self._refuse(name, f"gave {values.size} touch values, which do not fit its sensors")
            return False
        if device.scale is not None:
            values = values * device.scale
        self.states = {**self.states, name: TouchState(name, device.sensors, values, reading.stamp)}
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
        """Mark stale states; return the devices whose forces became unknown."""
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


_OLD = 1.0
"""A state that is collected this much later than usual is not fresh [s]: the loop did not run, and
people may have moved the hand."""

_GRASPED = {None: -1, False: 0, True: 1}  # a device's report, as `Measured.grasped` has it


class StateAggregator:
    """Merges the states of all devices; published arrays are never changed, but replaced.

    A position that is not validly measured keeps its last value, which does not count as fresh;
    before the first measurement it is ``NaN``.

    Args:
        devices: The devices, which together have every actuator once.
        touch: Gathers the readings of their touch sensors.

    Attributes:
        sample: The measured quantities of all actuators.
        grasped: The devices' own reports ``(n,)``: 1 holding, 0 not holding, -1 no report.
        fresh: Whether each actuator was validly measured since the last `collect` ``(n,)``.
        channels: Further channels by ``device/channel``, among them the forces that touch sensors
            measure on the fingers.
        measured: The same measurements as lists, for the controller.
    """

    def __init__(self, devices: Sequence[Supervisor], touch: TouchGatherer) -> None:
        n = sum(len(device.indices) for device in devices)
        unmeasured = readonly([math.nan] * n)
        self._devices = tuple(devices)
        self._touch = touch
        self._by_taxels: dict[str, tuple[Mapping[str, FloatArray], FloatArray]] = {}
        self._indices = [np.array(device.indices, dtype=np.intp) for device in devices]
        self._where = dict(zip((d.name for d in devices), self._indices, strict=True))
        self._whole = len(devices) == 1 and tuple(devices[0].indices) == tuple(range(n))
        self._seen = [0] * len(devices)
        # A state waits for the next tick, or for the one after it.
        self._oldest = _OLD + 2.0 / min((d.spec.rate for d in devices), default=1.0)
        self._stamps = [math.nan] * len(devices)
        self._fresh: dict[int, tuple[BoolArray, list[bool]]] = {}
        self._extras: dict[str, Mapping[str, FloatArray]] = {}
        self.sample = Measurements(*(unmeasured,) * len(MEASURED))
        self.grasped: NDArray[np.int8] = np.full(n, -1, dtype=np.int8)
        self.channels: Mapping[str, FloatArray] = {}
        self._new = 0
        self._invalid: dict[int, BoolArray] = {}
        self.fresh, listed = self._flags(0)
        nothing = [math.nan] * n
        self.measured = Measured(nothing, nothing, nothing, listed, [-1] * n)

    @property
    def touch(self) -> Mapping[str, TouchState]:
        """The newest states of the touch sensors, by device."""
        return self._touch.states

    def channels_with(self, computed: Mapping[str, FloatArray]) -> Mapping[str, FloatArray]:
        """Return the further channels together with those that the controller has computed."""
        return {**self.channels, **computed} if computed else self.channels

    def collect(self, stamp: float = -math.inf) -> None:
        """Merge the states that arrived since the last call.

        Args:
            stamp: Now [s]; touch readings that are older by `STALE_AFTER` become stale, and states
                that waited for too long are not fresh.
        """
        new = 0
        for k, device in enumerate(self._devices):
            link = device.connection
            state = link.state
            if state is not None and link.states != self._seen[k]:
                self._seen[k] = link.states
                # One bit per device, so that the flags of each combination are built once. A driver
                # may return the same measurement again without saying so.
                late = stamp - link.answered > self._oldest
                new |= (state.fresh and state.stamp != self._stamps[k] and not late) << k
                self._stamps[k] = state.stamp
                self._merge(k, state)
        for name in self._touch.outdate(stamp):
            if name in self._by_taxels:
                forces = self._touch.forces[name]
                self._keep_extras(name, {**self._extras[name], TIP_FORCE: forces})
        if new != self._new or self._invalid:
            # Not reused while there are invalid positions: the flags are then built at every tick.
            self._new = -1 if self._invalid else new
            self.fresh, self.measured.fresh = self._flags(new)
            for k, invalid in self._invalid.items():
                fresh = self.fresh.copy()
                fresh[self._indices[k][invalid]] = False
                fresh.flags.writeable = False
                self.fresh, self.measured.fresh = fresh, fresh.tolist()

    def known(self, device: Supervisor) -> bool:
        """Return whether the newest state of a device has a valid position for every actuator."""
        state = device.connection.state
        return state is not None and bool(np.isfinite(state.position).all())

    def where(self, device: Supervisor) -> NDArray[np.intp] | None:
        """Return the hand's indices of a device's actuators; ``None``: all of them, in order."""
        return None if self._whole else self._where[device.name]

    def _flags(self, devices: int) -> tuple[BoolArray, list[bool]]:
        cached = self._fresh.get(devices)
        if cached is None:
            flags = np.zeros(sum(len(i) for i in self._indices), dtype=np.bool_)
            for k, indices in enumerate(self._indices):
                flags[indices] = bool(devices >> k & 1)
            flags.flags.writeable = False
            cached = self._fresh[devices] = (flags, flags.tolist())
        return cached

    def _merge(self, k: int, state: ActuatorState) -> None:
        measured, before = self.measured, self.sample
        sample: Measurements = state
        if not self._whole:
            where = self._indices[k]
            pairs = zip(measured_arrays(before), measured_arrays(state), strict=True)
            sample = Measurements(*(_put(old, where, new) for old, new in pairs))
        measured.update(sample, before)
        # One sum finds any NaN or infinity, and is much faster than testing each value.
        total = sum(measured.position)
        if total - total != 0.0:  # a position is not finite
            position = np.where(np.isfinite(sample.position), sample.position, before.position)
            sample = replace(sample, position=position)
            measured.position = position.tolist()
            invalid = ~np.isfinite(state.position)
            if invalid.any():
                self._invalid[k] = invalid
            else:
                self._invalid.pop(k, None)
        elif self._invalid:
            self._invalid.pop(k, None)
        self.sample = sample
        if state.grasped is not None:
            grasped = self.grasped.copy()
            grasped[self._indices[k]] = [_GRASPED[report] for report in state.grasped]
            self.grasped = grasped
            measured.grasped = grasped.tolist()
        name, extras = self._devices[k].name, state.extras
        if state.touch is not None:
            self._touch.take(name, self._devices[k].guarded.capabilities, state.touch)
        felt = self._touch.forces.get(name)
        # The device's own forces on its fingers take precedence over the sums of its taxels.
        if felt is not None and TIP_FORCE not in extras:
            # Most states have neither a new touch reading nor new channels.
            known = self._by_taxels.get(name)
            if known is not None and known[0] is extras and known[1] is felt:
                return
            self._by_taxels[name] = extras, felt
            extras = {**extras, TIP_FORCE: felt}
        if extras or self._extras.get(name):
            self._keep_extras(name, extras)

    def _keep_extras(self, name: str, extras: Mapping[str, FloatArray]) -> None:
        """Keep the further channels of a device."""
        self.measured.touch = self._felt(name, extras)
        # After `_felt`, which needs the channels without this device's.
        self._extras[name] = extras
        self.channels = {
            f"{device}/{channel}": values
            for device, channels in self._extras.items()
            for channel, values in channels.items()
        }

    def _felt(self, device: str, extras: Mapping[str, FloatArray]) -> list[float]:
        """Return the forces on the fingers [N], each from the device that measures it."""
        forces = [extras[TIP_FORCE]] if TIP_FORCE in extras else []
        for other, channels in self._extras.items():
            if other != device and TIP_FORCE in channels:
                forces.append(channels[TIP_FORCE])
        return tip_forces(forces)


def _put(into: FloatArray, where: NDArray[np.intp], values: FloatArray) -> FloatArray:
    changed = into.copy()
    changed[where] = values
    return changed
