"""The input of a controller at a tick: the newest measurements of all actuators and fingers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtee.sample import FloatArray, Measurements

TIP_FORCE = "contact_force"
"""The channel of a device's state with the contact force on every finger of the hand [N], summed
over all links of the finger."""

GRIP_FORCE = "loop/grip_force"
"""The channel with the force between fingertips at rest, and its error [N]: only the controller
knows it, since it has seen the efforts of the fingers before they touched."""

MET = "loop/met"
"""The channel with the positions of all actuators at which fingers that bend met what they hold
[rad | m]; ``NaN``: not known. From there on, they no longer give the fingers' posture."""


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
                quantities that a device does not measure, are converted only once.
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
    forces: list[float] = merged.tolist()
    return forces
