"""Properties of an emulated device: the option ``emulator``, read into the emulator's dataclass."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Annotated, Any, TypeVar

from pydantic import Field, TypeAdapter, ValidationError

from rtee.errors import ConfigError, suggestion

P = TypeVar("P")

Byte = Annotated[int, Field(ge=0, le=255)]
"""A count or number that fits into a byte."""

Rate = Annotated[int, Field(gt=0, le=100_000_000)]
"""Bits per second."""

Duration = Annotated[float, Field(ge=0.0, le=1e6)]
"""A time [s]."""

Positive = Annotated[float, Field(gt=0.0, le=1e12)]
"""An amount above 0."""

_FORMS = {
    "tuple_type": "; a list is written [1, 2, 3]",
    "dict_type": "; a mapping is written {name: value}",
    "dataclass_type": "; a mapping is written {name: value}",
}
"""Hint on how to write a value of the wrong type, by pydantic's error type."""


def read_properties(kind: type[P], options: Mapping[str, Any], **defaults: Any) -> P:
    """Return the properties of an emulated device from its driver's options.

    Args:
        kind: The emulator's dataclass of properties.
        options: The driver's options; only ``emulator`` is read.
        defaults: Values that follow from other options, for properties that are not given.

    Raises:
        ConfigError: if a name is unknown or a value invalid.
    """
    given = {**defaults, **dict(options.get("emulator") or {})}
    known = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    # Pydantic ignores unknown names for a plain dataclass: a misspelt one would go unnoticed.
    for name in given:
        if name not in known:
            raise ConfigError(
                f"unknown property '{name}' of the emulated device; {suggestion(name, known)}"
            )
    try:
        return TypeAdapter(kind).validate_python(given)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"] if part != "[key]")
        message = first["msg"].removeprefix("Value error, ").lower().replace("tuple", "list")
        message += _FORMS.get(first["type"], "")
        # An error without a name comes from `__post_init__`: the properties contradict each other.
        what = f"property '{name}'" if name else "properties"
        raise ConfigError(f"{what} of the emulated device: {message}") from None
