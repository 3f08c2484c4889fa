"""Reflexes: reactions of the fingers to contacts, and to an object that slips.

Pure like the rest of a tick: measurements in, references and effort limits out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from rtee.actions.openings import MARGIN
from rtee.drivers.capabilities import GripForce
from rtee.hand.config_schema import GraspSettings
from rtee.hand.model import Hand
from rtee.loop import contact_rules as rules
from rtee.loop.closing import leg_speed, meeting_speed, squeezing_speed
from rtee.loop.evidence import ContactMonitor
from rtee.loop.grip import ELSEWHERE, Grip
from rtee.loop.measured import Measured
from rtee.loop.motion import Limiter
from rtee.loop.plan import Plan
from rtee.loop.pressing import ForceEstimate, Pressing, Tare, ceilings
from rtee.loop.profiles import Profile
from rtee.loop.squeeze import Held, Squeeze
from rtee.types import Around, Event, FirstContact, OnContact

_LIGHT = 2.0
"""Effort limit of an approach in addition to friction, as a multiple of the contact threshold: with
less, the effort could not exceed the threshold."""

_LAGS = 0.5
"""During an approach, an actuator that moves by less than this share of its reference, and is
behind it, gets more effort."""

_KEEPS_UP = 0.75
"""An actuator whose effort nothing limits presses on something when it moves by less than this
share of its reference: in simulation, joints go on at 0.3 to 0.7 while others of their finger
stand."""

_LOOKED_AT = 0.02
"""Interval at which the approach's progress is evaluated [s]: at 1 kHz, the travel of a single tick
is lost in rounding."""

_AHEAD = 0.1
"""Share of its tolerance beyond which an actuator is ahead of its reference: more than noise."""

_WAITS = 0.1
"""A finger that waits for others goes on when it has felt nothing for this long [s]: contacts
chatter."""

_SLOW = 0.1
"""Where efforts cannot be limited, a squeeze closes at this share of the velocity limits: slow
enough for the object to centre itself between the fingers."""


@dataclass(slots=True)
class _ApproachingActuator:
    """An actuator that approaches a contact."""

    mode: OnContact
    target: float
    ahead: float
    tolerance: float
    kept_up: float
    touched: bool = False
    felt: float = -math.inf
    limit: float = math.inf
    runs: bool = False
    looked: float = math.nan
    was: float = math.nan
    reference: float = math.nan


@dataclass(slots=True)
class _LegReactions:
    """The reactions of a leg of a goal to contacts.

    Attributes:
        watched: The leg's closing actuators, by index.
        sides: Fingers on each side; one finger of each must touch before the force is built up.
        most: Highest effort limit after slips, by actuator [N·m | N].
        first: Whether all actuators stop at the first contact.
        force: The requested force [N], which is not eased; ``None``: none.
        grip: Computes the force, where one was requested.
        pressing: Actuators whose effort produces the force.
        slips: Whether slips are answered and reported.
        speed: Share of the velocity limits at which the actuators squeeze.
        slowly: The same once the force is nearly there.
        together: The force between the tips, where the fingers keep their posture as they squeeze;
            ``None``: each actuator presses with an effort of its own.
        predicted: Efforts for the force, by the levers [N·m | N].
        meeting: Speed of the opening at which the fingers meet an object [m/s].
        around: Whether the fingers are on the path around an object, which ends once one is felt.
        widest: Opening beyond which they touch it elsewhere than with their tips [m].
        width: Width of the object, if it is known [m].
    """

    watched: dict[int, _ApproachingActuator]
    sides: tuple[frozenset[str], ...] = ()
    most: Mapping[int, float] = field(default_factory=dict)
    first: bool = False
    force: float | None = None
    grip: Grip | None = None
    pressing: frozenset[int] = frozenset()
    slips: bool = True
    speed: float = 1.0
    slowly: float = 1.0
    together: ForceEstimate | None = None
    predicted: Mapping[int, float] = field(default_factory=dict)
    meeting: float = math.inf
    around: bool = False
    widest: float = math.inf
    width: float = math.nan

    def share(self, measured: Measured) -> float:
        """Return the share of the force to press with.

        Fingers may touch elsewhere than with their tips. Without sensors, the force may then exceed
        the estimate from efforts by `ELSEWHERE`, but it must not exceed the requested force.
        """
        grip = self.grip
        if grip is None or grip.tip_force(measured.touch) == grip.tip_force(measured.touch):
            return 1.0
        opening = grip.opening(measured.position)
        if not opening > self.widest:
            return 1.0
        share = 1.0 / (1.0 + ELSEWHERE)
        # What keeps tips from all around farther apart than it is wide lies nearer to the fingers'
        # hinges, where they press that much harder.
        return min(share, self.width / opening) if grip.around and opening > self.width else share


class Reflexes:
    """Stops fingers that touch something, squeezes once enough do, and answers slips.

    `ContactMonitor` detects contacts. Motions towards rest have no reflexes.

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
        busy: Actuators stopped or squeezing, which `ContactMonitor` must not evaluate.
        effort: Effort limits by actuator that replace those of the goal [N·m | N].
        changed: Whether ``effort`` has changed; the caller resets it.
        touched: Fingers that touched something since the goal began.
        in_place: Effort limits with which the next goal's object is held already, by actuator
            [N·m | N]; empty: it is not.
    """

    def __init__(
        self,
        hand: Hand,
        grasp: GraspSettings,
        profile: Profile,
        limiter: Limiter,
        contact: ContactMonitor,
        limit: Callable[[int], float],
        start: Callable[[int, float, bool], float | None],
        report: Callable[[Event], None],
    ) -> None:
        self._hand, self._grasp, self._limit, self._start = hand, grasp, limit, start
        self._profile, self._limiter, self._contact = profile, limiter, contact
        self._report = report
        self._approach: _LegReactions | None = None
        self._squeeze: Squeeze | Pressing | None = None
        self._tare = Tare()
        self._before = -math.inf
        self.active = self.changed = False
        self.busy: set[int] = set()
        self.effort: dict[int, float] = {}
        self.touched: tuple[str, ...] = ()
        self.in_place: Mapping[int, float] = {}

    @property
    def around(self) -> bool:
        """Whether the fingers are on the path around an object."""
        return self._approach is not None and self._approach.around

    @property
    def held(self) -> Iterable[int]:
        """The actuators that squeeze an object, whose effort limits are set here."""
        return () if self._squeeze is None else self._squeeze.held

    @property
    def building(self) -> bool:
        """Whether a force is being built up or corrected."""
        return self._squeeze is not None and self._squeeze.building

    @property
    def at_end(self) -> bool:
        """Whether the references of what squeezes have gone as far as they may."""
        return self._squeeze is not None and self._squeeze.at_end

    @property
    def felt(self) -> tuple[float, float]:
        """The force between the tips of fingers that keep their posture, and its error [N].

        ``NaN``: not known.
        """
        squeeze = self._squeeze
        if not isinstance(squeeze, Pressing):
            return math.nan, math.nan
        return squeeze.felt, squeeze.doubt

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
        targets, force = plan.legs[leg].targets, plan.force
        touch = isinstance(plan.to, FirstContact)
        self.touched = ()
        self.forget(targets)
        usual = self._grasp.on_contact
        # A device with forces in its data sheet builds up the force by itself.
        if force is not None and plan.grip is not None and plan.grip.sheet is None:
            usual = usual or OnContact.SQUEEZE
        in_place, self.in_place = self.in_place, {}
        # The first leg of a grasp only opens wide around the object.
        opens = isinstance(plan.to, Around) and leg + 1 < len(plan.legs)
        together = self._together(plan, measured)
        if opens and together is not None:
            # Not on this path, where the fingers must keep clear of one another.
            self._allow(ceilings(self._hand, {}, plan.effort))
            self.active = True
        if not (plan.on_contact or touch or usual):
            return
        watched: dict[int, _ApproachingActuator] = {}
        for i, target in targets.items():
            spec, here = self._hand.actuators[i], measured.position[i]
            mode: OnContact | None = OnContact.STOP
            if not (touch or opens):
                mode = self._mode(plan.on_contact, i, usual)
            # Hands close away from rest; a hand that opens touches nothing on purpose.
            closes = abs(target - spec.rest) > abs(here - spec.rest) + tolerance[i]
            if mode is not None and closes:
                ahead = 1.0 if target > here else -1.0
                watched[i] = _ApproachingActuator(mode, target, ahead, tolerance[i], stamp)
        if not watched:
            return
        if leg == 0:
            for i in watched:
                self._tare.forget(i)
        if opens:
            # Anything met on this path, at any opening, is not touched with the tips.
            self._approach = _LegReactions(
                watched,
                first=True,
                force=None if force is None else force.value,
                grip=plan.grip,
                together=together,
                predicted=plan.effort,
                around=True,
                widest=-math.inf,
                width=math.nan if plan.width is None else plan.width,
            )
            share = self._approach.share(measured)
            if together is None and force is not None and share < 1.0:
                for i, each in watched.items():
                    if i in plan.effort:
                        each.limit = share * plan.effort[i]
                self._allow({i: each.limit for i, each in watched.items() if i in plan.effort})
            self.active = True
            return
        sides: tuple[frozenset[str], ...] = ()
        most: Mapping[int, float] = {}
        slopes: Mapping[int, float] = {}
        if plan.grip is not None:
            names = self._hand.finger_names
            at = plan.grip.intensity[-1] / 2.0
            if plan.width is not None:
                at = plan.grip.intensity_at(plan.width)
            slopes = plan.grip.effort_slopes(at)
            sides = tuple(
                frozenset(names[f] for f in side) for side in (plan.grip.fingers, plan.grip.others)
            )
            if force is not None and force.most is not None:
                most = plan.grip.efforts(force.most, at)
        for i, each in watched.items():
            self._contact.approach(i, each.ahead, slopes.get(i), stamp, measured)
        slips = bool(plan.on_contact or self._grasp.on_contact or most)
        pressing = frozenset(plan.effort)
        wanted = None if force is None else force.value
        speed = leg_speed(plan, 0, self._hand)
        slowly = min(speed, squeezing_speed(plan, self._hand))
        self._approach = approach = _LegReactions(
            watched, sides, most, touch, wanted, plan.grip, pressing, slips, speed, slowly
        )
        if any(each.mode is not OnContact.SQUEEZE for each in watched.values()):
            together = None
        if together is not None and plan.grip is not None and wanted is not None:
            approach.together, approach.predicted = together, plan.effort
            at = plan.grip.intensity_at(plan.width or 0.0)
            approach.meeting = meeting_speed(wanted, plan.grip, at, plan.lag)
        if isinstance(plan.to, Around):
            approach.widest, approach.width = plan.to.width + MARGIN, plan.to.width
        self.active = True
        unknown = [
            self._hand.actuators[i].name for i in watched if self._contact.unknown(i, measured)
        ]
        if unknown:
            who = ", ".join(unknown)
            text = (
                f"contacts of {who} cannot be felt by effort yet, since free motion is not known; "
                "until it is, they are felt once the actuator stands still"
            )
            self._report(Event("contact_unknown", who, text, stamp))
        if in_place:
            self._go_on(approach, in_place, stamp)
            return
        if together is not None:
            self._contact.presses_now(watched, False)
            self._allow(ceilings(self._hand, dict(plan.effort), watched))
            return
        sheet = None if plan.grip is None else plan.grip.sheet
        for i, each in watched.items():
            # A device with forces in its data sheet builds up the force by itself; a touch needs
            # none.
            if touch or (each.mode is OnContact.SQUEEZE and sheet is None):
                self._begin_lightly(i, each, measured.position[i], sheet)

    def _together(self, plan: Plan, measured: Measured) -> ForceEstimate | None:
        """Return the force between fingers that keep their posture, where a goal needs that.

        A single actuator has no posture to keep; and a force that is not measured is produced by
        effort limits alone.
        """
        grip = plan.grip
        if plan.force is None or grip is None or grip.sheet or len(plan.effort) < 2:
            return None
        estimate = ForceEstimate(self._hand, grip, self._tare)
        return estimate if estimate.known(measured, plan.effort) else None

    def _allow(self, efforts: Mapping[int, float]) -> None:
        """Set effort limits [N·m | N]."""
        self.effort.update(efforts)
        self.changed = True

    def _go_on(self, approach: _LegReactions, efforts: Mapping[int, float], stamp: float) -> None:
        """Let actuators that hold an object continue from their effort limits [N·m | N]."""
        fingers: dict[str, None] = {}
        for i, each in approach.watched.items():
            each.touched = True
            fingers.update(dict.fromkeys(self._hand.actuators[i].fingers))
        self.touched = tuple(fingers)
        if any(each.mode is OnContact.SQUEEZE for each in approach.watched.values()):
            self._begin_squeeze(approach, stamp, 1.0, efforts)
            self.changed = True

    def _begin_lightly(
        self, i: int, each: _ApproachingActuator, here: float, sheet: GripForce | None
    ) -> None:
        """Have an actuator approach with little effort, unless it presses on an object already."""
        full = self._limit(i)
        if not math.isfinite(full):
            return
        if (self._limiter.position[i] - here) * each.ahead > each.tolerance:
            return  # it would drop the object
        light = _LIGHT * self._contact.threshold(i)
        if sheet is not None:
            # Forces of a sheet are those at the fingertips: even the weakest overcomes friction.
            self._allow({i: min(max(light, sheet.effort[0]), full)})
            return
        known = self._hand.dynamics.get(self._hand.actuators[i].name)
        friction = (known.dry_friction if known is not None else None) or 0.0
        each.limit = min(friction + light, full)
        self._allow({i: each.limit})

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

    def step(self, stamp: float, measured: Measured, limits: Sequence[float]) -> bool:
        """Detect contacts of the running goal, and react to them.

        Args:
            stamp: Now [s].
            measured: The measured state.
            limits: Effort limits sent last [N·m | N].

        Returns:
            Whether efforts were evaluated, which also teaches free motion.
        """
        approach = self._approach
        if approach is None:
            return False
        passed, self._before = stamp - self._before, stamp
        grip, force = approach.grip, approach.force
        sides = () if grip is not None and grip.around else approach.sides
        # If some fingers press with all of the force, there is no need to wait for the others.
        forced = grip is not None and force is not None and grip.tip_force(measured.touch) >= force
        pressed = self._squeeze is None and self._pressed(approach, stamp, measured)
        for i, watched in approach.watched.items():
            if watched.touched and self._squeeze is None and not approach.first:
                self._resume(i, watched, stamp, measured)
            if watched.touched or not measured.fresh[i]:
                continue
            # An object pushed by one of several fingers is not held yet: all must touch, unless one
            # that touches stops the others short of it.
            every = watched.mode is OnContact.SQUEEZE
            velocity = self._profile.velocity[i]
            reference = self._limiter.position[i]
            if approach.around:
                # Only contacts that are felt, or pressed on: efforts show an impact only when it is
                # over.
                forces = self._contact.forces(i, measured)
                touches = rules.any_touch(forces, self._grasp.touch) is True
            else:
                every = every and not (forced or self._contact.blocked(i))
                touches = self._contact.meets(
                    i,
                    stamp,
                    measured,
                    reference,
                    velocity,
                    limits[i],
                    every=every,
                    sides=sides,
                )
            if not (pressed or touches):
                strengthened = watched.limit < math.inf
                # Where nothing measures effort, a contact looks like friction.
                once = approach.around or not self._contact.has_effort(i, measured)
                if strengthened and once and self._contact.moved(i, measured):
                    # Friction is overcome: from now on, only an object can stop the actuator.
                    self._allow({i: watched.limit})
                    watched.limit = math.inf
                elif strengthened:
                    self._strengthen(i, watched, stamp, measured)
                elif approach.together is not None:
                    self._weigh(i, watched, stamp, passed, measured)
                continue
            self._note(i, stamp, measured)
            if approach.first:
                for j, other in approach.watched.items():
                    self._stop(j, other, stamp, measured)
                break
            self._stop(i, watched, stamp, measured)
            if approach.together is not None:
                self._stop_finger(i, approach, stamp, measured)
        if not approach.first and self._squeeze is None and self.touched:
            self._oppose(approach, stamp, measured)
        if not approach.first and self._squeeze is None and self._enough(approach):
            share = approach.share(measured)
            self._begin_squeeze(approach, stamp, share, pressing=measured.effort)
        return not approach.around

    def _oppose(self, approach: _LegReactions, stamp: float, measured: Measured) -> None:
        """Let a side that has come to its end oppose one that touches something.

        The force between the two sides, which is known, then shows whether there is an object.
        """
        if approach.together is None:
            return
        fingers = {i: set(self._hand.actuators[i].fingers) for i in approach.watched}
        touching = {f for i, each in approach.watched.items() if each.touched for f in fingers[i]}
        for side in approach.sides if touching else ():
            own = {i: each for i, each in approach.watched.items() if fingers[i] & side}
            if touching.isdisjoint(side) and all(
                self._at_end(i, each, measured) for i, each in own.items()
            ):
                for i, each in own.items():
                    self._stop(i, each, stamp, measured)

    def _at_end(self, i: int, watched: _ApproachingActuator, measured: Measured) -> bool:
        """Return whether an approaching actuator has come to its end and may touch something."""
        felt = rules.any_touch(self._contact.forces(i, measured), self._grasp.touch)
        here = (measured.position[i], self._limiter.position[i])
        return rules.may_oppose(
            felt, left=max(abs(watched.target - p) for p in here), tolerance=watched.tolerance
        )

    def _pressed(self, approach: _LegReactions, stamp: float, measured: Measured) -> bool:
        """Return whether efforts show that the fingers press on something with the full force.

        Fingers that met the object on the way around it may press before the actuators set out.
        """
        grip, force, estimate = approach.grip, approach.force, approach.together
        if grip is None or force is None or estimate is None:
            return False
        if not math.isnan(grip.tip_force(measured.touch)):
            return False  # sensors decide
        pressing = {i: each for i, each in approach.watched.items() if i in approach.predicted}
        still = {
            i
            for i, each in pressing.items()
            # The effort of friction must be known.
            if each.touched or (stamp - each.kept_up >= _LOOKED_AT and self._tare.sure(i))
        }
        if not still:
            return False
        least = approach.share(measured) * force
        waiting = {i for i, each in pressing.items() if each.touched and self._tare.sure(i)}
        # What presses so on fingers that wait is the other side, with the object in between.
        if rules.is_pressed(estimate.sides(measured.effort, measured.position, waiting), least):
            return True
        fingers = [self._fingers_of(side) for side in (pressing, still)]
        sides = (grip.fingers, grip.others)
        return rules.presses(
            estimate.by_efforts(measured.effort, measured.position, still),
            least,
            (not fingers[1].isdisjoint(side) for side in sides if not fingers[0].isdisjoint(side)),
        )

    def _fingers_of(self, indices: Iterable[int]) -> set[int]:
        """Return the fingers of some actuators, by index."""
        names = self._hand.finger_names
        return {names.index(f) for i in indices for f in self._hand.actuators[i].fingers}

    def _weigh(
        self,
        i: int,
        watched: _ApproachingActuator,
        stamp: float,
        passed: float,
        measured: Measured,
    ) -> None:
        """Learn the effort of an approaching actuator while it keeps up with its reference."""
        here, reference = measured.position[i], self._limiter.position[i]
        moved, wanted = here - watched.was, reference - watched.reference
        # An actuator that falls behind may already press on something, however gently it came.
        if moved * watched.ahead >= _KEEPS_UP * wanted * watched.ahead > 0.0:
            watched.kept_up = stamp
        if moved * watched.ahead >= _LAGS * wanted * watched.ahead > 0.0 and not self.touched:
            self._tare.learn(i, measured.effort[i], passed)
        watched.was, watched.reference = here, reference

    def _resume(
        self, i: int, watched: _ApproachingActuator, stamp: float, measured: Measured
    ) -> None:
        """Let an actuator that waits for others go on once its fingers have lost the contact."""
        felt = rules.any_touch(self._contact.forces(i, measured), self._grasp.touch)
        if felt is not False or watched.mode is not OnContact.SQUEEZE:
            watched.felt = stamp
        elif stamp - watched.felt >= _WAITS:
            watched.touched = False
            self.busy.discard(i)
            self._contact.unpin(i, stamp)
            self._profile.go({i: watched.target})

    def _stop_finger(
        self, i: int, approach: _LegReactions, stamp: float, measured: Measured
    ) -> None:
        """Stop all actuators of the fingers of one; otherwise, these would fold."""
        fingers = set(self._hand.actuators[i].fingers)
        for j, other in approach.watched.items():
            if other.touched or not fingers.intersection(self._hand.actuators[j].fingers):
                continue
            self._stop(j, other, stamp, measured)
        if isinstance(self._squeeze, Pressing):
            for j, other in approach.watched.items():
                if other.touched and j not in self._squeeze.held:
                    self._squeeze.join(j)

    def _strengthen(
        self, i: int, watched: _ApproachingActuator, stamp: float, measured: Measured
    ) -> None:
        """Raise the effort of an approaching actuator up to the goal's limit.

        It needs more if it falls behind, or if its limit hides what free motion takes.
        """
        here, reference = measured.position[i], self._limiter.position[i]
        full = self._limit(i)
        # An actuator that runs ahead of its reference must brake with its full effort.
        runs = (here - reference) * watched.ahead > _AHEAD * watched.tolerance
        if runs or watched.runs:
            watched.runs = runs
            self.effort[i] = full if runs else watched.limit
            self.changed = True
        if stamp - watched.looked < _LOOKED_AT:
            return
        # From the second time on: before, its travel is unknown.
        if watched.looked == watched.looked:
            moved, wanted = here - watched.was, reference - watched.reference
            time = self._grasp.squeeze_time
            if (
                self._contact.behind(i)
                and not moved * watched.ahead >= _LAGS * wanted * watched.ahead
            ):
                # Until it has set out, friction must be overcome before it counts as stalled. Then
                # no faster by rare measurements: the next one shows whether it goes on.
                passed = _LOOKED_AT if self._contact.moved(i, measured) else stamp - watched.looked
                share = passed / time if time > 0.0 else 1.0
                watched.limit = min(watched.limit + share * full, full)
            elif self._contact.bound(i):
                watched.limit = min(watched.limit + _LIGHT * self._contact.threshold(i), full)
            elif self._contact.learned(i):
                light = self._contact.friction(i) + _LIGHT * self._contact.threshold(i)
                watched.limit = min(max(watched.limit, light), full)
            if not runs:
                self.changed = self.changed or self.effort.get(i) != watched.limit
                self.effort[i] = watched.limit
        watched.looked, watched.was, watched.reference = stamp, here, reference

    def _note(self, i: int, stamp: float, measured: Measured) -> None:
        """Record that an actuator's fingers touch something, and report it."""
        actuator = self._hand.actuators[i]
        forces = self._contact.forces(i, measured)
        felt = [
            finger
            for finger, force in zip(actuator.fingers, forces, strict=False)
            if force >= self._grasp.touch
        ]
        new = [f for f in felt or actuator.fingers if f not in self.touched]
        self.touched += tuple(new)
        if new and not self.around:  # the fingers are going to close on it
            who = ", ".join(new)
            text = f"{who} touched something (actuator {actuator.name})"
            self._report(Event("contact", who, text, stamp))

    def _stop(
        self, i: int, watched: _ApproachingActuator, stamp: float, measured: Measured
    ) -> None:
        """Stop an actuator where it is."""
        if watched.touched:
            return
        watched.touched, watched.felt = True, stamp
        here = measured.position[i]
        if not math.isfinite(here):
            return
        together = self._approach is not None and self._approach.together is not None
        several = len(self._hand.actuators[i].fingers) > 1
        if watched.mode is OnContact.SQUEEZE and several and not together:
            return  # it moves both sides: there is nothing to wait for
        # The reference leads into the object: only the part of its lead that presses is kept.
        if self._start(i, stamp, True) is None:
            self._profile.go({}, brake=(i,))
        else:
            there = here + self._kept(i, measured) * (self._limiter.position[i] - here)
            self._profile.seed({i: there})
            self._limiter.seed(i, there)
        self.busy.add(i)
        holds = watched.mode is OnContact.HOLD
        self._contact.pin(i, stamp, measured, grasping=holds)
        if together:
            return
        if watched.mode is not OnContact.STOP and math.isfinite(self._limit(i)):
            self.effort[i] = self._light(i, watched)
            self.changed = True

    def _kept(self, i: int, measured: Measured) -> float:
        """Return the share of an actuator's effort that presses, net of weight and friction."""
        together = self._approach and self._approach.together
        if not together or together.hunts:
            return 0.0
        return rules.pressing_share(measured.effort[i], self._tare.of(i))

    def _light(self, i: int, watched: _ApproachingActuator) -> float:
        """Return the effort limit that overcomes friction and presses lightly [N·m | N]."""
        full = self._limit(i)
        if watched.limit < full:
            return watched.limit
        return min(self._contact.friction(i) + self._contact.threshold(i), full)

    # --- the force ---------------------------------------------------------------------------

    def _enough(self, approach: _LegReactions) -> bool:
        """Return whether enough fingers touch to squeeze without pushing the object away."""
        squeezing = [
            (i, each) for i, each in approach.watched.items() if each.mode is OnContact.SQUEEZE
        ]
        touching: set[str] = set()
        for i, each in squeezing:
            if each.touched:
                touching.update(self._hand.actuators[i].fingers)
        fingers = {f for i, _ in squeezing for f in self._hand.actuators[i].fingers}
        return rules.enough_touch(touching, approach.sides, fingers, self._grasp.contact_fingers)

    def _begin_squeeze(
        self,
        approach: _LegReactions,
        stamp: float,
        share: float,
        efforts: Mapping[int, float] | None = None,
        pressing: Sequence[float] = (),
    ) -> None:
        """Begin to build up the force with all actuators that squeeze, together.

        They begin with the given effort limits [N·m | N]. Without these they begin lightly, but
        with no less effort than they exert already, or the object would fall.
        """
        if approach.together is not None and approach.grip is not None:
            self._press(approach, approach.grip, approach.together, stamp, share)
            return
        held: dict[int, Held] = {}
        floor, most = 0.0, math.inf
        for i, each in approach.watched.items():
            if each.mode is not OnContact.SQUEEZE:
                continue
            full = share * self._limit(i)
            if math.isfinite(full) and full > 0.0:
                begin = self._light(i, each) if efforts is None else efforts.get(i, full)
                if pressing and abs(pressing[i]) > begin:
                    begin = min(abs(pressing[i]), full)
                held[i] = Held(begin, full)
                spec = self._hand.actuators[i]
                floor = max(floor, self._grasp.grip_effort * spec.effort / full)
                most = min(most, approach.most.get(i, full) / full)
                # The approach is slow only for the sake of the impact; but while only one side has
                # met the object, the other side must not strike it.
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
            if approach.slowly < approach.speed:
                velocity = {i: self._hand.actuators[i].velocity for i in held}
                squeeze.slowly = {i: approach.slowly * top for i, top in velocity.items()}
        self._squeeze = squeeze if held else None
        approach.watched = {
            i: each for i, each in approach.watched.items() if each.mode is not OnContact.SQUEEZE
        }
        squeeze.begin(stamp)

    def _press(
        self,
        approach: _LegReactions,
        grip: Grip,
        estimate: ForceEstimate,
        stamp: float,
        share: float,
    ) -> None:
        """Begin to press with the fingers that touch; the others join when they do."""
        predicted = {i: share * effort for i, effort in approach.predicted.items()}
        most = [approach.most[i] / e for i, e in predicted.items() if e and i in approach.most]
        pressing = Pressing(
            self._hand,
            self._grasp,
            self._profile,
            self._limiter,
            self._contact,
            self._report,
            grip,
            estimate,
            share * (approach.force or math.nan),
            predicted,
            min(most, default=1.0),
            approach.meeting,
        )
        pressing.answers_slips = approach.slips
        for i, each in approach.watched.items():
            if each.touched:
                pressing.join(i)
                self.busy.add(i)
        self._squeeze = pressing
        pressing.begin(stamp)
        self._allow(pressing.effort)

    def keep(self, stamp: float, measured: Measured) -> None:
        """Build up and maintain the force on a held object; called at every tick while `active`."""
        squeeze = self._squeeze
        if squeeze is None:
            return
        building = not squeeze.built
        if squeeze.step(stamp, measured):
            self.effort.update(squeeze.effort)
            self.changed = True
        if building and squeeze.built and isinstance(squeeze, Squeeze):
            self.busy.difference_update(squeeze.held)
