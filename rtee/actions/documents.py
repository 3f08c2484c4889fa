"""YAML documents that come from people: read safely, with the line of every mistake."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rtee.actions.yamltext import read_canonical
from rtee.errors import ActionError, suggestion
from rtee.hand.files import read_bytes
from rtee.hand.yamlfile import too_deep, yaml_reader

Key = str | int | tuple[str, ...]
Keys = tuple[Key, ...]


@dataclass(frozen=True)
class Document:
    """A parsed file: its data and where it came from."""

    data: Any
    path: Path
    text: str

    def line(self, keys: Keys) -> int | None:
        """Return the line, counted from 1, where an entry stands; ``None`` if it has none."""
        from ruamel.yaml.error import YAMLError
        from ruamel.yaml.nodes import MappingNode, SequenceNode

        try:
            node: Any = yaml_reader().compose(self.text)
        except (YAMLError, ValueError, RecursionError):
            return None
        if node is None:
            return None
        line: int = node.start_mark.line + 1
        for key in keys:
            if isinstance(node, MappingNode):
                pair = next((p for p in node.value if _key_of(p[0]) == key), None)
                if pair is None:
                    break
                line, node = pair[0].start_mark.line + 1, pair[1]
            elif isinstance(node, SequenceNode) and isinstance(key, int):
                if key >= len(node.value):
                    break
                node = node.value[key]
                line = node.start_mark.line + 1
            else:
                break
        return line

    @property
    def root(self) -> Node:
        """The whole document."""
        return Node(self.data, self, ())


@dataclass(frozen=True, slots=True)
class Node:
    """One entry of a document, which knows its place."""

    value: Any
    document: Document
    keys: Keys

    def error(self, message: str) -> ActionError:
        """Return an error that names the file and the line of this entry."""
        return ActionError(message, path=self.document.path, line=self.document.line(self.keys))

    @property
    def what(self) -> str:
        """How the entry is called in a sentence."""
        named = [key for key in self.keys if isinstance(key, str)]
        return f"'{named[-1]}'" if named else "the file"

    def child(self, key: Key, value: Any) -> Node:
        """Return an entry inside this one."""
        return Node(value, self.document, (*self.keys, key))

    def entries(self) -> dict[str, Node]:
        """Return the entries of a mapping, which must not be empty.

        Raises:
            ActionError: if it is none, is empty, or has keys that are no text.
        """
        found = {}
        for key, node in self.pairs():
            if not isinstance(key, str):
                raise self.error(f"the key {key!r} in {self.what} must be a name")
            found[key] = node
        return found

    def pairs(self) -> list[tuple[Any, Node]]:
        """Return the entries of a mapping with keys of any kind; raises `ActionError`."""
        if not isinstance(self.value, dict):
            raise self.error(f"{self.what} must be a mapping, not {_kind(self.value)}")
        if not self.value:
            raise self.error(f"{self.what} is empty")
        return [(key, self.child(key, value)) for key, value in self.value.items()]

    def fields(self, required: Collection[str], optional: Collection[str] = ()) -> dict[str, Node]:
        """Return the entries of a mapping with known keys.

        Raises:
            ActionError: if a key is unknown or missing.
        """
        entries = self.entries()
        known = [*required, *optional]
        for key, node in entries.items():
            if key not in known:
                raise node.error(f"unknown key '{key}'; {suggestion(key, known)}")
        for key in required:
            if key not in entries:
                raise self.error(f"{self.what} lacks the key '{key}'")
        return entries

    def items(self) -> list[Node]:
        """Return the entries of a list; raises `ActionError` if it is none."""
        if not isinstance(self.value, list):
            raise self.error(f"{self.what} must be a list, not {_kind(self.value)}")
        return [self.child(index, value) for index, value in enumerate(self.value)]

    def string(self) -> str:
        """Return a text; raises `ActionError` if it is none."""
        if not isinstance(self.value, str):
            raise self.error(f"{self.what} must be a text, not {_kind(self.value)}")
        return self.value

    def strings(self) -> tuple[str, ...]:
        """Return a list of texts; raises `ActionError` if it is none."""
        return tuple(item.string() for item in self.items())

    def flag(self) -> bool:
        """Return true or false; raises `ActionError` if it is neither."""
        if not isinstance(self.value, bool):
            raise self.error(f"{self.what} must be true or false, not {_kind(self.value)}")
        return self.value

    def number(self, *, lowest: float = -math.inf) -> float:
        """Return a finite number; raises `ActionError` if it is none or too low."""
        value = self.value
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise self.error(f"{self.what} must be a number, not {_kind(value)}")
        if not abs(value) <= 1e300:
            raise self.error(f"{self.what} must be a finite number, not {value}")
        if value < lowest:
            raise self.error(f"{self.what} is {value:g}; it must be at least {lowest:g}")
        return float(value)

    def numbers(self, count: int) -> tuple[float, ...]:
        """Return a list of ``count`` numbers; raises `ActionError` if it is none."""
        items = self.items()
        if len(items) != count:
            raise self.error(f"{self.what} must have {count} numbers, not {len(items)}")
        return tuple(item.number() for item in items)


def _key_of(node: Any) -> Key:
    if isinstance(node.value, list):
        return tuple(str(getattr(item, "value", item)) for item in node.value)
    return str(node.value)


def _kind(value: Any) -> str:
    match value:
        case None:
            return "empty"
        case bool():
            return "true or false"
        case int() | float():
            return "a number"
        case str():
            return f"the text '{value[:40]}'"
        case list():
            return "a list"
        case dict():
            return "a mapping"
    return f"a {type(value).__name__}"


def read_text(path: Path) -> str:
    """Read a text file of bounded size.

    Raises:
        ActionError: if it cannot be read, is too long or is no UTF-8 text.
    """
    raw = read_bytes(path, "file of actions", ActionError)
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError as error:
        line = raw[: error.start].count(b"\n") + 1
        raise ActionError("is no UTF-8 text", path=path, line=line) from None


def read_document(path: Path) -> Document:
    """Read a YAML file by a safe loader.

    Raises:
        ActionError: if it cannot be read, is empty or is no YAML; with the line.
    """
    text = read_text(path)
    data = read_canonical(text)
    return Document(parse(text, path) if data is None else data, path, text)


def parse(text: str, path: Path) -> Any:
    """Parse YAML text; ``path`` is for messages.

    Raises:
        ActionError: if it is empty or no YAML; with the line.
    """
    from ruamel.yaml.error import MarkedYAMLError, YAMLError

    deep = too_deep(text)
    if deep is not None:
        raise ActionError("is nested too deeply", path=path, line=deep)
    try:
        data = yaml_reader().load(text)
    except MarkedYAMLError as error:
        raise _syntax_error(error, text, path) from None
    except YAMLError as error:
        raise ActionError(f"is no YAML: {str(error).splitlines()[0]}", path=path) from None
    except RecursionError:
        raise ActionError("is nested too deeply", path=path) from None
    except (ValueError, TypeError, LookupError, ArithmeticError, AttributeError) as error:
        raise ActionError(f"is no YAML that can be read: {error}", path=path) from None
    if data is None:
        raise ActionError("is empty", path=path)
    return data


def _syntax_error(error: Any, text: str, path: Path) -> ActionError:
    mark = error.problem_mark or error.context_mark
    line = None if mark is None else mark.line + 1
    lines = text.splitlines()
    if line is not None and line <= len(lines) and "\t" in lines[line - 1]:
        return ActionError("holds a tab; YAML is indented with spaces", path=path, line=line)
    problem = (error.problem or error.context or "not well formed").split("\n")[0]
    return ActionError(f"is no YAML: {problem}", path=path, line=line)
