"""Read the options of a driver that are a plain dataclass; defaults and errors of all options.

The kinematic driver runs on every computer, so its options need no pydantic, whose import takes
9 MB; those of drivers for devices are pydantic models, see `rtee.drivers.options`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from typing import Any, TypeVar

from rtee.errors import ConfigError, suggestion
from rtee.hand.validation import Invalid, validated
from rtee.types import DeviceSpec

T = TypeVar("T")


def read_plain_options(kind: type[T], spec: DeviceSpec) -> T:
    """Return the options of a device, checked.

    Args:
        kind: The dataclass of the options.
        spec: The device.

    Raises:
        ConfigError: if a name is unknown or a value unusable; it names the option and the file.
    """
    try:
        return validated(kind, dict(spec.options))
    except Invalid as error:
        raise options_error(error.errors(), default_options(kind), spec) from None


def default_options(kind: Any) -> dict[str, Any]:
    """Return the default of each option, also for pydantic models.

    Args:
        kind: A driver's ``Options``; ``None`` for none. Required options have the default ``None``.
    """
    if kind is None:
        return {}
    if not dataclasses.is_dataclass(kind):
        fields = kind.model_fields.items()
        return {
            name: None if field.is_required() else field.get_default(call_default_factory=True)
            for name, field in fields
        }
    found: dict[str, Any] = {}
    for field in dataclasses.fields(kind):
        if field.default_factory is not dataclasses.MISSING:
            found[field.name] = field.default_factory()
        else:
            found[field.name] = None if field.default is dataclasses.MISSING else field.default
    return found


def options_error(
    mistakes: Sequence[Mapping[str, Any]], known: Collection[str], spec: DeviceSpec
) -> ConfigError:
    """Return the error for the first mistake in a device's options, as a sentence.

    Args:
        mistakes: The mistakes, in the form of `Invalid.errors`.
        known: The names that options may have.
        spec: The device.
    """
    # One mistake at a time: a user corrects them one by one anyway.
    first = mistakes[0]
    place = ".".join(str(part) for part in first["loc"])
    return ConfigError(
        _sentence(first, place or "options", known, spec),
        key=f"devices.{spec.name}.options.{place}",
    )


def _sentence(
    mistake: Mapping[str, Any], name: str, known: Collection[str], spec: DeviceSpec
) -> str:
    where = f"{spec.source}: " if spec.source else ""
    if mistake["type"] == "extra_forbidden":
        hint = suggestion(name, list(known))
        return f"{where}device '{spec.name}': unknown option '{name}'; {hint}"
    if mistake["type"] == "missing":
        return f"{where}device '{spec.name}': option '{name}' is missing"
    message = mistake["msg"].removeprefix("Value error, ")
    return f"{where}device '{spec.name}': option '{name}': {message[:1].lower()}{message[1:]}"
