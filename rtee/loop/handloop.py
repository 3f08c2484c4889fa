"""The loop of one hand: the cycle of a tick, its goals, its devices and its observers."""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self
from zlib import crc32

import anyio
import anyio.abc
import numpy as np

from rtee import monotonic
from rtee.commands import (
    Abort,
    Cancel,
    Command,
    CommandRecord,
    Freeze,
    Hold,
    Jog,
    SetActive,
    SetGripEffort,
    StreamSample,
)
from rtee.drivers.base import Driver
from rtee.errors import ConfigError, GoalRejected, RteeError, suggestion
from rtee.hand.config_schema import Behaviour
from rtee.hand.model import Hand
from rtee.loop.clock import AnyClock, Tick, TickStatistics
from rtee.loop.controller import Controller
from rtee.loop.devices import CONFIRM_WITHIN, Devices
from rtee.loop.observer import Observer, Observers
from rtee.loop.plan import Plan
from rtee.loop.planning import OPEN, FoundActions, make_plan
from rtee.loop.settings import DeviceSettings, LoopSettings
from rtee.loop.streams.intake import StreamIntake
from rtee.loop.supervisor import Supervisor
from rtee.sample import TickRecord, measured_arrays
from rtee.types import (
    DeviceStatus,
    Event,
    Feedback,
    Goal,
    JointKind,
    LoopStatistics,
    Named,
    Reference,
    Result,
)

if TYPE_CHECKING:
    from rtee.actions.library import ActionLibrary
    from rtee.loop.clock import Tick


log = logging.getLogger(__name__)

ITSELF = "rtee"
"""Client name for the goals that the loop submits itself."""

GRIP_EFFORT = "grip_effort"
"""The hand's own gain: effort kept on a held object, as a fraction of the effort limit."""

_LONG_PAUSE = 1.0
"""A loop that did not run for so long reports it and ends its goals [s]: longer than a busy
computer delays it, and long enough for people to have moved a device that went limp."""

_MOVED = 0.01
"""An actuator has moved during a pause if it is measured elsewhere by this share of its range:
noise, play and a soft object move it less."""

_ROUNDED = 1e-4
"""A position at most this far beyond a limit is a rounding error of the client [rad | m]."""


