"""Objects between the fingers of emulated devices, described in the same way for every device."""

from __future__ import annotations

import math
import re
import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

from msgspec import structs

from rtee.buses.emulator import Emulator
from rtee.buses.wear import Wear
from rtee.drivers.axis import Axis, VirtualObject
from rtee.drivers.options import read_properties
from rtee.errors import ConfigError
from rtee.hand.validation import Invalid, MistakeKind, validated
from rtee.types import DeviceSpec

OPTION = "object"
"""The property of every emulated device that puts an object between its fingers at the start."""

WEAR = "wear"
"""The property of every emulated device that makes it worn or ideal."""

ECHO = "echo"
"""The property of every emulated device on a line whose adapter returns what the host sends."""

IDEAL_STATE, WORN_STATE = "ideal", "worn"
"""Values of `WEAR`: as in the data sheet, or as known from real devices."""

STIFFNESS = 50.0
"""Default stiffness of an object; for its unit, see `ObjectInHand`."""

WRITTEN = "0.4 (fraction of the closing travel), 50mm (its width), or 50mm:20 (softer)"
"""The notation of an object, for messages."""

_PATTERN = re.compile(r"([0-9.eE+-]+)\s*(mm|cm|m)?\s*(?::\s*([0-9.eE+-]+))?")
_METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_SOFTEST, _HARDEST = 0.1, 1e6
"""Range of an object's stiffness: around a softer one the fingers close as if nothing were there;
in a harder one a single encoder count is more than full effort."""
_SLACK = 0.02
"""How far beyond a newly placed object the fingers may already be closed [fraction of their
travel]: friction and the resolution of encoders leave fingers that far from their target."""


class Closes(Protocol):
    """A motor of an emulated device that an object may stop."""

    obstacle: VirtualObject | None

    @property
    def position(self) -> float:
        """Position [the motor's unit]."""
        ...


class Closing(NamedTuple):
    """Closing motion of a motor on an object, in the motor's units.

    Attributes:
        motor: The motor.
        opened: Position at which the fingers are open.
        closed: Position at which they are closed.
        effort: Greatest effort of the motor.
    """

    motor: Closes
    opened: float
    closed: float
    effort: float

    @property
    def part(self) -> float:
        """Fraction of the travel by which the motor is closed, 0 to 1."""
        return (self.motor.position - self.opened) / (self.closed - self.opened)


@dataclass(frozen=True, slots=True)
class ObjectInHand:
    """An object that fingers close on.

    Attributes:
        closure: Fraction of the travel from open to closed at which the fingers meet it, 0 to 1;
            ignored if the width is given.
        width: Width [m], for devices whose distance between the fingers is known.
        stiffness: Effort that presses the fingers through their full travel [greatest effort of the
            device]: at 50, full effort presses them 2 % of the travel into the object.
    """

    closure: float = 0.0
    width: float | None = None
    stiffness: float = STIFFNESS

    @classmethod
    def parse(cls, value: object) -> ObjectInHand:
        """Read an object as text: ``0.4``, ``50mm``, ``0.05m``, ``50mm:20``.

        Raises:
            ConfigError: if the text has none of these forms, or a value is out of range.
        """
        # YAML's `yes` would otherwise be read as the number 1.
        match = None if isinstance(value, bool) else _PATTERN.fullmatch(str(value).strip())
        try:
            size, stiffness = (math.nan, 0.0) if match is None else _numbers(match)
        except ValueError:
            size, stiffness = math.nan, 0.0
        if match is None or not math.isfinite(size) or not _SOFTEST <= stiffness <= _HARDEST:
            raise ConfigError(
                f"the object '{value}' cannot be read; write {WRITTEN}; the stiffness is 0.1 to 1e6"
            )
        unit = match[2]
        if unit is not None:
            return cls(width=size * _METRES[unit], stiffness=stiffness)
        if not 0.0 <= size <= 1.0:
            raise ConfigError(
                f"the fingers must meet the object at 0 to 1 of the travel, not at {size:g}; a "
                "width needs a unit, such as 50mm"
            )
        return cls(closure=size, stiffness=stiffness)


def _numbers(found: re.Match[str]) -> tuple[float, float]:
    return float(found[1]), STIFFNESS if found[3] is None else float(found[3])


