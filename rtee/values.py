"""Values for programs: comparable, printed on one line, picklable, convertible to plain data."""

from __future__ import annotations

import copyreg
import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, fields
from enum import Enum
from pathlib import PurePath
from types import MappingProxyType
from typing import Any, ClassVar, Final

import numpy as np

_LONGEST_LINE: Final = 240
"""Longest text of a value [characters]: three lines of a terminal at most."""

_MOST: Final = 8
"""Most items of an array, sequence or mapping that its text shows."""


def _view(items: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(items)


# Python pickles every mapping but its read-only view, which is what rtee's values hold.
copyreg.pickle(MappingProxyType, lambda view: (_view, (dict(view),)))


class Value:
    """Base of the frozen dataclasses that programs get and keep.

    Two are equal if they are of one class and all their fields are equal: arrays element by
    element, and unmeasured values (``NaN``) are equal.
    """

    __slots__ = ()
    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def __init_subclass__(cls) -> None:
        # `dataclass` keeps methods of the class itself, but would replace inherited ones.
        for name in ("__eq__", "__repr__"):
            if name not in vars(cls):
                setattr(cls, name, vars(Value)[name])

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other):
            return NotImplemented
        compared = (f.name for f in fields(self) if f.compare)
        return all(same(getattr(self, name), getattr(other, name)) for name in compared)

    def __repr__(self) -> str:
        shown = (
            f"{f.name}={_text(value)}"
            for f in fields(self)
            if f.repr and not same(value := getattr(self, f.name), _default(f))
        )
        return _cut(f"{type(self).__name__}({', '.join(shown)})")

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as JSON values.

        Arrays and tuples become lists, and members of enumerations become texts. Numbers that JSON
        does not have become ``None``: ``NaN`` for unmeasured values, and infinite limits.
        """
        return {f.name: plain(getattr(self, f.name)) for f in fields(self)}


def _default(spec: Field[Any]) -> Any:
    made: Any = spec.default
    return made if spec.default_factory is MISSING else spec.default_factory()


def same(one: Any, other: Any) -> bool:
    """Return whether two values are equal; ``NaN`` equals ``NaN``."""
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        a, b = np.asarray(one), np.asarray(other)
        return np.array_equal(a, b, equal_nan=a.dtype.kind == b.dtype.kind == "f")
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, float) and isinstance(other, float) and math.isnan(one):
        return math.isnan(other)
    return bool(one == other)


def number(value: Any) -> float | None:
    """Return a value as a number; ``None`` for text, and for values that no `float` can hold."""
    try:
        return float(value.__float__())
    # Such as text, an array of several numbers, or an integer beyond the range.
    except (AttributeError, TypeError, ValueError, OverflowError):
        return None


def plain(value: Any) -> Any:
    """Return a value as a JSON value; see `Value.to_dict`."""
    match value:
        case Value():
            return value.to_dict()
        case Enum():
            return value.value
        case np.ndarray() | np.generic():
            return plain(value.tolist())
        case float():
            return value if math.isfinite(value) else None
        case Mapping():
            return {str(key): plain(item) for key, item in value.items()}
        case str() | int() | None:
            return value
        case Sequence() if not isinstance(value, bytes):
            return [plain(item) for item in value]
    return str(value)


def _text(value: Any) -> str:
    match value:
        case Enum() | PurePath():
            return repr(str(value))
        case float():
            return f"{value:.6g}"
        case np.ndarray() if value.size > _MOST:
            shape = "x".join(map(str, value.shape))
            return f"<{shape} {value.dtype}>"
        case np.ndarray():
            return np.array2string(value, precision=4, separator=", ").replace("\n", "")
        case str() | bytes():
            return _cut(repr(value))
        case Mapping():
            items = [f"{key!r}: {_text(item)}" for key, item in [*value.items()][:_MOST]]
            return f"{{{', '.join(items)}{_rest(value)}}}"
        case Sequence():
            items = [_text(item) for item in value[:_MOST]]
            return f"[{', '.join(items)}{_rest(value)}]"
    return repr(value)


def _rest(value: Mapping[Any, Any] | Sequence[Any]) -> str:
    return f", … {len(value) - _MOST} more" if len(value) > _MOST else ""


def _cut(text: str) -> str:
    line = text.replace("\n", " ")
    return line if len(line) <= _LONGEST_LINE else f"{line[: _LONGEST_LINE - 2]}…{line[-1]}"
