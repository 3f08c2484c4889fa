"""YAML as rtee writes it: deterministic text, and a fast reader for exactly that text.

ruamel.yaml's pure reader takes a tenth of a second for a thousand lines, which a control loop
should not pay at every start. `read_canonical` reads the small subset that `emit` writes in a
few milliseconds, and vouches for it: it answers only when emitting what it read gives the very
same text. Everything else (edited by hand, comments in between) goes through ruamel.yaml.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

DECIMALS = 9
"""Decimals of stored numbers: a nanometre, a nanoradian."""

_PLAIN = re.compile(r"[A-Za-z][A-Za-z0-9_./-]*")
_NUMBER = re.compile(r"-?[0-9]+(\.[0-9]+(e[+-][0-9]+)?)?")
_KEY = re.compile(r'((?:"(?:[^"\\]|\\.)*")|[^\s:#"\[\]{},][^\s:]*):(?: (\S.*))?')
_TOKEN = re.compile(r'\s*([\[\],]|"(?:[^"\\]|\\.)*"|[^\[\],\s"]+)')
_CONTROL = re.compile(r"[\x00-\x09\x0b-\x1f\x7f]")
_WORDS: Mapping[str, Any] = {"true": True, "false": False, "null": None}
_RESERVED = frozenset({"true", "false", "null", "yes", "no", "on", "off", "y", "n", "nan", "inf"})


def emit_scalar(value: object) -> str:
    """Return a string, number, flag or ``None`` as one token.

    Raises:
        TypeError: if it is none of these, or not finite.
    """
    match value:
        case None:
            return "null"
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
    if value - value != 0.0:
        raise TypeError("cannot write a number that is not finite")
    text = repr(round(float(value), DECIMALS) + 0.0)
    if "e" in text and "." not in text:
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
        lines = _lines(item, indent + "  ")
        yield f"{indent}- {next(lines)[len(indent) + 2 :]}"
        yield from lines


def emit(data: Mapping[str, Any], comments: Sequence[str] = ()) -> str:
    """Return a mapping of scalars, lists and mappings as block YAML; the same data, the same text.

    Args:
        data: The document; keys are strings. A list holds mappings, or scalars and lists of them.
        comments: Lines for people at the top, without the ``#``.
    """
    head = [f"# {line}".rstrip() for line in comments]
    return "\n".join([*head, *_lines(data, "")]) + "\n"


class _UnfamiliarError(Exception):
    """The text is not as `emit` writes it."""


def _read_scalar(token: str) -> Any:
    if token.startswith('"'):
        return json.loads(token)
    if token in _WORDS:
        return _WORDS[token]
    if _NUMBER.fullmatch(token):
        return float(token) if "." in token else int(token)
    if _PLAIN.fullmatch(token):
        return token
    raise _UnfamiliarError


def _read_flow(text: str) -> Any:
    if not text.startswith("["):
        return _read_scalar(text)
    outer: list[Any] = []
    stack = [outer]
    for piece in _TOKEN.findall(text):
        if piece == "[":
            inner: list[Any] = []
            stack[-1].append(inner)
            stack.append(inner)
        elif piece == "]":
            stack.pop()
        elif piece != ",":
            stack[-1].append(_read_scalar(piece))
    if len(stack) != 1 or len(outer) != 1:
        raise _UnfamiliarError
    return outer[0]


class _Lines:
    def __init__(self, lines: Sequence[str]) -> None:
        self.lines = [(len(line) - len(line.lstrip(" ")), line.lstrip(" ")) for line in lines]
        self.at = 0

    def mapping(self, indent: int) -> dict[str, Any]:
        found: dict[str, Any] = {}
        while self.at < len(self.lines):
            depth, text = self.lines[self.at]
            if depth != indent or text.startswith("- "):
                break
            match = _KEY.fullmatch(text)
            if match is None:
                raise _UnfamiliarError
            self.at += 1
            key = _read_scalar(match[1])
            found[key] = self._block(indent) if match[2] is None else _read_flow(match[2])
        return found

    def _block(self, indent: int) -> Any:
        if self.at >= len(self.lines):
            raise _UnfamiliarError
        depth, text = self.lines[self.at]
        if depth == indent + 2:
            return self.mapping(depth)
        if depth == indent and text.startswith("- "):
            return self._items(indent)
        raise _UnfamiliarError

    def _items(self, indent: int) -> list[Any]:
        items = []
        while self.at < len(self.lines):
            depth, text = self.lines[self.at]
            if depth != indent or not text.startswith("- "):
                break
            self.lines[self.at] = (indent + 2, text[2:])
            items.append(self.mapping(indent + 2))
        return items


def read_canonical(text: str) -> dict[str, Any] | None:
    """Return the document if its text is exactly what `emit` writes for it, else ``None``."""
    if not text.isascii() or _CONTROL.search(text):
        return None
    lines = text.split("\n")
    body = next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))
    comments = [line[1:].removeprefix(" ") for line in lines[:body]]
    reader = _Lines(lines[body:-1])
    try:
        data = reader.mapping(0)
        if reader.at == len(reader.lines) and emit(data, comments) == text:
            return data
    except (_UnfamiliarError, ValueError, TypeError, RecursionError, IndexError):
        return None
    return None
