"""The options of a driver in hand.yaml and the properties of its emulated device.

They are checked once, when the driver or the emulator is made.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, TypeVar

from msgspec import Meta, field

from rtee.errors import ConfigError
from rtee.hand.validation import Invalid, MistakeKind, Section, validated
from rtee.types import DeviceSpec

Positive = Annotated[float, Meta(gt=0.0, le=1e12)]
"""An amount above 0."""

NotNegative = Annotated[float, Meta(ge=0.0, le=1e12)]
"""An amount that is at least 0."""

Byte = Annotated[int, Meta(ge=0, le=255)]
"""A count or number that fits into a byte."""

Rate = Annotated[int, Meta(ge=1200, le=12_000_000)]
"""Bits per second of a serial line: from the slowest rate in use for Modbus to the highest of USB
converters."""

CanRate = Annotated[int, Meta(ge=10_000, le=1_000_000)]
"""Bits per second of a CAN bus: the lowest and highest rate of CiA 301."""

Duration = Annotated[float, Meta(ge=0.0, le=1e6)]
"""A time [s]."""

# The following have bounds between what a device can have and the same number in a thousandth of
# the unit, so that milliseconds, millimetres and milliamperes are refused.

Moment = Annotated[float, Meta(gt=0.0, le=10.0)]
"""Time of an exchange or of a finger's full travel [s]."""

Pause = Annotated[float, Meta(ge=0.0, le=1.0)]
"""Time before or after a frame [s]."""

Length = Annotated[float, Meta(gt=0.0, le=1.0)]
"""A length on a hand, or the speed at which it passes in a second [m | m/s]."""

Current = Annotated[float, Meta(gt=0.0, le=20.0)]
"""Current of a motor in a hand [A]."""


class DeviceOptions(Section, frozen=True):
    """Options that every device has; unknown names are refused."""

    emulator: dict[str, Any] = field(default_factory=dict)
    """Properties of the emulated device (``rtee run --emulated``), as its emulator defines them."""


S = TypeVar("S", bound=Section)


def read_options(kind: type[S], spec: DeviceSpec) -> S:
    """Return the options of a device, checked.

    Raises:
        ConfigError: if a name is unknown or a value invalid; it names the option and its origin.
    """
    try:
        return validated(kind, dict(spec.options))
    except Invalid as error:
        place, words = _told(error, "option", "options", "")
        origin = spec.origin(str(error.first.at[0]) if error.first.at else "")
        where = f"{origin}: " if origin else ""
        raise ConfigError(
            f"{where}device '{spec.name}': {words}", key=f"devices.{spec.name}.options.{place}"
        ) from None


def read_properties(kind: type[S], given: Mapping[str, Any]) -> S:
    """Return the properties of an emulated device; raises `ConfigError`."""
    try:
        return validated(kind, dict(given))
    except Invalid as error:
        words = _told(error, "property", "properties", " of the emulated device")[1]
        raise ConfigError(words) from None


def _told(error: Invalid, one: str, all_: str, of: str) -> tuple[str, str]:
    """Return the place of the first mistake, and the mistake as a sentence."""
    # One mistake at a time: a user corrects them one by one anyway.
    place = ".".join(map(str, error.first.at))
    what = f"{one} '{place}'{of}" if place else all_ + of
    match error.first.fault:
        case MistakeKind.UNKNOWN:
            return place, f"unknown {what}; {error.sentence}"
        case MistakeKind.MISSING:
            return place, f"{what} is missing"
        case MistakeKind.UNFIT:
            return place, f"{what}: input {error.sentence}"
    return place, f"{what}: {error.sentence}"
