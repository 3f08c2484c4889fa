"""Lines of hand.yaml for people to type."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from typing import Final

_PLAIN: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]*\Z")
_WORDS: Final = ("true", "false", "null", "yes", "no", "on", "off", "y", "n")


def rest_line(rest: Mapping[str, float]) -> str:
    """Return the line that gives rest positions [rad | m]."""
    pairs = (f"{_scalar(name)}: {value!r}" for name, value in rest.items())
    return f"rest: {{{', '.join(pairs)}}}"


def ignore_line(actuators: Iterable[str]) -> str:
    """Return the line that ignores actuators."""
    return f"ignore: [{', '.join(map(_scalar, actuators))}]"


def _scalar(name: str) -> str:
    """Return a name in YAML, quoted where it would be read as something else."""
    plain = _PLAIN.match(name) and name.lower() not in _WORDS
    return name if plain else json.dumps(name)
