"""Detect for each actuator, from its state, whether it is blocked, grasps or has lost its grasp."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rtee.hand.config_schema import GraspSettings, StallSettings
from rtee.sample import FloatArray, Measurements
from rtee.types import ActuatorSpec

_LOST_AFTER = 0.05
"""A grasp counts as lost when it looks lost for this long [s]: measurements are noisy, and a few
periods of the slowest devices pass in this time."""

_LOST_MOVE = 0.02
"""A grasp looks lost once the actuator has closed further by this fraction of its range, more than
a soft object gives way."""

TIP_FORCE = "contact_force"
"""The channel of a device's state with the contact force on every finger of the hand, summed over
all of its links."""

_FELT = 0.1
"""A fingertip counts as touching for this long after it was last felt [s]: contacts chatter."""

_DELIVERED = 3
"""A device has certainly received a reference that led at this many of its measurements: a driver
measures before it sends, and may return what came back in the exchange before. The third is a
margin."""

_SILENCE = 3.0
"""A measurement that comes later than this many usual intervals ends a silence, in which the
actuator may or may not have been at rest."""

_USUAL_SHARE = 0.125
"""Weight of the newest interval in the usual one: it follows a change of rate within 8 of them."""


@dataclass(slots=True)
class Measured:
    """What a controller is given at a tick; lists in the hand's order of actuators.

    Attributes:
        position: Measured positions [rad | m]; ``NaN``: not measured.
        effort: Measured efforts [N·m | N].
        temperature: Measured temperatures [°C].
        fresh: Whether the measurement is newer than at the tick before.
        grasped: The device's own word: 1 holding, 0 not, -1 none.
        current: Measured currents [A]; empty: none at all.
        touch: Measured contact forces on the fingers [N], in the hand's order; ``NaN``: not
            measured; empty: none at all.
    """

    position: Sequence[float]
    effort: Sequence[float]
    temperature: Sequence[float]
    fresh: Sequence[bool]
    grasped: Sequence[int]
    current: Sequence[float] = ()
    touch: Sequence[float] = ()

    def update(self, sample: Measurements, before: Measurements | None = None) -> None:
        """Copy from a sample what a controller needs.

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
    """Return the forces on the fingers [N] from what some devices measured, for `Measured`.

    Args:
        measured: The channel `TIP_FORCE` of each; what is not measured is ``NaN``.
    """
    if not measured:
        return []
    together = measured[0]
    for other in measured[1:]:
        if other.shape == together.shape:
            # `fmax` prefers a number to NaN: each device knows only the fingers it measures.
            together = np.fmax(together, other)
    return [float(force) for force in together]


@dataclass(slots=True)
class _Grip:
    """What an actuator was last known to hold: in which direction it presses, and where it is."""

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
    own_word: bool = False
    old_word: bool = False
    new: bool = True
    hold_position: float = math.nan
    losing_since: float = math.nan


