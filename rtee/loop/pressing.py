"""Press on an object with fingers of several actuators, by the depth of their references.

If each actuator pressed with an effort of its own, the slightest error of one would let the finger
fold, or let one finger push the others to their stops. So the fingers keep their posture: all
references move together along the action, into the object and out of it, until the force is the
requested one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Iterable, Sequence

from rtee.hand.config_schema import GraspSettings
from rtee.hand.model import Hand
from rtee.loop import contact_rules as rules
from rtee.loop.evidence import ContactMonitor
from rtee.loop.grip import ELSEWHERE, ONE_SIDE, Grip
from rtee.loop.measured import Measured
from rtee.loop.motion import Limiter
from rtee.loop.profiles import Profile
from rtee.loop.squeeze import SlipReport
from rtee.types import Event

_FOLLOW = 0.15
"""Time constant of the control of the force [s]: slower than motors and exchanges respond, so that
nothing oscillates."""

_LOOKS_AHEAD = 0.1
"""How far ahead the force is predicted from its rate [s]: some exchanges, and the servo's delay."""

_INTEGRATES = 0.4
"""The same of servos with integral control, which go on building up effort for long after the
reference has stopped: in simulation, an Allegro keeps within 9 % then, and within 13 % with 0.1 or
0.2 s."""

_SMOOTH = 0.03
"""Time constant of the force's rate [s]: longer than the noise of a few exchanges."""

_YIELDS = 1e-3
"""Depth assumed to give the requested force until the true one is known [m]: fingers and their
servos yield by a millimetre or more."""

_DEPTHS = (5e-5, 2e-2)
"""Least and largest such depth [m]: those of a rigid finger, and of a servo with a low gain."""

_FIRST = 1e-4
"""Depth after which the stiffness is known [m]: more than the resolution of positions."""

_HOLDS = 0.3
"""Least share of the requested force at which something is held."""

_NEAR = 0.04
"""The force has arrived within this share of the requested one, a little less than the error of a
sensor."""

_SETTLE = 0.15
"""Time for which the force must have been there [s]: some exchanges of the slowest device."""

_LONGEST = 3.0
"""Longest time for building up the force, from the contact on [s]: twenty time constants."""

_AT_REST = 1.0
"""Longest further wait for the tips to come no nearer [s]: fingers that bend creep for as long."""

_SPARE = 2.0
"""Effort limits are this multiple of the efforts that the levers predict: sensors break, and
keeping the posture takes effort, too."""

_BELIEVED = 3.0
"""Largest factor by which sensors correct those efforts, where the object is met elsewhere than the
levers assume: in simulation, a finger takes 5 times as much, beyond `_SPARE`."""

_POSTURE = 0.25
"""Share of the effort limit that carries a finger and overcomes its friction, besides the force."""

_KNOWN = 0.05
"""The same share once weight and friction are known from the approach."""

_FULL = 0.97
"""An actuator counts as at its effort limit above this share of it."""

_BEYOND = 0.25
"""How far beyond the action's posture the references may lead [1]: servos yield while they press on
a thin object."""

_GENTLY = 0.5
"""Share of the acceleration limits that is used: the limiter must not step in."""

_TARE = 0.1
"""Time constant of the mean effort of the approach [s]: weight and friction, over some exchanges
of the slowest device, before the contact shows."""

_BEFORE = 0.2
"""The effort of the approach is taken from at least this long ago [s]: a gentle contact presses for
some tenths of a second before it shows."""

_SLIP = 0.75
"""Increase of the force after a slip, as a share of the present one: it overtakes a growing
load."""

_CONFIRMED = 2
"""Measurements in succession that must show a slip: a single one may be noise."""


def ceilings(
    hand: Hand,
    predicted: dict[int, float],
    indices: Iterable[int],
    weight: Callable[[int], float] | None = None,
) -> dict[int, float]:
    """Return effort limits of actuators that keep their posture [N·m | N], by index.

    Args:
        hand: The hand.
        predicted: Efforts of those that press, by the levers [N·m | N].
        indices: The actuators.
        weight: Effort of each besides the force [N·m | N]; ``None``: not known yet.
    """
    limits = {}
    for i in indices:
        full = hand.actuators[i].effort
        if i not in predicted:
            limits[i] = full
            continue
        known = weight(i) if weight is not None else math.nan
        own = _SPARE * abs(known) + _KNOWN * full if known == known else _POSTURE * full
        limits[i] = min(_SPARE * predicted[i] + own, full)
    return limits


