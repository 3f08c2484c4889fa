"""Convert dataclasses to JSON and back without loss of precision."""

from __future__ import annotations

import json
import math
import types
import typing
from collections.abc import Mapping
from enum import Enum
from typing import Any, TypeVar

from rtee.errors import LogError
from rtee.hand.validation import field_names, has_fields

T = TypeVar("T")


def to_json(value: object) -> str:
    """Return a dataclass, or lists and mappings of dataclasses, as JSON; infinities as strings."""
    return json.dumps(_plain(value), indent=1)


def _plain(value: Any) -> Any:
    kind: Any = type(value)
    if has_fields(kind):
        return {name: _plain(getattr(value, name)) for name in field_names(kind)}
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, float):
        # JSON has no infinities; float() reads "inf" back.
        return value if math.isfinite(value) else repr(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return value


def from_json(text: str | bytes, kind: type[T]) -> T:
    """Return the dataclass in a text that `to_json` wrote; `LogError` if it does not fit."""
    try:
        value = _value_of(json.loads(text), kind)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise LogError(f"{kind.__name__} cannot be read from JSON: {error}") from error
    return typing.cast("T", value)


def _value_of(value: Any, kind: Any) -> Any:
    """Return plain data as a value of a type, which is given as in an annotation."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        if value is None:
            return None
        return _value_of(value, next(each for each in arguments if each is not type(None)))
    if origin is Mapping:
        return {key: _value_of(item, arguments[1]) for key, item in value.items()}
    if origin is tuple:
        return tuple(_value_of(item, arguments[0]) for item in value)
    if has_fields(kind):
        hints = typing.get_type_hints(kind)
        known = field_names(kind)
        # Older recordings may have fields that no longer exist.
        return typing.cast("Any", kind)(
            **{key: _value_of(item, hints[key]) for key, item in value.items() if key in known}
        )
    return kind(value)
