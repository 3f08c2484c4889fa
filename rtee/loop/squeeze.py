"""Squeeze an object with several actuators: build up the force, ease it, and answer slips."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from rtee.hand.config_schema import GraspSettings
from rtee.hand.model import Hand
from rtee.loop import contact_rules as rules
from rtee.loop.evidence import ContactMonitor
from rtee.loop.grip import ONE_SIDE, Grip
from rtee.loop.measured import Measured
from rtee.loop.profiles import Profile
from rtee.types import Event

_SETTLE = 0.15
"""Time for fingers and object to come to rest after a change of force [s]: some exchanges of the
slowest device."""

_EASE_EVERY = 0.5
"""Interval of the steps by which a grasp is eased [s]: long enough for a slip to show before the
next step."""

_EASE_STEP = 0.05
"""Size of these steps as a share of the goal's effort limits: small, since friction gives no
warning."""

_SLIP_STEP = 0.25
"""Least increase of the effort after a slip, as a share of the goal's effort limits: the slip ends
within a few steps, or the object is gone."""

_SLIP_SHARE = 0.75
"""Increase of the effort after a slip as a share of the present effort, if that is more: it
overtakes a growing load."""

_REPORT_EVERY = 0.5
"""Slips are reported at most this often [s]: one event for people, not one for each step."""

_FOLLOW = 0.1
"""Time constant of the control of the measured force [s]: slower than motors respond, so that
nothing oscillates."""

_AT_LIMIT = 0.9
"""An actuator counts as at its effort limit above this share of it. Below, the effort is still
rising, or the impact is not over, and the force does not yet show what the limit gives. The exact
value matters little: in simulation 0.5 to 1 lead to the same force."""

_THERE = 0.02
"""The force has arrived when its error is below this share of the requested force: less than the
5 % by which a measured force may be off (`_TIP_SHARE` in `grip.py`). With 10 % the correction would
end visibly too early."""

_CORRECTED = 3.0
"""Longest time for which the force is corrected after the fingers have come to rest [s]: thirty
time constants."""

_NEARLY = 0.5
"""Share of the force above which fingers that bend close more slowly."""

_BELIEVED = 2.0
"""Largest factor by which a measured force changes the effort limits: sensors break, too."""

_HEEL = 0.25
"""Least factor of fingers from all around: with their middle links, they press four times as hard
as with their tips."""

_FELT = 0.2
"""Below this share of the requested force, nothing is corrected: the object is lost, or the sensors
measure only a part of the force."""

_RISES = 2.0
"""Time in which an effort rises to its limit [s]; it may stay below: the reference leads no
deeper."""

_CONFIRMED = 2
"""Measurements in succession that must show a change of force: a single one may be noise."""


@dataclass(slots=True)
class Held:
    """An actuator that squeezes, and its measurements when it last came to rest.

    Attributes:
        start: Effort limit to begin with [N·m | N].
        full: Effort limit at level 1 [N·m | N].
        position: Position at rest [rad | m]; ``NaN``: it has not come to rest.
        effort: Size of the effort at rest [N·m | N].
        touch: Force on its fingers at rest [N].
        low: Number of successive measurements with another force.
    """

    start: float
    full: float
    position: float = math.nan
    effort: float = math.nan
    touch: float = math.nan
    low: int = 0


class SlipReport:
    """Reports answers to slips, as seldom as people need; that the force is at its limit, once."""

    def __init__(self, hand: Hand, report: Callable[[Event], None]) -> None:
        self._hand, self._report = hand, report
        self._last, self._told_limit = -math.inf, False

    def answered(self, i: int, stamp: float, *, limited: bool) -> None:
        """Report a slip at an actuator, and whether the force could be raised no further."""
        if stamp - self._last < _REPORT_EVERY or (limited and self._told_limit):
            return
        self._last, self._told_limit = stamp, self._told_limit or limited
        actuator = self._hand.actuators[i]
        who = ", ".join(actuator.fingers) or actuator.name
        does = "the force is at its limit" if limited else "the force is raised"
        text = f"slip at {who} (actuator {actuator.name}): {does}"
        self._report(Event("slip", who, text, stamp, "warning"))


class Squeeze:
    """Builds up a force, eases it while it holds, and raises it when the object slips.

    Args:
        hand: The hand.
        grasp: Settings for times and efforts.
        profile: Holds the targets of the actuators.
        contact: Detects whether the actuators hold an object.
        report: Called with events.
        held: The actuators, by index.
        floor: Least level of effort to ease to; 1: the effort limits of the goal.
        most: Highest level of effort after slips.

    Attributes:
        held: The actuators, by index.
        effort: Their effort limits [N·m | N].
        built: Whether the force has been built up.
        answers_slips: Whether slips are answered and reported.
        force: The requested force [N]; ``NaN``: none.
        grip: Computes the force measured at the fingertips, for a requested force.
        pressing: The actuators whose effort makes the force.
        slowly: Speeds with which they close once the force is nearly there [rad/s | m/s].
    """

    def __init__(
        self,
        hand: Hand,
        grasp: GraspSettings,
        profile: Profile,
        contact: ContactMonitor,
        report: Callable[[Event], None],
        held: dict[int, Held],
        floor: float,
        most: float,
    ) -> None:
        self._grasp, self._profile, self._contact = grasp, profile, contact
        self._slip_report = SlipReport(hand, report)
        self.held = held
        self.effort = {i: each.start for i, each in held.items()}
        self.built = False
        self.answers_slips = True
        self.force = math.nan
        self.grip: Grip | None = None
        self.pressing: frozenset[int] = frozenset()
        self.slowly: Mapping[int, float] = {}
        self._factor, self._corrected = 1.0, math.nan
        self._correct_until, self._there = -math.inf, math.inf
        self._rising_until = -math.inf
        self._strayed = math.inf
        self._correcting = self._arrived = False
        self._floor, self._most = floor, most
        self._level = 1.0
        self._since = self._before = self._enough = self._settled = self._ease = math.inf

    def forget(self, i: int) -> None:
        """Forget an actuator."""
        self.held.pop(i, None)
        self.effort.pop(i, None)
        self.pressing -= {i}

    @property
    def building(self) -> bool:
        """Whether the force is still being built up, or brought to the requested one."""
        return not self.built or self._correcting

    @property
    def at_end(self) -> bool:
        """Whether the references have gone as far as they may."""
        return all(self._profile.position[i] == self._profile.target[i] for i in self.held)

    def begin(self, stamp: float) -> None:
        """Begin to build up the force at a time [s]."""
        self._since = self._before = self._enough = stamp

    def step(self, stamp: float, measured: Measured) -> bool:
        """Run one tick; return whether ``effort`` has changed."""
        if self.slowly and self._nearly(measured):
            goes_on = {i: self._profile.target[i] for i in self.slowly if i in self.held}
            self._profile.go(goes_on, velocity=self.slowly)
            ways = (abs(t - self._profile.position[i]) / self.slowly[i] for i, t in goes_on.items())
            self._rising_until = stamp + max(ways, default=0.0)
            self.slowly = {}
        if not self.built:
            self._build(stamp, measured)
            return True
        self._judge(stamp, measured)
        self._correcting = self.grip is not None and self._corrects(stamp, measured)
        if self.grip is not None and self._correcting:
            corrected = self._correct(stamp, measured)
            self._settled, self._ease = stamp + _SETTLE, stamp + _EASE_EVERY
            return corrected
        if not self.answers_slips:
            return False
        if not any(self._contact.grasping(i) for i in self.held):
            self._settled = stamp + _SETTLE
            return False
        if stamp < self._settled:
            for held in self.held.values():
                # Measurements while the force changes cannot serve as a reference for slips.
                held.position = math.nan
            return False
        for i, held in self.held.items():
            if measured.fresh[i] and self._slips(i, held, measured):
                # One slip at a time: the level is common to all actuators, which settle again
                # before the next check.
                self._raise(i, stamp)
                return True
        if self._level > self._floor and stamp >= self._ease:
            self._set_level(max(self._level - _EASE_STEP, self._floor), stamp)
            return True
        return False

    def _judge(self, stamp: float, measured: Measured) -> None:
        """Tell the contacts whether the fingers press on something, as far as the force shows it.

        All fingers count, as one motor may move both sides: one side alone holds nothing, nor do
        fingers that have left the place where they grasped.
        """
        felt = math.nan if self.grip is None else self.grip.tip_force(measured.touch)
        for i in self.pressing:
            strays = rules.strays(self._contact.strayed(i, stamp, measured.position))
            if felt == felt or strays:
                self._contact.presses_now((i,), not (strays or rules.faint(felt, self.force)))

    @property
    def _least(self) -> float:
        """Least factor by which a measured force changes the effort limits."""
        return _HEEL if self.grip is not None and self.grip.around else 1.0 / _BELIEVED

    def _corrects(self, stamp: float, measured: Measured) -> bool:
        """Return whether the force is being brought to the requested one, at first or again."""
        until = self._correct_until if self._correct_until < math.inf else self._rising_until
        if stamp < until:
            self._strayed = stamp
            return True
        self._arrived = True
        if not self._strays(measured):
            self._strayed = stamp
        if stamp - self._strayed < _SETTLE:
            return False
        self._correct_until, self._there, self._corrected = stamp + _CORRECTED, stamp, stamp
        return True

    def _strays(self, measured: Measured) -> bool:
        """Return whether the force has drifted, because the object shifts or creeps.

        A force that was raised after a slip is kept. While slips are answered, a higher force may
        be due to one.
        """
        share = self._felt(measured) / self.force
        if not share >= _FELT or self._level != 1.0:
            return False
        now = 0.0 if self.answers_slips else math.inf
        return not rules.force_rests(share, now, 0.0)

    def _correct(self, stamp: float, measured: Measured) -> bool:
        """Bring the force that sensors measure to the requested one; return whether it changed.

        Adaptive fingers bend, and touch elsewhere than the levers assume. Without sensors at the
        fingertips of both sides, only the levers count. Once the force has arrived, it is lowered
        no further than necessary: sensors may also measure external forces.
        """
        felt = self._felt(measured)
        time, self._corrected = stamp - self._corrected, stamp
        wanted = self.force
        if self._arrived:
            wanted = max(wanted, min(felt, rules.STRONG * wanted))
        # Of several joints, the one that bears most shows what the limits give; others may be
        # held by their posture, and never come near theirs.
        most = max((self._exerted(i, measured) for i in self.pressing), default=math.inf)
        at_limit = most >= _AT_LIMIT * self._factor
        rests = at_limit and any(self._contact.blocked(i) for i in self.pressing)
        if rests and self._correct_until == math.inf:
            self._correct_until = stamp + _CORRECTED
        if not (rests and abs(felt - wanted) <= _THERE * wanted):
            self._there = stamp
        if felt != felt or stamp - self._there >= _SETTLE:
            self._correct_until = stamp
        if not (felt >= _FELT * wanted and time > 0.0 and self.pressing):
            return False
        factor = self._factor
        if felt > wanted:
            # Below its limit, an actuator would not respond until the limit was lowered to its
            # effort: start from there.
            factor = min(factor, most)
        elif not at_limit:
            return False  # the efforts are still rising to the present limit
        factor *= 1.0 + min(time / _FOLLOW, 1.0) * (1.0 - felt / wanted)
        self._factor = min(max(factor, self._least), _BELIEVED)
        self._apply()
        return True

    def _felt(self, measured: Measured) -> float:
        """Return the force by sensors at the fingertips [N]; ``NaN``: it is not measured."""
        grip, touch = self.grip, measured.touch
        least = math.nan if grip is None else grip.tip_force(touch)
        if grip is None or grip.around or least != least:
            return least
        most = max(sum(touch[f] for f in side) for side in (grip.fingers, grip.others))
        return max(least, most / ONE_SIDE)

    def _nearly(self, measured: Measured) -> bool:
        """Return whether most of the force is there: by sensors, else by efforts."""
        felt = self._felt(measured)
        if felt == felt:
            return felt >= _NEARLY * self.force
        return any(self._exerted(i, measured) >= _NEARLY for i in self.pressing)

    def _exerted(self, i: int, measured: Measured) -> float:
        """Return an actuator's effort as a share of its uncorrected effort limit."""
        share = abs(measured.effort[i]) / (self._level * self.held[i].full)
        return share if share == share else math.inf

    def _build(self, stamp: float, measured: Measured) -> None:
        time = self._grasp.squeeze_time
        enough = self._felt(measured) >= self.force
        # The impact of the fingers exceeds the force they press with: the build-up waits until the
        # impact has passed, and only a lasting force counts.
        if enough:
            self._since += stamp - self._before
        else:
            self._enough = stamp
        self._before = stamp
        there = enough and stamp - self._enough >= _SETTLE
        share = min((stamp - self._since) / time, 1.0) if time > 0.0 else 1.0
        for i, held in self.held.items():
            self.effort[i] = held.start + share * (held.full - held.start)
        if share >= 1.0 or there:
            self.built = True
            if there:  # with less effort than the levers predict
                shares = (self._exerted(i, measured) for i in self.pressing)
                self._factor = max(max(shares, default=1.0), self._least)
                self._factor = min(self._factor, 1.0)
                self._apply()
            self._ease = stamp + self._grasp.grip_after
            self._correct_until, self._there = math.inf, stamp
            self._rising_until = max(self._rising_until, stamp) + _RISES
            for i in self.held:
                self._contact.unpin(i, stamp)

    def _slips(self, i: int, held: Held, measured: Measured) -> bool:
        """Return whether the object of an actuator seems to slip, or to be pulled."""
        position, effort = measured.position[i], abs(measured.effort[i])
        forces = self._contact.forces(i, measured)
        touch = sum(forces) if forces else math.nan
        if held.position != held.position:
            held.position, held.effort, held.touch, held.low = position, effort, touch, 0
            return False
        ahead = 1.0 if self._profile.target[i] >= position else -1.0
        if rules.creeps((position - held.position) * ahead, self._contact.tolerance(i)):
            return True
        pulled = rules.pulled(effort, held.effort, touch, held.touch, self._grasp.touch)
        held.low = held.low + 1 if pulled else 0
        return held.low >= _CONFIRMED

    def _raise(self, i: int, stamp: float) -> None:
        """Answer a slip with more effort, and report it."""
        before = self._level
        level = min(before + max(_SLIP_STEP, _SLIP_SHARE * before), self._most)
        # Never eased below this again: the object would slip again.
        self._floor = max(self._floor, level)
        self._set_level(level, stamp)
        self._slip_report.answered(i, stamp, limited=level <= before)

    def _set_level(self, level: float, stamp: float) -> None:
        self._level = level
        self._settled, self._ease = stamp + _SETTLE, stamp + _EASE_EVERY
        self._apply()

    def _apply(self) -> None:
        for i, held in self.held.items():
            factor = self._factor if i in self.pressing else 1.0
            self.effort[i] = self._level * factor * held.full
