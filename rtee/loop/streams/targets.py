"""Resolve the names in the samples of a stream: actuators, joints, or actions with elements.

A blend of actions adds up their displacements from rest, each scaled by its intensity, and clamps
the sum into the limits. Synergies (Santello, Flanders and Soechting 1998) and eigengrasps
(Ciocarlie and Allen 2009) combine postures in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

from rtee.actions.types import ActionReference, Timed
from rtee.errors import ActionError, GoalRejected, UnknownAction, suggestion
from rtee.hand.model import Hand
from rtee.types import ActuatorSpec, JointKind

if TYPE_CHECKING:
    from rtee.actions.library import ActionLibrary
    from rtee.hand.transmission import Coupling

FAR = 0.5
"""A position further beyond the limits than this share of the range is a mistake, such as degrees
for radians. Anything closer, such as from a glove, is clamped."""

_FAST = 20.0
"""A velocity above this multiple of the limit is a mistake, too; a lower one is clamped."""

_AGREE = 1e-2
"""Tolerated difference between the positions that two joints require of their actuator, as a share
of its range: clients round their numbers."""

_STEPS = 60
"""Bisections of the range in the search for a joint's position: enough for the precision of a
double."""


@dataclass(frozen=True, slots=True)
class _Joint:
    """A joint that one actuator moves; ``coupling``: the map from the actuator to the joint."""

    name: str
    index: int
    coupling: Coupling | None

    def actuator(self, value: float, spec: ActuatorSpec) -> float:
        """Return the actuator's position for a position of the joint [rad | m]."""
        coupling = self.coupling
        if coupling is None:
            return value
        low, high = spec.lower, spec.upper
        if coupling.linear or not (math.isfinite(low) and math.isfinite(high)):
            at, slope = coupling.dual(spec.rest)
            return spec.rest + (value - at) / slope
        rising = coupling.value(high) > coupling.value(low)
        ends = sorted((coupling.value(low), coupling.value(high)))
        share = (value - ends[0]) / (ends[1] - ends[0])
        if not 0.0 <= share <= 1.0:  # beyond the range, by the same share as the joint
            return low + (share if rising else 1.0 - share) * (high - low)
        for _ in range(_STEPS):
            middle = 0.5 * (low + high)
            if (coupling.value(middle) < value) == rising:
                low = middle
            else:
                high = middle
        return 0.5 * (low + high)

    def rate(self, velocity: float, at: float) -> float:
        """Return the actuator's velocity for a velocity of the joint [rad/s | m/s]."""
        if self.coupling is None:
            return velocity
        slope = self.coupling.dual(at)[1]
        # Where the joint reverses, no velocity of the actuator moves it.
        return velocity / slope if slope else math.nan


@dataclass(frozen=True, slots=True)
class _Blend:
    """An action: its actuators' displacements from rest at intensity 1, by index [rad | m]."""

    name: str
    displacement: Mapping[int, float]


