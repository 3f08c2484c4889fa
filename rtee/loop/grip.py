"""The opening of the fingertips and the force between them, from measurements of the actuators.

A few small tables are computed when a goal begins. The loop and the threads that publish and record
then compute both with a handful of sums.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from rtee.actions.openings import JOINTS, TABLE, OpeningTable
from rtee.drivers.capabilities import GripForce
from rtee.hand.config_schema import ActuatorDynamics, Following
from rtee.hand.inertia import inertia_of
from rtee.hand.model import Hand
from rtee.loop import contact_rules as rules
from rtee.loop.measured import GRIP_FORCE, MET, TIP_FORCE, tip_forces
from rtee.sample import TickRecord

TIPS: Final = "tip forces"
"""The force is measured by sensors at the fingertips."""

DEVICE: Final = "device"
"""The force is measured by the device, in newtons by its data sheet."""

EFFORT: Final = "effort"
"""The force is estimated from measured efforts."""

LIMIT: Final = "effort limit"
"""The force is estimated from the effort limits of actuators that are blocked."""

_EFFORT_SHARE: Final = 0.15
"""Error of an estimate from measured efforts, as a share of the force, besides dry friction: the
object is seldom exactly where the fingertips meet in the table."""

_SHARED: Final = 0.25
"""Such an error where one motor moves more than two fingers, which do not share its effort as the
levers assume: in simulation, a 3-Finger presses with 18 % more."""

ELSEWHERE: Final = 0.6
"""Error, likewise, of an estimate from the efforts of several actuators, and the least error where
fingers touch elsewhere than at their tips: the point of contact decides how much of an effort a
joint bears, and how much its friction takes. In simulation, HERI II, Allegro and the SoftHand are
off by 0.53 to 0.58; a claw presses with a third more at its heel, and a fifth less askew."""

ONE_SIDE: Final = 1.25
"""One side presses no harder than this multiple of the force: a palm or another finger may hold
against it, and the other side may never come. An impact may reach 1.3 times the force, and the
force is kept within some percent."""

_LIMIT_SHARE: Final = 0.25
"""Error of an estimate from effort limits, likewise: motors do not keep them more exactly."""

_TIP_SHARE: Final = 0.05
"""Error of sensors at the fingertips of a pair of jaws, likewise: better than either estimate,
though they drift."""

_ASKEW: Final = 0.1
"""The same of other fingers: their links meet an object at an angle to one another, of which
sensors without a direction tell nothing, and it shifts between them. In simulation, 75 of 76 grasps
stay within it and half of the difference between the sides."""

_UNEVEN: Final = 0.15
"""What an object weighs along the closing direction makes the sides differ by up to twice this
share of the force. A larger difference comes from fingers that press on one another."""

_SQUEEZES: Final = 0.1
"""An actuator takes part in squeezing if it closes the tips by at least this share of the most
effective one; the others would need efforts smaller than their friction."""

_PRESSES: Final = 0.5
"""Without sensors at the tips, an actuator presses above this share of its effort limit: free
motion takes less."""

_SAGS: Final = 7e-3
"""By how much fingers that bend are off the table where they meet an object, as an error of their
actuator [rad]: springs give way to their weight, and to the force that first shows the contact. In
MuJoCo, a 3-Finger is 1.1 mm too wide to 2.6 mm too narrow at a lever of 0.42 m/rad."""

_FIRST_ORDER: Final = 0.5
"""Error of a correction by levers, as a share of it: levers change over the corrected distance."""

_AHEAD: Final = 0.01
"""A reference presses if it leads by more than this share of the action's travel: above
rounding."""

_LEAST_TRAVEL: Final = 1e-9
"""Below this, the squared travel of the actuators counts as zero [rad² | m²]: dividing by it would
only amplify rounding."""


@dataclass(frozen=True, slots=True)
class Grip:
    """The opening and the force of one action's fingertips.

    Attributes:
        indices: The actuators that the action moves.
        rest: Their positions at intensity 0 [rad | m].
        target: Their positions at intensity 1 [rad | m].
        intensity: Intensities of the table, rising.
        width: Opening at each intensity [m].
        lever: Decrease of the opening per unit of each actuator, at each intensity [m/rad | 1].
        friction: Effort that each actuator loses to dry friction [N·m | N].
        efficiency: Share of each actuator's effort that reaches the fingertips.
        fingers: Indices of the fingers on the first side.
        others: Indices of the fingers on the other sides.
        around: Whether the tips close from more than two sides.
        sheet: Force by effort limit from the device's data sheet, for a single actuator.
        inertia: Inertia of motor and gear at each actuator [kg·m² | kg]; 0: not known.
        empty: Opening at which the empty hand's fingertips meet one another [m].
        strongest: Largest force by the data sheets of fingers whose limits would give more [N].
    """

    indices: tuple[int, ...]
    rest: tuple[float, ...]
    target: tuple[float, ...]
    intensity: tuple[float, ...]
    width: tuple[float, ...]
    lever: tuple[tuple[float, ...], ...]
    friction: tuple[float, ...]
    efficiency: tuple[float, ...]
    fingers: tuple[int, ...]
    others: tuple[int, ...]
    around: bool = False
    sheet: GripForce | None = None
    inertia: tuple[float, ...] = (0.0,)
    empty: float = 0.0
    strongest: float = math.inf

    @classmethod
    def of(
        cls,
        hand: Hand,
        opening: OpeningTable,
        targets: Mapping[int, float],
        grips: Mapping[int, GripForce],
        empty: float,
    ) -> Grip:
        """Return the grip of an action.

        Args:
            hand: The hand.
            opening: The action's table.
            targets: Positions of the action's actuators at intensity 1, by index [rad | m].
            grips: Forces by the devices' data sheets, by actuator index.
            empty: Opening at which the empty hand's fingertips meet one another [m].
        """
        indices = tuple(hand.actuator_index(name) for name in opening.actuators)
        known = [hand.dynamics.get(name, ActuatorDynamics()) for name in opening.actuators]
        names = hand.finger_names
        sides = [[names.index(finger) for finger in side] for side in opening.sides]
        single = grips.get(indices[0]) if len(indices) == 1 else None
        return cls(
            indices,
            tuple(float(hand.rest[i]) for i in indices),
            tuple(targets[i] for i in indices),
            tuple(opening.intensity.tolist()),
            tuple(opening.width.tolist()),
            tuple(tuple(row) for row in opening.lever.tolist()),
            tuple(k.dry_friction or 0.0 for k in known),
            tuple(1.0 if k.efficiency is None else k.efficiency for k in known),
            tuple(sides[0]),
            tuple(finger for side in sides[1:] for finger in side),
            opening.around,
            single,
            # Compliance between motor and fingertip keeps the motor's inertia out of the impact.
            tuple(
                inertia_of(hand.actuators[i], hand.actuators[i].effort, k)
                if k.coupling in (None, Following.RIGID)
                else 0.0
                for i, k in zip(indices, known, strict=True)
            ),
            empty,
            # With tips all around, the force is the sum.
            min((k.finger_force for k in known if k.finger_force), default=math.inf)
            * (len(sides) if opening.around else 1),
        )

    # --- the opening -------------------------------------------------------------------------

    def opening(self, position: Sequence[float]) -> float:
        """Return the opening [m] at positions of all actuators of the hand; ``NaN`` if unknown.

        Interpolates the table at the nearest posture of the action, and corrects by the levers for
        the actuators' distances from that posture.
        """
        share = self._nearest(position)
        # NaN: the action does not move, or a position is not known.
        if share != share:
            return math.nan
        low, high = self.intensity[0], self.intensity[-1]
        at = min(max(share, low), high)
        width = self._interpolated(self.width, at)
        for i, rest, target, lever in zip(
            self.indices, self.rest, self.target, self._levers(at), strict=True
        ):
            # First order in the distance from the action's line; enough for a few degrees.
            width -= lever * (position[i] - rest - at * (target - rest))
        # The levers hold up to contact of the tips; beyond it they would give negative openings.
        return max(width, 0.0)

    def opening_error(self, position: Sequence[float]) -> float:
        """Return how far the opening at some positions may be off [m]; ``NaN`` if it is unknown.

        For fingers that bend, give the positions at which they met an object.
        """
        sags = _SAGS if self.bends and len(self.indices) == 1 else 0.0
        (lever, *_) = self._levers(self.intensity_of(position))
        return self._table_error(position) + sags * abs(lever)

    def doubt(self, position: Sequence[float]) -> float:
        """Return the largest opening that may be measured while the tips touch one another [m]."""
        return max(self.empty, self.width[-1], 0.0) + self._table_error(position)

    def _table_error(self, position: Sequence[float]) -> float:
        """Return the error of the table [m].

        Off the action's line, the table is corrected to first order only: half of the correction is
        uncertain.
        """
        share = self._nearest(position)
        if share != share:
            return math.nan
        at = min(max(share, self.intensity[0]), self.intensity[-1])
        off = abs(max(self._interpolated(self.width, at), 0.0) - self.opening(position))
        table = TABLE if len(self.indices) == 1 else JOINTS
        return table + _FIRST_ORDER * off

    def intensity_of(self, position: Sequence[float]) -> float:
        """Return the intensity of the table whose posture is nearest to actuator positions."""
        share = self._nearest(position)
        return min(max(share, self.intensity[0]), self.intensity[-1])

    def _nearest(self, position: Sequence[float]) -> float:
        """Return the intensity whose posture is nearest to actuator positions."""
        along = length = 0.0
        for i, rest, target in zip(self.indices, self.rest, self.target, strict=True):
            travel = target - rest
            along += (position[i] - rest) * travel
            length += travel * travel
        return along / length if length > _LEAST_TRAVEL else math.nan

    def intensity_at(self, width: float) -> float:
        """Return the intensity of an opening [m], clamped into the table."""
        widths = self.width
        if width >= widths[0]:
            return self.intensity[0]
        if width <= widths[-1]:
            return self.intensity[-1]
        # The widths fall, and `bisect` needs rising values.
        k = bisect_right(widths, -width, key=lambda each: -each) - 1
        share = (widths[k] - width) / (widths[k] - widths[k + 1])
        return self.intensity[k] + share * (self.intensity[k + 1] - self.intensity[k])

    def position_at(self, intensity: float) -> dict[int, float]:
        """Return the actuators' positions at an intensity, by index [rad | m]."""
        return {
            i: rest + intensity * (target - rest)
            for i, rest, target in zip(self.indices, self.rest, self.target, strict=True)
        }

    def width_at(self, intensity: float) -> float:
        """Return the opening at an intensity of the table [m]."""
        return self._interpolated(self.width, intensity)

    def slope_at(self, intensity: float) -> float:
        """Return the decrease of the opening per unit of intensity, at an intensity [m]."""
        k, _ = self._cell(intensity)
        # Over a few cells, since a single cell may be as short as rounding.
        low, high = max(k - 2, 0), min(k + 3, len(self.width) - 1)
        travel = self.intensity[high] - self.intensity[low]
        return (self.width[low] - self.width[high]) / travel

    def error_of(self, width: float, intensity: float) -> float:
        """Return the actuators' error that corresponds to an error of the opening.

        Args:
            width: Error of the opening [m].
            intensity: Where on the action.

        Returns:
            The norm of the errors of all actuators [rad | m], in the worst direction.
        """
        levers = self._levers(intensity)
        return width / max(math.sqrt(sum([lever * lever for lever in levers])), _LEAST_TRAVEL)

    def _cell(self, intensity: float) -> tuple[int, float]:
        grid = self.intensity
        k = min(max(bisect_right(grid, intensity) - 1, 0), len(grid) - 2)
        return k, (intensity - grid[k]) / (grid[k + 1] - grid[k])

    def _interpolated(self, column: Sequence[float], intensity: float) -> float:
        k, share = self._cell(intensity)
        return column[k] + share * (column[k + 1] - column[k])

    def _levers(self, intensity: float) -> list[float]:
        k, share = self._cell(intensity)
        return [a + share * (b - a) for a, b in zip(self.lever[k], self.lever[k + 1], strict=True)]

    @property
    def bends(self) -> bool:
        """Whether the fingers bend, so that the mass that moves with them is not known."""
        return not all(self.inertia)

    def moving_mass(self, intensity: float) -> float:
        """Return the mass that moves with the fingers, referred to the opening [kg], or ``NaN``.

        A force on the tips accelerates each actuator by its lever and inertia.
        """
        levers = self._levers(intensity)
        if self.bends:
            return math.nan
        gives = sum([lever * lever / i for lever, i in zip(levers, self.inertia, strict=True)])
        return 1.0 / gives if gives > 0.0 else math.nan

    # --- the force ---------------------------------------------------------------------------

    def squeezing(self, intensity: float) -> list[tuple[int, int, float]]:
        """Return the actuators that press the tips together at an intensity.

        Returns:
            For each actuator its place in ``indices``, its index in the hand, and the size of its
            lever [m/rad | 1].
        """
        closes = [
            lever * (target - rest)
            for lever, rest, target in zip(
                self._levers(intensity), self.rest, self.target, strict=True
            )
        ]
        least = max(_SQUEEZES * max(closes), _LEAST_TRAVEL)
        # With tips all around, the opening is a diameter: each tip closes by half of it.
        share = 0.5 if self.around else 1.0
        levers = self._levers(intensity)
        return [
            (k, self.indices[k], share * abs(levers[k]))
            for k, by in enumerate(closes)
            if by >= least
        ]

    def forces(self, hand: Hand, intensity: float) -> tuple[float, float]:
        """Return the weakest and the strongest force that can be requested at an intensity [N]."""
        if self.sheet is not None:
            where = self.position_at(intensity)[self.indices[0]]
            low, high = self.sheet.range_at(where)
            limit = hand.actuators[self.indices[0]].effort
            if limit < self.sheet.effort[1]:
                high = self.sheet.force_for(limit, where)
            return low, high
        strongest = math.inf
        for k, i, lever in self.squeezing(intensity):
            # The weakest actuator decides, since the others can press less.
            left = hand.actuators[i].effort - self.friction[k]
            strongest = min(strongest, max(left, 0.0) * self.efficiency[k] / lever)
        return 0.0, min(strongest, self.strongest)

    def efforts(self, force: float, intensity: float) -> dict[int, float]:
        """Return the effort limits [N·m | N] for a force [N] at an intensity, by actuator index."""
        if self.sheet is not None:
            where = self.position_at(intensity)[self.indices[0]]
            return {self.indices[0]: self.sheet.effort_for(force, where)}
        return {
            i: force * lever / self.efficiency[k] + self.friction[k]
            for k, i, lever in self.squeezing(intensity)
        }

    def effort_slopes(self, intensity: float) -> dict[int, float]:
        """Return the effort per newton of force [N·m/N | 1] at an intensity, by actuator index."""
        if self.sheet is not None:
            where = self.position_at(intensity)[self.indices[0]]
            low, high = self.sheet.range_at(where)
            span = self.sheet.effort[1] - self.sheet.effort[0]
            return {self.indices[0]: span / (high - low)}
        return {i: lever / self.efficiency[k] for k, i, lever in self.squeezing(intensity)}

    def touches(
        self,
        position: Sequence[float],
        effort: Sequence[float],
        limits: Sequence[float],
        touch: Sequence[float],
        least: float,
    ) -> bool:
        """Return whether the tips seem to press on something from both sides.

        Args:
            position: Positions of all actuators of the hand [rad | m].
            effort: Measured efforts [N·m | N]; ``NaN``: not measured.
            limits: Effort limits sent [N·m | N].
            touch: Forces at the fingertips [N], if they are measured.
            least: Least force at which a fingertip counts as touching [N].
        """
        sides = ([touch[i] for i in side if i < len(touch)] for side in (self.fingers, self.others))
        felt = rules.both_sides_touch(sides, least)
        if felt is not None:
            return felt
        share = self._nearest(position)
        if share != share:
            return False
        chosen = self.squeezing(min(max(share, self.intensity[0]), self.intensity[-1]))
        return any(abs(effort[i]) >= _PRESSES * limits[i] for _, i, _ in chosen)

    def feels(self, touch: Sequence[float], least: float) -> bool:
        """Return whether any fingertip touches, by sensors.

        Args:
            touch: Forces at the fingertips [N], if they are measured.
            least: Least force at which a fingertip counts as touching [N].
        """
        return any(touch[i] >= least for i in (*self.fingers, *self.others) if i < len(touch))

    def tip_force(self, touch: Sequence[float]) -> float:
        """Return the force that sensors at the fingertips measure [N]; ``NaN``: not at all of them.

        Both sides press on an object with the same force, except that one of them also bears its
        weight along the closing direction: the force between them is their mean.
        """
        one, other = self._sides_felt(touch)
        if self.around:
            return one + other
        # A side that is not measured is NaN, which `min` would lose as its second argument.
        return min(0.5 * (one + other), (1.0 + _UNEVEN) * min(one, other))

    def tip_error(self, touch: Sequence[float]) -> float:
        """Return the error of `tip_force` [N]: that of the sensors, and how the sides differ."""
        one, other = self._sides_felt(touch)
        share = _TIP_SHARE if self._jaws else _ASKEW
        return share * self.tip_force(touch) + (0.0 if self.around else 0.5 * abs(one - other))

    def _sides_felt(self, touch: Sequence[float]) -> tuple[float, float]:
        """Return the force on the fingers of either side, by sensors [N]; ``NaN``: not measured."""
        if not touch or max(*self.fingers, *self.others) >= len(touch):
            return math.nan, math.nan
        return sum([touch[i] for i in self.fingers]), sum([touch[i] for i in self.others])

    @property
    def _jaws(self) -> bool:
        """Whether one actuator moves two fingers against each other."""
        return len(self.indices) == 1 and len(self.fingers) + len(self.others) == 2

    def force(
        self,
        position: Sequence[float],
        effort: Sequence[float],
        limits: Sequence[float],
        touch: Sequence[float],
        pressing: bool,
        met: Sequence[float] = (),
    ) -> tuple[float, float, str]:
        """Return the force between the tips and its error [N], and the source of the figure.

        Fingers that bend go on after the tips have met the object, beyond the posture for which the
        table gives their levers. The change of the levers since then adds to the error; if it is
        too large, the force is not known.

        Args:
            position: Positions of all actuators of the hand [rad | m].
            effort: Measured efforts [N·m | N]; ``NaN``: not measured.
            limits: Effort limits sent [N·m | N].
            touch: Forces at the fingertips [N], if they are measured.
            pressing: Whether actuators are known to be blocked, so that they exert their limits.
            met: Positions at which fingers that bend met the object [rad | m]; empty: not known.

        Returns:
            Force and error, ``NaN`` if unknown, and `TIPS`, `DEVICE`, `EFFORT`, `LIMIT` or nothing.
        """
        felt = self.tip_force(touch)
        if felt == felt:
            return felt, self.tip_error(touch), TIPS
        share = self._nearest(position)
        if share != share:
            return math.nan, math.nan, ""
        at = min(max(share, self.intensity[0]), self.intensity[-1])
        chosen = self.squeezing(at)
        if self.sheet is not None and effort[self.indices[0]] == effort[self.indices[0]]:
            i = self.indices[0]
            force = self.sheet.force_for(abs(effort[i]), position[i])
            return force, _EFFORT_SHARE * force, DEVICE
        if self.around and self.sheet is None:
            # With fingers all around, efforts do not show how many press.
            return math.nan, math.nan, ""
        found = self._by_levers(chosen, position, effort, limits, pressing)
        share = self._nearest(met) if met else math.nan
        if share != share or not found[2] or self.sheet is not None:
            return found
        force, error, source = found
        before = self.squeezing(min(max(share, self.intensity[0]), self.intensity[-1]))
        unbent = self._by_levers(before, position, effort, limits, pressing)[0]
        off = abs(force - unbent)
        if off > ELSEWHERE * min(force, unbent):
            return math.nan, math.nan, ""
        return force, error + off, source

    def _shared(self, chosen: Sequence[tuple[int, int, float]]) -> bool:
        """Return whether more than two fingers share the effort of one motor of `squeezing`."""
        return len(chosen) <= 1 and len(self.fingers) + len(self.others) != 2

    def _by_levers(
        self,
        chosen: Sequence[tuple[int, int, float]],
        position: Sequence[float],
        effort: Sequence[float],
        limits: Sequence[float],
        pressing: bool,
    ) -> tuple[float, float, str]:
        """Return the force, its error and its source, as `force`, by levers of `squeezing`."""
        if chosen and all(effort[i] == effort[i] for _, i, _ in chosen):
            return self._from_efforts(chosen, effort)
        if pressing and chosen and all(math.isfinite(limits[i]) for _, i, _ in chosen):
            if self.sheet is not None:
                i = self.indices[0]
                force = self.sheet.force_for(limits[i], position[i])
            else:
                force = min(
                    max(limits[i] - self.friction[k], 0.0) * self.efficiency[k] / lever
                    for k, i, lever in chosen
                )
            return force, _LIMIT_SHARE * force, LIMIT
        return math.nan, math.nan, ""

    def _from_efforts(
        self, chosen: Sequence[tuple[int, int, float]], effort: Sequence[float]
    ) -> tuple[float, float, str]:
        """Return the force that fits measured efforts best, by least squares."""
        along = square = lost = 0.0
        for k, i, lever in chosen:
            closing = math.copysign(1.0, self.target[k] - self.rest[k])
            # An effort that opens the fingers does not press.
            held = max(effort[i] * closing, 0.0)
            along += lever * max(held - self.friction[k], 0.0) * self.efficiency[k]
            lost += lever * self.friction[k] * self.efficiency[k]
            square += lever * lever
        # The force f that minimises the sum of (lever·f - effort)².
        force = along / square
        share = _SHARED if self._shared(chosen) else _EFFORT_SHARE
        return force, lost / square + share * force, EFFORT