class HandLoop:
    """The loop of one hand.

    ``async with`` starts the devices' tasks on entry and closes the devices on exit. The owner of
    the clock calls `tick`, which never waits. Methods must be called in the thread of the event
    loop, except for `submit`, `cancel`, `hold` and `jog`: they only check and append, and are safe
    in any thread.

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
        controller: Computes the references; pure.
        devices: The devices' supervisors, by name.
        streams: Checks and queues the samples of a stream; one thread at a time may use it.
        clock_statistics: Statistics of the loop's clock, from its first tick on.

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
        now: Callable[[], float] = monotonic.asked,
    ) -> None:
        self.hand = hand
        self.library = library
        self.settings = settings
        self.controller = Controller(hand, settings)
        self.clock_statistics: TickStatistics | None = None
        self._now = now
        self._observers = Observers(now)
        self._pending: deque[tuple[Goal, Plan] | Command] = deque()
        self._devices = Devices(hand, devices, self._observers.event, now)
        self.devices = self._devices.by_name
        self.streams = StreamIntake(
            self.controller, library, self._pending.append, self._devices, now
        )
        self._begun: list[tuple[tuple[Goal, Plan] | CommandRecord, float]] = []
        self._found = FoundActions()
        self._record: TickRecord | None = None
        self._group: anyio.abc.TaskGroup | None = None
        self._waiters: dict[str, tuple[anyio.Event, list[Result]]] = {}
        self._status_at = -math.inf
        self._busy_at = math.inf
        self._suspended = math.nan  # until the first tick
        self._ended = False
        self._muted: list[str] = []
        self._unread: list[tuple[Supervisor, int, Sequence[float], str]] = []

    @property
    def name(self) -> str:
        """The hand's name."""
        return self.hand.name

    async def __aenter__(self) -> Self:
        """Start the devices' tasks."""
        # Before the first tick: reading the file takes as long as many ticks. The first goal that
        # needs it reports any error in it.
        with contextlib.suppress(ConfigError):
            _ = self.library.openings
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

    async def ready(self) -> None:
        """Wait until every device has tried to connect once.

        Raises:
            UserError: if a mistake in the configuration keeps a device from ever connecting.
        """
        for device in self.devices.values():
            await device.ready()

    def end(self) -> None:
        """End all goals after the last tick; the observers receive their results."""
        if not self._ended:
            self._ended = True
            while self._pending:  # queued after the last tick
                self._begin_now(self._pending.popleft())
            self._begin_now(Freeze("the loop ended"))

    # --- the cycle ---------------------------------------------------------------------------

    def tick(self, tick: Tick) -> None:
        """Run one tick: `cycle`, then `notify_observers`; never waits."""
        self.cycle(tick)
        self.notify_observers()

    def cycle(self, tick: Tick) -> None:
        """Run one tick from sensing to moving; `notify_observers` reports it afterwards.

        The two are separate for hands that share a clock: observers may wake threads, which then
        compete for the interpreter, so the devices of all hands go before any observer.
        """
        stamp = tick.due_ns * 1e-9
        devices, state, controller = self._devices, self._devices.state, self.controller
        # Sense: collect the states that the devices have returned since the last tick.
        before = controller.measured.position  # replaced, never changed
        state.collect(stamp)
        if self._unread:
            self._restart_moved()
        devices.follow(
            lambda command: self._begin(command, tick.number, stamp),
            self._pending.append,
            self._on_lost,
        )
        suspended = monotonic.suspended()
        paused = self._paused(tick.missed / self.settings.rate, suspended)
        self._suspended = suspended
        if paused >= _LONG_PAUSE:
            self._resume(paused, before)
        # Start goals and apply commands, in the order of their arrival.
        moves = False
        waiting: list[tuple[Goal, Plan] | Command] = []
        while self._pending:
            item = self._pending.popleft()
            # What the loop itself does for safety waits for the devices, unless a stop came.
            own = isinstance(item, tuple) and item[0].client == ITSELF
            if own and self._unread and len(self._muted) == len(self._unread):
                waiting.append(item)
                continue
            moves |= isinstance(item, tuple | Jog | StreamSample)
            self._begin(item, tick.number, stamp)
        if moves and self._muted:
            # The reference must not move on while no device follows it.
            self._begin(Hold(self._muted[-1]), tick.number, stamp)
        self._pending += waiting
        # Control: executor, profile and limiter turn goal and state into the reference.
        controller.step(stamp, state.measured)
        if self.settings.safety.idle_disable is not None:
            self._disable_when_idle(stamp, self.settings.safety.idle_disable)
        # Copies, since the controller changes its lists at the next tick.
        position = np.array(controller.reference_position)
        velocity = np.array(controller.reference_velocity)
        effort = np.array(controller.reference_effort)
        # Move: send the reference. A device that answers at once is also read again here.
        sent = position, velocity, effort
        starts = controller.starts
        devices.move(tick.number, sent, controller.max_velocity, starts.unplaced, starts.started)
        starts.started.clear()
        # The record comes last: nothing that the devices wait for depends on it.
        self._record = TickRecord(
            *measured_arrays(state.sample),
            tick=tick.number,
            stamp=stamp,
            wall_ns=tick.wall_ns,
            grasped=state.grasped,
            fresh=state.fresh,
            reference_position=position,
            reference_velocity=velocity,
            reference_effort=effort,
            channels=state.channels_with(controller.channels),
            touch=state.touch,
        )

    def notify_observers(self) -> None:
        """Report the last `cycle` to the observers."""
        record = self._record
        if self._begun:
            self._report_begun()
        if record is None:
            return
        self._observers.tick(record)
        if self.controller.outbox:
            self._deliver()
        if record.stamp >= self._status_at:
            self._observers.describe_object(self._devices.object_description, record.stamp)
            window = self.settings.statistics_window
            if self._status_at > 0.0:
                self._status_at = record.stamp + window
                statuses, statistics = self.statuses(), self.statistics()
                self._observers.each(lambda each: each.on_status(statuses, statistics))
            else:  # spread out, so that hands on one clock do not all report at the same tick
                self._status_at = record.stamp + crc32(self.name.encode()) / 2**32 * window

    def _begin(self, item: tuple[Goal, Plan] | Command, tick: int, stamp: float) -> None:
        if isinstance(item, tuple):
            self._begun.append((item, stamp))
            self.controller.accept(item[1], stamp)
        else:
            self._begun.append((CommandRecord(tick, stamp, item), stamp))
            self.controller.apply(item, stamp)

    def _begin_now(self, item: tuple[Goal, Plan] | Command) -> None:
        """Begin a plan or a command after the last tick, and report it."""
        self._begin(item, 0 if self._record is None else self._record.tick + 1, self._now())
        self._report_begun()
        self._deliver()

    def _report_begun(self) -> None:
        begun, self._begun = self._begun, []
        for item, stamp in begun:
            if isinstance(item, tuple):
                self._observers.goal(*item, stamp)
            else:
                self._observers.command(item)

    def _deliver(self) -> None:
        """Pass the controller's reports to the observers, and disable devices that are too hot."""
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

    def _paused(self, without: float, suspended: float) -> float:
        """Return for how long the loop did not run [s].

        Args:
            without: Time without ticks [s], by a clock that stands still in a suspended computer.
            suspended: For how long the computer has been suspended until now [s].
        """
        return without + suspended - self._suspended

    def _resume(self, paused: float, before: Sequence[float]) -> None:
        """End goals and streams after a long pause; send nothing before devices are read again."""
        reason = f"the loop did not run for {paused:.1f} s"
        text = (
            f"{self.name}: {reason}, so its devices got no references: its process was stopped, or "
            "the computer suspended or too busy"
        )
        self._observers.event(Event("loop_paused", self.name, text, self._now(), "warning"))
        # After waiting goals: somebody may have asked for them long ago.
        self._pending += (Abort(reason), Hold(reason))
        for device in self.devices.values():
            device.muted += 1
            self._muted.append(reason)
            # The first state may have been measured before the pause.
            self._unread.append((device, device.connection.states + 2, before, reason))

    def _restart_moved(self) -> None:
        """Start the references of what has moved during a pause where it is measured."""
        unread, self._unread = self._unread, []
        for device, enough, before, reason in unread:
            if device.active and device.connection.states < enough:
                self._unread.append((device, enough, before, reason))
                continue
            if moved := self._moved(device, before):
                # As after activation: whoever moved it may have moved it anywhere.
                self._pending += (
                    Abort(reason, tuple(moved)),
                    SetActive(dict.fromkeys(moved, False)),
                    SetActive(dict.fromkeys(moved, True)),
                )
            device.muted -= 1
            self._muted.remove(reason)

    def _moved(self, device: Supervisor, before: Sequence[float]) -> list[str]:
        """Return the actuators of a device that are no longer where they were measured before."""
        state, moved = device.connection.state, list[str]()
        if state is None or not device.active:
            return moved
        for i, here in zip(device.indices, state.position.tolist(), strict=True):
            spec = self.hand.actuators[i]
            span = spec.upper - spec.lower
            # An actuator without limits has no range; 1 rad is a typical one.
            beside = _MOVED * (span if math.isfinite(span) else 1.0)
            # On its way to the reference, it has only followed it, or a soft object has yielded.
            low, high = sorted((before[i], self.controller.reference_position[i]))
            if (
                not low - beside <= here <= high + beside
                and here == here
                and before[i] == before[i]
            ):
                moved.append(spec.name)
        return moved

    def _disable_when_idle(self, stamp: float, within: float) -> None:
        """Disable the hand once it has been idle for ``within`` seconds."""
        busy = not self._devices.any_active or not self.controller.idle
        if busy or math.isinf(self._busy_at):
            self._busy_at = stamp
        elif stamp - self._busy_at >= within:
            self._busy_at = math.inf
            text = f"{self.name}: idle for {within:g} s, disabled; `rtee recover` wakes it"
            self._observers.event(Event("idle", self.name, text, stamp))
            self.behave(Behaviour.DISABLE, text)

    # --- goals -------------------------------------------------------------------------------

    def submit(self, goal: Goal, *, partly: bool = False) -> None:
        """Accept a goal, which begins at the next tick; the observers receive its result.

        With ``partly``, actuators whose device is not active are left out, unless none would be
        left.

        Raises:
            GoalRejected: if one of its values cannot be used, or a device is not active.
            UnknownAction: if there is no such action.
            ActionError: if the action doesn't exist with these elements.
        """
        if self._ended:
            raise GoalRejected("the loop has ended")
        plan = make_plan(
            goal,
            self.hand,
            self.library,
            self.settings,
            devices=self._devices.forces(),
            found=self._found,
        )
        movable = self._devices.movable()
        if not plan.involved <= movable:
            if partly and not plan.involved.isdisjoint(movable):
                plan = plan.only(movable)
            self._devices.check_movable(plan.involved, movable)
        self._pending.append((goal, plan))

    async def execute(self, goal: Goal, *, partly: bool = False) -> Result:
        """Submit a goal (see `submit`) and return its result; cancelling this cancels the goal."""
        done, results = anyio.Event(), list[Result]()
        self._waiters[goal.goal_id] = (done, results)
        try:
            self.submit(goal, partly=partly)
            await done.wait()
        except anyio.get_cancelled_exc_class():
            self.cancel(goal.goal_id)
            raise
        finally:
            self._waiters.pop(goal.goal_id, None)
        return results[0]

    def cancel(self, goal_id: str) -> None:
        """Cancel a goal: the hand brakes and holds the measured posture. Ignores unknown goals."""
        self._pending.append(Cancel(goal_id))

    def hold(self, reason: str = "") -> None:
        """Brake and hold the measured posture; blocked fingers keep pressing on their object."""
        self._pending.append(Hold(reason))

    def jog(self, positions: Mapping[str, float], max_velocity: float | None = None) -> None:
        """Move some actuators directly; a running goal is pre-empted.

        Args:
            positions: Target positions by actuator, inside their limits [rad | m].
            max_velocity: Velocity limit [rad/s | m/s]; ``None``: the actuators' own.

        Raises:
            GoalRejected: if an actuator is unknown or not active, or a value is not a number or
                beyond a limit.
        """
        names = self.hand.actuator_names
        for name, value in positions.items():
            if name not in names:
                raise GoalRejected(
                    f"unknown actuator '{name}'; {suggestion(name, names)}",
                    option="positions",
                    given=name,
                    valid=names,
                )
            spec = self.hand.actuator(name)
            if math.isfinite(value) and not spec.lower - _ROUNDED <= value <= spec.upper + _ROUNDED:
                raise GoalRejected(
                    f"the position {value:g} of '{name}' is outside its limits {spec.lower:g} to "
                    f"{spec.upper:g} {'m' if spec.kind == JointKind.PRISMATIC else 'rad'}",
                    option="positions",
                )
            if not math.isfinite(value):
                raise GoalRejected(f"the position of '{name}' must be a number, not {value:g}")
        if max_velocity is not None and not (max_velocity > 0 and math.isfinite(max_velocity)):
            raise GoalRejected(f"the velocity must be above 0, not {max_velocity:g}")
        indices = [self.hand.actuator_index(name) for name in positions]
        self._devices.check_movable(indices)
        limit = math.inf if max_velocity is None else float(max_velocity)
        self._pending.append(Jog(dict(positions), limit))

    # --- devices -----------------------------------------------------------------------------

    async def stop(self, reason: str = "stopped") -> list[tuple[str, bool]]:
        """Stop all devices now; a running goal is cancelled. Cannot raise.

        Returns:
            Every device with whether it confirmed that it stopped.
        """
        confirmed = await self._freeze_while(reason, Supervisor.stop)
        missing = [name for name, done in confirmed if not done]
        text = f"{self.name}: {reason}"
        text += f"; not confirmed by {', '.join(missing)}" if missing else "; confirmed"
        severity = "error" if missing else "info"
        self._observers.event(Event("stop", self.name, text, self._now(), severity))
        return confirmed

    async def disable(self, reason: str = "disabled") -> list[tuple[str, bool]]:
        """Disable all devices, which leaves them limp and inactive. Returns the same as `stop`."""
        return await self._freeze_while(reason, Supervisor.disable)

    async def keep(self, reason: str = "") -> list[tuple[str, bool]]:
        """Send every device a last reference: the measured posture, or the grip on its object.

        No references are sent afterwards, though the loop may still tick. A device that was not
        read since a pause of the loop is stopped where it is. Returns the same as `stop`.
        """
        posture = self.controller.starts.posture_to_keep()
        effort = self.controller.reference_effort
        record, suspended = self._record, monotonic.suspended()
        without = 0.0 if record is None else self._now() - record.stamp
        paused = self._paused(without, suspended) >= _LONG_PAUSE
        unread = {unread.name for unread, *_ in self._unread}

        async def keep(device: Supervisor, within: float) -> bool:
            position = [posture[i] for i in device.indices]
            known = not paused and device.name not in unread
            if not (known and all(map(math.isfinite, position))):
                return device.active and await device.stop(within)
            last = Reference.at(position, max_effort=[effort[i] for i in device.indices])
            return await device.hold(last, within)

        self._mute(reason)
        return await self._devices.confirm(reason, keep)

    async def _freeze_while(
        self, reason: str, request: Callable[[Supervisor, float], Awaitable[bool]]
    ) -> list[tuple[str, bool]]:
        """Send no references while the devices serve a request; then start from where they are."""
        self._mute(reason)
        self._pending.append(Freeze(reason))
        try:
            return await self._devices.confirm(reason, request)
        finally:
            # Again: the hand may have moved in the meantime.
            self._pending.append(Freeze(reason))
            self._devices.mute(False)
            self._muted.remove(reason)

    def _mute(self, reason: str) -> None:
        """Send no references for a while; what would move the hand meanwhile ends at once."""
        self._devices.mute(True)
        self._muted.append(reason)

    async def recover(self, device: str | None = None) -> None:
        """Bring a device, or all, out of fault or inactivity, without moving it.

        Raises:
            ConfigError: if there is no such device.
            RteeError: the error of a device that cannot be recovered; the others were recovered.
        """
        await self._devices.recover(device)

    async def set_gains(self, gains: Mapping[str, float], device: str | None = None) -> None:
        """Change gains of a device, or of every device that has them.

        Without a device, ``grip_effort`` is the effort kept on a held object, 0 to 1 of the
        effort limit.

        Raises:
            ConfigError: if there is no such device, no device has such a gain, or a value is bad.
            RteeError: if a device refuses them.
        """
        gains = dict(gains)
        grip = gains.pop(GRIP_EFFORT, None) if device is None else None
        if grip is not None and not 0.0 <= grip <= 1.0:
            raise ConfigError(f"{GRIP_EFFORT} must be 0 to 1, not {grip:g}")
        await self._devices.set_gains(gains, device)
        if grip is not None:
            self._pending.append(SetGripEffort(float(grip)))

    # --- lost clients and devices ------------------------------------------------------------

    def client_lost(self, client: str) -> None:
        """Apply the configured behaviour after the client that holds the lease has died."""
        text = f"the client '{client}' is lost"
        self._observers.event(Event("client_lost", client, text, self._now(), "warning"))
        self.behave(self.settings.safety.on_client_lost, text)

    def _on_lost(self, reason: str) -> None:
        self.behave(self.settings.safety.on_link_lost, reason)

    def behave(self, behaviour: Behaviour, reason: str) -> None:
        """Apply a behaviour of the safety settings; returns at once."""
        match behaviour:
            case Behaviour.HOLD:
                self.hold(reason)
            case Behaviour.STOP:
                self._start(self.stop, reason)
            case Behaviour.DISABLE:
                self._start(self.disable, reason)
            case Behaviour.OPEN:
                self.hold(reason)
                try:
                    self.submit(Goal(Named(OPEN), client=ITSELF), partly=True)
                except RteeError as error:
                    log.warning("%s cannot open: %s", self.name, error)

    def _start(self, work: Callable[..., Coroutine[Any, Any, object]], *arguments: object) -> None:
        """Run a coroutine function in a task of its own."""
        if self._group is not None:
            self._group.start_soon(work, *arguments)

    # --- watching ----------------------------------------------------------------------------

    def add_observer(self, observer: Observer) -> None:
        """Report everything to an observer from now on."""
        self._observers.add(observer)

    def remove_observer(self, observer: Observer) -> None:
        """Stop reporting to an observer."""
        self._observers.remove(observer)

    def announce(self, event: Event) -> None:
        """Report an event from outside, such as a mark or a new action, to the observers."""
        self._observers.event(event)

    def now(self) -> float:
        """Return the time of the loop's clock [s]."""
        return self._now()

    def snapshot(self) -> TickRecord:
        """Return the record of the last tick.

        Raises:
            RteeError: if the loop has not ticked yet.
        """
        if self._record is None:
            raise RteeError(f"{self.name}: the loop has not ticked yet")
        return self._record

    def statuses(self) -> list[DeviceStatus]:
        """Return the status of every device, with doubtful positions and temperatures."""
        statuses = []
        for device in self.devices.values():
            status, heat = device.status(), self.controller.heat(device.indices)
            doubts = self.controller.doubts(device.indices)
            message = "; ".join(text for text in (status.message, doubts, heat) if text)
            statuses.append(replace(status, message=message) if heat or doubts else status)
        return statuses

    def statistics(self) -> LoopStatistics:
        """Return the statistics of the clock."""
        clock = self.clock_statistics
        if clock is None:
            return LoopStatistics(rate=self.settings.rate)
        return clock.summary(self._observers.dropped)


