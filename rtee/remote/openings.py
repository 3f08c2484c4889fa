"""The openings of a running hand's actions, and the forces that can be asked for with them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rtee.actions.library import ActionLibrary
from rtee.actions.openings import Opening
from rtee.actions.types import Action
from rtee.errors import ActionError
from rtee.loop.devices import device_forces
from rtee.loop.grip import Grip
from rtee.loop.opening_plan import DeviceForces, force_range
from rtee.loop.supervisor import Supervisor
from rtee.sample import FloatArray


@dataclass(frozen=True, eq=False)
class OpeningRange:
    """Openings and forces that goals with one action may ask for.

    Attributes:
        action: Name of the action.
        elements: Elements of a primitive.
        intensity: Intensities ``(k,)``, rising.
        opening: The opening there ``(k,)`` [m], falling.
        least_force: Weakest force that can be asked for at some opening [N].
        most_force: Strongest force that can be asked for at some opening [N].
        unlimited: Why no force can be asked for, in words; empty if one can.
    """

    action: str
    elements: tuple[str, ...]
    intensity: FloatArray
    opening: FloatArray
    least_force: float
    most_force: float
    unlimited: str

    @property
    def widest(self) -> float:
        """The largest opening [m]."""
        return float(self.opening[0])

    @property
    def narrowest(self) -> float:
        """The smallest opening [m]."""
        return float(self.opening[-1])

    def at(self, intensity: float) -> float:
        """Return the opening at an intensity [m]; beyond the table, that at its end."""
        return float(np.interp(intensity, self.intensity, self.opening))

    def intensity_at(self, opening: float) -> float:
        """Return the intensity of an opening [m]; beyond the table, that at its end."""
        return float(np.interp(-opening, -self.opening, self.intensity))


def opening_fields(library: ActionLibrary, devices: Iterable[Supervisor]) -> dict[str, Any]:
    """Return the fields of a ``rtee_msgs/OpeningList``: of all actions with an up-to-date opening.

    Args:
        library: The hand's actions.
        devices: Its devices.

    Raises:
        ConfigError: if the file of the openings holds something else.
    """
    forces, found = device_forces(library.hand, devices), []
    openings = library.openings
    for action in library:
        try:
            found.append(_fields(library, action, openings.of(action), forces))
        except ActionError:  # it has none, or one that is out of date: a goal says which
            continue
    return {"openings": found}


def _fields(
    library: ActionLibrary, action: Action, opening: Opening, forces: DeviceForces
) -> dict[str, Any]:
    hand, last = library.hand, action.waypoints[-1]
    targets = {hand.actuator_index(name): last.position[name] for name in last.involved}
    grip = Grip.of(hand, opening, targets, forces.grips)
    least, most, unlimited = force_range(hand, opening, grip, forces)
    return {
        "action": action.name,
        "elements": action.elements,
        "intensity": opening.intensity,
        "opening": opening.width,
        "least_force": least,
        "most_force": most,
        "unlimited": unlimited,
    }


def opening_of(fields: Mapping[str, Any]) -> OpeningRange:
    """Return what the fields of a ``rtee_msgs/Opening`` say."""
    return OpeningRange(**{**fields, "elements": tuple(fields["elements"])})
