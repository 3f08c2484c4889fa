"""Convert dataclasses to JSON and back without loss of precision."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from typing import Any, Final, TypeVar

from msgspec import ValidationError, convert, to_builtins

from rtee.errors import LogError

T = TypeVar("T")

_UNKNOWN: Final = re.compile(r"Object contains unknown field `(.+?)`(?: - at `\$\.(.+)`)?")
"""msgspec's message about a key that a section does not have: the key, and the section's place."""


def to_json(value: object) -> str:
    """Return a dataclass, or lists and mappings of dataclasses, as JSON; infinities as strings."""
    return json.dumps(_finite(to_builtins(value, enc_hook=dict)), indent=1)


def _finite(value: Any) -> Any:
    match value:
        case dict():
            return {key: _finite(item) for key, item in value.items()}
        case list() | tuple():
            return [_finite(item) for item in value]
        case float() if not math.isfinite(value):
            return repr(value)  # JSON has no infinities; msgspec reads "inf" back
    return value


def _sections(data: Any, place: str | None) -> Sequence[Any]:
    """Return the sections at msgspec's name of a place; ``name[...]``: each one of a mapping."""
    found = [data]
    # Without dots, which separate names.
    for step in place.replace("[...]", ".*").split(".") if place else ():
        if step == "*":
            found = [one for section in found for one in section.values()]
        else:
            found = [section[step] for section in found]
    return found


def from_json(text: str | bytes, kind: type[T]) -> T:
    """Return the dataclass in a text that `to_json` wrote; `LogError` if it does not fit."""
    try:
        data = json.loads(text)
        while True:
            try:
                return convert(data, kind, strict=False)
            except ValidationError as error:
                # Older recordings may have fields that no longer exist.
                if (unknown := _UNKNOWN.fullmatch(str(error))) is None:
                    raise
                old = [s for s in _sections(data, unknown[2]) if unknown[1] in s]
                if not old:
                    raise
                for section in old:
                    del section[unknown[1]]
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError) as error:
        raise LogError(f"{kind.__name__} cannot be read from JSON: {error}") from error
