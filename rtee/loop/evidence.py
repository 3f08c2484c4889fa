"""Evidence of contacts: which actuators and fingers show one, by what sign, and since when.

The only place that reads measurements for contacts: forces on the fingers, the device's own report,
effort above that of free motion, and stalls. What follows from them is decided by the rules in
`rtee.loop.contact_rules`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from rtee.hand.config_schema import GraspSettings, StallSettings
from rtee.hand.model import Hand
from rtee.loop import contact_rules as rules
from rtee.loop.free_motion import FREELY, SURELY_FREE, FreeMotion, LearnedMotion, Stretches
from rtee.loop.measured import Measured
from rtee.loop.tip_levers import TipLevers

_LOST_AFTER = 0.05
"""A grasp counts as lost when it looks lost for this long [s]: longer than noise, and a few periods
of the slowest devices."""

_FELT = 0.1
"""A fingertip counts as touching for this long after its last contact force [s]: contacts
chatter."""

_DELIVERED = 3
"""After this many measurements with a leading reference, the device has certainly received one: a
driver measures before it sends, and may return the answer to the exchange before. The third is a
margin."""

_SILENCE = 3.0
"""A measurement later than this many usual intervals ends a silence, during which it is unknown
whether the actuator was at rest."""

_CONFIRMED = 2
"""Measurements in succession whose effort must show a contact: a single one may be noise."""

_STEP_WAYS = 1.5
"""Counts of the position by which the reference must move on while the effort shows a contact: a
servo that moves in single counts has moved by then."""

_UNKNOWN_SHARE = 0.05
"""Threshold of a contact for an actuator that moves no fingertip, as a share of its effort limit
above the effort of free motion: its lever, and so the force, is unknown."""

_SET_OUT = 0.1
"""Efforts are not evaluated for this long after an actuator has started to move, while it overcomes
static friction, nor after a silence of its device: the effort of an acceleration may arrive this
late [s]."""

_STEPS = 12
"""Measurements of a moving actuator before its current is judged: a slow device moves in
steps, of which some must be seen."""

_SURGE = 1.5
"""A current shows a contact above this many times the largest of free motion: friction varies by
less over a motion."""

_SURGED = 4
"""Successive measurements that must show this while the actuator stands still: a step of a slow
motion takes fewer."""

_LEARN_EVERY = 0.02
"""Interval at which an actuator's free motion is learned from goals that react to no contact [s]:
some hundred measurements of a motion are enough, and the tick's time is short."""

_RESOLUTION = 0.01
"""Least threshold of a contact as a share of the effort limit: devices measure no better."""

_USUAL_SHARE = 0.125
"""Weight of the newest interval in the usual one, which follows a change of rate within 8
intervals; likewise of the newest lag."""

_MOVES = 0.1
"""Share of the velocity limit above which the lag is measured: below, friction dominates."""


@dataclass(slots=True)
class _Grip:
    """The last known grip of an actuator: direction of pressing, and its position [rad | m]."""

    direction: float
    position: float


@dataclass(slots=True)
class _WatchedActuator:
    tolerance: float
    target: float
    anchor: float
    since: float
    seen: float
    start: float = math.nan
    led: int = 0  # measurements in a row in which it lagged by more than it hung back at first
    lags: int = 0  # the same by more than its tolerance alone
    blocked_at: float = math.nan
    grasping: bool = False
    own_report: bool = False
    old_report: bool = False
    new: bool = True
    hung: float = 0.0
    hold_position: float = math.nan
    hold_forces: Sequence[float] = ()
    losing_since: float = math.nan
    presses: bool | None = None
    led_from: float = math.nan
    pressed: bool = False


@dataclass(slots=True)
class _EffortApproach:
    """Effort data of an actuator that approaches a contact.

    Attributes:
        ahead: Direction in which it closes.
        threshold: Effort of a contact above that of free motion [N·m | N].
        by_tip: Whether the threshold follows from the tip's lever at the present posture.
        velocity: Velocity of the reference when it was last evaluated [rad/s | m/s].
        seen: When it was last evaluated [s].
        began: When it set out [s].
        over: Number of successive measurements above the threshold.
        in_effort: Whether the device measures its effort.
        most: Largest current of its free motion [A].
        steps: Number of measurements of that motion.
        was: Its last measured position [rad | m].
        led_from: Its reference when its effort first showed a contact [rad | m].
        came_from: Its measured position then [rad | m].
        surge: Size of the largest recent acceleration of its reference [rad/s² | m/s²].
        surged: When that acceleration occurred [s].
        bound: Whether its effort limit keeps its free motion from being learned.
    """

    ahead: float
    threshold: float
    by_tip: bool
    velocity: float = 0.0
    seen: float = math.nan
    began: float = math.nan
    over: int = 0
    in_effort: bool = False
    most: float = 0.0
    steps: int = 0
    was: float = math.nan
    led_from: float = math.nan
    came_from: float = math.nan
    surge: float = 0.0
    surged: float = -math.inf
    bound: bool = False