class Tare:
    """The efforts of actuators before they touch anything: of weight and friction."""

    def __init__(self) -> None:
        # For each actuator the mean effort at two earlier times, the older one first, and now; the
        # time since the later of these; and how often it was moved up.
        self._means: dict[int, tuple[float, float, float, float, int]] = {}

    def forget(self, i: int) -> None:
        """Forget an actuator."""
        self._means.pop(i, None)

    def learn(self, i: int, effort: float, time: float) -> None:
        """Learn from an effort of the approach [N·m | N] and the time since the last one [s]."""
        if effort != effort:
            return
        older, old, mean, passed, turns = self._means.get(i, (effort, effort, effort, 0.0, 0))
        mean += min(time / _TARE, 1.0) * (effort - mean)
        passed += min(time, _BEFORE)
        if passed >= _BEFORE:
            older, old, passed, turns = old, mean, 0.0, turns + 1
        self._means[i] = older, old, mean, passed, turns

    def of(self, i: int) -> float:
        """Return the effort [N·m | N]; ``NaN``: not known."""
        return self._means[i][0] if i in self._means else math.nan

    def sure(self, i: int) -> bool:
        """Return whether the effort was learned in motion, not only while setting out."""
        return i in self._means and self._means[i][4] > 1


class ForceEstimate:
    """The force between the tips: from sensors at the fingertips, else from efforts.

    By efforts, each finger presses with the force that best fits the efforts of its actuators, and
    a side with the sum of its fingers. Both sides press equally; their mean is the force.

    Attributes:
        hunts: Whether servos integrate their error, so that their lead does not show the force.
    """

    def __init__(self, hand: Hand, grip: Grip, tare: Tare) -> None:
        self._hand, self._grip, self._tare = hand, grip, tare
        closing = (math.copysign(1.0, t - r) for t, r in zip(grip.target, grip.rest, strict=True))
        self._closing = dict(zip(grip.indices, closing, strict=True))
        names = (hand.actuators[i].name for i in grip.indices)
        self.hunts = any(d.ki for name in names if (d := hand.dynamics.get(name)) is not None)

    @property
    def weight(self) -> Callable[[int], float]:
        """The effort of an actuator besides the force [N·m | N]; ``NaN``: not known."""
        return self._tare.of

    def known(self, measured: Measured, pressing: Iterable[int]) -> bool:
        """Return whether the force is measured, or all efforts that it follows from are."""
        felt = self._grip.tip_force(measured.touch)
        return felt == felt or all(math.isfinite(measured.effort[i]) for i in pressing)

    def of(self, measured: Measured) -> float:
        """Return the force [N]; ``NaN``: not known."""
        felt = self._grip.tip_force(measured.touch)
        return felt if felt == felt else self.by_efforts(measured.effort, measured.position)

    def error(self, measured: Measured) -> float:
        """Return the error of the force [N].

        If it follows from efforts, the error is at least half the difference between the two sides.
        It is ``NaN`` for servos with integral control, whose efforts hunt within dry friction.
        """
        felt = self._grip.tip_error(measured.touch)
        if felt == felt:
            return felt
        sides = [] if self._grip.around else self.sides(measured.effort, measured.position)
        apart = 0.5 * (max(sides, default=0.0) - min(sides, default=0.0))
        return math.nan if self.hunts else max(ELSEWHERE * self.of(measured), apart)

    def by_efforts(
        self,
        effort: Sequence[float],
        position: Sequence[float],
        only: Container[int] | None = None,
    ) -> float:
        """Return the force by efforts [N]; ``NaN``: they are not measured.

        Both sides press equally; their mean is the force. The arguments are those of `sides`.
        """
        sides = self.sides(effort, position, only)
        if not sides:
            return math.nan
        return sum(sides) if self._grip.around else sum(sides) / len(sides)

    def both_press(self, measured: Measured) -> bool:
        """Return whether each side presses, as far as efforts show; sensors take precedence."""
        grip = self._grip
        if grip.around or not math.isnan(grip.tip_force(measured.touch)):
            return True
        return rules.both_press(self.sides(measured.effort, measured.position))

    def sides(
        self,
        effort: Sequence[float],
        position: Sequence[float],
        only: Container[int] | None = None,
    ) -> list[float]:
        """Return the force of each side that squeezes, by efforts [N].

        Args:
            effort: Efforts of all actuators [N·m | N].
            position: Their positions [rad | m].
            only: Those that press; others may need their effort to accelerate. ``None``: all.
        """
        grip, names = self._grip, self._hand.finger_names
        along: dict[int, float] = {}
        square: dict[int, float] = {}
        for k, i, lever in grip.squeezing(grip.intensity_of(position)):
            for name in self._hand.actuators[i].fingers:
                finger = names.index(name)
                weight = self._tare.of(i)
                held = (
                    (effort[i] - (weight if weight == weight else 0.0))
                    * self._closing[i]
                    * grip.efficiency[k]
                )
                held = held if only is None or i in only else 0.0
                along[finger] = along.get(finger, 0.0) + lever * held
                square[finger] = square.get(finger, 0.0) + lever * lever
        return [
            sum(max(along[f], 0.0) / square[f] for f in side if f in along)
            for side in (grip.fingers, grip.others)
            if any(f in along for f in side)
        ]


