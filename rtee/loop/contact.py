"""Detect from an actuator's state whether it is blocked, grasps, or has lost its grasp."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rtee.hand.config_schema import GraspSettings, StallSettings
from rtee.sample import FloatArray, Measurements
from rtee.types import ActuatorSpec

_LOST_AFTER = 0.05
"""A grasp counts as lost when it looks lost for this long [s]: longer than noise, and a few periods
of the slowest devices."""

_LOST_MOVE = 0.02
"""A grasp looks lost once the actuator has closed further by this fraction of its range, more than
a soft object gives way."""

TIP_FORCE = "contact_force"
"""The channel of a device's state with the contact force on every finger of the hand [N], summed
over all links of the finger."""

_FELT = 0.1
"""A fingertip counts as touching for this long after its last contact force [s]: contacts
chatter."""

_DELIVERED = 3
"""After this many measurements with a leading reference, the device has certainly received one: a
driver measures before it sends, and may return the answer to the exchange before. The third is a
margin."""

_SILENCE = 3.0
"""A measurement that comes later than this many usual intervals ends a silence, in which the
actuator may or may not have been at rest."""

_USUAL_SHARE = 0.125
"""Weight of the newest interval in the usual one, which follows a change of rate within 8
intervals."""


@dataclass(slots=True)
class Measured:
    """The measured state that a controller is given at a tick; lists in the hand's actuator order.

    Attributes:
        position: Measured positions [rad | m]; ``NaN``: not measured.
        effort: Measured efforts [N·m | N].
        temperature: Measured temperatures [°C].
        fresh: Whether the measurement is newer than at the tick before.
        grasped: The device's own report: 1 holding, 0 not holding, -1 no report.
        current: Measured currents [A]; empty: no device measures any.
        touch: Measured contact forces on the fingers [N], in the hand's order; ``NaN``: not
            measured; empty: no device measures any.
    """

    position: Sequence[float]
    effort: Sequence[float]
    temperature: Sequence[float]
    fresh: Sequence[bool]
    grasped: Sequence[int]
    current: Sequence[float] = ()
    touch: Sequence[float] = ()

    def update(self, sample: Measurements, before: Measurements | None = None) -> None:
        """Copy the quantities that a controller needs from a sample.

        Args:
            sample: The sample.
            before: The previous sample. Arrays that are the same object in both, such as those of
                quantities that a device does not measure, are not converted again.
        """
        # Lists, since indexing numpy arrays one value at a time takes several times as long.
        self.position = sample.position.tolist()
        if before is None or sample.effort is not before.effort:
            self.effort = sample.effort.tolist()
        if before is None or sample.temperature is not before.temperature:
            self.temperature = sample.temperature.tolist()
        if before is None or sample.current is not before.current:
            self.current = sample.current.tolist()


def tip_forces(measured: Sequence[FloatArray]) -> list[float]:
    """Return the forces on the fingers [N], merged from the measurements of some devices.

    Args:
        measured: The channel `TIP_FORCE` of each device ``(fingers,)``; ``NaN``: not measured.
    """
    if not measured:
        return []
    merged = measured[0]
    for other in measured[1:]:
        if other.shape == merged.shape:
            # `fmax` prefers a number to NaN: each device knows only the fingers it measures.
            merged = np.fmax(merged, other)
    return [float(force) for force in merged]


@dataclass(slots=True)
class _Grip:
    """The last known grip of an actuator: direction of pressing, and its position [rad | m]."""

    direction: float
    position: float


@dataclass(slots=True)
class _Watched:
    tolerance: float
    target: float
    anchor: float
    since: float
    seen: float
    start: float = math.nan
    led: int = 0
    blocked_at: float = math.nan
    grasping: bool = False
    own_report: bool = False
    old_report: bool = False
    new: bool = True
    hold_position: float = math.nan
    losing_since: float = math.nan


class ContactWatch:
    """Watches the actuators of the last goal or stream for contacts.

    An actuator is *blocked* when it stays behind its reference and hardly moves for the stall time,
    or when its device reports that it holds an object. Time in which its device is silent does not
    count as time at rest. A blocked actuator *grasps* when its effort is above a threshold, or when
    its device reports a grasp. Where the forces at its fingertips are measured, they decide
    instead: it grasps with those fingers whose tips touch, and does not grasp if no tip touches.

    The device's report doesn't count at the end of the range, where devices report the mechanical
    stop. It counts only for the motion it belongs to: a report that the device made before it can
    have begun this motion counts only once the actuator has stalled. Where the motion leads away
    from a held object, nothing counts as a grasp until the actuator has left the object.
    """

    def __init__(
        self,
        actuators: Sequence[ActuatorSpec],
        stall: StallSettings,
        grasp: GraspSettings,
        fingers: Sequence[str] = (),
    ) -> None:
        self._actuators = actuators
        self._fingers = fingers
        self._felt: dict[str, float] = {}
        self._now = -math.inf
        self._stall = stall
        self._grasp = grasp
        self._watched: dict[int, _Watched] = {}
        self._grips: list[_Grip | None] = [None] * len(actuators)
        self._usual = [math.nan] * len(actuators)
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
            self._watched[i] = _Watched(tolerance[i], target, math.nan, stamp, stamp)

    def aim(self, i: int, target: float) -> None:
        """Set another target position for a watched actuator [rad | m]."""
        watched = self._watched.get(i)
        if watched is not None:
            watched.target = target

    def forget(self, indices: Iterable[int]) -> None:
        """Stop watching some actuators."""
        for i in indices:
            self._watched.pop(i, None)

    def pin(self, i: int, stamp: float, position: float, *, grasping: bool) -> None:
        """Record that an actuator was stopped because it touches an object.

        Until `unpin` it must not be passed to `update`.

        Args:
            i: The actuator.
            stamp: Now [s].
            position: Where it was stopped [rad | m].
            grasping: Whether it counts as holding the object.
        """
        watched = self._watched.get(i)
        if watched is not None:
            watched.blocked_at, watched.grasping = stamp, grasping
            watched.own_report, watched.hold_position = False, position

    def unpin(self, i: int, stamp: float) -> None:
        """Watch an actuator as if its motion had just begun."""
        watched = self._watched.get(i)
        if watched is not None:
            watched.anchor, watched.since, watched.seen = math.nan, stamp, stamp
            watched.blocked_at, watched.grasping = math.nan, False

    def tolerance(self, i: int) -> float:
        """Return the position error of an actuator that counts as none [rad | m]."""
        watched = self._watched.get(i)
        return math.inf if watched is None else watched.tolerance

    def blocked(self, i: int) -> bool:
        """Return whether an actuator is blocked."""
        watched = self._watched.get(i)
        return watched is not None and not math.isnan(watched.blocked_at)

    def grasping(self, i: int) -> bool:
        """Return whether an actuator holds an object."""
        watched = self._watched.get(i)
        return watched is not None and watched.grasping

    def presses(self, i: int, reference: float, position: float) -> bool:
        """Return whether an actuator holds an object, or is still kept from its reference."""
        if not self.blocked(i):
            return False
        watched = self._watched[i]
        return watched.grasping or abs(reference - position) > watched.tolerance

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

    def _touch(self, i: int) -> bool | None:
        """Return whether a fingertip that an actuator moves touches; ``None``: not measured."""
        tips = {self._touches(finger) for finger in self._actuators[i].fingers}
        # A tip that is not measured may be the one that touches, so the answer is "unknown".
        return True if True in tips else None if None in tips or not tips else False

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
            behind = (reference[i] - position) * ahead > tolerance
            watched.led = watched.led + 1 if behind else 0
            # A device that reports grasps reports them once its target is at rest.
            arriving = report == 0 and abs(reference[i] - watched.target) > tolerance
            # "not ... <=", since the anchor is NaN at first. An actuator pushed backwards (a grip
            # that is being opened) is not behind: its motion has not begun.
            if not abs(position - watched.anchor) <= self._slow[i] or not behind or arriving:
                watched.anchor, watched.since = position, stamp
                watched.blocked_at = math.nan
                watched.grasping = False
            stalled = behind and stamp - watched.since >= self._stall.time
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
        self, i: int, watched: _Watched, position: float, report: int, ahead: float, stalled: bool
    ) -> bool:
        """Return whether the device's own report of a grasp counts."""
        begun = watched.led >= _DELIVERED or (position - watched.start) * ahead > watched.tolerance
        watched.old_report = report == 1 and (watched.old_report or watched.new or not begun)
        believed = stalled or not watched.old_report
        return report == 1 and believed and not self._at_end(i, position, watched)

    def _block(
        self,
        i: int,
        watched: _Watched,
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
        effort = abs(measured.effort[i])
        report = measured.grasped[i]
        holds = own_report or (report != 0 and not away and effort >= self._grasp.effort * limit)
        # A sensor at the tip is better evidence than efforts, which include friction.
        touch = self._touch(i) if self._felt else None
        if touch is not None:
            holds = touch and not away
        if holds:
            watched.grasping = True
            watched.own_report = own_report
            watched.hold_position = measured.position[i]
            self._grips[i] = _Grip(ahead, measured.position[i])

    def _listen(self, i: int, watched: _Watched, position: float, stamp: float) -> None:
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
        self, i: int, watched: _Watched, position: float, report: int, ahead: float
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

    def _at_end(self, i: int, position: float, watched: _Watched) -> bool:
        spec = self._actuators[i]
        # By the target, not by the direction of motion: closing always leads away from rest.
        end = spec.upper if watched.target >= spec.rest else spec.lower
        return abs(end - position) <= watched.tolerance

    def lost(
        self, stamp: float, measured: Measured, reference: Sequence[float], limits: Sequence[float]
    ) -> list[int]:
        """Return the actuators that have just lost their object.

        An object is lost when no fingertip touches it any more (where that is measured), when the
        device withdraws its report while its target is at rest, or when the actuator moves on
        towards its target without effort.
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
        self, i: int, watched: _Watched, measured: Measured, reference: float, limit: float
    ) -> bool:
        if self._felt and self._touch(i) is False:
            return True
        # The report is trusted only while the target is at rest: devices clear it when they move.
        if watched.own_report:
            return measured.grasped[i] == 0 and abs(reference - watched.target) <= watched.tolerance
        push = reference - watched.hold_position
        moved = (measured.position[i] - watched.hold_position) * (1.0 if push >= 0.0 else -1.0)
        spec = self._actuators[i]
        span = spec.upper - spec.lower
        # Further than noise, but no more than half of the way that is left to close.
        enough = max(3.0 * watched.tolerance, _LOST_MOVE * span if math.isfinite(span) else 0.0)
        if moved <= min(enough, 0.5 * abs(push)) or moved <= 0.5 * watched.tolerance:
            return False
        effort = abs(measured.effort[i])
        # Half of the threshold: noise must not end a grasp that has just been found.
        return math.isnan(effort) or effort < 0.5 * self._grasp.effort * limit
