"""The devices of one hand: their actuators, which of them may be moved, and common requests."""

from __future__ import annotations

import logging
import math
from collections.abc import Awaitable, Callable, Collection, Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from operator import is_

import anyio
import numpy as np

from rtee.commands import Abort, Command, Freeze, SetAcceptsEffort, SetActive
from rtee.drivers.base import Driver
from rtee.drivers.capabilities import Capabilities, GripForce
from rtee.errors import ConfigError, GoalRejected, RteeError, suggestion
from rtee.hand.model import Hand
from rtee.loop.forces import DeviceForces
from rtee.loop.settings import DeviceSettings
from rtee.loop.state_aggregator import StateAggregator, TouchGatherer
from rtee.loop.supervisor import Supervisor
from rtee.objects.description import ObjectDescription
from rtee.sample import FloatArray
from rtee.types import Event, Lifecycle, Reference, readonly

log = logging.getLogger(__name__)

CONFIRM_WITHIN = 0.15
"""Time a device has to confirm a stop [s]: several exchanges on the slowest bus."""

_REPEAT_AFTER = 1.0
"""Time between reports of the same refusal [s]: a device may repeat it at every tick."""

Steer = Callable[[Command], None]
"""Passes a command to the controller."""


class Devices:
    """The devices of one hand.

    Args:
        hand: The hand.
        devices: The devices with their drivers; together they drive every actuator once.
        on_event: Called with events.
        now: The clock [s].

    Attributes:
        by_name: The devices' supervisors, by name.
        state: Merges their states into the state of the hand.

    Raises:
        ConfigError: if an actuator is driven by no device, or by two.
    """

    def __init__(
        self,
        hand: Hand,
        devices: Sequence[tuple[DeviceSettings, Driver]],
        on_event: Callable[[Event], None],
        now: Callable[[], float],
    ) -> None:
        self._hand = hand
        self._on_event = on_event
        self._now = now
        self.by_name: dict[str, Supervisor] = {}
        driven: dict[str, str] = {}
        for settings, driver in devices:
            spec = settings.spec
            for actuator in spec.actuators:
                if actuator.name in driven:
                    raise ConfigError(
                        f"{spec.source + ': ' if spec.source else ''}the actuator"
                        f" '{actuator.name}' is driven by two devices,"
                        f" '{driven[actuator.name]}' and '{spec.name}'"
                    )
                driven[actuator.name] = spec.name
            indices = tuple(hand.actuator_index(actuator.name) for actuator in spec.actuators)
            supervisor = Supervisor(settings, driver, indices, on_event, now=now)
            self.by_name[spec.name] = supervisor
        missing = [name for name in hand.actuator_names if name not in driven]
        if missing or len(self.by_name) != len(devices):
            text = f"no device drives the actuator '{missing[0]}'"
            raise ConfigError(
                f"{hand.name}: {text if missing else 'two devices have the same name'}"
            )
        self._all = tuple(self.by_name.values())
        self.state = StateAggregator(self._all, TouchGatherer(hand, self._refuse_touch))
        self._active = dict.fromkeys(self.by_name, 0)
        self._masks = {d.name: np.ones(len(d.indices), dtype=np.bool_) for d in self._all}
        self._max_velocity: list[float] = []
        self._velocity_limits: FloatArray = np.empty(0)
        self._warned: dict[str, float] = {}
        self._forces: tuple[list[Capabilities], DeviceForces] | None = None

    # --- active devices ----------------------------------------------------------------------

    @property
    def any_active(self) -> bool:
        """Whether any device may be moved."""
        return any(self._active.values())

    def follow(self, begin: Steer, steer: Steer, on_lost: Callable[[str], None]) -> None:
        """Detect devices that became active or inactive, or that refused a reference.

        Args:
            begin: Called with commands for the controller when a device has become active; they
                come before waiting goals, which may have arrived since then.
            steer: Called with all other commands, which come after waiting ones: those may be the
                reason.
            on_lost: Called with the reason when a device became inactive while others are active.
        """
        active = self._active
        for device in self._all:
            link = device.connection
            if not device.indices:  # it only measures, and moves nothing
                continue
            # By number: a device may have been inactive between two ticks, and been moved.
            number = link.activations if link.lifecycle is Lifecycle.ACTIVE else 0
            if number != active[device.name]:
                self._follow(device, begin, steer, on_lost)
            if link.rejected:
                self._refused(device, steer)

    def _follow(
        self, device: Supervisor, begin: Steer, steer: Steer, on_lost: Callable[[str], None]
    ) -> None:
        names = device.actuators
        if device.active and not self._active[device.name]:
            # The reference starts from the measured position, so there must be a valid one.
            if self.state.known(device):
                self._active[device.name] = device.connection.activations
                accepts = "max_effort" in device.guarded.capabilities.accepts
                # Before `SetActive`, after which the first references are sent.
                begin(SetAcceptsEffort(dict.fromkeys(names, accepts)))
                begin(SetActive(dict.fromkeys(names, True)))
            return
        self._active[device.name] = 0
        trouble = device.connection.trouble or "it was inactive for a moment"
        text = f"device '{device.name}': {trouble}"
        # Abort while the actuators still count as active: the goal then ends with this reason.
        steer(Abort(text, names))
        steer(SetActive(dict.fromkeys(names, False)))
        if self.any_active:
            # With no device left, nothing can hold, stop or open.
            on_lost(text)

    def _refused(self, device: Supervisor, steer: Steer) -> None:
        """Restart the reference at a device's measured positions after it refused one."""
        text, device.connection.rejected = device.connection.rejected, ""
        steer(Abort(text, device.actuators))
        steer(Freeze(text, device.actuators))
        self._warn("rejected", device.name, text)

    def _refuse_touch(self, device: str, text: str) -> None:
        self._warn("touch_refused", device, text)

    def _warn(self, kind: str, device: str, text: str) -> None:
        """Report a warning, unless it repeats one of a moment ago."""
        now = self._now()
        if now - self._warned.get(text, -math.inf) >= _REPEAT_AFTER:
            # Only the last text is kept: texts contain values, so a dictionary would grow.
            self._warned = {text: now}
            self.by_name[device].warn(kind, text)

    def movable(self) -> frozenset[int]:
        """Return the actuators that may be moved, from the next tick on; any thread may call it."""
        found: frozenset[int] = frozenset()
        for device in self._all:
            if (
                device.active
                and (self._active[device.name] or self.state.known(device))
                and "position" in device.guarded.capabilities.accepts
            ):
                found = found.union(device.indices)
        return found

    def check_movable(self, indices: Iterable[int], movable: Collection[int] | None = None) -> None:
        """Check that some actuators may be moved; ``movable`` is the result of `movable` if known.

        Raises:
            GoalRejected: if one of them may not be moved.
        """
        movable = self.movable() if movable is None else movable
        idle = set(indices).difference(movable)
        if not idle:
            return
        for device in self._all:
            if (why := device.guarded.capabilities.refuses.get("position")) is not None:
                raise GoalRejected(f"'{device.name}' does not accept set-points: {why}")
        lost = [device for device in self._all if not idle.isdisjoint(device.indices)]
        doing = any(device.guarded.doing for device in lost)
        texts = "; ".join(
            f"device '{device.name}' has not measured its position"
            if device.active
            else device.status().trouble
            for device in lost
        )
        raise GoalRejected(texts if doing else f"{texts}; see `rtee status`, then recover")

    def forces(self) -> DeviceForces:
        """Return which efforts and forces the devices can limit; the same object while unchanged.

        Any thread may call it.
        """
        known = self._forces
        abilities = [device.guarded.capabilities for device in self._all]
        if known is None or not all(map(is_, known[0], abilities)):
            self._forces = known = abilities, device_forces(self._hand, self._all)
        return known[1]

    # --- at a tick ---------------------------------------------------------------------------

    def move(
        self,
        tick: int,
        sent: tuple[FloatArray, FloatArray, FloatArray],
        max_velocity: list[float],
        unplaced: AbstractSet[int] = frozenset(),
        started: AbstractSet[int] = frozenset(),
    ) -> None:
        """Send every device that is due its part of a tick's reference, and read its state.

        Args:
            tick: Number of the tick.
            sent: Position [rad | m], velocity [rad/s | m/s] and effort limit [N·m | N] of all
                actuators ``(n,)``; never changed afterwards.
            max_velocity: Velocity limits of all actuators [rad/s | m/s].
            unplaced: Actuators without a reference, see `ReferenceStart`; their devices get none.
            started: Actuators whose reference was started since the last tick.
        """
        if max_velocity != self._max_velocity:
            self._max_velocity = list(max_velocity)
            # Converted only when they change: with every goal, not with every tick.
            self._velocity_limits = readonly(max_velocity)
        for device in self._all if started else ():
            if places := [k for k, i in enumerate(device.indices) if i in started]:
                device.connection.restart(places, sent[0][list(device.indices)])
        for device in self._all:
            if device.due(tick):
                moving = self._active[device.name] and not device.muted
                if unplaced and not unplaced.isdisjoint(device.indices):
                    moving = False
                device.exchange(self._reference(device, *sent) if moving else None)

    def _reference(
        self, device: Supervisor, position: FloatArray, velocity: FloatArray, effort: FloatArray
    ) -> Reference:
        where, mask, top = self.state.where(device), self._masks[device.name], self._velocity_limits
        if where is None:
            return Reference(position, effort, top, mask, velocity)
        return Reference(position[where], effort[where], top[where], mask, velocity[where])

    # --- requests to all devices -------------------------------------------------------------

    def mute(self, muted: bool) -> None:
        """Suspend (``True``) the sending of references to all devices, or undo that (``False``)."""
        for device in self._all:
            device.muted += 1 if muted else -1

    async def confirm(
        self, reason: str, request: Callable[[Supervisor, float], Awaitable[bool]]
    ) -> list[tuple[str, bool]]:
        """Make a request to all devices at the same time; return which of them confirmed.

        Args:
            reason: Why, for the log.
            request: Called with a device and the time it may take [s]; returns whether the device
                confirmed.
        """
        confirmed = dict.fromkeys(self.by_name, False)

        async def one(device: Supervisor) -> None:
            try:
                # A device that fails must not prevent the others from stopping.
                confirmed[device.name] = await request(device, CONFIRM_WITHIN)
            except Exception:
                log.exception("device '%s' could not be reached: %s", device.name, reason)

        async with anyio.create_task_group() as group:
            for device in self._all:
                group.start_soon(one, device)
        return list(confirmed.items())

    async def recover(self, name: str | None) -> None:
        """Recover a device, or without a name all devices at the same time.

        Raises:
            ConfigError: if there is no such device.
            RteeError: the error of a device that cannot be recovered; the others were recovered.
        """
        chosen, errors = self._chosen(name), list[RteeError]()

        async def one(device: Supervisor) -> None:
            try:
                await device.recover()
            except RteeError as error:
                # Collected, so that the task group does not cancel the others with the first error.
                errors.append(error)

        async with anyio.create_task_group() as group:
            for device in chosen:
                group.start_soon(one, device)
        if errors:
            raise errors[0]

    @property
    def object_description(self) -> ObjectDescription | None:
        """The object that a simulated device of the hand grasps, if there is one."""
        return next(filter(None, (device.guarded.object_description for device in self._all)), None)

    async def set_gains(self, gains: Mapping[str, float], name: str | None) -> None:
        """Change gains of a device, or of all that have them.

        Raises:
            ConfigError: if there is no such device, no device has such a gain, or a value is bad.
            RteeError: if a device refuses them.
        """
        chosen = self._chosen(name)
        known = {gain for device in chosen for gain in device.guarded.capabilities.gains}
        for gain, value in gains.items():
            if gain not in known:
                raise ConfigError(f"unknown gain '{gain}'; {suggestion(gain, known)}")
            # All are checked before the first is set, so that a mistake changes nothing.
            if not math.isfinite(value):
                raise ConfigError(f"the gain '{gain}' must be a number, not {value:g}")
        for device in chosen:
            own = {k: v for k, v in gains.items() if k in device.guarded.capabilities.gains}
            if own:
                await device.set_gains(own)

    def _chosen(self, name: str | None) -> list[Supervisor]:
        if name is not None and name not in self.by_name:
            raise ConfigError(f"unknown device '{name}'; {suggestion(name, self.by_name)}")
        return list(self._all) if name is None else [self.by_name[name]]


def device_forces(hand: Hand, devices: Iterable[Supervisor]) -> DeviceForces:
    """Return which efforts and forces devices can limit; any thread may call it."""
    names = hand.actuator_names
    refused: dict[int, str] = {}
    grips: dict[int, GripForce] = {}
    unlimited: set[int] = set()
    for device in devices:
        can = device.guarded.capabilities
        if "max_effort" not in can.accepts:
            refused |= dict.fromkeys(device.indices, can.refuses.get("max_effort", ""))
        grips |= {i: can.grip[names[i]] for i in device.indices if names[i] in can.grip}
        unlimited |= {hand.actuator_index(name) for name in can.unlimited}
    return DeviceForces(refused, grips, frozenset(unlimited))
