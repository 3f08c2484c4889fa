"""Convert dataclasses to JSON and back without loss of precision."""

from __future__ import annotations

import json
import math
import re
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
                section = data
                for key in unknown[2].split(".") if unknown[2] else ():
                    section = section[key]
                del section[unknown[1]]
    except (ValueError, TypeError, LookupError, RecursionError) as error:
        raise LogError(f"{kind.__name__} cannot be read from JSON: {error}") from error