async def drive(
    loops: Sequence[HandLoop], clock: AnyClock, idle: Callable[[int], None] | None = None
) -> None:
    """Tick some hands on one clock until cancelled, or until the clock ends.

    The busy time of a tick is the processor time that this thread uses from one wake-up to the
    next, for the hands, their devices' tasks, recording and publishing.

    Args:
        loops: The hands.
        clock: Their clock.
        idle: Called after each tick with the due time of the next one, CLOCK_MONOTONIC [ns].
    """
    statistics = TickStatistics(clock.rate)
    for loop in loops:
        loop.clock_statistics = statistics
    used = time.thread_time_ns()

    def at_tick(tick: Tick) -> None:
        nonlocal used
        before, used = used, time.thread_time_ns()
        # The devices of all hands before any observer, which may wake other threads.
        for loop in loops:
            loop.cycle(tick)
        if statistics.started:
            statistics.add(tick.woken_ns, tick.lateness_ns, used - before, tick.missed)
        statistics.started = True
        for loop in loops:
            loop.notify_observers()
        if idle is not None:
            idle(tick.due_ns + clock.period_ns)

    await clock.drive(at_tick)


OPEN_WITHIN = 3.0
"""Time that opening may take at the end [s]: most hands open faster, and service managers wait
longer before they kill a process."""

