"""A plan for the controller: the legs of a motion with their limits, checked before it moves."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

from rtee.actions.types import Posture
from rtee.hand.model import Hand
from rtee.loop.grip import Grip
from rtee.types import Aim, Around, FirstContact, Force, Intensity, OnContact, Opening, from_rest


@dataclass(frozen=True, slots=True)
class Leg:
    """One motion to a set of set-points.

    Attributes:
        name: Alias of the inner action of a timed action, else empty.
        targets: Position by actuator index [rad | m], inside the limits.
        before: Time to wait before the motion [s].
        after: Time to wait after the motion [s].
    """

    name: str
    targets: Mapping[int, float]
    before: float = 0.0
    after: float = 0.0


@dataclass(frozen=True, slots=True)
class Plan:
    """A checked goal in numbers, independent of the hand's actions and files.

    Attributes:
        goal_id: The goal.
        action: Name of the action, as the library writes it.
        elements: Elements of the action.
        legs: The motions, one after the other.
        involved: Indices of the actuators that move.
        effort: Effort limits of the goal by actuator index [N·m | N].
        timeout: Longest time [s].
        to: The goal's target, which decides when the goal is reached.
        speed: Share of the velocity limits.
        force: The force between the fingertips, if one is asked for.
        on_contact: Reaction to a contact, by finger; "": that of all other fingers.
        timed: Whether the legs are inner actions.
        grip: Computes opening and force of the fingertips, for an action that has an opening.
        meets: Positions of actuators beyond which the empty hand may touch itself on the action's
            path, by index [rad | m]; empty: not known.
        lag: Delay of its actuators behind their references, where the force depends on how far
            these lead into the object [s]; 0: not known.
    """

    goal_id: str
    action: str
    elements: tuple[str, ...]
    legs: tuple[Leg, ...]
    involved: frozenset[int]
    effort: Mapping[int, float]
    timeout: float
    to: Intensity | Opening | Around | FirstContact
    speed: float = 1.0
    force: Force | None = None
    on_contact: Mapping[str, OnContact] = field(default_factory=dict)
    timed: bool = False
    grip: Grip | None = None
    meets: Mapping[int, float] = field(default_factory=dict)
    lag: float = 0.0

    @property
    def aim(self) -> Aim:
        """The aim of the goal, which decides whether it has succeeded."""
        if isinstance(self.to, FirstContact):
            return Aim.CONTACT
        holds = isinstance(self.to, Around) or OnContact.SQUEEZE in self.on_contact.values()
        return Aim.OBJECT if holds else Aim.POSTURE

    @property
    def by_depth(self) -> bool:
        """Whether the force depends on how far references lead into the object.

        Lag then adds to the impact. With a single actuator, or a force in a data sheet, effort
        limits bound the force instead.
        """
        return len(self.effort) > 1 and self.grip is not None and self.grip.sheet is None

    @property
    def width(self) -> float | None:
        """The requested opening, or the given width of the object [m]."""
        return self.to.width if isinstance(self.to, Opening | Around) else None

    def only(self, indices: Collection[int]) -> Plan:
        """Return the plan for some of its actuators only; legs without any are left out."""
        legs = [
            replace(leg, targets={i: t for i, t in leg.targets.items() if i in indices})
            for leg in self.legs
        ]
        left = tuple(leg for leg in legs if leg.targets)
        return replace(self, legs=left, involved=self.involved.intersection(indices))


def targets_of(posture: Posture, hand: Hand, intensity: float = 1.0) -> dict[int, float]:
    """Return the positions of a posture at an intensity, by actuator index [rad | m]."""
    targets: dict[int, float] = {}
    for name in posture.involved:
        index = hand.actuator_index(name)
        spec = hand.actuators[index]
        wanted = from_rest(spec.rest, posture.position[name], intensity)
        # Calibration may have narrowed the limits since the action was made.
        targets[index] = min(max(wanted, spec.lower), spec.upper)
    return targets