class Targets:
    """The actuators behind the names of a sample; made once for samples with the same names.

    Attributes:
        indices: The actuators that the names refer to.

    Raises:
        GoalRejected: if a name is unknown or cannot be a target, or two refer to one actuator.
    """

    def __init__(self, names: Sequence[str], hand: Hand, library: ActionLibrary) -> None:
        self._hand = hand
        self._names = tuple(names)
        self._joints: list[_Joint] = []
        self._blends: list[_Blend] = []
        for name in names:
            self._add(name, library)
        blended = {i for blend in self._blends for i in blend.displacement}
        for joint in self._joints:
            if joint.index in blended:
                raise GoalRejected(
                    f"'{hand.actuator_names[joint.index]}' is given twice: by '{joint.name}' and "
                    "by an action"
                )
        self.indices = frozenset(blended | {joint.index for joint in self._joints})

    def _add(self, name: str, library: ActionLibrary) -> None:
        hand = self._hand
        if name in hand.actuator_names:
            self._joints.append(_Joint(name, hand.actuator_index(name), None))
        elif name in hand.joint_names:
            row = hand.joint_names.index(name)
            index = hand.transmission.moves(row)
            if index is None:
                raise GoalRejected(f"no actuator moves the joint '{name}': it cannot be a target")
            coupling = hand.transmission.couplings[row]
            self._check_inverse(name, coupling, hand.actuators[index])
            self._joints.append(_Joint(name, index, coupling))
        else:
            self._blends.append(self._blend(name, library))

    @staticmethod
    def _check_inverse(name: str, coupling: Coupling, spec: ActuatorSpec) -> None:
        """Refuse a joint that has the same position at several positions of its actuator."""
        from rtee.hand.transmission import sample

        if coupling.linear:
            return
        values = [coupling.value(q) for q in sample(spec.lower, spec.upper)]
        steps = [b - a for a, b in pairwise(values)]
        if not (all(step > 0.0 for step in steps) or all(step < 0.0 for step in steps)):
            raise GoalRejected(
                f"the joint '{name}' has the same position at several positions of '{spec.name}'; "
                f"give '{spec.name}' instead"
            )

    def _blend(self, name: str, library: ActionLibrary) -> _Blend:
        hand = self._hand
        try:
            action, *elements = name.split() or [""]
            plain = elements and not {":", "*"} & {*name}  # as in "PinchTight index thumb"
            use = ActionReference.of(action, elements) if plain else ActionReference.of(name)
            found = library.find(use.action, use.elements)
        except UnknownAction:
            known = [*hand.actuator_names, *hand.joint_names, *library.names]
            raise GoalRejected(
                f"'{name}' is neither an actuator nor a joint nor an action; "
                f"{suggestion(name, set(known))}"
            ) from None
        except ActionError as error:
            raise GoalRejected(error.message) from None
        if isinstance(found, Timed):
            raise GoalRejected(f"'{name}' is a timed action, which has no intensity to stream")
        posture, rest = found.posture, hand.rest
        indices = [hand.actuator_index(each) for each in posture.involved]
        names = hand.actuator_names
        travels = {i: posture.position[names[i]] - float(rest[i]) for i in indices}
        return _Blend(name, {i: use.scale * travel for i, travel in travels.items()})

    def resolve(
        self, values: Mapping[str, float], velocity: Mapping[str, float]
    ) -> tuple[dict[int, float], dict[int, float]]:
        """Return positions and, where given, velocities by actuator index.

        Args:
            values: Positions by name [rad | m], for actions the intensity.
            velocity: Velocities by name [rad/s | m/s], for actions [1/s]; may be incomplete.

        Raises:
            GoalRejected: if a value is not plausible.
        """
        for name in velocity:
            if name not in values:
                raise GoalRejected(f"'{name}' has a velocity but no position")
        for number in (*values.values(), *velocity.values()):
            if not math.isfinite(number):
                raise GoalRejected(f"a sample consists of finite numbers, not {number:g}")
        positions: dict[int, float] = {}
        rates: dict[int, float] = {}
        for joint in self._joints:
            self._join(joint, values[joint.name], velocity.get(joint.name), positions, rates)
        if self._blends:
            self._add_blends(values, velocity, positions, rates)
        return positions, rates

    def _join(
        self,
        joint: _Joint,
        value: float,
        speed: float | None,
        positions: dict[int, float],
        rates: dict[int, float],
    ) -> None:
        index = joint.index
        spec = self._hand.actuators[index]
        at = joint.actuator(value, spec)
        span = spec.upper - spec.lower
        revolute = spec.kind is not JointKind.PRISMATIC
        if math.isfinite(span) and not (spec.lower - FAR * span <= at <= spec.upper + FAR * span):
            unit, other = ("rad", "degrees") if revolute else ("m", "millimetres")
            of = "" if joint.coupling is None else f" (of '{spec.name}': {at:g} {unit})"
            raise GoalRejected(
                f"{value:g} {unit} of '{joint.name}'{of} is far beyond the limits "
                f"{spec.lower:g} to {spec.upper:g} {unit}; are these {other}?"
            )
        if index in positions and abs(positions[index] - at) > _AGREE * span:
            raise GoalRejected(
                f"'{joint.name}' and another target need different positions of '{spec.name}', "
                f"which moves both: {at:g} and {positions[index]:g}"
            )
        positions.setdefault(index, at)
        if speed is not None:
            rate = joint.rate(speed, at)
            if abs(rate) > _FAST * spec.velocity:
                raise GoalRejected(
                    f"the velocity {speed:g} of '{joint.name}' is far beyond its limit "
                    f"{spec.velocity:g} {'rad' if revolute else 'm'}/s"
                )
            rates.setdefault(index, rate)

    def _add_blends(
        self,
        values: Mapping[str, float],
        velocity: Mapping[str, float],
        positions: dict[int, float],
        rates: dict[int, float],
    ) -> None:
        """Sum the displacements from rest of all actions."""
        rest = self._hand.rest
        # An action without a velocity makes those of the actuators it shares unknown, too.
        given = all(blend.name in velocity for blend in self._blends)
        for blend in self._blends:
            intensity = values[blend.name]
            if not -FAR <= intensity <= 1.0 + FAR:
                raise GoalRejected(
                    f"the intensity of '{blend.name}' must be 0 to 1, not {intensity:g}"
                )
            intensity = min(max(intensity, 0.0), 1.0)  # a glove overshoots a little
            for i, displacement in blend.displacement.items():
                positions[i] = positions.get(i, float(rest[i])) + intensity * displacement
                if given:
                    rates[i] = rates.get(i, 0.0) + velocity[blend.name] * displacement
        for blend in self._blends:
            for i in blend.displacement:
                spec = self._hand.actuators[i]
                positions[i] = min(max(positions[i], spec.lower), spec.upper)
