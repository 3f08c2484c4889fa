"""Execute one goal at a time: time and state in, set-points, feedback and results out."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Final, TypedDict

from rtee.actions.openings import MARGIN
from rtee.drivers.plausibility import Plausibility
from rtee.hand.config_schema import Following
from rtee.hand.model import Hand
from rtee.loop import contact_rules as rules
from rtee.loop.closing import leg_speed
from rtee.loop.evidence import ContactMonitor
from rtee.loop.grip import DEVICE, ELSEWHERE, TIPS
from rtee.loop.measured import Measured
from rtee.loop.plan import Leg, Plan
from rtee.loop.profiles import Profile
from rtee.loop.reflexes import Reflexes
from rtee.loop.settings import LoopSettings
from rtee.sample import FloatArray
from rtee.types import (
    Aim,
    Around,
    Feedback,
    FirstContact,
    Intensity,
    JointKind,
    OnContact,
    Opening,
    Result,
    Shortfall,
    readonly,
)

_RANGE_SHARE = 0.01
"""How far short of its target an actuator may rest because of play, as a share of its range [1]. A
prismatic actuator's error must be below this share as well: the usual tolerance of 0.01 is a small
angle [rad], but in metres a fifth of the stroke of a typical gripper jaw. Position alone cannot
distinguish an object thinner than twice this share of the stroke from an empty hand."""

_STEADY = 0.25
"""How long a grasp must rest before its result is sent [s]: by then the impact is over, and an
object that springs away is gone."""

_EARLY = 0.03
"""Share of its travel by which an actuator may stop before the empty hand touches itself: rubber
gloves make fingers thicker than their model."""

_UNEVEN = 0.01
"""Further travel by which an actuator may stop early, as a time for each other actuator of its
finger [s]: they follow their references unevenly, and the others go on. In simulation, one of the
four in the thumb of a fast Allegro stops a tenth of its travel before the contact in its model."""

_ASTRAY = 0.05
"""Share of its range by which an actuator may be off the action's path from rest when it sets out:
from elsewhere, fingers meet elsewhere."""

_UNKNOWN_PATH: tuple[str, tuple[str, ...], bool] = ("", (), False)
"""No action; the hand did not set out on its path from rest."""

_REST_IN = 0.05
"""A goal is reached when the reference, at its velocity, would stay within the tolerance for this
time [s]: passing the target is not enough."""


_BENDS: Final = (Following.TENDON, Following.LINKAGE)
"""Couplings that let some links of a finger go on when others are blocked."""

_MEET: Final = 3
"""Most fingers that one actuator bends and whose posture its position gives: of more, some miss the
object and go on, and take the actuator's motion from those that met it."""

_APART: Final = 0.1
"""Fingers that bend have let go of an object when their sensors feel nothing for this long [s]:
contacts chatter, and the actuators go on meanwhile."""

_NOWHERE: Final = readonly(())
"""Positions at which the fingertips met nothing."""

_DIGITS: Final = 9
"""Decimals of a reported opening [m]: a nanometre is finer than any device resolves."""


class GripValues(TypedDict, total=False):
    """The fields of a `Result` about the opening and the force of the fingertips."""

    elements: tuple[str, ...]
    opening: float | None
    opening_error: float | None
    force: float | None
    force_error: float | None
    force_source: str
    force_asked: float | None
    shortfall: Shortfall
    within: bool | None


class Phase(Enum):
    """Part of a leg: waiting before it, moving, or waiting after it."""

    BEFORE = "before"
    MOVING = "moving"
    AFTER = "after"


@dataclass(slots=True)
class _Run:
    plan: Plan
    started: float
    leg: int = 0
    phase: Phase = Phase.BEFORE
    until: float = 0.0
    first_error: tuple[float, float] = (math.nan, math.nan)
    progress: list[float] = field(default_factory=list)
    reached: list[bool] = field(default_factory=list)
    stalled: list[bool] = field(default_factory=list)
    shares: dict[int, float] = field(default_factory=dict)
    angle: float = 0.0
    length: float = 0.0
    reported: float = -math.inf
    over: float = math.nan
    bears: float = math.nan
    near: float = math.nan

    @property
    def present(self) -> Leg:
        return self.plan.legs[self.leg]