class Pressing:
    """Brings the force between fingertips to the requested one, and keeps it.

    Args:
        hand: The hand.
        grasp: Settings.
        profile: Moves the reference.
        limiter: Holds the positions sent last.
        contact: Records which actuators hold the object.
        report: Called with events.
        grip: The grip.
        estimate: The force between the tips.
        force: The requested force [N].
        predicted: Efforts of the actuators that press, by the levers [N·m | N].
        most: Highest multiple of the requested force after slips.
        speed: Largest speed of the opening [m/s].

    Attributes:
        held: The actuators.
        effort: Their effort limits [N·m | N].
        built: Whether the force has been built up.
        failed: Whether there is nothing to press on.
        answers_slips: Whether slips are answered and reported.
        felt: The force between the tips [N].
        doubt: Its error [N].
    """

    def __init__(
        self,
        hand: Hand,
        grasp: GraspSettings,
        profile: Profile,
        limiter: Limiter,
        contact: ContactMonitor,
        report: Callable[[Event], None],
        grip: Grip,
        estimate: ForceEstimate,
        force: float,
        predicted: dict[int, float],
        most: float,
        speed: float,
    ) -> None:
        self._hand, self._grasp, self._profile, self._limiter = hand, grasp, profile, limiter
        self._contact, self._grip = contact, grip
        self._slip_report = SlipReport(hand, report)
        self._estimate, self._force, self._predicted = estimate, force, predicted
        self._most, self._speed = most, speed
        self._way = {
            i: target - rest
            for i, rest, target in zip(grip.indices, grip.rest, grip.target, strict=True)
        }
        self._base: dict[int, float] = {}
        self.held: set[int] = set()
        self.effort: dict[int, float] = {}
        self.built = self.failed = False
        self.answers_slips = True
        self.felt = self.doubt = math.nan
        self._level = 1.0
        self._share = self._velocity = self._depth = 0.0
        self._first = self._before = self._rate = self._foreseen = 0.0
        self._stiffness = force / _YIELDS
        self._stamp = self._began = self._off = math.nan
        self._by_efforts = self._width = math.nan
        self._nearest = self._from = math.inf
        self._since, self._still = math.nan, False
        self._rested: dict[int, float] = {}
        self._slipping = 0

    @property
    def building(self) -> bool:
        """Whether the force is still being brought to the requested one."""
        return not self.built

    @property
    def at_end(self) -> bool:
        """Whether the references have gone as far as they may."""
        return self._share >= self._furthest - 1e-9 and self._velocity > 0.0

    def join(self, i: int) -> None:
        """Let an actuator press together with the others from its present reference on."""
        if i in self._way:
            self._base[i] = self._limiter.position[i] - self._share * self._way[i]
            self.held.add(i)
            self.effort |= self._ceilings((i,))

    def forget(self, i: int) -> None:
        """Forget an actuator."""
        self.held.discard(i)
        self.effort.pop(i, None)
        self._base.pop(i, None)

    def begin(self, stamp: float) -> None:
        """Begin to press at a time [s]."""
        self._stamp = self._began = self._off = self._since = stamp

    def step(self, stamp: float, measured: Measured) -> bool:
        """Run one tick; return whether ``effort`` has changed."""
        self.felt, self.doubt = self._estimate.of(measured), self._estimate.error(measured)
        time, self._stamp = stamp - self._stamp, stamp
        if not (
            time > 0.0 and self.felt == self.felt and any(measured.fresh[i] for i in self.held)
        ):
            return False
        wanted = self._level * self._force
        share = self.felt / wanted
        sensed = not math.isnan(self._grip.tip_force(measured.touch))
        self._foresee(time, sensed)
        # All fingers count: one that stopped elsewhere holds nothing by itself.
        changed = self.answers_slips and self.built and self._slips(stamp, measured)
        gone = (
            rules.faint(self.felt, wanted) or self._past(measured) or self._strays(stamp, measured)
        )
        self._contact.presses_now(self._way, not gone)
        # By efforts, which friction shifts, a force is not known well enough to be foreseen.
        soon = (self._foreseen if sensed else self.felt) / wanted
        if self.built and self._rests(soon, sensed, measured):
            self._velocity = 0.0
            if not sensed:
                self._rate = 0.0
            return changed
        changed = self._move(time, wanted, measured) or changed
        if not self.built:
            if max(abs(share - 1.0), abs(soon - 1.0)) > _NEAR:
                self._off = stamp
            if rules.faint(self.felt, wanted):
                self._began = stamp  # it was not a contact: continue to the object, or to the end
            self._watch(stamp, measured)
            took = stamp - self._began
            there = stamp - self._off >= _SETTLE or self.at_end or took >= _LONGEST
            # Where nothing is held, there is nothing to wait for.
            rests = self._still or share < _HOLDS or took >= _LONGEST + _AT_REST
            if there and rests:
                self._arrive(stamp, share, measured)
        return changed

    def _watch(self, stamp: float, measured: Measured) -> None:
        """Note whether the tips have come nearer within the last while: the object moves then."""
        self._nearest = min(self._nearest, self._grip.opening(measured.position))
        gives = rules.gives_way(self._from - self._nearest)
        if gives or stamp - self._since >= rules.STILL:
            self._still, self._from, self._since = not gives, self._nearest, stamp

    def _past(self, measured: Measured) -> bool:
        """Return whether the fingertips have closed past what they held."""
        if not self.built:
            return False
        grip, here = self._grip, measured.position
        opening, doubt = grip.opening(here), grip.doubt(here)
        return rules.closed_past(opening, doubt, self._width, bends=grip.bends)

    def _strays(self, stamp: float, measured: Measured) -> bool:
        """Return whether a fingertip has left the place where it grasped."""
        if not self.built:
            return False
        way = (self._contact.strayed(i, stamp, measured.position) for i in self.held)
        return rules.strays(max(way, default=0.0))

    def _rests(self, share: float, sensed: bool, measured: Measured) -> bool:
        """Return whether the force, once reached, is no longer corrected."""
        if self.failed:
            return True
        efforts, position = measured.effort, measured.position
        now = self._estimate.by_efforts(efforts, position) if share > rules.STRONG else math.nan
        if sensed and self._estimate.hunts and not self.answers_slips:
            now = math.inf  # their efforts do not show the force
        return rules.force_rests(share, now, self._by_efforts)

    @property
    def _furthest(self) -> float:
        """How far the references may move along the action, from where they began [1]."""
        start = min(
            (
                (self._base[i] - rest) / (target - rest)
                for i, rest, target in zip(
                    self._grip.indices, self._grip.rest, self._grip.target, strict=True
                )
                if i in self._base and i in self._predicted
            ),
            default=0.0,
        )
        pressed = self.felt >= rules.FAINT * self._force
        return max(self._grip.intensity[-1] - start + (_BEYOND if pressed else 0.0), 0.0)

    def _move(self, time: float, wanted: float, measured: Measured) -> bool:
        """Move the references by the error of the force; return whether ``effort`` has changed."""
        self._learn_stiffness(wanted)
        speed = (wanted - self._foreseen) / (self._stiffness * _FOLLOW)
        speed = min(max(speed, -self._speed), self._speed)
        stronger = False
        if speed > 0.0 and (self._exhausted(measured) or self._one_sided(wanted, measured)):
            speed, stronger = 0.0, self._strengthen(time, measured)
        at = min(max(self._grip.intensity_of(measured.position), 0.0), self._grip.intensity[-1])
        slope = max(self._grip.slope_at(at), 1e-6)
        # Limited by the actuator that can change its velocity least.
        change = min(
            self._hand.actuators[i].acceleration / max(abs(self._way[i]), 1e-9) for i in self.held
        )
        rise = _GENTLY * change * slope * time
        self._velocity += min(max(speed - self._velocity, -rise), rise)
        before = self._share
        self._share = min(self._share + self._velocity * time / slope, max(self._furthest, before))
        self._depth += (self._share - before) * slope
        there = {i: base + self._share * self._way[i] for i, base in self._base.items()}
        self._profile.seed({i: self._profile.limits.clamp(i, p) for i, p in there.items()})
        return stronger

    def _foresee(self, time: float, sensed: bool) -> None:
        """Predict the force by its rate, a time after the last measurement [s]."""
        rate, self._before = (self.felt - self._before) / time, self.felt
        self._rate += min(time / _SMOOTH, 1.0) * (rate - self._rate)
        ahead = _INTEGRATES if sensed and self._estimate.hunts else _LOOKS_AHEAD
        self._foreseen = self.felt + ahead * self._rate

    def _learn_stiffness(self, wanted: float) -> None:
        """Learn which depth gives which force, from where the fingers began to press."""
        if self.felt < rules.FAINT * wanted:
            self._depth, self._first = 0.0, self.felt
        elif self._depth >= _FIRST and self._velocity > 0.0:
            least, most = (wanted / depth for depth in reversed(_DEPTHS))
            self._stiffness = min(max((self.felt - self._first) / self._depth, least), most)

    def _one_sided(self, wanted: float, measured: Measured) -> bool:
        """Return whether one side presses too hard, against something else than the other side."""
        touch = measured.touch
        sides = (self._grip.fingers, self._grip.others) if touch and not self._grip.around else ()
        return any(sum(touch[f] for f in side) > ONE_SIDE * wanted for side in sides)

    def _exhausted(self, measured: Measured) -> bool:
        """Return whether all actuators of one side that press are at their effort limits.

        Deeper references would not press harder, but push the object and that side back.
        """
        pressing = self._predicted.keys() & self.held
        full = {i for i in pressing if abs(measured.effort[i]) >= _FULL * self.effort[i]}
        return full == pressing or any(side and side <= full for side in self._sides(pressing))

    def _sides(self, indices: Iterable[int]) -> list[set[int]]:
        """Return those of some actuators that move the fingers of each side."""
        grip, names = self._grip, self._hand.finger_names
        if grip.around:  # each finger is a side of its own
            return []
        moved = [({names.index(f) for f in self._hand.actuators[i].fingers}, i) for i in indices]
        sides = (grip.fingers, grip.others)
        return [{i for own, i in moved if not own.isdisjoint(side)} for side in sides]

    def _strengthen(self, time: float, measured: Measured) -> bool:
        """Allow the efforts that the force takes at the present posture; return whether it is more.

        On a wide object, levers change by a multiple between its width and where it is met. Sensors
        show how much effort the present force takes. The limits rise as slowly as the force may:
        the references of actuators at their limits lead far ahead, and would strike at once.
        """
        grip, known = self._grip, self._predicted
        now = grip.efforts(self._force, grip.intensity_of(measured.position))
        if math.isnan(grip.tip_force(measured.touch)):
            share = 0.0
        else:
            share = self._force / max(self.felt, rules.FAINT * self._force)
        sensed = {i: share * abs(measured.effort[i]) for i in known}
        more = {
            i: max(effort, min(sensed[i], _BELIEVED * effort))
            for i, effort in now.items()
            if i in known
        }
        grows = min(time / _FOLLOW, 1.0)
        more = {i: e + grows * (more[i] - e) for i, e in known.items() if more.get(i, e) > e}
        self._predicted = known | more
        self.effort |= self._ceilings(more.keys() & self.held)
        return bool(more)

    def _arrive(self, stamp: float, share: float, measured: Measured) -> None:
        """Judge whether something is held, and record the result."""
        self.built = True
        self.failed = share < _HOLDS or not self._estimate.both_press(measured)
        holds = self._still and not self.failed
        for i in self.held:
            self._contact.pin(i, stamp, measured, grasping=i in self._predicted and holds)
        self._width = self._grip.opening(measured.position)
        self._rested = self._touches(measured)
        self._by_efforts = self._estimate.by_efforts(measured.effort, measured.position)

    def _ceilings(self, indices: Iterable[int]) -> dict[int, float]:
        predicted = {i: self._level * effort for i, effort in self._predicted.items()}
        return ceilings(self._hand, predicted, indices, self._estimate.weight)

    def _touches(self, measured: Measured) -> dict[int, float]:
        """Return the force on the fingers of each actuator that presses [N]."""
        found = {}
        for i in self._predicted.keys() & self.held:
            forces = self._contact.forces(i, measured)
            found[i] = sum(forces) if forces else math.nan
        return found

    def _slips(self, stamp: float, measured: Measured) -> bool:
        """Answer a slip, or a pull, with more force; return whether there is one."""
        now = self._touches(measured)
        pulled = [
            i
            for i, touch in now.items()
            if rules.pulled(0.0, 0.0, touch, self._rested.get(i, touch), self._grasp.touch)
        ]
        self._slipping = self._slipping + 1 if pulled else 0
        if self._slipping < _CONFIRMED:
            return False
        before = self._level
        self._level = min(before * (1.0 + _SLIP), max(self._most, 1.0))
        self.effort |= self._ceilings(self.held)
        self._rested, self._slipping = now, 0
        self._slip_report.answered(pulled[0], stamp, limited=self._level <= before)
        return True
