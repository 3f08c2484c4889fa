"""YAML as plain data that knows its lines: no tags, aliases, tabs, duplicate keys or NaN."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from rtee.errors import ConfigError
from rtee.hand.files import read_bytes

_DEEPEST: Final = 64

MAX_SIZE: Final = 1_000_000

Location = tuple[str | int, ...]

_TAG = "tag:yaml.org,2002:"


@dataclass(frozen=True, slots=True)
class YamlDocument:
    """A YAML document.

    Attributes:
        path: The file it was read from.
        data: Its content: mappings, lists, strings, numbers, booleans and ``None``.
        lines: The line of every key and item, by its location from the root.
    """

    path: Path
    data: Any
    lines: Mapping[Location, int] = field(default_factory=dict)

    def line(self, location: Location) -> int | None:
        """Return the line of a location, or of what encloses it."""
        for end in range(len(location), -1, -1):
            line = self.lines.get(location[:end])
            if line is not None:
                return line
        return None

    def error(self, location: Location, message: str) -> ConfigError:
        """Return an error that names file, line and field."""
        key = ".".join(str(part)[:80] for part in location)
        return ConfigError(
            f"{key}: {message}" if key else message,
            path=self.path,
            line=self.line(location),
            key=key or None,
        )


def read_yaml(path: Path | str, what: str) -> YamlDocument:
    """Read a YAML file whose root is a mapping.

    Args:
        path: The file.
        what: What it should be, for messages, such as ``"hand.yaml"``.

    Raises:
        ConfigError: The file does not exist or cannot be read, is no YAML, or holds a tab, a
            duplicate key, a tag, an anchor, a NaN or an infinite number.
    """
    file = Path(path)
    data = read_bytes(file, what)
    if len(data) > MAX_SIZE:
        raise ConfigError(f"{what} is larger than {MAX_SIZE // 1_000_000} MB", path=file)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise ConfigError(f"{what} is not UTF-8 text", path=file, line=line) from None
    return parse_yaml(text, file, what)


def yaml_reader(*, keep_comments: bool = False) -> Any:
    """Return a ruamel.yaml reader without tags that make objects.

    It is silent about an anchor that is given twice, which YAML 1.2 (section 7.1) allows.
    """
    from ruamel.yaml import YAML

    yaml = YAML() if keep_comments else YAML(typ="safe", pure=True)
    yaml.composer.warn_double_anchors = False
    return yaml


def too_deep(text: str) -> int | None:
    """Return the line from which on a text opens too many brackets, which take long to parse.

    Brackets in quotes and comments count, too; nobody leaves so many of them open there.
    """
    depth = 0
    for number, row in enumerate(text.splitlines(), 1):
        depth += row.count("[") + row.count("{") - row.count("]") - row.count("}")
        if depth > _DEEPEST:
            return number
    return None


def parse_yaml(text: str, path: Path, what: str) -> YamlDocument:
    """Parse the text of a YAML file; see `read_yaml`."""
    from ruamel.yaml.error import MarkedYAMLError, YAMLError

    for number, row in enumerate(text.splitlines(), 1):
        if "\t" in row[: len(row) - len(row.lstrip())]:
            raise ConfigError("a tab in the indentation; use blanks", path=path, line=number)
    deep = too_deep(text)
    if deep is not None:
        raise ConfigError(f"{what} is nested too deeply", path=path, line=deep)
    try:
        node = yaml_reader().compose(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        problem = str(error.problem or error.context)
        if problem.startswith("but "):
            problem = f"{error.context}, {problem}"
        raise ConfigError(
            f"{what} is not YAML: {problem}",
            path=path,
            line=mark.line + 1 if mark else None,
        ) from None
    except (YAMLError, RecursionError, ValueError) as error:
        deep = isinstance(error, RecursionError)
        reason = "nested too deeply" if deep else str(error).splitlines()[0]
        raise ConfigError(f"{what} is not YAML: {reason[:200]}", path=path) from None
    if node is None:
        raise ConfigError(f"{what} is empty", path=path)
    return _Reader(path).read(node, what)


class _Reader:
    """Turns YAML nodes into plain data and remembers their lines."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.lines: dict[Location, int] = {}
        self.seen: set[int] = set()

    def read(self, node: Any, what: str) -> YamlDocument:
        data = self.value(node, ())
        if not isinstance(data, dict):
            raise ConfigError(f"{what} should be keys with values", path=self.path, line=1)
        return YamlDocument(self.path, data, self.lines)

    def value(self, node: Any, location: Location) -> Any:
        line = node.start_mark.line + 1
        self.lines.setdefault(location, line)
        if id(node) in self.seen or node.anchor:
            raise self._error(line, "anchors and aliases are refused; write the value out")
        self.seen.add(id(node))
        tag = str(node.tag or "")
        if not tag.startswith(_TAG):
            raise self._error(line, f"the tag '{tag}' is refused")
        kind = tag.removeprefix(_TAG)
        if kind == "map":
            return self._mapping(node, location)
        if kind == "seq":
            return [self.value(item, (*location, i)) for i, item in enumerate(node.value)]
        return self._scalar(kind, str(node.value), line)

    def _mapping(self, node: Any, location: Location) -> dict[str, Any]:
        data: dict[str, Any] = {}
        for key_node, value_node in node.value:
            line = key_node.start_mark.line + 1
            key = key_node.value
            if not isinstance(key, str):
                raise self._error(line, "a key should be a word")
            if key in data:
                first = self.lines[(*location, key)]
                raise self._error(line, f"'{key[:80]}' stands twice, first in line {first}")
            self.lines[(*location, key)] = line
            data[key] = self.value(value_node, (*location, key))
        return data

    def _scalar(self, kind: str, text: str, line: int) -> Any:
        match kind:
            case "str" | "timestamp":
                return text
            case "null":
                return None
            case "bool":
                return text.lower() == "true"
            case "int":
                return self._integer(text, line)
            case "float":
                return self._float(text, line)
            case _:
                raise self._error(line, f"the tag '{kind}' is refused")

    def _integer(self, text: str, line: int) -> int:
        try:
            digits = text.replace("_", "")
            return int(digits, 0 if digits.lstrip("+-")[:2].lower() in ("0x", "0o", "0b") else 10)
        except ValueError:
            raise self._error(line, f"'{text[:40]}' is not a number") from None

    def _float(self, text: str, line: int) -> float:
        try:
            value = float(text.replace("_", ""))
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self._error(line, f"'{text[:40]}' is not a finite number")
        return value

    def _error(self, line: int, message: str) -> ConfigError:
        return ConfigError(message, path=self.path, line=line)