def grip_at(grip: Grip | None, record: TickRecord) -> tuple[float, float, float, str]:
    """Return the opening [m], the force and its error [N], and the source of the force.

    ``grip`` is that of the last goal with an opening or a force. The publisher and the recorder
    call this in their own threads, so that the loop needn't.
    """
    if grip is None:
        return math.nan, math.nan, math.nan, ""
    position, effort = record.position.tolist(), record.effort.tolist()
    limits = record.reference_effort.tolist()
    felt = [values for name, values in record.channels.items() if name.endswith(f"/{TIP_FORCE}")]
    # An actuator that holds an object presses if its reference leads further into the object.
    ahead = record.reference_position - record.position
    pressing = any(
        ahead[i] * (target - rest) > _AHEAD * (target - rest) ** 2 and record.grasped[i] == 1
        for i, rest, target in zip(grip.indices, grip.rest, grip.target, strict=True)
    )
    met = record.channels[MET].tolist() if MET in record.channels else []
    force, error, source = grip.force(position, effort, limits, tip_forces(felt), pressing, met)
    known = record.channels.get(GRIP_FORCE)
    if known is not None and source:
        # By finger, and without what weight and friction take, as in the result.
        force, error = known.tolist()
        if error != error:
            force, source = math.nan, ""
    return grip.opening(met or position), force, error, source