class Executor:
    """Runs at most one goal; a new one replaces it, starting from the present reference.

    Args:
        hand: The hand.
        settings: The loop's settings.
        profile: Moves the reference.
        contact: Detects blocked and grasping actuators.
        plausible: Detects implausible measured positions.
        reflexes: React to contacts of the fingers.
        report: Called with feedback, and with the result of every goal, exactly once.

    Attributes:
        max_velocity: Velocity limits of the last leg, by actuator [rad/s | m/s].
    """

    def __init__(
        self,
        hand: Hand,
        settings: LoopSettings,
        profile: Profile,
        contact: ContactMonitor,
        plausible: Plausibility,
        reflexes: Reflexes,
        report: Callable[[Feedback | Result], None],
    ) -> None:
        self._hand = hand
        self.max_velocity = [actuator.velocity for actuator in hand.actuators]
        self._settings = settings
        self._profile = profile
        self._contact = contact
        self._plausible = plausible
        self._reflexes = reflexes
        self._emit = report
        self._run: _Run | None = None
        self._turn = 0
        self._path = _UNKNOWN_PATH
        self._met: tuple[float, ...] = ()
        self._told, self._meeting = _NOWHERE, frozenset[int]()
        self._felt = -math.inf
        self._limits: Sequence[float] = [math.inf] * len(hand.actuators)
        self._bending = {
            i
            for i, actuator in enumerate(hand.actuators)
            if (known := hand.dynamics.get(actuator.name)) and known.coupling in _BENDS
        }
        self._prismatic = tuple(a.kind is JointKind.PRISMATIC for a in hand.actuators)

    @property
    def running(self) -> Plan | None:
        """The plan under way."""
        return None if self._run is None else self._run.plan

    @property
    def met(self) -> FloatArray | None:
        """Positions at which fingers that bend met what they hold ``(n,)`` [rad | m].

        ``NaN``: not known; ``None``: the fingers hold nothing, or do not bend.
        """
        if not self._met or self._bending.isdisjoint(self._meeting):
            return None
        return self._told if any(self._contact.grasping(i) for i in self._meeting) else None

    def start(self, plan: Plan, stamp: float, measured: Measured) -> None:
        """Begin a plan; the running one ends as pre-empted.

        Actuators that the new plan doesn't involve stop where they are.
        """
        self.end(stamp, measured, preempted=True)
        legs = len(plan.legs)
        self._run = run = _Run(plan, stamp)
        run.progress, run.reached, run.stalled = [0.0] * legs, [False] * legs, [False] * legs
        self._contact.forget(plan.involved)
        # What is held goes on to be held where it was met.
        if not self._reflexes.in_place:
            self._met = ()
        # What stopped an action may have pushed fingers off the path of its repetition.
        if self._path[:2] != (plan.action, plan.elements):
            self._path = plan.action, plan.elements, self._on_path(plan, measured)
        self._wait(run, stamp)
        self._proceed(run, stamp, measured)
        if run.phase is Phase.BEFORE:
            self._profile.go({}, brake=self._moving(except_for=()))

    def step(
        self, stamp: float, measured: Measured, reference: Sequence[float], limits: Sequence[float]
    ) -> None:
        """Evaluate the state; proceed to the next leg, or end the goal, when it is time.

        Args:
            stamp: Now [s].
            measured: The measured state.
            reference: Positions sent last [rad | m].
            limits: Effort limits sent last [N·m | N].
        """
        run = self._run
        self._limits = limits
        if run is None:
            return
        targets = run.present.targets
        if run.phase is Phase.MOVING:
            if isinstance(run.plan.to, Around):
                self._note_touch(run, stamp, measured, limits)
            reflexes = self._reflexes
            # Actuators that a reflex has stopped would look stalled.
            free = [i for i in targets if i not in reflexes.busy] if reflexes.active else targets
            self._contact.update(stamp, measured, reference, limits, free)
            felt = reflexes.step(stamp, measured, limits)
            self._learn(targets, stamp, measured, reference, felt=felt)
            if not self._plausible.doubted(targets):
                self._judge(run, stamp, measured)
            # A goal must neither succeed nor stall by a position that cannot be right. A single
            # implausible step is waited out.
            elif (broken := self._plausible.broken(targets)) is not None:
                self._profile.go({}, brake=self._moving(except_for=()))
                self.end(stamp, measured, aborted=True, reason=self._plausible.words(broken))
                return
        self._proceed(run, stamp, measured)
        # The last leg is over, and its result was reported.
        if self._run is not run:
            return
        if stamp - run.started >= run.plan.timeout:
            self._profile.go({}, brake=self._moving(except_for=()))
            self.end(stamp, measured, timed_out=True)
        elif stamp - run.reported >= 1.0 / self._settings.feedback_rate:
            self._report(run, stamp)

    def _learn(
        self,
        targets: Iterable[int],
        stamp: float,
        measured: Measured,
        reference: Sequence[float],
        *,
        felt: bool,
    ) -> None:
        """Learn from the motion of one actuator per tick, to keep the tick short.

        Where efforts are ``felt``, the reflexes learn from them themselves.
        """
        velocity = self._profile.velocity
        moving = [i for i in targets if velocity[i] != 0.0 and measured.fresh[i]]
        if moving:
            self._turn = (self._turn + 1) % len(moving)
            i = moving[self._turn]
            if not self._reflexes.touched:
                self._contact.follows(i, measured.position[i], reference[i], velocity[i])
            if not felt:
                self._contact.learn(i, stamp, measured, reference[i], velocity[i], self._limits[i])

    def led(self, targets: Mapping[int, float], measured: Measured) -> None:
        """Record that a jog or a stream moves some actuators, by index [rad | m]."""
        self._path, self._met = _UNKNOWN_PATH, ()
        for i, target in targets.items():
            self._contact.led(i, measured.position[i], target)

    def seeded(self, indices: Collection[int], stamp: float, measured: Measured) -> None:
        """Restart the leg after the references of some of its actuators were reset."""
        self._path = _UNKNOWN_PATH  # people may have moved the hand
        run = self._run
        if (
            run is not None
            and run.phase is Phase.MOVING
            and not run.plan.involved.isdisjoint(indices)
        ):
            self._set_out(run, stamp, measured)

    def end(
        self,
        stamp: float,
        measured: Measured,
        *,
        preempted: bool = False,
        cancelled: bool = False,
        timed_out: bool = False,
        aborted: bool = False,
        reason: str = "",
    ) -> None:
        """End the running goal, if any, with its result."""
        run = self._run
        if run is None:
            return
        # First, so that nothing below can end the same goal twice.
        self._run = None
        self._report(run, stamp)
        targets = run.present.targets
        fingers = self._contact.fingers
        plan = run.plan
        grasped = any(self._contact.grasping(i) for i in plan.involved)
        unknown = self._may_be_nothing(run, measured)
        if unknown:
            grasped, fingers = False, ()
        early = preempted or cancelled or timed_out
        self._emit(
            Result(
                goal_id=plan.goal_id,
                action=plan.action,
                reached=all(run.reached),
                stalled=any(run.stalled),
                grasped=grasped,
                grasped_fingers=fingers,
                preempted=preempted,
                cancelled=cancelled,
                timed_out=timed_out,
                aborted=aborted,
                reason=reason,
                # The larger of two different units: zero only if both are.
                error=max(self._norms(targets, measured.position)),
                duration=stamp - run.started,
                position=dict(
                    zip(self._hand.actuator_names, map(float, measured.position), strict=True)
                ),
                touched=() if unknown else self._reflexes.touched,
                unknown=unknown,
                aim=plan.aim,
                **self._grip_values(run, measured, grasped, aborted, early=early),
            )
        )

    def _note_touch(
        self, run: _Run, stamp: float, measured: Measured, limits: Sequence[float]
    ) -> None:
        """Record the actuators' positions at which the fingertips met an object.

        From there on, adaptive fingers bend while the force builds up: their actuators move on, and
        their positions no longer give the width of the object.
        """
        grip, bends = run.plan.grip, self._bends(run)
        if grip is None:
            return
        least, touch = self._settings.grasp.touch, measured.touch
        sensed = not math.isnan(grip.tip_force(touch))
        # Without sensors: a bending finger bends before its effort reaches half of its limit.
        met = bool(self._reflexes.touched) and bends and not sensed
        if not (met or grip.touches(measured.position, measured.effort, limits, touch, least)):
            # A bending finger slips and catches itself again on what the other side still touches.
            kept = grip.feels(touch, least) or (sensed and stamp - self._felt <= _APART)
            if not (bends and kept):
                self._met = ()
            return
        self._felt = stamp
        if not self._met:
            self._met, self._meeting = tuple(measured.position), frozenset(grip.indices)
            moved = (self._hand.actuators[i].fingers for i in self._bending & self._meeting)
            known = max(map(len, moved), default=0) <= _MEET
            self._told = readonly(self._met if known else [math.nan] * len(self._met))

    def _bends(self, run: _Run) -> bool:
        """Return whether the grasping fingers bend while their actuator goes on."""
        grip = run.plan.grip
        return grip is not None and not self._bending.isdisjoint(grip.indices)

    def _may_be_nothing(self, run: _Run, measured: Measured) -> bool:
        """Return whether the result cannot state for certain that an object is held.

        The hand may be touching itself. Or an object is touched, but not gripped by the tips: other
        parts of the hand, or its weight on the fingers, may hold it.
        """
        plan, contact = run.plan, self._contact
        grasped = any(contact.grasping(i) for i in plan.involved)
        closes = plan.aim is Aim.POSTURE and self._stopped_closing(run)
        word = contact.says(plan.involved)
        if closes and plan.meets:
            return not word and not (self._path[2] and self._stopped_early(run))
        if plan.grip is None or not (self._reflexes.touched or grasped or closes):
            return False
        met, here, grip = self._met or measured.position, measured.position, plan.grip
        bends = self._bends(run)
        # Fingers that met one another push each other off the path. Those that bend as they press
        # have an opening only where they met the object.
        places = (met,) if bends else (met, here)
        if any(rules.may_be_nothing(grip.opening(p), grip.doubt(p), word=word) for p in places):
            return True
        # One motor that bends several fingers goes on with those that miss the object.
        own = bends and len(grip.squeezing(grip.intensity_of(met))) > 1
        past = own and rules.closed_past(
            grip.opening(here), grip.doubt(here), grip.opening(met), bends=True
        )
        if past and not word:
            return True
        last = isinstance(plan.to, Around) and run.leg + 1 == len(plan.legs)
        if OnContact.STOP in (*plan.on_contact.values(), self._settings.grasp.on_contact):
            return False  # the goal asks only for a touch
        return last and not grasped and any(contact.touch(i) is not False for i in plan.involved)

    def _stopped_closing(self, run: _Run) -> bool:
        """Return whether an actuator was stopped while closing in the last leg.

        An actuator that was pushed away from rest, or beyond its target, before the leg began does
        not count.
        """
        rest, contact = self._hand.rest, self._contact
        return run.stalled[-1] and any(
            contact.closes(i, rest[i]) for i in run.present.targets if contact.blocked(i)
        )

    def _on_path(self, plan: Plan, measured: Measured) -> bool:
        """Return whether the hand is on the path of an action from rest."""
        target = plan.legs[-1].targets
        ways = [target.get(i, a.rest) - a.rest for i, a in enumerate(self._hand.actuators)]
        here = [p - a.rest for p, a in zip(measured.position, self._hand.actuators, strict=True)]
        length = sum([way * way for way in ways])
        share = sum([way * at for way, at in zip(ways, here, strict=True)]) / (length or 1.0)
        return all(
            abs(at - share * way) <= _ASTRAY * (actuator.upper - actuator.lower)
            for at, way, actuator in zip(here, ways, self._hand.actuators, strict=True)
        )

    def _stopped_early(self, run: _Run) -> bool:
        """Return whether something stopped an actuator clearly before the empty hand does."""
        actuators = self._hand.actuators
        ways = {i: target - actuators[i].rest for i, target in run.present.targets.items()}
        # All arrive together with the one that takes longest.
        longest = max(abs(way) / self.max_velocity[i] for i, way in ways.items())
        joints = Counter(
            name for i, way in ways.items() if abs(way) > run.shares[i]
            for name in actuators[i].fingers
        )  # fmt: skip
        for i, way in ways.items():
            if abs(way) <= run.shares[i]:  # others may have pushed it away from rest
                continue
            ahead = math.copysign(1.0, way)
            came = ahead * (self._contact.farthest(i) - actuators[i].rest)
            meets = min(ahead * (run.plan.meets[i] - actuators[i].rest), abs(way))
            further = max((joints[name] for name in actuators[i].fingers), default=1) - 1
            early = (_EARLY + _UNEVEN * further / longest) * abs(way)
            if not rules.came_as_far(came, meets, max(early, run.shares[i])):
                return True
        return False

    def _grip_values(
        self, run: _Run, measured: Measured, grasped: bool, aborted: bool, *, early: bool
    ) -> GripValues:
        """Return the fields of the result about opening and force of the fingertips.

        A goal that ended ``early`` had no time to build up the force.
        """
        plan = run.plan
        grip, to = plan.grip, plan.to
        if grip is None or aborted:
            # A device was lost, or what it measures is not believed.
            return {"elements": plan.elements}
        blocked = any(self._contact.blocked(i) for i in grip.indices)
        bent = [] if (told := self.met) is None else told.tolist()
        met = bent or (self._met if self._met and grasped else measured.position)
        width, width_error = grip.opening(met), grip.opening_error(met)
        force, error, source = grip.force(
            measured.position, measured.effort, self._limits, measured.touch, blocked, bent
        )
        within = None
        if isinstance(to, Around) and not math.isnan(width):
            within = grasped and -to.narrower <= width - to.width <= to.wider
        felt, doubt = self._reflexes.felt
        # Fingers that touch elsewhere than the levers assume, or of an unknown posture.
        elsewhere = within is False or math.isnan(width)
        # So does `_LegReactions.share`, which lowers the force there however wide it may be.
        elsewhere = elsewhere or (isinstance(to, Around) and width > to.width + MARGIN)
        elsewhere = elsewhere and source not in (TIPS, DEVICE) and grasped
        if felt == felt:
            # More exact: measured per finger, without the effects of weight and friction.
            force, error = felt, doubt
            if elsewhere or doubt != doubt:
                force, error, source = math.nan, math.nan, ""
        elif elsewhere:
            error = max(error, ELSEWHERE * force)
        asked = None if plan.force is None else plan.force.value
        wanted = math.nan if early or not grasped or asked is None else asked
        short = rules.falls_short(force, error, wanted)
        return {
            "elements": plan.elements,
            # A zero of floating point is neither -2.8e-17 nor -0.
            "opening": None if math.isnan(width) else round(width, _DIGITS) + 0.0,
            "opening_error": None if math.isnan(width_error) else round(width_error, _DIGITS),
            "force": None if math.isnan(force) else force,
            "force_error": None if math.isnan(error) else error,
            "force_source": source,
            "force_asked": asked,
            "shortfall": self._shortfall(plan, measured) if short else Shortfall.NONE,
            "within": within,
        }

    def _shortfall(self, plan: Plan, measured: Measured) -> Shortfall:
        """Return why the force on what is held is less than the requested one."""
        effort, limits = measured.effort, self._limits
        # Of several joints, the one that bears most shows what the limits give.
        if any(rules.is_bound(effort[i], limits[i]) for i in plan.effort):
            return Shortfall.EFFORT_LIMIT
        known = all(effort[i] == effort[i] for i in plan.effort)
        at_end = known and self._reflexes.at_end
        return Shortfall.END_OF_MOTION if at_end else Shortfall.UNKNOWN

    def _wait(self, run: _Run, stamp: float) -> None:
        run.phase = Phase.BEFORE
        run.until = stamp + run.present.before

    def _proceed(self, run: _Run, stamp: float, measured: Measured) -> None:
        """Leave the phases that are over; a leg without waiting times starts at once."""
        while True:
            if run.phase is Phase.BEFORE and stamp >= run.until:
                self._set_out(run, stamp, measured)
                return
            if run.phase is Phase.AFTER and stamp >= run.until:
                if run.leg + 1 == len(run.plan.legs):
                    self.end(stamp, measured)
                    return
                run.leg += 1
                self._wait(run, stamp)
                self._report(run, stamp)
                # The next leg may have no time to wait, and then starts at this very tick.
                continue
            return

    def _set_out(self, run: _Run, stamp: float, measured: Measured) -> None:
        run.phase, run.over, run.bears, run.near = Phase.MOVING, math.nan, math.nan, math.nan
        leg = run.present
        if run.leg and run.plan.by_depth:  # the way here has shown by how much the fingers lag
            run.plan = replace(run.plan, lag=self._contact.lag(run.plan.effort))
        speed = leg_speed(run.plan, run.leg, self._hand)
        for i, actuator in enumerate(self._hand.actuators):
            # Never 0: times are divided by it, and some devices take 0 for no limit.
            self.max_velocity[i] = speed * actuator.velocity or math.ulp(0.0)
        top = dict(enumerate(self.max_velocity))
        self._profile.go(leg.targets, brake=self._moving(except_for=leg.targets), velocity=top)
        run.angle = self._tolerance(run.plan)
        run.length = self._length_tolerance(leg.targets, run.angle)
        run.shares = self._shares(run)
        # After `go`: an earlier stall belongs to another motion.
        self._contact.begin(leg.targets, run.shares, stamp)
        self._reflexes.begin(run.plan, run.leg, run.shares, measured, stamp)
        # Progress is measured from here.
        run.first_error = self._norms(leg.targets, measured.position)
        self._report(run, stamp)

    def _moving(self, except_for: Collection[int]) -> list[int]:
        profile = self._profile
        states = zip(profile.velocity, profile.position, profile.target, strict=True)
        return [
            i
            for i, (velocity, position, target) in enumerate(states)
            if (velocity != 0.0 or position != target) and i not in except_for
        ]

    def _judge(self, run: _Run, stamp: float, measured: Measured) -> None:
        error = self._norms(run.present.targets, measured.position)
        if self._reflexes.around and self._reflexes.touched:
            # The object is wider than assumed: the fingers close on it from here.
            run.reached[run.leg], run.progress[run.leg] = True, 1.0
            run.phase, run.until = Phase.AFTER, stamp + run.present.after
            return
        # A progress bar must not go back when the hand overshoots.
        run.progress[run.leg] = max(run.progress[run.leg], self._progress(run, error))
        targets = run.present.targets
        arrived = self._within(run, error) and self._settled(run)
        # An object held on the last millimetre counts as held, though the target is reached, too.
        held = any(self._contact.grasping(i) for i in targets)
        if not held and self._bears(run, stamp, measured):
            # The object is thinner than the tolerance of a stall: only the effort reveals it.
            held = any(self._contact.grasping(i) for i in targets)
            if not held:
                return
        if not held and not arrived and self._near(run, stamp, measured):
            if stamp - run.near < self._settings.stall.time:
                return
            arrived = True
        if arrived and not held:
            if self._plausible.leaping(targets, stamp):
                return
            run.reached[run.leg] = True
            run.progress[run.leg] = 1.0
        elif not self._over(run, measured):
            run.over = math.nan
            return
        else:
            if run.over != run.over:
                run.over = stamp
            if not self._steady(run, stamp):
                return
            run.stalled[run.leg] = True
        run.phase = Phase.AFTER
        run.until = stamp + run.present.after

    def _near(self, run: _Run, stamp: float, measured: Measured) -> bool:
        """Return whether each actuator rests within its play of its target.

        At rest, the play and the friction of many actuators add up to more than their tolerance.
        """
        to, actuators = run.plan.to, self._hand.actuators
        # A stricter tolerance of the goal applies here, too; an opening has its own tolerance.
        if near := not (isinstance(to, Opening) or self._profile.moving or self._reflexes.touched):
            usual = Intensity().tolerance
            asked = to.tolerance if isinstance(to, Intensity | FirstContact) else usual
            share = _RANGE_SHARE * min(asked / usual, 1.0)
            near = all(
                abs(target - measured.position[i])
                <= share * (actuators[i].upper - actuators[i].lower)
                < math.inf
                for i, target in run.present.targets.items()
            )
        if not near:
            run.near = math.nan
        elif run.near != run.near:
            run.near = stamp
        return near

    def _bears(self, run: _Run, stamp: float, measured: Measured) -> bool:
        """Return whether the single actuator of a grasp still presses where it has stopped."""
        targets = run.present.targets
        last = run.leg + 1 == len(run.plan.legs)
        if not (isinstance(run.plan.to, Around) and last and len(targets) == 1):
            return False
        (i,) = targets
        # A reflex that has stopped it decides what it does next.
        if i in self._reflexes.busy or not self._settled(run):
            return False
        if not measured.fresh[i]:
            return run.bears == run.bears  # as at its last measurement
        grip, contact, position = run.plan.grip, self._contact, measured.position
        word = measured.grasped[i] == 1
        nothing = grip is None or rules.may_be_nothing(
            grip.opening(position), grip.doubt(position), word=word
        )
        if nothing or not contact.bears(i, measured, self._limits[i]):
            run.bears = math.nan
            return False
        if run.bears != run.bears:
            run.bears = stamp
        if stamp - run.bears >= _STEADY:
            contact.pin(i, stamp, measured, grasping=True)
        return True

    def _progress(self, run: _Run, error: tuple[float, float]) -> float:
        left = 0.0
        # Angles and lengths have separate tolerances.
        least = (run.angle, run.length)
        for now, first, tolerance in zip(error, run.first_error, least, strict=True):
            if first > tolerance:
                left = max(left, now / first)
        done = 1.0 - left
        # NaN: an actuator has no measured position yet.
        return min(1.0, max(0.0, done)) if done == done else 0.0

    def _norms(
        self, targets: Mapping[int, float], position: Sequence[float]
    ) -> tuple[float, float]:
        """Return the norm of the error of revolute [rad] and of prismatic actuators [m]."""
        angle = length = 0.0
        for i, target in targets.items():
            error = target - position[i]
            if self._prismatic[i]:
                # Angles and lengths have different units: one norm for each.
                length += error * error
            else:
                angle += error * error
        return math.sqrt(angle), math.sqrt(length)

    def _tolerance(self, plan: Plan) -> float:
        """Return the norm of the error that counts as 0 [rad | m]."""
        if isinstance(plan.to, Intensity | FirstContact):
            return plan.to.tolerance
        if plan.grip is None:  # as in recordings of goals without a table
            return Intensity().tolerance
        at = plan.grip.intensity_at(plan.to.width)
        return plan.grip.error_of(self._settings.opening_tolerance, at)

    def _length_tolerance(self, targets: Iterable[int], tolerance: float) -> float:
        spans = [
            self._hand.actuators[i].upper - self._hand.actuators[i].lower
            for i in targets
            if self._prismatic[i]
        ]
        return min(tolerance, _RANGE_SHARE * min(spans)) if spans else tolerance

    def _within(self, run: _Run, error: tuple[float, float]) -> bool:
        return error[0] <= run.angle and error[1] <= run.length

    def _settled(self, run: _Run) -> bool:
        """Return whether the reference has arrived at the targets, and is not just passing them."""
        profile, targets = self._profile, run.present.targets
        # The reference is at rest, so the hand stays where it is.
        if not profile.moving:
            return True
        if not self._within(run, self._norms(targets, profile.position)):
            return False
        # Motion of the reference if it went on like this for a moment.
        travels = {i: profile.velocity[i] * _REST_IN for i in targets}
        return self._within(run, self._norms(travels, [0.0] * profile.size))

    def _shares(self, run: _Run) -> dict[int, float]:
        """Return each actuator's tolerance: if all are within theirs, so is the norm."""
        targets, tolerance = run.present.targets, run.angle
        lengths = sum([self._prismatic[i] for i in targets])
        length = run.length / math.sqrt(lengths or 1)
        angle = tolerance / math.sqrt(len(targets) - lengths or 1)
        return {i: length if self._prismatic[i] else angle for i in targets}

    def _over(self, run: _Run, measured: Measured) -> bool:
        """Return whether every actuator has either arrived or is blocked."""
        blocked = False
        for i, target in run.present.targets.items():
            if self._contact.blocked(i):
                blocked = True
            # "not ... <=", since NaN must count as not arrived.
            elif not abs(target - measured.position[i]) <= run.shares[i]:
                return False
        return blocked

    def _steady(self, run: _Run, stamp: float) -> bool:
        """Return whether the fingers that reacted, and the object, have come to rest."""
        if not self._reflexes.touched:
            return True
        return rules.settled(
            steady=stamp - run.over, least=_STEADY, building=self._reflexes.building
        )

    def _report(self, run: _Run, stamp: float) -> None:
        run.reported = stamp
        plan = run.plan
        inner = {leg.name: run.progress[k] for k, leg in enumerate(plan.legs)} if plan.timed else {}
        self._emit(
            Feedback(
                goal_id=plan.goal_id,
                progress=sum(run.progress) / len(run.progress),
                inner=run.present.name,
                inner_progress=inner,
                stamp=stamp,
            )
        )
