"""Which efforts and forces the devices of a hand can limit, and those that a goal asks for."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from rtee.actions.openings import OpeningTable
from rtee.drivers.capabilities import GripForce
from rtee.errors import GoalRejected, suggestion
from rtee.hand.model import Hand
from rtee.loop.grip import Grip


@dataclass(frozen=True, slots=True)
class DeviceForces:
    """Efforts and forces that the devices of a hand can limit; by default all efforts.

    Attributes:
        refused: Reason why a device takes no effort limit, in words or empty, by actuator index.
        grips: Forces in the devices' data sheets, by actuator index.
        unlimited: Actuators whose effort their device cannot limit, though it limits others.
    """

    refused: Mapping[int, str] = field(default_factory=dict)
    grips: Mapping[int, GripForce] = field(default_factory=dict)
    unlimited: frozenset[int] = frozenset()


def effort_limits(
    efforts: Mapping[str, float], hand: Hand, refused: Mapping[int, str]
) -> dict[int, float]:
    """Return the effort limits of a goal or a stream, by actuator index [N·m | N].

    Args:
        efforts: The limits by name [N·m | N].
        hand: The hand.
        refused: Reason why a device takes no effort limit, in words or empty, by actuator index.

    Raises:
        GoalRejected: if a limit cannot be used.
    """
    limits: dict[int, float] = {}
    for name, value in efforts.items():
        if name not in hand.actuator_names:
            raise GoalRejected(
                f"effort for an unknown actuator '{name}'; {suggestion(name, hand.actuator_names)}"
            )
        index = hand.actuator_index(name)
        most = hand.actuators[index].effort
        if not 0.0 < value <= most:
            raise GoalRejected(
                f"the effort limit of '{name}' must be above 0 and at most {most:g}, not {value:g}"
            )
        if reason := _refusal(hand, index, refused):
            raise GoalRejected(reason)
        limits[index] = float(value)
    return limits


def force_efforts(
    force: float, at: float, hand: Hand, opening: OpeningTable, grip: Grip, devices: DeviceForces
) -> dict[int, float]:
    """Return the effort limits for a force between the tips, by actuator index [N·m | N].

    Args:
        force: The force [N].
        at: Intensity at which it is exerted.
        hand: The hand.
        opening: The action's table.
        grip: The action's grip.
        devices: Which efforts and forces its devices can limit.

    Raises:
        GoalRejected: if the force cannot be exerted, or limited; the sentence names the nearest.
    """
    low, high = grip.forces(hand, at)
    # A rounding error at the ends is not worth a refusal.
    if not low * (1.0 - 1e-9) <= force <= high * (1.0 + 1e-9):
        raise GoalRejected(_beyond(force, low, high, opening.label, grip.width_at(at)))
    if reason := unlimited(hand, opening, grip, at, devices):
        raise GoalRejected(reason)
    return grip.efforts(force, at)


def _beyond(force: float, low: float, high: float, label: str, width: float) -> str:
    nearest, reason = (high, "most") if force > high else (low, "least")
    return (
        f"{label} gives at {reason} {nearest:.3g} N at an opening of {width * 1e3:.3g} mm, "
        f"not {force:g} N; the nearest is {nearest:.3g} N"
    )


def unlimited(
    hand: Hand, opening: OpeningTable, grip: Grip, at: float, devices: DeviceForces
) -> str:
    """Return why no force of an action can be limited at an intensity, in words; empty if one can.

    Actuators and devices without limits refuse every force.
    """
    if math.isinf(grip.forces(hand, at)[1]):
        return (
            f"{opening.label}: the force cannot be limited: its actuators have no effort limits; "
            "give some under 'limits' in hand.yaml"
        )
    presses = grip.effort_slopes(at)
    nearest = "the nearest is the same without a force"
    for i in presses:
        if reason := _refusal(hand, i, devices.refused):
            return f"{reason}; {nearest}"
    # Two sides press equally: it is enough to limit one of them.
    if all(_loose(hand, side, presses, devices) for side in opening.sides):
        names = ", ".join(hand.actuators[i].name for i in presses if i in devices.unlimited)
        return (
            f"the force of {opening.label} cannot be limited: its device cannot limit the effort "
            f"of {names}; {nearest}"
        )
    return ""


def _refusal(hand: Hand, index: int, refused: Mapping[int, str]) -> str:
    if index not in refused:
        return ""
    why = f": {refused[index]}" if refused[index] else ""
    return f"the device of '{hand.actuators[index].name}' takes no effort limit{why}"


def _loose(
    hand: Hand, side: Sequence[str], presses: Mapping[int, float], devices: DeviceForces
) -> bool:
    """Return whether a side presses with an actuator that cannot be limited, or with none."""
    pressing = [i for i in presses if set(side).intersection(hand.actuators[i].fingers)]
    return not pressing or any(i in devices.unlimited for i in pressing)