REST_WITHIN = 0.18
"""Time that the other behaviours may take [s]: the devices' time to confirm, and a little for the
tasks."""


async def bring_to_rest(
    loop: HandLoop, behaviour: Behaviour, reason: str, *, ticking: bool = True
) -> list[tuple[str, bool]]:
    """Bring a hand to rest before its loop ends. Cannot raise or be cancelled; ends in time.

    Args:
        loop: The hand.
        behaviour: The behaviour to apply.
        reason: Why, for the log.
        ticking: Whether the loop still ticks; else the hand can't open, and is stopped.

    Returns:
        Every device with whether it confirmed.
    """
    confirmed = dict.fromkeys(loop.devices, False)
    # The run is being cancelled: without the shield, the first await would raise.
    with anyio.CancelScope(shield=True):
        try:
            if behaviour is Behaviour.OPEN:
                # An opened hand holds its posture; one that could not open is stopped.
                opened = ticking and await _open(loop)
                behaviour = Behaviour.HOLD if opened else Behaviour.STOP
            with anyio.move_on_after(REST_WITHIN):
                match behaviour:
                    case Behaviour.DISABLE:
                        confirmed |= dict(await loop.disable(reason))
                    case Behaviour.STOP:
                        confirmed |= dict(await loop.stop(reason))
                    case _:
                        confirmed |= dict(await loop.keep(reason))
            if behaviour is not Behaviour.STOP:  # `HandLoop.stop` reports itself
                _report(loop, behaviour, reason, confirmed)
        except Exception:
            log.exception("%s could not be brought to rest (%s)", loop.name, behaviour)
    return list(confirmed.items())


async def _open(loop: HandLoop) -> bool:
    """Open the hand; return whether it can hold the posture that it has reached in time."""
    with anyio.move_on_after(OPEN_WITHIN):
        goal = Goal(Named(OPEN), client=ITSELF, timeout=OPEN_WITHIN)
        try:
            return not (await loop.execute(goal, partly=True)).aborted
        except RteeError as error:
            log.warning("%s cannot open: %s", loop.name, error)
            return False
    return True


def _report(loop: HandLoop, behaviour: Behaviour, reason: str, confirmed: dict[str, bool]) -> None:
    missing = [name for name, done in confirmed.items() if not done]
    text = f"{loop.name}: {reason}, {behaviour}"
    text += f"; not confirmed by {', '.join(missing)}" if missing else "; confirmed"
    severity = "error" if missing else "info"
    loop.announce(Event("at_rest", loop.name, text, loop.now(), severity))