class ContactMonitor:
    """Watches the actuators of the last goal or stream for contacts.

    An actuator is *blocked* when it stays behind its reference, hardly moves for the stall time and
    does not keep pace with a slow reference, or when its device reports that it holds an object.
    Time in which its device is silent does not count as time at rest. A blocked actuator *grasps*
    when its effort is above a threshold, or when its device reports a grasp. Where the forces at
    its fingertips are measured, they decide instead: it grasps with those fingers whose tips touch,
    and does not grasp if no tip touches.

    The device's report doesn't count at the end of the range, where devices report the mechanical
    stop. It counts only for the motion it belongs to: a report that the device made before it can
    have begun this motion counts only once the actuator has stalled. Where the motion leads away
    from a held object, nothing counts as a grasp until the actuator has left the object.
    """

    def __init__(
        self,
        hand: Hand,
        stall: StallSettings,
        grasp: GraspSettings,
        learned: Mapping[str, LearnedMotion],
    ) -> None:
        self._hand = hand
        actuators = self._actuators = hand.actuators
        names = self._fingers = hand.finger_names
        # A recording without the hand's SRDF names fingers that its model does not have.
        self._places = [tuple(names.index(f) for f in a.fingers if f in names) for a in actuators]
        self._free = [FreeMotion(a.effort, a.velocity, a.acceleration) for a in actuators]
        self._levers = TipLevers(hand)
        self._approaching: dict[int, _EffortApproach] = {}
        for actuator, free in zip(actuators, self._free, strict=True):
            if actuator.name in learned:
                free.restore(learned[actuator.name])
        self._stretches = [Stretches() for _ in actuators]
        self._lessons: dict[int, tuple[float, float]] = {}
        # Position and reference at the start of the motion that shows an actuator's lag, by index.
        self._paced: dict[int, tuple[float, float]] = {}
        self._felt: dict[str, float] = {}
        self._now = -math.inf
        self._stall = stall
        self._grasp = grasp
        self._watched: dict[int, _WatchedActuator] = {}
        self._grips: list[_Grip | None] = [None] * len(actuators)
        self._usual = [math.nan] * len(actuators)
        # Kept across goals: an actuator that was pushed back stays there when it is to close again.
        self._farthest = [math.nan] * len(actuators)
        self._with_effort: set[int] = set()
        # An actuator that moves less than this in the stall time [rad | m] "hardly moves".
        self._slow = [stall.speed * actuator.velocity * stall.time for actuator in actuators]

    def begin(
        self, targets: Mapping[int, float], tolerance: Mapping[int, float], stamp: float
    ) -> None:
        """Start to watch some actuators, forgetting their earlier contacts.

        Args:
            targets: Their target positions, by index [rad | m].
            tolerance: Position error that counts as none, by index [rad | m].
            stamp: Now [s].
        """
        for i, target in targets.items():
            self._watched[i] = _WatchedActuator(tolerance[i], target, math.nan, stamp, stamp)
            self._paced.pop(i, None)

    def aim(self, i: int, target: float) -> None:
        """Set another target position for a watched actuator [rad | m]."""
        watched = self._watched.get(i)
        if watched is not None:
            watched.target = target

    def forget(self, indices: Iterable[int]) -> None:
        """Stop watching some actuators."""
        for i in indices:
            self._watched.pop(i, None)
            self._approaching.pop(i, None)

    def pin(self, i: int, stamp: float, measured: Measured, *, grasping: bool) -> None:
        """Record that an actuator was stopped because it touches an object.

        Until `unpin` it must not be passed to `update`.

        Args:
            i: The actuator.
            stamp: Now [s].
            measured: The measured state in which it was stopped.
            grasping: Whether it counts as holding the object.
        """
        watched = self._watched.get(i)
        if watched is not None:
            watched.blocked_at, watched.grasping = stamp, grasping
            watched.own_report, watched.hold_position = False, measured.position[i]
            watched.hold_forces = self.forces(i, measured)

    def presses_now(self, indices: Iterable[int], presses: bool) -> None:
        """Record whether some actuators press on something, by the force between the tips."""
        for i in indices:
            watched = self._watched.get(i)
            if watched is not None:
                watched.presses = presses

    def unpin(self, i: int, stamp: float) -> None:
        """Watch an actuator as if its motion had just begun."""
        watched = self._watched.get(i)
        if watched is not None:
            watched.presses = None
            watched.anchor, watched.since, watched.seen = math.nan, stamp, stamp
            watched.blocked_at, watched.grasping = math.nan, False
            watched.hold_position = math.nan

    def tolerance(self, i: int) -> float:
        """Return the position error of an actuator that counts as 0 [rad | m]."""
        watched = self._watched.get(i)
        return math.inf if watched is None else watched.tolerance

    def blocked(self, i: int) -> bool:
        """Return whether an actuator is blocked."""
        watched = self._watched.get(i)
        return watched is not None and not math.isnan(watched.blocked_at)

    def closes(self, i: int, rest: float) -> bool:
        """Return whether a watched actuator set out away from its rest position [rad | m]."""
        watched = self._watched.get(i)
        return watched is not None and (
            (watched.target - watched.start) * (watched.target - rest) > 0.0
        )

    def led(self, i: int, position: float, target: float) -> None:
        """Record that an actuator that is not watched is moved to a target [rad | m]."""
        ahead = 1.0 if target >= position else -1.0
        if (self._farthest[i] - target) * ahead < 0.0:
            self._farthest[i] = math.nan

    def farthest(self, i: int) -> float:
        """Return how far an actuator has come since it last moved the other way [rad | m]."""
        return self._farthest[i]

    def grasping(self, i: int) -> bool:
        """Return whether an actuator holds an object."""
        watched = self._watched.get(i)
        return watched is not None and watched.grasping

    def says(self, indices: Iterable[int]) -> bool:
        """Return whether the device of one of some actuators reports that it holds an object."""
        return any(
            (w := self._watched.get(i)) is not None and w.grasping and w.own_report for i in indices
        )

    def shows(self, i: int, measured: Measured, hard: float) -> bool:
        """Return whether more than its position shows that an actuator presses on something.

        Args:
            i: The actuator.
            measured: The measured state.
            hard: Least effort at which it presses [N·m | N].
        """
        word = bool(measured.grasped) and measured.grasped[i] == 1
        return rules.shows(self.grasping(i), word=word, effort=abs(measured.effort[i]), hard=hard)

    def bears(self, i: int, measured: Measured, limit: float) -> bool:
        """Return whether a watched actuator that has arrived presses on something.

        Args:
            i: The actuator.
            measured: The measured state.
            limit: Its effort limit [N·m | N].
        """
        watched = self._watched.get(i)
        if watched is None:
            return False
        closing = watched.target - watched.start
        return rules.holds(
            self.touch(i) if watched.presses is None else watched.presses,
            word=measured.grasped[i] == 1,
            denied=measured.grasped[i] == 0,
            away=False,
            moved=True,
            effort=math.copysign(1.0, closing) * measured.effort[i],
            least=self._pressing(i, limit),
        )

    def presses(self, i: int, reference: float, position: float) -> bool:
        """Return whether an actuator holds an object, or is still kept from its reference."""
        if not self.blocked(i):
            return False
        watched = self._watched[i]
        return watched.grasping or abs(reference - position) > watched.tolerance

    def strayed(self, i: int, stamp: float, position: Sequence[float]) -> float:
        """Return how far an actuator has moved its fingertip since it was pinned or grasped [m].

        Args:
            i: The actuator.
            stamp: Now [s].
            position: Positions of all actuators [rad | m].
        """
        watched = self._watched.get(i)
        if watched is None:
            return 0.0
        moved = abs(position[i] - watched.hold_position)
        # Seldom, since a lever takes a good part of a tick. Without a grip, the motion is NaN.
        if not moved > watched.tolerance:
            return 0.0
        lever = self._levers.of(i, stamp, position)
        return moved * lever if lever == lever else 0.0

    def clasped(self, i: int, reference: float) -> bool:
        """Return whether an actuator holds an object that its reference still leads into."""
        grip = self._grips[i]
        if grip is None or not self.grasping(i):
            return False
        return (reference - grip.position) * grip.direction > self._watched[i].tolerance

    @property
    def fingers(self) -> tuple[str, ...]:
        """The fingers that hold an object, each once; where tips are measured, those that touch."""
        holding: dict[str, None] = {}
        for i, watched in self._watched.items():
            if watched.grasping:
                touching = (f for f in self._actuators[i].fingers if self._touches(f) is not False)
                holding.update(dict.fromkeys(touching))
        return tuple(holding)

    def feel(self, stamp: float, touch: Sequence[float]) -> None:
        """Record the forces at the fingertips; called first at every tick.

        Args:
            stamp: Now [s].
            touch: Forces on the fingers [N]; see `Measured`.
        """
        self._now = stamp
        if len(touch) != len(self._fingers):  # a driver for another hand, or no forces
            return
        for finger, force in zip(self._fingers, touch, strict=True):
            if force >= self._grasp.touch:
                self._felt[finger] = stamp
            # Not NaN: this finger is measured, even if it has never touched anything.
            elif force == force:
                self._felt.setdefault(finger, -math.inf)
            elif self._felt:  # a sensor that has gone silent must not count as "lost"
                self._felt.pop(finger, None)

    def _touches(self, finger: str) -> bool | None:
        """Return whether a fingertip touches something; ``None``: not measured."""
        felt = self._felt.get(finger)
        return None if felt is None else self._now - felt <= _FELT

    def touch(self, i: int) -> bool | None:
        """Return whether a fingertip that an actuator moves touches; ``None``: not measured."""
        if not self._felt:
            return None
        return rules.one_touches([self._touches(finger) for finger in self._actuators[i].fingers])

    def blocked_longer_than(self, seconds: float, stamp: float) -> list[int]:
        """Return the actuators that have been blocked for longer than a time [s]."""
        return [i for i, w in self._watched.items() if stamp - w.blocked_at >= seconds]

    def update(
        self,
        stamp: float,
        measured: Measured,
        reference: Sequence[float],
        limits: Sequence[float],
        indices: Iterable[int],
    ) -> None:
        """Evaluate the measurements of actuators in motion.

        Args:
            stamp: Now [s].
            measured: The measured state.
            reference: Positions sent [rad | m].
            limits: Effort limits sent [N·m | N].
            indices: The actuators to evaluate.
        """
        for i in indices:
            watched = self._watched.get(i)
            # A repeated measurement is not evidence of rest.
            if watched is None or not measured.fresh[i]:
                continue
            position = measured.position[i]
            report = measured.grasped[i]
            self._listen(i, watched, position, stamp)
            ahead = 1.0 if watched.target >= position else -1.0
            tolerance = watched.tolerance
            if not (self._farthest[i] - position) * ahead >= 0.0:
                self._farthest[i] = position
            lag = (reference[i] - position) * ahead
            if watched.new and lag > 0.0:
                # It lagged before it set out, as a servo under load does.
                watched.hung = min(lag, tolerance)
            behind = lag > tolerance + watched.hung
            watched.led = watched.led + 1 if behind else 0
            watched.lags = watched.lags + 1 if lag > tolerance else 0
            # Its device may not have the reference yet, however late measurements are.
            begun = (position - watched.start) * ahead > self._slow[i]
            waits = watched.led < _DELIVERED and not begun
            # A device that reports grasps reports them once its target is at rest.
            arriving = report == 0 and abs(reference[i] - watched.target) > tolerance
            # "not ... <=", since the anchor is NaN at first. An actuator pushed backwards (a grip
            # that is being opened) is not behind: its motion has not begun.
            moves = not abs(position - watched.anchor) <= self._slow[i]
            if moves or not behind or arriving or waits:
                watched.anchor, watched.since = position, stamp
                watched.blocked_at = math.nan
                watched.grasping = False
                watched.led_from = reference[i]
            stalled = behind and stamp - watched.since >= self._stall.time
            if stalled and rules.keeps_pace(
                moved=position - watched.anchor,
                wanted=reference[i] - watched.led_from,
                left=abs(watched.target - reference[i]),
                tolerance=tolerance,
            ):
                watched.anchor, watched.since, watched.led_from = position, stamp, reference[i]
                stalled = False
            # Skipped in nearly every tick: this runs for each actuator at each tick.
            away = own_report = False
            if report == 1 or self._grips[i] is not None:
                own_report = self._own_report(i, watched, position, report, ahead, stalled)
                away = self._leads_away(i, watched, position, report, ahead)
                own_report = own_report and not away
            else:
                watched.old_report = False
            watched.new = False
            if stalled or own_report:
                self._block(i, watched, measured, limits[i], own_report, away, ahead, stamp)

    def _own_report(
        self,
        i: int,
        watched: _WatchedActuator,
        position: float,
        report: int,
        ahead: float,
        stalled: bool,
    ) -> bool:
        """Return whether the device's own report of a grasp counts."""
        begun = watched.led >= _DELIVERED or (position - watched.start) * ahead > watched.tolerance
        watched.old_report = report == 1 and (watched.old_report or watched.new or not begun)
        believed = stalled or not watched.old_report
        return report == 1 and believed and not self._at_end(i, position, watched)

    def _block(
        self,
        i: int,
        watched: _WatchedActuator,
        measured: Measured,
        limit: float,
        own_report: bool,
        away: bool,
        ahead: float,
        stamp: float,
    ) -> None:
        """Record that an actuator is blocked, and whether it holds an object."""
        if math.isnan(watched.blocked_at):
            watched.blocked_at = stamp
        watched.pressed = own_report or not abs(measured.effort[i]) < self._stopping(i, limit)
        if rules.holds(
            self.touch(i) if watched.presses is None else watched.presses,
            word=own_report,
            denied=measured.grasped[i] == 0,
            away=away,
            moved=self._has_moved(i, watched, measured, ahead) or self._grips[i] is not None,
            effort=abs(measured.effort[i]),
            least=self._pressing(i, limit),
        ):
            watched.grasping = True
            watched.own_report = own_report
            watched.hold_position = measured.position[i]
            watched.hold_forces = self.forces(i, measured)
            self._grips[i] = _Grip(ahead, measured.position[i])

    def _has_moved(
        self, i: int, watched: _WatchedActuator, measured: Measured, ahead: float
    ) -> bool:
        # Half of the tolerance: an actuator that grips from the start moves no further. As long as
        # the friction is unknown, gears that yield to it may move as far.
        least = (0.5 if self._free[i].known else 1.0) * watched.tolerance
        return (measured.position[i] - watched.start) * ahead > least

    def behind(self, i: int) -> bool:
        """Return whether a watched actuator is behind a reference that its device has received."""
        watched = self._watched.get(i)
        return watched is not None and watched.lags >= _DELIVERED

    def moved(self, i: int, measured: Measured) -> bool:
        """Return whether a watched actuator has moved towards its target, not just its gears."""
        watched = self._watched.get(i)
        if watched is None:
            return False
        ahead = math.copysign(1.0, watched.target - watched.start)
        return self._has_moved(i, watched, measured, ahead)

    def _pressing(self, i: int, limit: float) -> float:
        """Return the least effort at which an actuator may press on something [N·m | N].

        With a limit hardly above the effort of free motion, friction may stop it anywhere.
        """
        free, least = self._free[i], self._grasp.effort * limit
        full = self._actuators[i].effort
        if not free.known or math.isinf(full):
            return least
        return max(least, free.dry + _RESOLUTION * full)

    def _stopping(self, i: int, limit: float) -> float:
        """Return the effort below which only friction stops an approaching actuator [N·m | N]."""
        approach = self._approaching.get(i)
        if approach is None or math.isinf(self._actuators[i].effort):
            return 0.0
        dry = self._free[i].dry if self._free[i].known and approach.in_effort else 0.0
        return min(dry + approach.threshold, rules.ALL * limit)

    def _listen(self, i: int, watched: _WatchedActuator, position: float, stamp: float) -> None:
        """Record the time since the last measurement; silence does not count as rest."""
        gap, watched.seen = stamp - watched.seen, stamp
        if watched.new:
            watched.start = position
            return
        usual = self._usual[i]
        if not usual > 0.0:
            usual = gap
        if gap > self._stall.time:
            watched.anchor, watched.since = position, stamp
        elif gap > _SILENCE * usual:
            watched.since += gap - _SILENCE * usual
        # A single long silence must not raise the usual interval by much.
        newest = gap if gap < 2.0 * usual else 2.0 * usual
        self._usual[i] = usual + _USUAL_SHARE * (newest - usual)

    def _leads_away(
        self, i: int, watched: _WatchedActuator, position: float, report: int, ahead: float
    ) -> bool:
        """Return whether the motion leads away from the object the actuator holds or just held."""
        grip = self._grips[i]
        left = grip is not None and abs(position - grip.position) > watched.tolerance
        if left and (watched.new or (report != 1 and watched.led >= _DELIVERED)):
            grip = self._grips[i] = None
        if grip is None and watched.new and report == 1:
            # Held since before this motion: hands close away from the rest posture.
            off = position - self._actuators[i].rest
            direction = 0.0 if abs(off) <= watched.tolerance else math.copysign(1.0, off)
            grip = self._grips[i] = _Grip(direction, position)
        return grip is not None and grip.direction * ahead < 0.0

    def _at_end(self, i: int, position: float, watched: _WatchedActuator) -> bool:
        spec = self._actuators[i]
        # By the target, not by the direction of motion: closing always leads away from rest.
        end = spec.upper if watched.target >= spec.rest else spec.lower
        return abs(end - position) <= watched.tolerance

    def lost(
        self, stamp: float, measured: Measured, reference: Sequence[float], limits: Sequence[float]
    ) -> list[int]:
        """Return the actuators that have just lost their object.

        An object is lost when no fingertip touches it any more, or one finger of an actuator bears
        what another one bore (where that is measured), when the device withdraws its report while
        its target is at rest, or when the actuator moves on towards its target without effort.
        """
        lost: list[int] = []
        for i, watched in self._watched.items():
            if not (watched.grasping and measured.fresh[i]):
                continue
            if not self._looks_lost(i, watched, measured, reference[i], limits[i]):
                watched.losing_since = math.nan
            elif math.isnan(watched.losing_since):
                watched.losing_since = stamp
            elif stamp - watched.losing_since >= _LOST_AFTER:
                watched.grasping = False
                watched.losing_since = math.nan
                lost.append(i)
        return lost

    def _looks_lost(
        self, i: int, watched: _WatchedActuator, measured: Measured, reference: float, limit: float
    ) -> bool:
        # It takes two fingers that hold, and a third one.
        forces = watched.hold_forces
        if len(forces) > 2 and rules.handed_over(forces, self.forces(i, measured)):
            return True
        if watched.presses is not None:
            return not watched.presses
        word = None
        if watched.own_report:
            # Trusted only while the target is at rest: devices clear their report when they move.
            resting = abs(reference - watched.target) <= watched.tolerance
            word = not (measured.grasped[i] == 0 and resting)
        push = reference - watched.hold_position
        spec = self._actuators[i]
        return rules.lost(
            self.touch(i),
            word=word,
            moved=(measured.position[i] - watched.hold_position) * (1.0 if push >= 0.0 else -1.0),
            push=push,
            tolerance=watched.tolerance,
            span=spec.upper - spec.lower,
            effort=abs(measured.effort[i]),
            least=self._grasp.effort * limit,
        )

    # --- an approach -------------------------------------------------------------------------

    def forces(self, i: int, measured: Measured) -> list[float]:
        """Return the forces on the fingers of an actuator [N]; empty if none are measured."""
        touch = measured.touch
        return [touch[k] for k in self._places[i]] if len(touch) == len(self._fingers) else []

    def approach(
        self, i: int, ahead: float, slope: float | None, stamp: float, measured: Measured
    ) -> None:
        """Expect a contact of a watched actuator, whose effort is evaluated from now on.

        Args:
            i: The actuator.
            ahead: Direction in which it closes.
            slope: Its effort per newton at the tips [N·m/N | 1]; ``None``: that of its fingertip at
                the present posture.
            stamp: Now [s].
            measured: The last measurements.
        """
        by_tip = slope is None
        least = self._tip_threshold(i, stamp, measured) if slope is None else self._least(i, slope)
        self._approaching[i] = _EffortApproach(ahead, least, by_tip)
        self._stretches[i].restart()

    def threshold(self, i: int) -> float:
        """Return the effort of a contact of an approaching actuator, above friction [N·m | N]."""
        return self._approaching[i].threshold

    def friction(self, i: int) -> float:
        """Return the largest recent effort of an actuator's free motion [N·m | N]; 0: unknown."""
        approach = self._approaching.get(i)
        # A model learned from currents has no efforts.
        return self._free[i].most if approach is not None and approach.in_effort else 0.0

    def learned(self, i: int) -> bool:
        """Return whether the effort of an actuator's free motion is known from measured efforts."""
        approach = self._approaching.get(i)
        return approach is not None and approach.in_effort and self._free[i].known

    def bound(self, i: int) -> bool:
        """Return whether the effort limit of an approaching actuator hides what motion takes."""
        approach = self._approaching.get(i)
        return approach is not None and approach.bound

    def _least(self, i: int, slope: float) -> float:
        """Return the effort of a contact [N·m | N]; ``slope``: effort per newton at the tips."""
        least = _RESOLUTION * self._actuators[i].effort
        return max(slope * self._grasp.contact_force, least if math.isfinite(least) else 0.0)

    def _tip_threshold(self, i: int, stamp: float, measured: Measured) -> float:
        """Return the effort of a contact by the tip's lever at the present posture [N·m | N]."""
        spec = self._actuators[i]
        lever = self._levers.of(i, stamp, measured.position)
        if lever != lever:
            return _UNKNOWN_SHARE * spec.effort
        known = self._hand.dynamics.get(spec.name)
        efficiency = (known.efficiency if known is not None else None) or 1.0
        return self._least(i, lever / efficiency)

    def meets(
        self,
        i: int,
        stamp: float,
        measured: Measured,
        reference: float,
        velocity: float,
        limit: float,
        *,
        every: bool,
        sides: Sequence[frozenset[str]] = (),
    ) -> bool:
        """Return whether an approaching actuator's fingers touch something.

        Args:
            i: The actuator.
            stamp: Now [s].
            measured: The measured state.
            reference: Its reference [rad | m].
            velocity: Velocity of its reference [rad/s | m/s].
            limit: Its effort limit [N·m | N].
            every: Whether each of its fingers must touch, not just one.
            sides: The fingers of each side of the opening, of which one is enough then.
        """
        felt = self._felt_now(i, measured, every, sides)
        # Where forces are measured, efforts are not used, and nothing is learned from them.
        pushes = felt is None and self._pushes(i, stamp, measured, reference, velocity, limit)
        blocked = self.blocked(i) and self._watched[i].pressed
        return rules.touches(felt, pushes=pushes, blocked=blocked)

    def _felt_now(
        self, i: int, measured: Measured, every: bool, sides: Sequence[frozenset[str]]
    ) -> bool | None:
        forces, least = self.forces(i, measured), self._grasp.touch
        if every and forces and sides:
            places = list(zip((self._fingers[k] for k in self._places[i]), forces, strict=True))
            pressing = [[force for name, force in places if name in side] for side in sides]
            # In a hand with one motor, other fingers may never touch anything.
            if len(pressing) > 1 and all(pressing):
                return rules.both_sides_touch(pressing, least)
        return rules.any_touch(forces, least, every=every)

    def has_effort(self, i: int, measured: Measured) -> bool:
        """Return whether an actuator's effort or current is measured, now or before."""
        effort, current = measured.effort[i], measured.current[i] if measured.current else math.nan
        if effort == effort or current == current:
            self._with_effort.add(i)
        return i in self._with_effort

    def unknown(self, i: int, measured: Measured) -> bool:
        """Return whether effort shows an actuator's contacts while its free motion is unknown."""
        if rules.any_touch(self.forces(i, measured), self._grasp.touch) is not None:
            return False
        return self.has_effort(i, measured) and not self._free[i].known

    def learn(
        self,
        i: int,
        stamp: float,
        measured: Measured,
        reference: float,
        velocity: float,
        limit: float,
    ) -> None:
        """Learn an actuator's free motion from a motion away from rest that reacts to no contact.

        Args:
            i: The actuator.
            stamp: Now [s].
            measured: The measured state.
            reference: Its reference [rad | m].
            velocity: Velocity of its reference [rad/s | m/s].
            limit: Its effort limit [N·m | N].
        """
        before, speed = self._lessons.get(i, (-math.inf, 0.0))
        passed = stamp - before
        if 0.0 <= passed < _LEARN_EVERY:
            return
        self._lessons[i] = stamp, velocity
        here = measured.position[i]
        if velocity * (here - self._actuators[i].rest) <= 0.0 or not passed <= 3.0 * _LEARN_EVERY:
            self._stretches[i].restart()
            return
        signal = measured.effort[i]
        if signal != signal:
            signal, limit = measured.current[i] if measured.current else math.nan, math.inf
        if signal == signal:
            sample = signal, velocity, (velocity - speed) / passed
            self._teach(i, here, reference, sample, limit)

    def _teach(
        self,
        i: int,
        here: float,
        reference: float,
        sample: tuple[float, float, float] | None,
        limit: float,
    ) -> None:
        """Learn free motion from a measurement, unless the effort limit bounds it.

        Args:
            i: The actuator.
            here: The measured position [rad | m].
            reference: Its reference [rad | m].
            sample: As for `Stretches.take`.
            limit: Its effort limit [N·m | N].
        """
        stretch = self._stretches[i]
        if sample is not None and rules.is_bound(sample[0], limit):
            # Earlier samples may be bounded, too: a raised limit takes effect a few samples later.
            stretch.restart()
        else:
            stretch.take(self._free[i], here, reference, sample)

    def follows(self, i: int, here: float, reference: float, velocity: float) -> None:
        """Learn by how much time an actuator lags behind its reference while it moves freely.

        An actuator that is stopped falls behind by the full travel of its reference, which is not
        lag.

        Args:
            i: The actuator.
            here: The measured position [rad | m].
            reference: Its reference [rad | m].
            velocity: Velocity of the reference [rad/s | m/s].
        """
        if abs(velocity) < _MOVES * self._actuators[i].velocity:
            self._paced.pop(i, None)
            return
        was, led = self._paced.setdefault(i, (here, reference))
        wanted = abs(reference - led)
        # Over a shorter distance, noise of the position could look like motion.
        if wanted <= self._slow[i]:
            return
        self._paced[i] = here, reference
        if (here - was) * math.copysign(1.0, reference - led) >= FREELY * wanted:
            free = self._free[i]
            free.lag += _USUAL_SHARE * (max((reference - here) / velocity, 0.0) - free.lag)

    def lag(self, indices: Iterable[int]) -> float:
        """Return the largest lag of some actuators [s]; 0: none has moved yet."""
        return max((self._free[i].lag for i in indices), default=0.0)

    @property
    def learned_motion(self) -> dict[str, LearnedMotion]:
        """The learned free motion of actuators, by name."""
        pairs = zip(self._actuators, self._free, strict=True)
        return {actuator.name: free.state() for actuator, free in pairs if free.known}

    def _pushes(
        self,
        i: int,
        stamp: float,
        measured: Measured,
        reference: float,
        velocity: float,
        limit: float,
    ) -> bool:
        """Return whether an actuator needs more effort than free motion does."""
        approach = self._approaching[i]
        approach.bound = False
        signal, threshold = measured.effort[i], approach.threshold
        approach.in_effort = signal == signal
        if signal != signal:
            if not measured.current:
                return False
            signal = measured.current[i]
        dt = stamp - approach.seen
        gain = (velocity - approach.velocity) / dt if dt > 0.0 else 0.0
        approach.velocity, approach.seen = velocity, stamp
        if abs(gain) >= approach.surge or stamp - approach.surged > _SET_OUT:
            approach.surge, approach.surged = abs(gain), stamp
        if signal != signal or velocity * approach.ahead <= 0.0:
            return False
        watched = self._watched[i]
        if abs(watched.target - measured.position[i]) <= watched.tolerance:
            return False  # it brakes, or reaches the end of its range
        here = measured.position[i]
        moves = (here - approach.was) * approach.ahead > 0.0
        approach.was = here
        if dt > _SILENCE * self._usual[i]:
            # In the meantime the device moved by itself: start over.
            approach.began = math.nan
            self._stretches[i].restart()
        if approach.began != approach.began:
            if not moves:
                return False  # the device has not begun, so its effort is not one of motion
            approach.began = stamp
        free, stretch = self._free[i], self._stretches[i]
        if not approach.in_effort:
            stretch.take(free, here, reference, (signal, velocity, gain))
            return self._surges(approach, abs(signal), moves=moves)
        setting_out = stamp - approach.began < _SET_OUT
        if setting_out or not free.knows(velocity, gain):
            # An acceleration is over soon; only what lasts needs another limit.
            approach.bound = rules.is_bound(signal, limit) and not setting_out
            # Overcoming static friction is a part of free motion that the model must learn.
            self._teach(i, here, reference, (signal, velocity, gain), limit)
            return False
        if approach.by_tip and threshold > 0.0:
            threshold = approach.threshold = self._tip_threshold(i, stamp, measured)
        excess = free.excess(signal, velocity, gain, threshold, approach.surge)
        # Efforts that may be contacts must not enter the model of free motion.
        sample = None if excess > SURELY_FREE else (signal, velocity, gain)
        self._teach(i, here, reference, sample, limit)
        if excess <= 1.0:
            approach.over = 0
            return False
        led = abs(reference - approach.led_from)
        if approach.over and rules.catches_up((here - approach.came_from) * approach.ahead, led):
            approach.over = 0
        if not approach.over:
            approach.led_from, approach.came_from, led = reference, here, 0.0
        approach.over += 1
        # A servo that moves in single counts needs as much before each of them.
        return approach.over >= _CONFIRMED and led >= _STEP_WAYS * stretch.count

    def _surges(self, approach: _EffortApproach, current: float, *, moves: bool) -> bool:
        """Return whether an actuator at standstill needs more current than its free motion.

        Args:
            approach: Its approach.
            current: Size of its current [A].
            moves: Whether it has moved since the last measurement.
        """
        approach.steps += moves
        if moves or approach.steps < _STEPS:
            # An actuator that moves under a current moves freely, however large the current is.
            approach.most = max(approach.most, current)
        if current <= _SURGE * approach.most:
            approach.over = 0
            return False
        approach.over += 1
        return approach.over >= _SURGED
