"""Merge the states of a hand's devices into the state of the hand."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rtee.loop.measured import TIP_FORCE, Measured, tip_forces
from rtee.loop.supervisor import Supervisor
from rtee.loop.touch import TouchGatherer
from rtee.sample import (
    MEASURED,
    ActuatorState,
    BoolArray,
    FloatArray,
    Measurements,
    measured_arrays,
)
from rtee.touch import TouchState
from rtee.types import readonly

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
        """Return the further channels, and what the controller has computed."""
        return {**self.channels, **computed} if computed else self.channels

    def collect(self, stamp: float = -math.inf) -> None:
        """Merge the states that arrived since the last call.

        Args:
            stamp: Now [s]; touch readings that are older by `STALE_AFTER` become stale.
        """
        new = 0
        for k, device in enumerate(self._devices):
            link = device.connection
            state = link.state
            if state is not None and link.states != self._seen[k]:
                self._seen[k] = link.states
                # One bit for each device, so that the flags of each combination are made once. A
                # driver that returns a measurement again may not say so.
                new |= (state.fresh and state.stamp != self._stamps[k]) << k
                self._stamps[k] = state.stamp
                self._merge(k, state)
        for name in self._touch.outdate(stamp):
            if name in self._by_taxels:
                forces = self._touch.forces[name]
                self._keep_extras(name, {**self._extras[name], TIP_FORCE: forces})
        if new != self._new or self._invalid:
            # Not the same while there are invalid positions: the flags are made for each tick.
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
        # After `_felt`, which still needs the other devices' channels only.
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
