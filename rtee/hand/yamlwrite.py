"""Write YAML; the same data result in the same text."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

from rtee.errors import foreign

DECIMALS: Final = 9
"""Decimal places of stored numbers: a nanometre or nanoradian, far below the accuracy of hands."""

_PLAIN: Final = re.compile(r"[A-Za-z][A-Za-z0-9_./-]*")
# In some version of YAML, these words are booleans, numbers or null.
_RESERVED: Final = frozenset(
    {"true", "false", "null", "yes", "no", "on", "off", "y", "n", "nan", "inf"}
)


def emit_scalar(value: object) -> str:
    """Return a string, number, boolean or ``None`` as one token.

    Raises:
        TypeError: if the value has another type, or is not finite.
    """
    match value:
        case None:
            return "null"
        # Before integers: in Python, a boolean is one.
        case bool():
            return "true" if value else "false"
        case int():
            return str(value)
        case float():
            return _emit_number(value)
        case str():
            plain = _PLAIN.fullmatch(value) and value.lower() not in _RESERVED
            return value if plain else _emit_string(value)
    raise TypeError(f"cannot write a {type(value).__name__} as YAML")


def _emit_string(value: str) -> str:
    def escaped(character: str) -> str:
        if character in '"\\':
            return "\\" + character
        return character if character.isprintable() else f"\\U{ord(character):08x}"

    return f'"{"".join(map(escaped, value))}"'


def _emit_number(value: float) -> str:
    # The difference is NaN for NaN and infinities.
    if value - value != 0.0:
        raise TypeError("cannot write a number that is not finite")
    # Adding 0 turns -0.0 into 0.0.
    text = repr(round(float(value), DECIMALS) + 0.0)
    if "e" in text and "." not in text:
        # In YAML 1.1, "1e-09" is a string.
        text = text.replace("e", ".0e")
    return text


def _emit_flow(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_emit_flow(item) for item in value) + "]"
    return emit_scalar(value)


def _lines(value: Mapping[str, Any], indent: str) -> Iterator[str]:
    for key, item in value.items():
        head = f"{indent}{emit_scalar(key)}:"
        if isinstance(item, Mapping):
            if not item:
                # A key without a value would be read back as null.
                raise TypeError("cannot write an empty mapping")
            yield head
            yield from _lines(item, indent + "  ")
        elif isinstance(item, (list, tuple)) and item and isinstance(item[0], Mapping):
            yield head
            yield from _item_lines(item, indent)
        else:
            yield f"{head} {_emit_flow(item)}"


def _item_lines(items: Sequence[Mapping[str, Any]], indent: str) -> Iterator[str]:
    for item in items:
        if not item:
            raise TypeError("cannot write an empty mapping")
        lines = _lines(item, indent + "  ")
        # The dash takes the place of the first key's indentation.
        yield f"{indent}- {next(lines)[len(indent) + 2 :]}"
        yield from lines


def emit(data: Mapping[str, Any], comments: Sequence[str] = ()) -> str:
    """Return a mapping of scalars, lists and mappings as block YAML.

    Args:
        data: The document; keys are strings. A list contains mappings, or scalars and lists of
            scalars.
        comments: Comment lines at the top, without the ``#``.
    """
    head = [f"# {foreign(line)}".rstrip() for line in comments]
    return "\n".join([*head, *_lines(data, "")]) + "\n"


def rest_line(rest: Mapping[str, float]) -> str:
    """Return the line of hand.yaml that gives rest positions [rad | m]."""
    pairs = (f"{emit_scalar(name)}: {value!r}" for name, value in rest.items())
    return f"rest: {{{', '.join(pairs)}}}"


def ignore_line(actuators: Iterable[str]) -> str:
    """Return the line of hand.yaml that ignores actuators."""
    return f"ignore: [{', '.join(map(emit_scalar, actuators))}]"
