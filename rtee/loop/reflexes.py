"""Reflexes: reactions of the fingers to contacts, and to an object that slips.

Pure like the rest of a tick: measurements in, references and effort limits out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from rtee.hand.config_schema import GraspSettings
from rtee.hand.model import Hand
from rtee.loop.contact import ContactWatch, Measured
from rtee.loop.free_motion import FreeMotion
from rtee.loop.grip import Grip
from rtee.loop.limiter import Limiter
from rtee.loop.plan import Plan
from rtee.loop.profiles import Profile
from rtee.loop.squeeze import Held, Squeeze, finger_forces
from rtee.loop.tip_levers import TipLevers
from rtee.types import Event, OnContact

_CONFIRMED = 2
"""Measurements in succession whose effort must show a contact: a single one may be noise."""

_UNKNOWN_SHARE = 0.05
"""Threshold of a contact for an actuator that moves no fingertip, as a share of its effort limit
above the effort of free motion: its lever, and so the force, is unknown."""

_SET_OUT = 0.1
"""Efforts are not evaluated for this long after an actuator has started, while it overcomes static
friction [s]."""

_RESOLUTION = 0.01
"""Least threshold of a contact as a share of the effort limit: devices measure no better."""

_LIGHT = 2.0
"""Effort limit of an approach besides friction, in thresholds of a contact: with less, the effort
could not exceed the threshold."""

_LAGS = 0.5
"""During an approach, an actuator that moves by less than this share of its reference, and is
behind it, gets more effort."""

_LOOKED_AT = 0.02
"""Interval at which the approach's progress is evaluated [s]: at 1 kHz, the travel of a single tick
is lost in rounding."""

_SLOW = 0.1
"""Where efforts cannot be limited, a squeeze closes at this share of the velocity limits: slow
enough for the object to centre itself between the fingers."""


@dataclass(slots=True)
class _Watched:
    """An actuator that approaches a contact."""

    mode: OnContact
    target: float
    ahead: float
    tolerance: float
    threshold: float
    velocity: float = 0.0
    seen: float = math.nan
    began: float = math.nan
    over: int = 0
    touched: bool = False
    in_effort: bool = False
    limit: float = math.inf
    by_tip: bool = False
    looked: float = math.nan
    was: float = math.nan
    reference: float = math.nan


@dataclass(slots=True)
class _Approach:
    """The reactions of a leg of a goal to contacts.

    Attributes:
        watched: The leg's closing actuators, by index.
        sides: Fingers on each side; one finger of each must touch before the force is built up.
        most: Highest effort limit after slips, by actuator [N·m | N].
        first: Whether all actuators stop at the first contact.
        force: The requested force [N], which is not eased; ``None``: none.
        grip: Computes the force, where one was requested.
        pressing: Actuators whose effort makes the force.
        slips: Whether slips are answered and reported.
        speed: Share of the velocity limits at which the actuators squeeze.
    """

    watched: dict[int, _Watched]
    sides: tuple[frozenset[str], ...] = ()
    most: Mapping[int, float] = field(default_factory=dict)
    first: bool = False
    force: float | None = None
    grip: Grip | None = None
    pressing: frozenset[int] = frozenset()
    slips: bool = True
    speed: float = 1.0


class Reflexes:
    """Stops fingers that touch something, squeezes once enough do, and answers slips.

    A finger touches when a sensor on it measures at least ``grasp.touch``. Without such sensors on
    its fingers, an actuator touches when its effort (or current) exceeds that of free motion (see
    `FreeMotion`) by ``grasp.contact_force`` at the fingertips in two successive measurements, or
    when it is blocked: by the device's own report, or because it has stalled. Motions towards rest
    have no reflexes.

    Args:
        hand: The hand.
        grasp: When and how to react.
        profile: Moves the reference.
        limiter: Holds the positions sent last.
        contact: Detects contacts; learns which actuators were stopped.
        limit: Returns an actuator's effort limit by its goal [N·m | N].
        start: Returns the measured position of an actuator if its reference may start from it now
            [s]; see `Plausibility.start`.
        report: Called with events.

    Attributes:
        active: Whether any actuator has a reflex; else a tick does nothing here.
        busy: Actuators stopped or squeezing, which `ContactWatch` must not evaluate.
        effort: Effort limits by actuator that replace those of the goal [N·m | N].
        changed: Whether ``effort`` has changed; the caller resets it.
        touched: Fingers that touched something since the goal began.
    """

    def __init__(
        self,
        hand: Hand,
        grasp: GraspSettings,
        profile: Profile,
        limiter: Limiter,
        contact: ContactWatch,
        limit: Callable[[int], float],
        start: Callable[[int, float, bool], float | None],
        report: Callable[[Event], None],
    ) -> None:
        self._hand, self._grasp, self._limit, self._start = hand, grasp, limit, start
        self._profile, self._limiter, self._contact = profile, limiter, contact
        self._report = report
        self._free = [
            FreeMotion(actuator.effort, actuator.velocity, actuator.acceleration)
            for actuator in hand.actuators
        ]
        self._levers = TipLevers(hand)
        self._approach: _Approach | None = None
        self._squeeze: Squeeze | None = None
        self.active = self.changed = False
        self.busy: set[int] = set()
        self.effort: dict[int, float] = {}
        self.touched: tuple[str, ...] = ()

    @property
    def held(self) -> Iterable[int]:
        """The actuators that squeeze an object, whose effort limits are set here."""
        return () if self._squeeze is None else self._squeeze.held

    # --- goals -------------------------------------------------------------------------------

    def forget(self, indices: Iterable[int]) -> None:
        """Forget everything about some actuators."""
        if not self.active:
            return
        for i in indices:
            self.busy.discard(i)
            self.effort.pop(i, None)
            if self._approach is not None:
                self._approach.watched.pop(i, None)
            if self._squeeze is not None:
                self._squeeze.forget(i)
        if self._approach is not None and not self._approach.watched:
            self._approach = None
        if self._squeeze is not None and not self._squeeze.held:
            self._squeeze = None
        self.active = bool(self._approach or self._squeeze or self.busy)

    def begin(
        self,
        plan: Plan,
        leg: int,
        tolerance: Mapping[int, float],
        measured: Measured,
        stamp: float,
    ) -> None:
        """Begin a leg of a plan.

        Args:
            plan: The plan.
            leg: The leg's number.
            tolerance: Position error that counts as none, by actuator [rad | m].
            measured: The last measurements.
            stamp: Now [s].
        """
        goal, targets = plan.goal, plan.legs[leg].targets
        self.touched = ()
        self.forget(targets)
        usual = self._grasp.on_contact
        # A device with forces in its data sheet builds up the force by itself.
        if goal.force is not None and plan.grip is not None and plan.grip.sheet is None:
            usual = usual or OnContact.SQUEEZE
        # The first leg of a grasp only opens wide around the object.
        if not (goal.on_contact or goal.touch or usual) or (goal.grasp and leg == 0):
            return
        watched: dict[int, _Watched] = {}
        for i, target in targets.items():
            spec, here = self._hand.actuators[i], measured.position[i]
            mode = OnContact.STOP if goal.touch else self._mode(goal.on_contact, i, usual)
            # Hands close away from rest; a hand that opens touches nothing on purpose.
            closes = abs(target - spec.rest) > abs(here - spec.rest) + tolerance[i]
            if mode is not None and closes:
                ahead = 1.0 if target > here else -1.0
                watched[i] = _Watched(mode, target, ahead, tolerance[i], math.nan)
        if not watched:
            return
        sides: tuple[frozenset[str], ...] = ()
        most: Mapping[int, float] = {}
        if plan.grip is not None:
            names = self._hand.finger_names
            at = plan.grip.intensity[-1] / 2.0
            if goal.opening is not None:
                at = plan.grip.intensity_at(goal.opening)
            for i, slope in plan.grip.effort_slopes(at).items():
                if i in watched:
                    watched[i].threshold = self._threshold(i, slope)
            sides = tuple(
                frozenset(names[f] for f in side) for side in (plan.grip.fingers, plan.grip.others)
            )
            if goal.max_force is not None:
                most = plan.grip.efforts(goal.max_force, at)
        for i, each in watched.items():
            each.by_tip = each.threshold != each.threshold
            if each.by_tip:
                each.threshold = self._tip_threshold(i, stamp, measured)
        slips = bool(goal.on_contact or self._grasp.on_contact or most)
        pressing = frozenset(plan.effort)
        self._approach = _Approach(
            watched, sides, most, goal.touch, goal.force, plan.grip, pressing, slips, goal.speed
        )
        self.active = True
        for i, each in watched.items():
            if each.mode is OnContact.SQUEEZE or goal.touch:
                # A device with forces in its data sheet builds up the force by itself; for a touch
                # there is none to build up.
                sheet = None if goal.touch or plan.grip is None else plan.grip.sheet
                if sheet is None:
                    self._begin_lightly(i, each, measured.position[i])

    def _threshold(self, i: int, slope: float) -> float:
        """Return the effort of a contact [N·m | N]; ``slope``: effort per newton at the tips."""
        least = _RESOLUTION * self._hand.actuators[i].effort
        return max(slope * self._grasp.contact_force, least if math.isfinite(least) else 0.0)

    def _tip_threshold(self, i: int, stamp: float, measured: Measured) -> float:
        """Return the effort of a contact by the tip's lever at the present posture [N·m | N]."""
        spec = self._hand.actuators[i]
        lever = self._levers.of(i, stamp, measured.position)
        if lever != lever:
            return _UNKNOWN_SHARE * spec.effort
        known = self._hand.dynamics.get(spec.name)
        efficiency = (known.efficiency if known is not None else None) or 1.0
        return self._threshold(i, lever / efficiency)

    def _begin_lightly(self, i: int, each: _Watched, here: float) -> None:
        """Have an actuator approach with little effort, unless it presses on an object already."""
        full = self._limit(i)
        if not math.isfinite(full):
            return
        if (self._limiter.position[i] - here) * each.ahead > each.tolerance:
            return  # it would drop the object
        known = self._hand.dynamics.get(self._hand.actuators[i].name)
        friction = (known.dry_friction if known is not None else None) or 0.0
        each.limit = min(friction + _LIGHT * each.threshold, full)
        self.effort[i] = each.limit
        self.changed = True

    def _mode(
        self, wanted: Mapping[str, OnContact], i: int, usual: OnContact | None
    ) -> OnContact | None:
        """Return an actuator's reaction to a contact: the most careful one of its fingers."""
        usual = wanted.get("", usual)
        fingers = self._hand.actuators[i].fingers
        modes = {wanted.get(finger, usual) for finger in fingers} or {usual}
        # `OnContact` lists the most careful one first.
        return next((mode for mode in OnContact if mode in modes), None)

    # --- a tick ------------------------------------------------------------------------------

    def step(self, stamp: float, measured: Measured) -> None:
        """Detect contacts of the running goal, and react to them."""
        approach = self._approach
        if approach is None:
            return
        for i, watched in approach.watched.items():
            if watched.touched or not measured.fresh[i]:
                continue
            if not self._touches(i, stamp, measured):
                if watched.limit < math.inf:
                    self._strengthen(i, watched, stamp, measured)
                continue
            self._note(i, watched, stamp, measured)
            if approach.first:
                for j, other in approach.watched.items():
                    self._stop(j, other, stamp, measured)
                return
            self._stop(i, watched, stamp, measured)
        if self._squeeze is None and self._enough(approach):
            self._begin_squeeze(approach, stamp)

    def _touches(self, i: int, stamp: float, measured: Measured) -> bool:
        """Return whether there is evidence that an actuator's fingers touch something."""
        assert self._approach is not None  # noqa: S101 - `step` has seen to that
        watched = self._approach.watched[i]
        forces = self._tip_forces(i, measured)
        # An object pushed by one of several fingers is not held yet: the others must touch, too.
        every = watched.mode is OnContact.SQUEEZE
        if forces and all(force == force for force in forces):
            least = self._grasp.touch
            return min(forces) >= least if every else max(forces) >= least
        return self._pushes(i, watched, stamp, measured) or self._contact.blocked(i)

    def _strengthen(self, i: int, watched: _Watched, stamp: float, measured: Measured) -> None:
        """Raise the effort of an approaching actuator that falls behind, up to the goal's limit."""
        here, reference = measured.position[i], self._limiter.position[i]
        if stamp - watched.looked < _LOOKED_AT:
            return
        # From the second time on: before, its travel is unknown.
        if watched.looked == watched.looked:
            moved, wanted = here - watched.was, reference - watched.reference
            behind = (reference - here) * watched.ahead > watched.tolerance
            full, time = self._limit(i), self._grasp.squeeze_time
            if behind and not moved * watched.ahead >= _LAGS * wanted * watched.ahead:
                share = (stamp - watched.looked) / time if time > 0.0 else 1.0
                watched.limit = min(watched.limit + share * full, full)
            elif watched.in_effort and self._free[i].known:
                light = self._free[i].most + _LIGHT * watched.threshold
                watched.limit = min(max(watched.limit, light), full)
            self.changed = self.changed or self.effort.get(i) != watched.limit
            self.effort[i] = watched.limit
        watched.looked, watched.was, watched.reference = stamp, here, reference

    def _pushes(self, i: int, watched: _Watched, stamp: float, measured: Measured) -> bool:
        """Return whether an actuator needs more effort than free motion does."""
        signal, threshold = measured.effort[i], watched.threshold
        watched.in_effort = signal == signal
        if signal != signal:
            if not measured.current:
                return False
            # A current [A] has no threshold in newton metres, so a relative one is used.
            signal, threshold = measured.current[i], 0.0
        velocity, dt = self._profile.velocity[i], stamp - watched.seen
        gain = (velocity - watched.velocity) / dt if dt > 0.0 else 0.0
        watched.velocity, watched.seen = velocity, stamp
        if signal != signal or velocity * watched.ahead <= 0.0:
            return False
        if abs(watched.target - measured.position[i]) <= watched.tolerance:
            return False  # it brakes, or reaches the end of its range
        if watched.began != watched.began:
            watched.began = stamp
        free = self._free[i]
        if stamp - watched.began < _SET_OUT:
            # Overcoming static friction is a part of free motion that the model must learn.
            free.learn(signal, velocity, gain)
            return False
        if watched.by_tip and threshold > 0.0:
            threshold = watched.threshold = self._tip_threshold(i, stamp, measured)
        pushes = free.exceeds(signal, velocity, gain, threshold)
        watched.over = watched.over + 1 if pushes else 0
        return watched.over >= _CONFIRMED

    def _note(self, i: int, watched: _Watched, stamp: float, measured: Measured) -> None:
        """Record that an actuator's fingers touch something, and report it."""
        actuator = self._hand.actuators[i]
        forces = self._tip_forces(i, measured)
        felt = [
            finger
            for finger, force in zip(actuator.fingers, forces, strict=False)
            if force >= self._grasp.touch
        ]
        new = [f for f in felt or actuator.fingers if f not in self.touched]
        self.touched += tuple(new)
        if new:
            who = ", ".join(new)
            text = f"{who} touched something (actuator {actuator.name})"
            self._report(Event("contact", who, text, stamp))

    def _stop(self, i: int, watched: _Watched, stamp: float, measured: Measured) -> None:
        """Stop an actuator where it is."""
        if watched.touched:
            return
        watched.touched = True
        here = measured.position[i]
        if not math.isfinite(here):
            return
        if watched.mode is OnContact.SQUEEZE and len(self._hand.actuators[i].fingers) > 1:
            return  # it moves both sides: there is nothing to wait for
        # At the measured position: the reference leads on into the object.
        if self._start(i, stamp, True) is None:
            self._profile.go({}, brake=(i,))
        else:
            self._profile.seed({i: here})
            self._limiter.seed(i, here)
        self.busy.add(i)
        holds = watched.mode is OnContact.HOLD
        self._contact.pin(i, stamp, here, grasping=holds)
        if watched.mode is not OnContact.STOP and math.isfinite(self._limit(i)):
            self.effort[i] = self._light(i, watched)
            self.changed = True

    def _light(self, i: int, watched: _Watched) -> float:
        """Return the effort limit that overcomes friction and presses lightly [N·m | N]."""
        full = self._limit(i)
        if watched.limit < full:
            return watched.limit
        # A model learned from currents has no efforts.
        free = self._free[i].most if watched.in_effort else 0.0
        return min(free + watched.threshold, full)

    # --- the force ---------------------------------------------------------------------------

    def _enough(self, approach: _Approach) -> bool:
        """Return whether enough fingers touch to squeeze without pushing the object away."""
        squeezing = [
            (i, each) for i, each in approach.watched.items() if each.mode is OnContact.SQUEEZE
        ]
        touching: set[str] = set()
        for i, each in squeezing:
            if each.touched:
                touching.update(self._hand.actuators[i].fingers)
        if not touching:
            return False
        # With one finger on either side, nothing is pushed away.
        if approach.sides:
            return all(touching.intersection(side) for side in approach.sides)
        fingers = {f for i, _ in squeezing for f in self._hand.actuators[i].fingers}
        return len(touching) >= min(self._grasp.contact_fingers, len(fingers))

    def _begin_squeeze(self, approach: _Approach, stamp: float) -> None:
        """Begin to build up the force with all actuators that squeeze, together."""
        held: dict[int, Held] = {}
        floor, most = 0.0, math.inf
        for i, each in approach.watched.items():
            if each.mode is not OnContact.SQUEEZE:
                continue
            full = self._limit(i)
            if math.isfinite(full) and full > 0.0:
                held[i] = Held(self._light(i, each), full)
                spec = self._hand.actuators[i]
                floor = max(floor, self._grasp.grip_effort * spec.effort / full)
                most = min(most, approach.most.get(i, full) / full)
                # Only the impact needs the low speed of the approach.
                self._profile.go({i: each.target}, velocity={i: approach.speed * spec.velocity})
            else:
                # Its effort cannot be limited, so it closes slowly instead.
                top = _SLOW * self._hand.actuators[i].velocity
                self._profile.go({i: each.target}, velocity={i: top})
            self.busy.discard(i)
            self._contact.unpin(i, stamp)
        self.busy.update(held)
        most = max(most, 1.0) if math.isfinite(most) else 1.0
        floor = 1.0 if approach.force is not None else min(floor, 1.0)
        squeeze = Squeeze(
            self._hand, self._grasp, self._profile, self._contact, self._report, held, floor, most
        )
        squeeze.answers_slips = approach.slips
        if approach.force is not None:
            squeeze.force, squeeze.grip = approach.force, approach.grip
            squeeze.pressing = approach.pressing.intersection(held)
        self._squeeze = squeeze if held else None
        approach.watched = {
            i: each for i, each in approach.watched.items() if each.mode is not OnContact.SQUEEZE
        }
        squeeze.begin(stamp)

    def keep(self, stamp: float, measured: Measured) -> None:
        """Build up and maintain the force on a held object; called at every tick while `active`."""
        squeeze = self._squeeze
        if squeeze is None:
            return
        building = not squeeze.built
        if squeeze.step(stamp, measured):
            self.effort.update(squeeze.effort)
            self.changed = True
        if building and squeeze.built:
            self.busy.difference_update(squeeze.held)

    def _tip_forces(self, i: int, measured: Measured) -> list[float]:
        return finger_forces(self._hand, i, measured)