class ContactWatch:
    """Watches the actuators of the last goal or stream.

    An actuator is *blocked* when it stays behind its reference and hardly moves for the stall time,
    or its device reports that it holds something. Time in which its device is silent does not count
    as time at rest. A blocked one *grasps* when its effort is above a threshold, or when its device
    reports a grasp. Where the forces at its fingertips are measured, they decide instead: it
    grasps with those fingers whose tips touch, and does not grasp if no tip does.

    The device's report doesn't count at the end of the range, where devices report the mechanical
    stop. It counts only for the motion it belongs to: a report from before the device can have
    begun this motion, because it is older than the motion or about an older set-point, counts only
    once the actuator has stalled. Where the motion leads away from what is held, nothing counts as
    a grasp until the actuator has left it.

    Args:
        actuators: The hand's actuators.
        stall: When an actuator counts as stalled.
        grasp: When a stalled one counts as holding.
        fingers: The hand's fingers, in its order.
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
        # Slower than this way [rad | m] in the stall time is "hardly moving".
        self._slow = [stall.speed * actuator.velocity * stall.time for actuator in actuators]

    def begin(
        self, targets: Mapping[int, float], tolerance: Mapping[int, float], stamp: float
    ) -> None:
        """Start to watch some actuators; what was known of them is forgotten.

        Args:
            targets: Where they go, by index [rad | m].
            tolerance: Error that counts as none, by index [rad | m].
            stamp: Now [s].
        """
        for i, target in targets.items():
            self._watched[i] = _Watched(tolerance[i], target, math.nan, stamp, stamp)

    def aim(self, i: int, target: float) -> None:
        """Note that a watched actuator now goes to another target [rad | m]."""
        watched = self._watched.get(i)
        if watched is not None:
            watched.target = target

    def forget(self, indices: Iterable[int]) -> None:
        """Stop watching some actuators."""
        for i in indices:
            self._watched.pop(i, None)

    def pin(self, i: int, stamp: float, position: float, *, grasping: bool) -> None:
        """Record that an actuator was stopped because it touches something.

        Until `unpin` it must not be passed to `update`.

        Args:
            i: The actuator.
            stamp: Now [s].
            position: Where it stays [rad | m].
            grasping: It counts as holding what it touches.
        """
        watched = self._watched.get(i)
        if watched is not None:
            watched.blocked_at, watched.grasping = stamp, grasping
            watched.own_word, watched.hold_position = False, position

    def unpin(self, i: int, stamp: float) -> None:
        """Watch an actuator as if its motion had just begun; what its device said is forgotten."""
        watched = self._watched.get(i)
        if watched is not None:
            watched.anchor, watched.since, watched.seen = math.nan, stamp, stamp
            watched.blocked_at, watched.grasping = math.nan, False

    def tolerance(self, i: int) -> float:
        """Return the error of an actuator that counts as none [rad | m]."""
        watched = self._watched.get(i)
        return math.inf if watched is None else watched.tolerance

    def blocked(self, i: int) -> bool:
        """Return whether an actuator is blocked."""
        watched = self._watched.get(i)
        return watched is not None and not math.isnan(watched.blocked_at)

    def grasping(self, i: int) -> bool:
        """Return whether an actuator holds something."""
        watched = self._watched.get(i)
        return watched is not None and watched.grasping

    def presses(self, i: int, reference: float, position: float) -> bool:
        """Return whether an actuator holds something, or is still kept from its reference."""
        if not self.blocked(i):
            return False
        watched = self._watched[i]
        return watched.grasping or abs(reference - position) > watched.tolerance

    def clasped(self, i: int, reference: float) -> bool:
        """Return whether an actuator holds something, and its reference still leads into that."""
        grip = self._grips[i]
        if grip is None or not self.grasping(i):
            return False
        return (reference - grip.position) * grip.direction > self._watched[i].tolerance

    @property
    def fingers(self) -> tuple[str, ...]:
        """The fingers that hold something, each once; where tips are measured, those that touch."""
        found: dict[str, None] = {}
        for i, watched in self._watched.items():
            if watched.grasping:
                touching = (f for f in self._actuators[i].fingers if self._touches(f) is not False)
                found.update(dict.fromkeys(touching))
        return tuple(found)

    def feel(self, stamp: float, touch: Sequence[float]) -> None:
        """Note the forces at the fingertips; called at every tick, before all else.

        Args:
            stamp: Now [s].
            touch: As measured; see `Measured`.
        """
        self._now = stamp
        if len(touch) != len(self._fingers):  # from a device of another hand, or none
            return
        for finger, force in zip(self._fingers, touch, strict=True):
            if force >= self._grasp.touch:
                self._felt[finger] = stamp
            # Not NaN, so this finger is measured, even if it has never touched anything.
            elif force == force:
                self._felt.setdefault(finger, -math.inf)
            elif self._felt:  # a sensor that has gone silent must not say "lost"
                self._felt.pop(finger, None)

    def _touches(self, finger: str) -> bool | None:
        """Return whether a fingertip touches something; ``None``: that is not measured."""
        felt = self._felt.get(finger)
        return None if felt is None else self._now - felt <= _FELT

    def _touch(self, i: int) -> bool | None:
        """Return whether a fingertip that an actuator moves touches; ``None``: not measured."""
        words = {self._touches(finger) for finger in self._actuators[i].fingers}
        # One tip that is not measured may be the one that touches: that is "unknown", not "no".
        return True if True in words else None if None in words or not words else False

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
        """Look at actuators on their way.

        Args:
            stamp: Now [s].
            measured: What was measured.
            reference: Positions sent [rad | m].
            limits: Effort limits sent [N·m | N].
            indices: The actuators to look at.
        """
        for i in indices:
            watched = self._watched.get(i)
            # The same measurement again says nothing about standing still.
            if watched is None or not measured.fresh[i]:
                continue
            position = measured.position[i]
            word = measured.grasped[i]
            self._listen(i, watched, position, stamp)
            # Pushed the other way (a grip that is being opened), it has not come to its motion yet.
            ahead = 1.0 if watched.target >= position else -1.0
            tolerance = watched.tolerance
            behind = (reference[i] - position) * ahead > tolerance
            watched.led = watched.led + 1 if behind else 0
            # A device that reports grasping itself does so once its target is at rest.
            arriving = word == 0 and abs(reference[i] - watched.target) > tolerance
            # "not ... <=", since the anchor is NaN at first.
            if not abs(position - watched.anchor) <= self._slow[i] or not behind or arriving:
                watched.anchor, watched.since = position, stamp
                watched.blocked_at = math.nan
                watched.grasping = False
            stalled = behind and stamp - watched.since >= self._stall.time
            # Nearly always neither holds, and this runs for each actuator at each tick.
            away = own_word = False
            if word == 1 or self._grips[i] is not None:
                own_word = self._own_word(i, watched, position, word, ahead, stalled)
                away = self._leads_away(i, watched, position, word, ahead)
                own_word = own_word and not away
            else:
                watched.old_word = False
            watched.new = False
            if stalled or own_word:
                self._block(i, watched, measured, limits[i], own_word, away, ahead, stamp)

    def _own_word(
        self, i: int, watched: _Watched, position: float, word: int, ahead: float, stalled: bool
    ) -> bool:
        """Return whether the device's own word that it holds something counts."""
        begun = watched.led >= _DELIVERED or (position - watched.start) * ahead > watched.tolerance
        watched.old_word = word == 1 and (watched.old_word or watched.new or not begun)
        believed = stalled or not watched.old_word
        return word == 1 and believed and not self._at_end(i, position, watched)

    def _block(
        self,
        i: int,
        watched: _Watched,
        measured: Measured,
        limit: float,
        own_word: bool,
        away: bool,
        ahead: float,
        stamp: float,
    ) -> None:
        """Note that an actuator is blocked, and whether it holds something."""
        if math.isnan(watched.blocked_at):
            watched.blocked_at = stamp
        effort = abs(measured.effort[i])
        word = measured.grasped[i]
        holds = own_word or (word != 0 and not away and effort >= self._grasp.effort * limit)
        # A sensor at the tip knows better than efforts, which friction falsifies.
        touch = self._touch(i) if self._felt else None
        if touch is not None:
            holds = touch and not away
        if holds:
            watched.grasping = True
            watched.own_word = own_word
            watched.hold_position = measured.position[i]
            self._grips[i] = _Grip(ahead, measured.position[i])

    def _listen(self, i: int, watched: _Watched, position: float, stamp: float) -> None:
        """Note the time since the last measurement; silence does not count as standing still."""
        # Everything below is about measurements that come late.
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
        # One long silence must not raise what counts as usual by much.
        newest = gap if gap < 2.0 * usual else 2.0 * usual
        self._usual[i] = usual + _USUAL_SHARE * (newest - usual)

    def _leads_away(
        self, i: int, watched: _Watched, position: float, word: int, ahead: float
    ) -> bool:
        """Return whether the motion leads away from what the actuator holds or has just held."""
        grip = self._grips[i]
        left = grip is not None and abs(position - grip.position) > watched.tolerance
        if left and (watched.new or (word != 1 and watched.led >= _DELIVERED)):
            grip = self._grips[i] = None
        if grip is None and watched.new and word == 1:
            # Held since before: by closing, that is away from the rest posture.
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
        """Return the actuators that have just lost what they held.

        Either no fingertip touches any more where that is measured, or the device takes back its
        word while its target stands still, or the actuator moves on towards its target and its
        effort is gone.
        """
        found: list[int] = []
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
                found.append(i)
        return found

    def _looks_lost(
        self, i: int, watched: _Watched, measured: Measured, reference: float, limit: float
    ) -> bool:
        if self._felt and self._touch(i) is False:
            return True
        # The report is trusted only while the target is at rest: devices clear it when they move.
        if watched.own_word:
            return measured.grasped[i] == 0 and abs(reference - watched.target) <= watched.tolerance
        push = reference - watched.hold_position
        moved = (measured.position[i] - watched.hold_position) * (1.0 if push >= 0.0 else -1.0)
        spec = self._actuators[i]
        span = spec.upper - spec.lower
        # Further than noise, but never more than half of what it could still close.
        enough = max(3.0 * watched.tolerance, _LOST_MOVE * span if math.isfinite(span) else 0.0)
        if moved <= min(enough, 0.5 * abs(push)) or moved <= 0.5 * watched.tolerance:
            return False
        effort = abs(measured.effort[i])
        # Half of the threshold: what has just been found to grasp must not be lost by noise.
        return math.isnan(effort) or effort < 0.5 * self._grasp.effort * limit
