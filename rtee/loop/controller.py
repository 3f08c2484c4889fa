"""The pure part of a tick: goals and measurements in, references and results out.

The same code runs live, in tests at any speed and on replay: a recording of goals, commands and
measurements gives the same references, bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
from typing import assert_never

import numpy as np
from msgspec import structs

from rtee.commands import (
    Abort,
    BeginStream,
    Cancel,
    Command,
    EndStream,
    Freeze,
    Hold,
    Jog,
    SetAcceptsEffort,
    SetActive,
    SetGripEffort,
    StreamSample,
)
from rtee.drivers.plausibility import Plausibility
from rtee.hand.limits import mechanism
from rtee.hand.model import Hand
from rtee.loop.closing import slowed
from rtee.loop.evidence import ContactMonitor
from rtee.loop.executor import Executor
from rtee.loop.free_motion import LearnedMotion
from rtee.loop.measured import GRIP_FORCE, MET, Measured
from rtee.loop.motion import Limiter, MotionLimits
from rtee.loop.plan import Plan
from rtee.loop.profiles import Profile, make_profile
from rtee.loop.reflexes import Reflexes
from rtee.loop.settings import LoopSettings
from rtee.loop.streams.player import StreamHold, StreamPlayer
from rtee.loop.thermal import CurrentHeat, Thermal, ThermalLevel
from rtee.sample import FloatArray
from rtee.types import Around, Event, Feedback, Result


class ReferenceStart:
    """Starts the references of a hand's actuators, only from measured positions.

    Args:
        profile: Moves the reference.
        limiter: Holds the positions sent last.
        contact: Detects contacts.
        plausible: Judges measured positions.
        active: Whether each actuator's device may be moved.
        effort: Effort limits sent last [N·m | N].
        pressing: Effort at which an actuator presses, as a fraction of its limit.

    Attributes:
        unplaced: Actuators that have become active but not been validly measured since; they have
            no reference yet.
        started: Actuators whose reference was started; emptied by its reader.
    """

    def __init__(
        self,
        profile: Profile,
        limiter: Limiter,
        contact: ContactMonitor,
        plausible: Plausibility,
        active: Sequence[bool],
        effort: Sequence[float],
        pressing: float,
    ) -> None:
        self._profile, self._limiter = profile, limiter
        self._contact, self._plausible = contact, plausible
        self._active, self._effort, self._pressing = active, effort, pressing
        self.unplaced: set[int] = set()
        self.started: set[int] = set()
        self._frozen: dict[int, bool] = {}
        self._now = -math.inf
        nothing = [math.nan] * len(active)
        self._measured = Measured(nothing, nothing, nothing, [False] * len(active), ())

    def at(self, i: int, stamp: float, touching: bool = False) -> float | None:
        """Return the measured position of an actuator if its reference may start from it [rad | m].

        Args:
            i: The actuator.
            stamp: Now [s].
            touching: Whether it is known to press against an object; if not, this is estimated.
        """
        touching = touching or self._touches(i)
        return self._plausible.start(i, stamp, self._limiter.position[i], touching=touching)

    def _touches(self, i: int) -> bool:
        """Return whether effort, touch or the device, not only position, shows a contact."""
        return self._contact.shows(i, self._measured, self._pressing * self._effort[i])

    def set(self, positions: Mapping[int, float]) -> None:
        """Start references, at rest, from positions by actuator [rad | m]."""
        self._profile.seed(positions)
        self.started.update(positions)
        for i, position in positions.items():
            self._limiter.seed(i, position)
            self._plausible.started(i, position)

    def brake(self, indices: Collection[int]) -> None:
        """Brake some actuators, unless the next tick can start them at their measured positions.

        Called before their contacts are forgotten.
        """
        self._frozen.update((i, self._touches(i)) for i in indices)
        self._profile.go({}, brake=[i for i in indices if self._active[i]])

    def activate(self, i: int) -> None:
        """Let an actuator that became active wait for its first valid measurement."""
        self.unplaced.add(i)
        self._plausible.forget((i,))

    def step(self, stamp: float, measured: Measured) -> list[int]:
        """Check the measurements of a tick, and start the references that wait for them.

        Inactive actuators are followed.

        Args:
            stamp: Now [s].
            measured: The measured state.

        Returns:
            The active actuators whose reference was started.
        """
        self._measured, self._now, sent = measured, stamp, self._limiter.position
        self._plausible.step(stamp, measured.position, measured.fresh, self._active, sent)
        if not (self._frozen or self.unplaced) and all(self._active):
            return []
        start: dict[int, float] = {}
        frozen, self._frozen = self._frozen, {}
        for i, active in enumerate(self._active):
            if active and i not in frozen and i not in self.unplaced:
                continue
            position = self.at(i, stamp, frozen.get(i, False))
            if position is not None and (active or position != sent[i]):
                start[i] = position
        if start:
            self.set(start)
            self.unplaced.difference_update(start)
        return [i for i in start if self._active[i]]

    def posture_to_keep(self) -> list[float]:
        """Return the positions to leave the hand at [rad | m]; blocked fingers keep their grip.

        ``NaN``: inactive, or `unplaced`, and therefore without a reference.
        """
        kept = list(self._limiter.position)
        for i, position in enumerate(kept):
            if not self._active[i] or i in self.unplaced:
                kept[i] = math.nan
            elif not self._contact.blocked(i):
                measured = self.at(i, self._now)
                kept[i] = position if measured is None else measured
        return kept


_THERMAL_EVERY = 0.1
"""Temperatures are checked this often [s]: motors warm up over seconds."""

_SETTLE = 0.1
"""Time the hand gets after braking before the measured posture is held [s]: servos lag behind."""

_OFF = 0.01
"""While holding, a reference further than this from the measured position moves to it [rad | m]:
less is within the tolerance of goals, and not worth a motion."""


@dataclass(slots=True)
class Outbox:
    """The reports of a controller, in order.

    Attributes:
        items: Feedback, results and events.
        disable: Actuators whose device must be disabled because they are too hot.
    """

    items: list[Feedback | Result | Event] = field(default_factory=list)
    disable: set[int] = field(default_factory=set)

    def __bool__(self) -> bool:
        return bool(self.items or self.disable)


class Controller:
    """The pure core of a hand's loop.

    Attributes:
        reference_position: Positions to send, after the limiter [rad | m].
        reference_velocity: Their velocities [rad/s | m/s].
        reference_effort: Effort limits to be sent [N·m | N].
        max_velocity: Velocity limits to be sent [rad/s | m/s].
        active: Whether an actuator's device may be moved.
        starts: Starts the references where actuators are measured.
        outbox: Reports, which the caller takes out.
        stream: The open stream, if there is one.
        ended_stream: Identifier of the stream that ended last.
    """

    def __init__(self, hand: Hand, settings: LoopSettings) -> None:
        self.hand = hand
        self.settings = settings
        self._grasp = settings.grasp
        self.stream: StreamPlayer | None = None
        self.ended_stream = ""
        self._limits = limits = MotionLimits.of(hand.actuators)
        n = len(hand.actuators)
        self._profile = make_profile(settings.profile, limits, settings.period)
        self._limiter = Limiter(limits, settings.period, settings.safety.max_step)
        self._contact = ContactMonitor(hand, settings.stall, settings.grasp, settings.free_motion)
        self._thermal = Thermal(settings.thermal, n)
        self._heat = CurrentHeat(settings.thermal, hand.actuator_names)
        self.outbox = Outbox()
        report = self.outbox.items.append
        ends = [mechanism(actuator, hand.urdf) for actuator in hand.actuators]
        self._plausible = Plausibility(hand.actuators, report, ends)
        self.active, self.reference_effort = [False] * n, [0.0] * n
        self.starts = ReferenceStart(
            self._profile,
            self._limiter,
            self._contact,
            self._plausible,
            self.active,
            self.reference_effort,
            settings.grasp.effort,
        )
        self._reflexes = Reflexes(
            hand,
            settings.grasp,
            self._profile,
            self._limiter,
            self._contact,
            self._limit,
            self.starts.at,
            report,
        )
        self._executor = Executor(
            hand, settings, self._profile, self._contact, self._plausible, self._reflexes, report
        )
        self.max_velocity = self._executor.max_velocity
        self._accepts = [True] * n
        self._goal_effort: dict[int, float] = {}
        self._holding: set[int] = set()
        self._kept: frozenset[int] = frozenset()
        self._settling: dict[int, float] = {}
        self._jogged: dict[int, float] = {}
        self._thermal_due = self._limited_reported = -math.inf
        self.starts.set(dict(enumerate(hand.rest.tolist())))
        nothing = [math.nan] * n
        self._measured = Measured(nothing, nothing, nothing, [False] * n, [-1] * n)
        self.reference_position = self._limiter.position
        self.reference_velocity = self._limiter.velocity
        self._set_efforts()
        self._stream_hold = StreamHold(
            hand, self._contact, self._limiter.position, self.reference_effort, self._holding
        )

    def restored(self) -> None:
        """Recompute derived values after the state was set from outside."""
        self._profile.restored()

    # --- goals and commands ------------------------------------------------------------------

    @property
    def channels(self) -> Mapping[str, FloatArray]:
        """Values computed in addition to the reference, by channel."""
        found = {} if self.stream is None else dict(self.stream.channels)
        felt = self._reflexes.felt
        if felt[0] == felt[0]:
            found[GRIP_FORCE] = np.array(felt)
        if (met := self._executor.met) is not None:
            found[MET] = met
        return found

    @property
    def learned_motion(self) -> dict[str, LearnedMotion]:
        """The learned free motion of actuators, by name."""
        return self._contact.learned_motion

    @property
    def running(self) -> Plan | None:
        """The plan under way."""
        return self._executor.running

    @property
    def grip_effort(self) -> float:
        """Effort kept on a held object, as a fraction of the effort limit."""
        return self._grasp.grip_effort

    @property
    def moving(self) -> bool:
        """Whether the reference is moving or a goal is running."""
        streams = self.stream is not None and self.stream.playing
        return self._profile.moving or self.running is not None or streams

    @property
    def measured(self) -> Measured:
        """The measurements of the last tick."""
        return self._measured

    @property
    def idle(self) -> bool:
        """Whether nothing moves, and no actuator presses against anything."""
        there = zip(self._limiter.position, self._measured.position, strict=True)
        return not self.moving and not any(
            self._contact.presses(i, reference, position)
            for i, (reference, position) in enumerate(there)
        )

    def heat(self, indices: Iterable[int]) -> str:
        """Describe the given actuators that are warm or have an invalid temperature."""
        return self._thermal.words({i: self.hand.actuators[i].name for i in indices})

    def doubts(self, indices: Iterable[int]) -> str:
        """Describe the given actuators that have an implausible measured position."""
        return "; ".join(words for i in indices if (words := self._plausible.words(i)))

    def accept(self, plan: Plan, stamp: float) -> None:
        """Begin a plan; the running goal ends as pre-empted, and a stream ends."""
        self._end_stream(stamp, f"{plan.action} took over")
        plan, kept_efforts = self._in_place(plan)
        if plan.by_depth:
            plan = replace(plan, lag=self._contact.lag(plan.effort))
        # Before contacts are forgotten: the result says which fingers grasp.
        self._executor.end(stamp, self._measured, preempted=True)
        # Without a restart, the motion is planned only once, when the executor starts.
        if restarts := self._restarts(plan.legs[0].targets, stamp):
            self.starts.set(restarts)
        self._forget_hold(plan.involved)
        kept = {i: e for i, e in self._goal_effort.items() if i not in plan.involved}
        self._goal_effort = kept | dict(plan.effort)
        # A requested force is kept; without one, the effort is lowered while an object is held.
        self._kept -= plan.involved
        if plan.force is not None:
            self._kept |= plan.involved
        self._reflexes.in_place = kept_efforts
        if not kept_efforts and (text := slowed(plan, self.hand)):
            who = ", ".join(plan.elements) or plan.action
            self.outbox.items.append(Event("slowed", who, text, stamp))
        self._executor.start(plan, stamp, self._measured)
        self._set_efforts()
        if lost := [self.hand.actuators[i].name for i in plan.involved if not self.active[i]]:
            self._fail(plan.involved, stamp, f"the device of {lost[0]} is not active any more")

    def _in_place(self, plan: Plan) -> tuple[Plan, dict[int, float]]:
        """Return a plan, without its approach if the object is held, and the grip's efforts.

        Opening first would drop the object. The new force is built up from the effort limits that
        hold it, by actuator [N·m | N].
        """
        around = isinstance(plan.to, Around) and len(plan.legs) > 1
        if not (around and any(self._contact.grasping(i) for i in plan.involved)):
            return plan, {}
        kept = {i: self.reference_effort[i] for i in plan.involved}
        return replace(plan, legs=plan.legs[-1:]), kept

    def _restarts(self, targets: Mapping[int, float], stamp: float) -> dict[int, float]:
        """Return from where to restart references that lead into an object, by index [rad | m].

        They are the measured positions: while it moves back out of the object, such a reference
        would press with the full effort limit. Where the target leads further into the object, the
        grip is kept.
        """
        there: dict[int, float] = {}
        kept = self._kept.union(self._reflexes.held)
        for i, target in targets.items():
            if i not in kept and not self._contact.blocked(i):
                continue
            here = self.starts.at(i, stamp, touching=i in kept)
            if here is not None and (self._limiter.position[i] - here) * (target - here) <= 0.0:
                there[i] = here
        return there

    def apply(self, command: Command, stamp: float) -> None:
        """Apply a command at a time [s]; one for an unknown goal or stream has no effect."""
        match command:
            case Cancel(goal_id):
                plan = self.running
                if plan is not None and goal_id in ("", plan.goal_id):
                    self._executor.end(stamp, self._measured, cancelled=True)
                    self._hold(stamp, range(self._profile.size))
            case Hold(reason):
                self._end_stream(stamp, reason or "the hand holds")
                self._executor.end(stamp, self._measured, cancelled=True, reason=reason)
                self._hold(stamp, self._free())
            case Freeze(reason, actuators):
                frozen, plan, stream = self._indices(actuators), self.running, self.stream
                if not actuators or (stream and not set(stream.indices).isdisjoint(frozen)):
                    self._end_stream(stamp, reason or "the hand has stopped")
                if not actuators or (plan and not plan.involved.isdisjoint(frozen)):
                    self._executor.end(stamp, self._measured, cancelled=True, reason=reason)
                # Before contacts are cleared: they distinguish a blocked finger from a broken
                # encoder.
                self.starts.brake(frozen)
                self._leave_hold(frozen)
            case Jog():
                self._jog(command, stamp)
            case SetGripEffort(fraction):
                self._grasp = structs.replace(self._grasp, grip_effort=fraction)
                self._set_efforts()
            case SetActive(active):
                self._set_active(active, stamp)
            case SetAcceptsEffort(accepts):
                for name, flag in accepts.items():
                    self._accepts[self.hand.actuator_index(name)] = flag
            case Abort(reason, actuators):
                self._fail(self._indices(actuators), stamp, reason)
            case BeginStream():
                self._end_stream(stamp, "another stream began")
                self.stream = StreamPlayer(command, self._limits, self.settings.period)
            case StreamSample():
                self._take_sample(command, stamp)
            case EndStream(stream, reason):
                if self.stream is not None and self.stream.name == stream:
                    self._end_stream(stamp, reason or "its client ended it")
            case never:
                assert_never(never)

    def _indices(self, actuators: Collection[str]) -> list[int]:
        if not actuators:
            return list(range(len(self.active)))
        return [self.hand.actuator_index(name) for name in actuators]

    def _free(self) -> list[int]:
        """Return the actuators that are not blocked; blocked ones may be holding an object."""
        return [i for i in range(self._profile.size) if not self._contact.blocked(i)]

    def _hold(self, stamp: float, indices: Collection[int]) -> None:
        """Brake, then hold the measured position, so that a blocked finger stops pushing."""
        self._profile.go({}, brake=indices)
        self._leave_hold(indices)
        self._settling.update(dict.fromkeys(indices, stamp + _SETTLE))

    def _leave_hold(self, indices: Iterable[int]) -> None:
        self._forget_hold(indices)
        self._set_efforts()

    def _forget_hold(self, indices: Iterable[int]) -> None:
        """Forget what some actuators hold; the caller computes the effort limits."""
        for i in indices:
            self._settling.pop(i, None)
            self._jogged.pop(i, None)
            self._holding.discard(i)
        self._contact.forget(indices)
        self._reflexes.forget(indices)

    def _jog(self, jog: Jog, stamp: float) -> None:
        wanted = {self.hand.actuator_index(name): v for name, v in jog.positions.items()}
        targets = {i: value for i, value in wanted.items() if self.active[i]}
        running = self.running is not None
        self._end_stream(stamp, "actuators were moved by hand")
        self._executor.end(stamp, self._measured, preempted=True)
        self._leave_hold(targets)
        self._executor.led(targets, self._measured)
        velocity = {i: min(jog.max_velocity, self.hand.actuators[i].velocity) for i in targets}
        for i, limit in velocity.items():
            self.max_velocity[i] = limit
        others = set(range(self._profile.size)) - set(targets) if running else ()
        self._profile.go(targets, brake=others, velocity=velocity)
        # A newly active actuator starts from the position measured in this tick.
        self._jogged |= {i: value for i, value in targets.items() if i in self.starts.unplaced}

    def _set_active(self, active: Mapping[str, bool], stamp: float) -> None:
        for name, flag in active.items():
            i = self.hand.actuator_index(name)
            if flag and not self.active[i]:
                self.starts.activate(i)
            elif not flag:
                self.starts.unplaced.discard(i)
            self.active[i] = flag
            self._leave_hold((i,))
            if not flag and self.stream is not None and i in self.stream.indices:
                self._end_stream(stamp, f"the device of {name} is not active any more")

    def _take_sample(self, sample: StreamSample, stamp: float) -> None:
        """Pass a sample to the stream; the first one pre-empts a running goal."""
        stream = self.stream
        if stream is None or stream.name != sample.stream:
            return
        positions = {self.hand.actuator_index(name): p for name, p in sample.positions.items()}
        velocities = {self.hand.actuator_index(name): v for name, v in sample.velocities.items()}
        for i in positions:
            if not self.active[i]:
                name = self.hand.actuators[i].name
                self._end_stream(stamp, f"the device of {name} is not active any more")
                return
        if not stream.taken(sample, positions):
            return
        if self.running is not None:
            self._executor.end(stamp, self._measured, preempted=True)
            self._profile.go({}, brake=set(range(self._profile.size)).difference(positions))
        new = [i for i in positions if i not in stream.indices]
        if new:
            self._begin_streaming(stream, {i: positions[i] for i in new}, stamp)
        self._stream_hold.aim(positions)
        limiter = self._limiter
        stream.take(sample, positions, velocities, stamp, limiter.position, limiter.velocity)

    def _begin_streaming(
        self, stream: StreamPlayer, targets: Mapping[int, float], stamp: float
    ) -> None:
        """Have actuators follow a stream, with its effort limits and with contact detection."""
        # Even without a restart: a moving profile plans its motion anew, as in older recordings.
        self.starts.set(self._restarts(targets, stamp))
        self._kept -= targets.keys()
        for i in targets:
            self.max_velocity[i] = self.hand.actuators[i].velocity
            self._goal_effort.pop(i, None)
        self._goal_effort |= self._stream_hold.limits(stream, targets.keys())
        self._leave_hold(targets)
        self._executor.led(targets, self._measured)
        self._stream_hold.begin(targets, stamp)

    def _hand_back(self, stream: StreamPlayer) -> None:
        """Return the actuators of a stream to the profile, which brakes them and holds there."""
        position, velocity = self._limiter.position, self._limiter.velocity
        self._profile.resume({i: (position[i], velocity[i]) for i in stream.indices})

    def _end_stream(self, stamp: float, why: str) -> None:
        stream, self.stream = self.stream, None
        if stream is None:
            return
        if stream.playing:
            self._hand_back(stream)
        self.ended_stream = stream.name
        self.outbox.items.append(stream.ended(why, stamp))

    def _streamed(self, stream: StreamPlayer, stamp: float) -> list[float]:
        """Return the wanted positions of all actuators [rad | m], by the stream or the profile."""
        if stream.overdue(stamp):
            self._hand_back(stream)
            self.outbox.items.append(stream.pause(stamp))
        self._profile.advance()
        wanted = list(self._profile.position)
        if stream.playing:
            stream.step(stamp, self._limiter.position, self._limiter.velocity, wanted)
        return wanted

    def _fail(self, indices: Collection[int], stamp: float, reason: str) -> None:
        plan = self.running
        if plan is None or not plan.involved.intersection(indices):
            return
        self._executor.end(stamp, self._measured, aborted=True, reason=reason)
        self._hold(stamp, self._free())

    # --- a tick ------------------------------------------------------------------------------

    def step(self, stamp: float, measured: Measured) -> None:
        """Run one tick: evaluate the state and advance the reference by one period.

        Args:
            stamp: When the tick was due [s].
            measured: The measured state; positions stay finite from their first measurement on.
        """
        self._measured = measured
        if measured.touch:
            self._contact.feel(stamp, measured.touch)
        limiter, starts = self._limiter, self.starts
        # A goal may have begun between activation, or a freeze, and this tick.
        if started := starts.step(stamp, measured):
            self._executor.seeded(started, stamp, measured)
        if self._jogged:
            again = {i: value for i, value in self._jogged.items() if i in started}
            self._profile.go(again, velocity={i: self.max_velocity[i] for i in again})
            # Not at a later tick: a hand must not move long after somebody asked for it.
            self._jogged = {}
        if starts.unplaced and (doubts := self.doubts(starts.unplaced)):
            self._fail(starts.unplaced, stamp, doubts)
        if stamp >= self._thermal_due:
            self._watch_temperature(stamp, measured)
        self._executor.step(stamp, measured, limiter.position, self.reference_effort)
        if self._reflexes.active:
            self._reflexes.keep(stamp, measured)
            if self._reflexes.changed:
                self._reflexes.changed = False
                self._set_efforts()
        stream = self.stream
        if stream is not None and self._stream_hold.look(stream, stamp, measured):
            self._set_efforts()
        self._ease_off(stamp, measured)
        if self._settling:
            self._settle(stamp)
        if stream is None:
            self._profile.advance()
            wanted = self._profile.position
        else:
            wanted = self._streamed(stream, stamp)
        if limiter.apply(wanted):
            self._report_limited(stamp)

    def _settle(self, stamp: float) -> None:
        profile = self._profile
        for i, due in list(self._settling.items()):
            if profile.velocity[i] != 0.0:
                self._settling[i] = stamp + _SETTLE
            elif stamp >= due:
                del self._settling[i]
                position = self.starts.at(i, stamp)
                if position is not None and abs(position - profile.position[i]) > _OFF:
                    profile.go({i: position})

    def _ease_off(self, stamp: float, measured: Measured) -> None:
        """Lower the effort of actuators blocked for some time; report grasps that are lost."""
        grasp = self._grasp
        streamed = () if self.stream is None else self.stream.indices
        for i in self._contact.blocked_longer_than(grasp.grip_after, stamp):
            if i in self._holding or i in self._kept or i in self._reflexes.effort:
                continue
            self._holding.add(i)
            # A stream commands the positions of its actuators: only their effort can be lowered.
            if (
                i not in streamed
                and not (self._accepts[i] and math.isfinite(self._effort_limit(i)))
                and (here := self.starts.at(i, stamp)) is not None
            ):
                push = self._profile.target[i] - here
                self._profile.go({i: here + grasp.grip_effort * push})
            self._set_efforts()
        limits, position = self.reference_effort, self._limiter.position
        for i in self._contact.lost(stamp, measured, position, limits):
            actuator = self.hand.actuators[i]
            who = ", ".join(actuator.fingers) or actuator.name
            text = f"{who} lost what it held (actuator {actuator.name})"
            self.outbox.items.append(Event("grasp_lost", who, text, stamp, "warning"))

    def _effort_limit(self, i: int) -> float:
        return self._goal_effort.get(i, self.hand.actuators[i].effort)

    def _limit(self, i: int) -> float:
        """Return the effort limit that an actuator's device enforces [N·m | N], or ``inf``."""
        return self._effort_limit(i) if self._accepts[i] else math.inf

    def _set_efforts(self) -> None:
        asked, reflexes, holding = self._goal_effort, self._reflexes.effort, self._holding
        efforts, factors, grip = self.reference_effort, self._thermal.factor, self.grip_effort
        for i, actuator in enumerate(self.hand.actuators):
            limit = asked.get(i, actuator.effort)
            if i in reflexes:
                limit = min(reflexes[i], actuator.effort)
            elif i in holding:
                limit = min(limit, grip * actuator.effort)
            efforts[i] = limit * factors[i]

    def _watch_temperature(self, stamp: float, measured: Measured) -> None:
        self._thermal_due = stamp + _THERMAL_EVERY
        derating = any(factor != 1.0 for factor in self._thermal.factor)
        found = self._heat.step(stamp, measured.temperature, measured.current)
        for change in self._thermal.step(stamp, found, self.active):
            name = self.hand.actuator_names[change.index]
            estimated = math.isnan(measured.temperature[change.index])
            self.outbox.items.append(change.event(name, stamp, estimated=estimated))
            if change.level is ThermalLevel.DISABLE:
                self.outbox.disable.add(change.index)
        if derating or any(factor != 1.0 for factor in self._thermal.factor):
            self._set_efforts()

    def _report_limited(self, stamp: float) -> None:
        if stamp - self._limited_reported < 1.0:
            return
        self._limited_reported = stamp
        names = ", ".join(compress(self.hand.actuator_names, self._limiter.limited))
        text = f"the reference of {names} was limited"
        self.outbox.items.append(Event("limited", names, text, stamp, "warning"))