class Grasps(ABC):
    """Base class for the emulator of a device that can hold an object between its fingers."""

    @abstractmethod
    def closings(self) -> Sequence[Closing]:
        """Return the closing motion of each motor that closes on an object."""

    def closure_at(self, width: float) -> float:
        """Return the fraction of the travel at which the fingers meet an object of a width [m].

        Raises:
            ConfigError: if the distance between this device's fingers is not known.
        """
        raise ConfigError(
            "the distance between this device's fingers is not known; give the fraction of the "
            "travel at which they meet the object, 0 to 1"
        )

    def place_object(self, obj: ObjectInHand) -> None:
        """Put an object between the fingers, replacing one that is there.

        Raises:
            ConfigError: if the object is too wide, or the fingers are closed further already.
        """
        at = obj.closure if obj.width is None else self.closure_at(obj.width)
        if not 0.0 <= at <= 1.0:
            width = 0.0 if obj.width is None else obj.width
            raise ConfigError(f"an object {width * 1e3:g} mm wide does not fit the fingers")
        closings = self.closings()
        # Motors that press on an object are not compared: the new object replaces it.
        if any(one.motor.obstacle is None and one.part > at + _SLACK for one in closings):
            raise ConfigError(
                "the fingers are already closed further than the object is wide; open them first"
            )
        for one in closings:
            travel = one.closed - one.opened
            one.motor.obstacle = VirtualObject(
                one.opened + at * travel,
                obj.stiffness * one.effort / abs(travel),
                # Whether the motor's counts rise or fall while the fingers close.
                math.copysign(1.0, travel),
            )

    def remove_object(self) -> None:
        """Remove the object from between the fingers."""
        for one in self.closings():
            one.motor.obstacle = None


def grasping(emulator: Emulator) -> Grasps:
    """Return the emulator, if it can hold an object.

    Raises:
        ConfigError: if nothing can be put between its fingers.
    """
    if not isinstance(emulator, Grasps):
        raise ConfigError("this emulated device cannot hold an object between its fingers")
    return emulator


def between_fingers(hand: str, specs: Sequence[DeviceSpec], text: str) -> tuple[DeviceSpec, ...]:
    """Return the devices of a hand, the emulated ones with an object between their fingers.

    Args:
        hand: The hand's name.
        specs: The devices of the hand.
        text: The object as text; see `ObjectInHand.parse`.

    Raises:
        ConfigError: if the text cannot be read, or no device is emulated.
    """
    # Parsed here only to refuse a wrong text once instead of for each device.
    ObjectInHand.parse(text)
    if not any(spec.emulated for spec in specs):
        drivers = ", ".join(sorted({spec.driver for spec in specs}))
        raise ConfigError(
            f"no device of hand '{hand}' is emulated (driver {drivers}): an object needs --driver "
            "devices --emulated, or --driver mujoco"
        )

    def holding(spec: DeviceSpec) -> DeviceSpec:
        properties = {**(spec.options.get("emulator") or {}), OPTION: text}
        return replace(spec, options={**spec.options, "emulator": properties})

    return tuple(holding(spec) if spec.emulated else spec for spec in specs)


def made_by(kind: type[Emulator], options: Mapping[str, Any]) -> Emulator:
    """Make an emulator from a driver's options, with the wear and the object that they give.

    Raises:
        ConfigError: if the options do not suit the emulator.
    """
    properties = dict(options.get("emulator") or {})
    # Removed, since the emulator would refuse a name that is not a property of its device.
    given, state = properties.pop(OPTION, None), properties.pop(WEAR, IDEAL_STATE)
    echo = properties.pop(ECHO, False)
    if not isinstance(echo, bool):
        raise ConfigError(f"the emulated device's echo is '{echo}'; write true or false")
    make: Callable[..., Emulator] = kind
    if kind.PROPERTIES is None:
        emulator = make()
    else:
        fitting = kind.fitting({**options, "emulator": properties})
        found = read_properties(kind.PROPERTIES, {**fitting, **properties})
        try:
            emulator = make(found)
        except (ArithmeticError, ValueError, struct.error) as error:
            if isinstance(error, ConfigError):
                raise
            raise ConfigError(f"a device cannot have these properties: {error}") from error
    emulator.echo = echo
    if state != IDEAL_STATE:
        wear_down(emulator, _wear_of(kind, state))
    if given is not None:
        grasping(emulator).place_object(ObjectInHand.parse(given))
    return emulator


def _wear_of(kind: type[Emulator], state: object) -> Wear:
    """Return the wear that the property `WEAR` describes; raises `ConfigError`."""
    if state == WORN_STATE:
        return kind.WEAR
    if not isinstance(state, Mapping):
        raise ConfigError(
            f"the emulated device's wear is '{state}'; write worn, ideal, or the values that "
            "differ from worn, such as {lag: 0.05}"
        )
    try:
        return validated(Wear, {**structs.asdict(kind.WEAR), **state})
    except Invalid as error:
        if error.first.fault is MistakeKind.UNKNOWN:
            unknown = f"unknown kind of wear '{error.first.at[0]}'; {error.sentence}"
            raise ConfigError(unknown) from None
        what = ".".join(map(str, error.first.at))
        raise ConfigError(f"wear '{what}' of the emulated device: {error.sentence}") from None


def wear_down(emulator: Emulator, wear: Wear) -> None:
    """Apply wear to an emulated device, which then differs from its data sheet."""
    for one in emulator.closings() if isinstance(emulator, Grasps) else ():
        if isinstance(one.motor, Axis):
            one.motor.travel = abs(one.closed - one.opened)
    emulator.wear_down(wear)
