"""Options that assign a servo, drive, motor or joint of the device to each actuator."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

from rtee.errors import ConfigError
from rtee.types import ActuatorSpec, DeviceSpec


def check_names(spec: DeviceSpec, option: str, named: Iterable[str]) -> None:
    """Check that an option names all actuators of a device, and nothing else.

    Args:
        spec: The device.
        option: The option's name, for the message.
        named: The names in it.

    Raises:
        ConfigError: if a name is missing or unknown.
    """
    wrong = {actuator.name for actuator in spec.actuators} ^ set(named)
    if wrong:
        raise ConfigError(
            f"device '{spec.name}': option '{option}' must name the device's actuators, each "
            f"once; these do not match: {', '.join(sorted(wrong))}"
        )


def numbers_of(spec: DeviceSpec, option: str, given: Mapping[str, int], what: str) -> list[int]:
    """Return the number that each actuator of a device has on the wire.

    Args:
        spec: The device.
        option: The option's name, for the message.
        given: The numbers in it, by actuator.
        what: The noun for the message, such as ``servo``.

    Raises:
        ConfigError: if a number is missing, or two are the same.
    """
    missing = [a.name for a in spec.actuators if a.name not in given]
    numbers = [given[a.name] for a in spec.actuators if a.name in given]
    if missing or len(set(numbers)) != len(numbers):
        raise ConfigError(
            f"device '{spec.name}': option '{option}' must give each actuator its own {what}; "
            f"{'missing: ' + ', '.join(missing) if missing else 'two have the same'}"
        )
    return numbers


def motors_of(
    spec: DeviceSpec,
    option: str,
    given: Mapping[str, str],
    known: Sequence[str],
    guess: Callable[[str], str],
) -> tuple[int, ...]:
    """Return the motor of each actuator of a device, as an index into the known motors.

    Args:
        spec: The device.
        option: The option that names motors, for the message.
        given: The motors in it, by actuator; empty if the option is not set.
        known: Names of the device's motors, in their order on the wire.
        guess: Returns the motor that an actuator's name suggests; empty if it suggests none.

    Raises:
        ConfigError: if an actuator has no motor, or two have the same.
    """
    if given:
        # Without this, a misspelt name would go unnoticed and its actuator would get the guess.
        check_names(spec, option, given)
    named = {a.name: given.get(a.name) or guess(a.name) for a in spec.actuators}
    indices = {name: known.index(motor) for name, motor in named.items() if motor in known}
    return tuple(numbers_of(spec, option, indices, "motor"))


_ROTATES = ("yaw", "rot", "oppos", "abduct")
"""Parts of names that identify the motor that rotates the thumb."""


def finger_motor(name: str, motors: Sequence[str]) -> str:
    """Return the motor that an actuator's name suggests; empty if it suggests none.

    Args:
        name: The actuator's name.
        motors: The motors of a hand: those of the fingers, then the one that bends the thumb, then
            the one that rotates it.
    """
    # Some makers say "little" where others, and many models of hands, say "pinky".
    lowered, (*fingers, bends, rotates) = name.lower().replace("pinky", "little"), motors
    if "thumb" in lowered:
        return rotates if any(word in lowered for word in _ROTATES) else bends
    return next((one for one in fingers if one.replace("pinky", "little") in lowered), "")


def only_actuator(spec: DeviceSpec, what: str) -> ActuatorSpec:
    """Return the actuator of a device that has only one.

    Args:
        spec: The device.
        what: The kind of device with its article, for the message, such as ``a WSG 50``.

    Raises:
        ConfigError: if it is configured with none, or with several.
    """
    if len(spec.actuators) != 1:
        raise ConfigError(
            f"device '{spec.name}': {what} has one actuator, not {len(spec.actuators)}",
            key=f"devices.{spec.name}.actuators",
        )
    return spec.actuators[0]
