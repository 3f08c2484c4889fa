"""Options that assign a servo, drive, motor or joint on the wire to each actuator."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from rtee.errors import ConfigError
from rtee.types import DeviceSpec


def check_names(spec: DeviceSpec, option: str, named: Iterable[str]) -> None:
    """Check that an option names all actuators of a device, and nothing else.

    Args:
        spec: The device.
        option: The option's name, for the message.
        named: The names in it.

    Raises:
        ConfigError: if it does not.
    """
    wrong = {actuator.name for actuator in spec.actuators} ^ set(named)
    if wrong:
        raise ConfigError(
            f"device '{spec.name}': option '{option}' must name the device's actuators, each "
            f"once; these do not match: {', '.join(sorted(wrong))}"
        )


def numbers_of(spec: DeviceSpec, option: str, given: Mapping[str, int], what: str) -> list[int]:
    """Return the number on the wire of each actuator of a device.

    Args:
        spec: The device.
        option: The option's name, for the message.
        given: The numbers in it, by actuator.
        what: What is numbered, for the message.

    Raises:
        ConfigError: if one is missing, or two are the same.
    """
    missing = [a.name for a in spec.actuators if a.name not in given]
    found = [given[a.name] for a in spec.actuators if a.name in given]
    if missing or len(set(found)) != len(found):
        raise ConfigError(
            f"device '{spec.name}': option '{option}' must give each actuator a {what} of its own; "
            f"{'missing: ' + ', '.join(missing) if missing else 'two have the same'}"
        )
    return found
