"""The openings of a running hand's actions, and the forces that goals may request with them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rtee.actions.library import ActionLibrary
from rtee.actions.openings import OpeningTable, meeting
from rtee.actions.types import Action
from rtee.loop.devices import device_forces
from rtee.loop.forces import DeviceForces, unlimited
from rtee.loop.grip import Grip
from rtee.loop.plan import targets_of
from rtee.loop.supervisor import Supervisor
from rtee.remote.hand_info import HandInfo
from rtee.sample import FloatArray
from rtee.values import Value

_NO_FORCE = 1e-3
"""A force of this size counts as none [N]: no device limits its effort so finely."""


@dataclass(frozen=True)
class OpeningRange(Value):
    """The openings and forces that goals may request with one action.

    Attributes:
        action: Name of the action.
        elements: Elements of a primitive.
        intensity: Intensities ``(k,)``, rising.
        opening: The opening at each intensity ``(k,)`` [m], falling.
        least_force: Weakest force that can be requested at any opening [N].
        most_force: Strongest force that can be requested at any opening [N].
        unlimited: Why no force can be requested, in words; empty if one can.
        least_forces: Weakest force at each of the openings ``(k,)`` [N].
        most_forces: Strongest force at each of the openings ``(k,)`` [N]; ``inf`` where no effort
            limits it, so that none can be requested.
    """

    action: str
    elements: tuple[str, ...]
    intensity: FloatArray
    opening: FloatArray
    least_force: float
    most_force: float
    unlimited: str
    least_forces: FloatArray
    most_forces: FloatArray

    @property
    def widest(self) -> float:
        """The largest opening [m]."""
        return float(self.opening[0])

    @property
    def narrowest(self) -> float:
        """The smallest opening [m]."""
        return float(self.opening[-1])

    def at(self, intensity: float) -> float:
        """Return the opening at an intensity [m], clamped into the table."""
        return float(np.interp(intensity, self.intensity, self.opening))

    def intensity_at(self, opening: float) -> float:
        """Return the intensity of an opening [m], clamped into the table."""
        return float(np.interp(-opening, -self.opening, self.intensity))

    def forces_at(self, opening: float) -> tuple[float, float]:
        """Return the weakest and the strongest force that can be requested at an opening [N].

        Between two openings of the table, the strongest one does not exceed the hand's. Both are 0
        where no force can be requested.

        Args:
            opening: The opening [m], clamped into the table.
        """
        widths = -self.opening
        low = float(np.interp(-opening, widths, self.least_forces))
        # A force is an effort divided by a lever. Levers are interpolated linearly, so the
        # reciprocal of the force is, too.
        most = np.where(np.isfinite(self.most_forces), self.most_forces, 0.0)
        weakness = 1.0 / np.maximum(most, _NO_FORCE)
        high = 1.0 / float(np.interp(-opening, widths, weakness))
        return (low, high) if high > max(low, 2.0 * _NO_FORCE) else (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class GripLimits(Value):
    """Range of openings, forces and speeds for goals, over all actions with an opening.

    Attributes:
        width: Least and largest opening of the fingertips [m].
        force: Weakest and strongest force between them [N]; ``None``: none can be asked for.
        speed: Fastest change of the opening [m/s].
    """

    width: tuple[float, float]
    force: tuple[float, float] | None
    speed: float


def limits_of(
    ranges: Sequence[OpeningRange], actions: Iterable[Action], info: HandInfo
) -> GripLimits:
    """Return the limits over some ranges, at least one.

    The opening of an action changes fastest where its table is steepest, while the slowest of its
    actuators moves at its velocity limit.
    """
    postures = {(each.name, each.elements): each.waypoints[-1] for each in actions}
    known = {actuator.name: actuator for actuator in info.actuators}
    fastest = 0.0
    for each in ranges:
        posture = postures[each.action, each.elements]
        travels = {
            name: abs(posture.position[name] - known[name].rest) for name in posture.involved
        }
        rate = min(
            (known[name].velocity / travel for name, travel in travels.items() if travel),
            default=0.0,
        )
        slopes = np.abs(np.diff(each.opening) / np.diff(each.intensity))
        fastest = max(fastest, rate * float(slopes.max()))
    forces = [each for each in ranges if not each.unlimited]
    return GripLimits(
        (min(each.narrowest for each in ranges), max(each.widest for each in ranges)),
        (min(f.least_force for f in forces), max(f.most_force for f in forces)) if forces else None,
        fastest,
    )


def opening_fields(library: ActionLibrary, devices: Iterable[Supervisor]) -> dict[str, Any]:
    """Return the fields of a ``rtee_msgs/OpeningList`` with all actions of up-to-date openings.

    Raises `ConfigError` if the file of the openings is malformed.
    """
    forces = device_forces(library.hand, devices)
    entries = [
        _fields(library, action, opening, forces)
        for action in library
        if (opening := library.openings.find(action)) is not None
    ]
    return {"openings": entries}


def _fields(
    library: ActionLibrary, action: Action, opening: OpeningTable, forces: DeviceForces
) -> dict[str, Any]:
    hand = library.hand
    targets = targets_of(action.waypoints[-1], hand)
    empty = meeting(action, opening, library, library.openings)
    grip = Grip.of(hand, opening, targets, forces.grips, empty)
    reason = unlimited(hand, opening, grip, grip.intensity[0], forces)
    ranges = [(0.0, 0.0) if reason else grip.forces(hand, at) for at in grip.intensity]
    low, high = zip(*ranges, strict=True)
    return {
        "action": action.name,
        "elements": action.elements,
        "intensity": opening.intensity,
        "opening": opening.width,
        "least_force": min(low),
        "most_force": max((force for force in high if force < math.inf), default=0.0),
        "unlimited": reason,
        "least_forces": low,
        "most_forces": high,
    }


def opening_of(fields: Mapping[str, Any]) -> OpeningRange:
    """Return the range in the fields of a ``rtee_msgs/Opening``."""
    return OpeningRange(**{**fields, "elements": tuple(fields["elements"])})
