"""What happens in one hand at a tick."""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Self
from zlib import crc32

import anyio
import anyio.abc
import numpy as np

from rtee.commands import Abort, Command, CommandRecord, Freeze, SetAcceptsEffort, SetActive
from rtee.drivers.base import Driver
from rtee.errors import ConfigError
from rtee.hand.model import Hand
from rtee.loop.controller import Controller
from rtee.loop.histogram import TickStatistics
from rtee.loop.observers import Observers
from rtee.loop.plan import Plan
from rtee.loop.settings import Behaviour, DeviceSettings, LoopSettings
from rtee.loop.state_aggregator import Gather
from rtee.loop.supervisor import Supervisor
from rtee.sample import TickRecord, measured_arrays
from rtee.types import (
    DeviceStatus,
    Event,
    Feedback,
    LoopStatistics,
    Reference,
    Result,
)

if TYPE_CHECKING:
    from rtee.actions.library import ActionLibrary
    from rtee.loop.clock import Tick

log = logging.getLogger(__name__)

CONFIRM_WITHIN = 0.15
"""Time a device has to confirm a stop [s]."""


class HandTicks:
    """The part of a hand's loop that the clock calls; see `rtee.loop.handloop.HandLoop`.

    ``async with`` starts the devices' tasks and, at the end, closes them.

    Args:
        hand: The hand.
        library: Its grasping actions.
        settings: The loop's settings.
        devices: Its devices with their drivers; together they drive every actuator once.
        now: The clock [s].

    Attributes:
        hand: The hand.
        library: Its grasping actions.
        settings: The loop's settings.
        controller: The pure part.
        devices: The devices' supervisors, by name.
        clock_statistics: Statistics of the clock that ticks it, once it ticks.

    Raises:
        ConfigError: if an actuator is driven by no device, or by two.
    """

    def __init__(
        self,
        hand: Hand,
        library: ActionLibrary,
        settings: LoopSettings,
        devices: Sequence[tuple[DeviceSettings, Driver]],
        *,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.hand = hand
        self.library = library
        self.settings = settings
        self.controller = Controller(hand, settings)
        self.clock_statistics: TickStatistics | None = None
        self._observers = Observers(now)
        self._now = now
        self.devices: dict[str, Supervisor] = {}
        for device, driver in devices:
            indices = tuple(hand.actuator_index(a.name) for a in device.spec.actuators)
            supervisor = Supervisor(device, driver, indices, self._observers.event, now=now)
            self.devices[device.spec.name] = supervisor
        self._check_devices(devices)
        self._masks = {
            name: np.ones(len(d.indices), dtype=np.bool_) for name, d in self.devices.items()
        }
        self._gather = Gather(list(self.devices.values()))
        self._pending: deque[Plan | Command] = deque()
        self._begun: list[tuple[Plan | CommandRecord, float]] = []
        self._was_active: dict[str, bool] = dict.fromkeys(self.devices, False)
        self._group: anyio.abc.TaskGroup | None = None
        self._waiters: dict[str, tuple[anyio.Event, list[Result]]] = {}
        self._status_at = -math.inf
        self._busy_at = math.inf
        self._told_refused: dict[str, float] = {}
        self._record: TickRecord | None = None
        self._ended = False

    def _check_devices(self, devices: Sequence[tuple[DeviceSettings, Driver]]) -> None:
        driven: dict[str, str] = {}
        for device, _ in devices:
            spec = device.spec
            for actuator in spec.actuators:
                if actuator.name in driven:
                    raise ConfigError(
                        f"{spec.source + ': ' if spec.source else ''}the actuator"
                        f" '{actuator.name}' is driven by two devices,"
                        f" '{driven[actuator.name]}' and '{spec.name}'"
                    )
                driven[actuator.name] = spec.name
        missing = [name for name in self.hand.actuator_names if name not in driven]
        if missing or len(self.devices) != len(devices):
            what = f"the actuator '{missing[0]}'" if missing else "a device's name is used twice:"
            raise ConfigError(f"{self.hand.name}: {what} is driven by no device of its own")

    @property
    def name(self) -> str:
        """The hand's name."""
        return self.hand.name

    async def __aenter__(self) -> Self:
        """Start the devices' tasks."""
        self._group = anyio.create_task_group()
        await self._group.__aenter__()
        for device in self.devices.values():
            self._group.start_soon(device.run, name=f"{self.name}/{device.name}")
        return self

    async def __aexit__(self, *_: object) -> None:
        """End a running goal and close the devices."""
        self.end()
        group, self._group = self._group, None
        if group is not None:
            group.cancel_scope.cancel()
            await group.__aexit__(None, None, None)

    def end(self) -> None:
        """End what goals were taken, once there are no ticks any more; their results are told."""
        if not self._ended:
            self._ended = True
            while self._pending:  # no tick came for it
                self._take_at_once(self._pending.popleft(), self._now())
            self._take_at_once(Freeze("the loop ended"), self._now())

    async def ready(self) -> None:
        """Wait until every device has tried to connect once.

        Raises:
            UserError: if a device can't ever be connected by a mistake of the user.
        """
        try:
            for device in self.devices.values():
                await device.tried.wait()
                if device.mistake is not None:
                    raise device.mistake
        finally:
            # A goal may come before the first tick would have noticed them.
            self._gather.collect()
            self._follow_devices()

    # --- a tick ------------------------------------------------------------------------------

    def tick(self, tick: Tick) -> None:
        """Do one tick; takes no time to speak of and never waits."""
        self.move_on(tick)
        self.notify_observers()

    def move_on(self, tick: Tick) -> None:
        """Move the reference on and hand it to the devices' tasks; `notify_observers` reports it.

        Whoever watches may wake other threads, which then want the interpreter: first the devices.
        """
        stamp = tick.due_ns * 1e-9
        controller, gather = self.controller, self._gather
        gather.collect()
        self._follow_devices()
        while self._pending:
            self._begin(self._pending.popleft(), tick.number, stamp)
        controller.step(stamp, gather.measured)
        if self.settings.safety.idle_disable is not None:
            self._rest_when_idle(stamp, self.settings.safety.idle_disable)
        record = self._record = TickRecord(
            *measured_arrays(gather.sample),
            tick=tick.number,
            stamp=stamp,
            wall_ns=tick.wall_ns,
            grasped=gather.grasped,
            fresh=gather.fresh,
            reference_position=np.array(controller.reference_position),
            reference_velocity=np.array(controller.reference_velocity),
            reference_effort=np.array(controller.reference_effort),
            channels=gather.channels,
        )
        for device in self.devices.values():
            if device.due(tick.number):
                moving = self._was_active[device.name] and not device.muted
                device.offer(self._reference(device, record) if moving else None)

    def notify_observers(self) -> None:
        """Tell the observers what the last `move_on` did."""
        record = self._record
        if self._begun:
            self._tell_begun()
        if record is None:
            return
        self._observers.tick(record)
        if self.controller.outbox:
            self._deliver()
        stamp = record.stamp
        if stamp >= self._status_at:
            window = self.settings.statistics_window
            if self._status_at > 0.0:
                self._status_at = stamp + window
                self._observers.status(self.statuses(), self.statistics())
            else:  # hands on one clock take turns
                self._status_at = stamp + crc32(self.name.encode()) / 2**32 * window

    def _rest_when_idle(self, stamp: float, within: float) -> None:
        """Disable the hand once it was idle for a time [s]."""
        powered = any(self._was_active.values())
        if not powered or not self.controller.idle or math.isinf(self._busy_at):
            self._busy_at = stamp
        elif stamp - self._busy_at >= within:
            self._busy_at = math.inf
            text = f"{self.name}: idle for {within:g} s, disabled; `rtee recover` wakes it"
            self._observers.event(Event("idle", self.name, text, stamp))
            self.behave(Behaviour.DISABLE, text)

    def _reference(self, device: Supervisor, record: TickRecord) -> Reference:
        top = np.array(self.controller.max_velocity)
        where = self._gather.where(device)
        position, velocity = record.reference_position, record.reference_velocity
        effort, mask = record.reference_effort, self._masks[device.name]
        if where is None:
            return Reference(position, effort, top, mask, velocity)
        return Reference(position[where], effort[where], top[where], mask, velocity[where])

    def _follow_devices(self) -> None:
        """Notice devices that may be moved now, or not any more."""
        for name, device in self.devices.items():
            active = device.active
            if active != self._was_active[name] and (not active or self._gather.known(device)):
                self._was_active[name] = active
                self._change(device, active)
            if device.rejected:
                self._refused(device)

    def _change(self, device: Supervisor, active: bool) -> None:
        names = self._names(device)
        if active:
            accepts = "max_effort" in device.driver.capabilities.accepts
            self._pending.append(SetAcceptsEffort(dict.fromkeys(names, accepts)))
            self._pending.append(SetActive(dict.fromkeys(names, True)))
            return
        text = f"device '{device.name}': {device.trouble}"
        self._pending.append(Abort(text, names))
        self._pending.append(SetActive(dict.fromkeys(names, False)))
        if any(self._was_active.values()):
            self.behave(self.settings.safety.on_link_lost, text)

    def _refused(self, device: Supervisor) -> None:
        """The device did not take a reference: begin again where it is."""
        text, device.rejected = device.rejected, ""
        names = self._names(device)
        self._pending.append(Abort(text, names))
        self._pending.append(Freeze(text, names))
        now = self._now()
        if now - self._told_refused.get(text, -math.inf) >= 1.0:
            self._told_refused = {text: now}
            self._observers.event(Event("rejected", device.name, text, now, "warning"))

    @staticmethod
    def _names(device: Supervisor) -> tuple[str, ...]:
        return tuple(actuator.name for actuator in device.spec.actuators)

    def _begin(self, what: Plan | Command, tick: int, stamp: float) -> None:
        if isinstance(what, Plan):
            self._begun.append((what, stamp))
            self.controller.accept(what, stamp)
            return
        self._begun.append((CommandRecord(tick, stamp, what), stamp))
        self.controller.apply(what, stamp)

    def _tell_begun(self) -> None:
        begun, self._begun = self._begun, []
        for what, stamp in begun:
            if isinstance(what, Plan):
                self._observers.goal(what.goal, stamp)
                self._observers.plan(what, stamp)
            else:
                self._observers.command(what)

    def _take_at_once(self, what: Plan | Command, stamp: float) -> None:
        self._begin(what, 0 if self._record is None else self._record.tick + 1, stamp)
        self._tell_begun()
        self._deliver()

    def _deliver(self) -> None:
        outbox = self.controller.outbox
        items, outbox.items[:] = list(outbox.items), []
        for item in items:
            match item:
                case Feedback():
                    self._observers.feedback(item)
                case Result():
                    self._observers.result(item)
                    waiting = self._waiters.pop(item.goal_id, None)
                    if waiting is not None:
                        waiting[1].append(item)
                        waiting[0].set()
                case Event():
                    self._observers.event(item)
        if outbox.disable:
            hot, outbox.disable = outbox.disable, set()
            for device in self.devices.values():
                if hot.intersection(device.indices):
                    self._start(device.disable, CONFIRM_WITHIN)

    def now(self) -> float:
        """Return the time of the clock it lives by [s]."""
        return self._now()

    def statuses(self) -> list[DeviceStatus]:
        """Return how the devices are doing."""
        found = []
        for device in self.devices.values():
            status, heat = device.status(), self.controller.heat(device.indices)
            doubts = self.controller.doubts(device.indices)
            said = "; ".join(text for text in (status.message, doubts, heat) if text)
            found.append(replace(status, message=said) if heat or doubts else status)
        return found

    def statistics(self) -> LoopStatistics:
        """Return how the clock is doing."""
        clock = self.clock_statistics
        if clock is None:
            return LoopStatistics(rate=self.settings.rate)
        return clock.summary(self._observers.dropped)

    def behave(self, behaviour: Behaviour, reason: str) -> None:
        """Do what the settings say for when nobody drives the hand any more; returns at once."""
        raise NotImplementedError

    def _start(self, function: Callable[..., object], *arguments: object) -> None:
        if self._group is not None:
            self._group.start_soon(function, *arguments)  # type: ignore[arg-type]
