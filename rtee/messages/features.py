"""Names of a hand's observed quantities as plain numbers, for learned policies.

One place for both, so that a policy trained on a recording runs on the hand: the datasets made of
recordings (`rtee.log.dataset`), and LeRobot's observations of a running hand.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from enum import StrEnum

from rtee.errors import ConfigError
from rtee.messages.state import State
from rtee.touch import TouchState


class ObservedQuantity(StrEnum):
    """An observed quantity, in the order of the observation vector.

    Positions of the actuators [rad | m], of the joints that follow them, efforts of the actuators
    [N·m | N], the opening of the fingertips [m], the force on each fingertip [N], the sum over the
    taxels of each touch sensor, and each taxel, in the sensor's unit.
    """

    POSITION = "position"
    JOINT = "joint"
    EFFORT = "effort"
    OPENING = "opening"
    FORCE = "force"
    TOUCH = "touch"
    TAXEL = "taxel"


USUAL = tuple(each for each in ObservedQuantity if each is not ObservedQuantity.TAXEL)
"""The default observations that are known; without taxels, which may be hundreds."""

_SUFFIXES = {
    ObservedQuantity.POSITION: "pos",
    ObservedQuantity.JOINT: "pos",
    ObservedQuantity.EFFORT: "effort",
    ObservedQuantity.FORCE: "force",
    ObservedQuantity.TOUCH: "touch",
    ObservedQuantity.TAXEL: "taxel",
}


def quantities(names: Iterable[str]) -> tuple[ObservedQuantity, ...]:
    """Return the quantities of these names, in their order; `ConfigError` for an unknown one."""
    given = set(names)
    if unknown := sorted(given - set(ObservedQuantity)):
        raise ConfigError(
            f"unknown observed quantity '{unknown[0]}'; valid: {', '.join(ObservedQuantity)}"
        )
    return tuple(each for each in ObservedQuantity if each in given)


def feature(quantity: ObservedQuantity, name: str = "") -> str:
    """Return the name of one number: ``thumb.pos``; LeRobot has no ``/`` in names."""
    return ".".join(filter(None, (name.replace("/", "."), _SUFFIXES.get(quantity, quantity))))


def taxels(sensor: str, count: int) -> list[str]:
    """Return the names of the taxels of a sensor."""
    return [f"{feature(ObservedQuantity.TAXEL, sensor)}.{number}" for number in range(count)]


def observed(
    state: State,
    touch: Iterable[TouchState],
    forces: Sequence[float],
    fingers: Sequence[str],
    wanted: Collection[ObservedQuantity],
) -> dict[str, float]:
    """Return the wanted numbers of a hand by name; unknown ones are ``NaN``.

    ``forces`` are those on the fingertips [N], or none.
    """
    wants_touch = {ObservedQuantity.TOUCH, ObservedQuantity.TAXEL} & set(wanted)
    felt = [each for each in touch if not each.stale] if wants_touch else []
    found: dict[ObservedQuantity, Mapping[str, float]] = {
        ObservedQuantity.POSITION: state.positions,
        ObservedQuantity.JOINT: {n: p for n, p in state.joints.items() if n not in state.names},
        ObservedQuantity.EFFORT: dict(zip(state.names, state.effort.tolist(), strict=True)),
        ObservedQuantity.OPENING: {"": math.nan if state.opening is None else state.opening},
        ObservedQuantity.FORCE: dict(zip(fingers, forces, strict=False)),
        ObservedQuantity.TOUCH: {
            sensor.name: total
            for each in felt
            for sensor, total in zip(each.sensors, each.totals.tolist(), strict=True)
        },
    }
    numbers = {
        feature(quantity, name): value
        for quantity in wanted
        for name, value in found.get(quantity, {}).items()
    }
    if ObservedQuantity.TAXEL in wanted:
        for each in felt:
            for sensor in each.sensors:
                values = each.of(sensor.name).tolist()
                numbers |= dict(zip(taxels(sensor.name, sensor.taxels), values, strict=True))
    return numbers
