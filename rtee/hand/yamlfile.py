"""Read YAML as plain data, with the line of every mistake."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Final

from rtee.errors import ConfigError, UserError, foreign
from rtee.hand.files import read_bytes

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


_DEEPEST: Final = 64
"""Most open brackets: deeper text takes long to parse, and no file of rtee has more than three."""

MAX_SIZE: Final = 1_000_000
"""Largest hand.yaml [characters]; usual ones have a few hundred."""

Location = tuple[str | int, ...]

_TAG = "tag:yaml.org,2002:"


@dataclass(frozen=True)
class YamlDocument:
    """A YAML document.

    Attributes:
        path: The file it was read from.
        data: Its content: mappings, lists, strings, numbers, booleans and ``None``.
        text: The text that holds it.
        known: Its `lines`, if they were found when it was read.
    """

    path: Path
    data: Any
    text: str = ""
    known: Mapping[Location, int] | None = None

    @cached_property
    def lines(self) -> Mapping[Location, int]:
        """The line of every key and item, by its location from the root.

        Of a text that `emit` wrote, only errors need it, so it is read once more then.
        """
        if self.known is not None:
            return self.known
        # The text was judged when it was first read, so this reader need not refuse anything.
        reader = _Reader(self.path, UserError, foreign=True)
        reader.value(yaml_reader().compose(self.text), ())
        return reader.lines

    def line(self, location: Location) -> int | None:
        """Return the line of a location, or of its parent."""
        # A missing key has no line: that of its section comes nearest.
        for end in range(len(location), -1, -1):
            line = self.lines.get(location[:end])
            if line is not None:
                return line
        return None

    def error(
        self, location: Location, message: str, raised: type[UserError] = ConfigError
    ) -> UserError:
        """Return an error that names file, line and field."""
        key = ".".join(str(part)[:80] for part in location)
        words = f"{key}: {message}" if key else message
        error = raised(words, path=self.path, line=self.line(location))
        if isinstance(error, ConfigError):
            error.key = key or None
        return error


def read_yaml(path: Path | str, what: str) -> YamlDocument:
    """Read a YAML file of at most 1 MB whose root is a mapping.

    Args:
        path: The file.
        what: What it should be, for messages, such as ``"hand.yaml"``.

    Raises:
        ConfigError: if the file does not exist or cannot be read, is not YAML, or holds a tab, a
            duplicate key, a tag, an anchor, a NaN or an infinite number.
    """
    file = Path(path)
    text = read_text(file, what)
    if len(text) > MAX_SIZE:
        raise ConfigError(f"{what} is larger than {MAX_SIZE // 1_000_000} MB", path=file)
    return parse_yaml(text, file, what)


def read_text(path: Path, what: str, raised: type[UserError] = ConfigError) -> str:
    """Read a text file.

    Args:
        path: The file.
        what: What it should be, for messages.
        raised: The error to raise.

    Raises:
        UserError: if it cannot be read, is larger than 64 MB, or is not UTF-8 text.
    """
    data = read_bytes(path, what, raised)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise raised(f"{what} is not UTF-8 text", path=path, line=line) from None


def yaml_reader(*, keep_comments: bool = False) -> Any:
    """Return a ruamel.yaml reader without tags that make objects.

    It is silent about an anchor that is given twice, which YAML 1.2 (section 7.1) allows.
    """
    from ruamel.yaml import YAML

    yaml = YAML() if keep_comments else YAML(typ="safe", pure=True)
    yaml.composer.warn_double_anchors = False
    return yaml


def too_deep(text: str) -> int | None:
    """Return the line at which a text exceeds the limit of open brackets, which take long to parse.

    Brackets in quotes and comments count, too; no real file leaves that many open there.
    """
    depth = 0
    for number, row in enumerate(text.splitlines(), 1):
        # Counted without parsing: the parser itself is what deep nesting makes slow.
        depth += row.count("[") + row.count("{") - row.count("]") - row.count("}")
        if depth > _DEEPEST:
            return number
    return None


def parse_yaml(
    text: str,
    path: Path,
    what: str,
    raised: type[UserError] = ConfigError,
    *,
    foreign: bool = False,
) -> YamlDocument:
    """Parse the text of a YAML file.

    Args:
        text: The text.
        path: The file, for messages.
        what: What it should be, for messages.
        raised: The error to raise.
        foreign: Whether a root that is not a mapping, aliases, NaN and keys that are lists are
            allowed, as other programs write them; such a key becomes a tuple of strings.

    Raises:
        UserError: in the same cases as `read_yaml`.
    """
    data = read_emitted(text)
    if data is not None:
        return YamlDocument(path, data, text)
    reader = _Reader(path, raised, foreign=foreign)
    node = _composed(text, path, what, raised, foreign=foreign)
    return YamlDocument(path, reader.document(node, what), text, reader.lines)


def _composed(text: str, path: Path, what: str, raised: type[UserError], *, foreign: bool) -> Any:
    """Return the root node of a YAML text."""
    from ruamel.yaml.error import MarkedYAMLError, YAMLError

    rows = enumerate(text.splitlines(), 1)
    # ruamel.yaml reports a tab as something else, some lines later.
    tab = next((n for n, row in rows if "\t" in row[: len(row) - len(row.lstrip())]), None)
    tabbed = raised("a tab in the indentation; use blanks", path=path, line=tab)
    if tab is not None and not foreign:
        raise tabbed
    deep = too_deep(text)
    if deep is not None:
        raise raised(f"{what} is nested too deeply", path=path, line=deep)
    try:
        node = yaml_reader().compose(text)
    except MarkedYAMLError as error:
        if tab is not None:
            raise tabbed from None
        mark = error.problem_mark or error.context_mark
        problem = str(error.problem or error.context)
        # ruamel.yaml splits one sentence into context and problem.
        if problem.startswith("but "):
            problem = f"{error.context}, {problem}"
        raise raised(
            f"{what} is not YAML: {problem}", path=path, line=mark.line + 1 if mark else None
        ) from None
    except (YAMLError, RecursionError, ValueError) as error:
        deep = isinstance(error, RecursionError)
        reason = "nested too deeply" if deep else str(error).splitlines()[0]
        raise raised(f"{what} is not YAML: {reason[:200]}", path=path) from None
    if node is None:
        raise raised(f"{what} is empty", path=path)
    return node


def _small(value: int) -> int:
    """Return an integer of at most 64 bits; others cannot be printed, or be floats."""
    if value.bit_length() > _BITS:
        raise ValueError("too large")
    return value


_BITS: Final = 64
"""Most bits of an integer: no setting, register or serial number is larger."""

_LINE: Final = re.compile(r'( *)(- )?("(?:[^"\\]|\\.)*"|[^\s:#"\[\]{},][^\s:]*):(?: (\S.*))?')
_TOKEN: Final = re.compile(r'"(?:[^"\\]|\\.)*"|[A-Za-z][^\[\],\s"]*|[^\[\],\s"]+')
_WORDS: Final = frozenset({"true", "false", "null"})


def _as_json(token: re.Match[str]) -> str:
    word = token[0]
    return f'"{word}"' if word[0].isalpha() and word not in _WORDS else word


def read_emitted(text: str) -> dict[str, Any] | None:
    """Return the document if its text is exactly what `emit` writes for it, otherwise ``None``.

    ruamel.yaml reads the SVH's 900 lines of stored actions in 250 ms; this takes 12 ms, and a hand
    starts only when its actions are read. It need not judge the text: what it makes of any text is
    right if `emit` writes the same text for it.
    """
    # `emit` escapes what is not printable, so such a text is not its own. The few texts beyond
    # ASCII are left to ruamel.yaml.
    if not text.isascii() or not text.replace("\n", "").isprintable():
        return None
    lines = text.split("\n")
    body = next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))
    root: dict[str, Any] = {}
    at: dict[int, Any] = {0: root}  # the mappings that are open, by the column of their keys
    opened: dict[int, str] = {}  # the key of each of them that has no value yet
    try:
        # Without the last one, which is empty: the text ends with a line break.
        for line in lines[body:-1]:
            blanks, dash, word, value = _LINE.fullmatch(line).groups()  # type: ignore[union-attr]
            column = len(blanks) + len(dash or "")
            if dash or column not in at:
                inner: dict[str, Any] = {}
                outer, name = at[column - 2], opened[column - 2]
                if dash:
                    outer.setdefault(name, []).append(inner)
                else:
                    outer[name] = inner
                at[column] = inner
            key = json.loads(word) if word[0] == '"' else word
            if value is None:
                opened[column] = key
                # The mapping at that column, if any, belongs to an earlier key.
                at.pop(column + 2, None)
            else:
                at[column][key] = json.loads(
                    _TOKEN.sub(_as_json, value), parse_int=lambda digits: _small(int(digits))
                )
        # The proof: only a text that `emit` would write counts as read.
        same = root and emit(root) == "\n".join(lines[body:])
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError):
        return None
    return root if same else None


_UNDER_WAY: Final = object()

_CONTROL: Final = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]")
"""Characters in a value that change lines or the order of what is read: other line breaks, control
characters, and embedded writing directions."""


class _Reader:
    """Turns YAML nodes into plain data and remembers their lines."""

    def __init__(self, path: Path, raised: type[UserError], *, foreign: bool) -> None:
        self.path = path
        self.raised = raised
        self.foreign = foreign
        self.lines: dict[Location, int] = {}
        self.seen: dict[int, Any] = {}

    def document(self, node: Any, what: str) -> Any:
        data = self.value(node, ())
        if not (self.foreign or isinstance(data, dict)):
            raise self.raised(f"{what} should be keys with values", path=self.path, line=1)
        return data

    def value(self, node: Any, location: Location) -> Any:
        line = node.start_mark.line + 1
        # The key's line is set before and comes first: it is where a user looks.
        self.lines.setdefault(location, line)
        if (id(node) in self.seen or node.anchor) and not self.foreign:
            raise self._error(line, "anchors and aliases are refused; write the value out")
        if id(node) not in self.seen:
            # An alias inside its own value would be read without end.
            self.seen[id(node)] = _UNDER_WAY
            self.seen[id(node)] = self._read(node, location, line)
        elif self.seen[id(node)] is _UNDER_WAY:
            raise self._error(line, "an alias contains itself")
        return self.seen[id(node)]

    def _read(self, node: Any, location: Location, line: int) -> Any:
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
            if self.foreign and key_node.tag == f"{_TAG}seq":
                key = tuple(str(item.value) for item in key)
            elif not isinstance(key, str):
                raise self._error(line, "a key should be a word")
            elif not self.foreign:
                foreign(key, partial(self._error, line))
            if key in data:
                first = self.lines[(*location, key)]
                raise self._error(line, f"'{str(key)[:80]}' occurs twice, first in line {first}")
            self.lines[(*location, key)] = line
            data[key] = self.value(value_node, (*location, key))
        return data

    def _scalar(self, kind: str, text: str, line: int) -> Any:
        match kind:
            # A date stays text: hand.yaml has none, and other programs' files are only shown.
            case "str" | "timestamp":
                # Descriptions may have several lines, and any characters of a person's language.
                for part in () if self.foreign else _CONTROL.findall(text):
                    foreign(part, partial(self._error, line))
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
            # Base 0 would refuse leading zeros, which YAML 1.2 allows.
            base = 0 if digits.lstrip("+-")[:2].lower() in ("0x", "0o", "0b") else 10
            return _small(int(digits, base))
        except ValueError:
            raise self._error(line, f"'{text[:40]}' is not a number of at most 64 bits") from None

    def _float(self, text: str, line: int) -> float:
        try:
            value = float(text.replace("_", ""))
        except ValueError:
            value = math.nan
        if not (self.foreign or math.isfinite(value)):
            raise self._error(line, f"'{text[:40]}' is not a finite number")
        return value

    def _error(self, line: int, message: str) -> UserError:
        return self.raised(message, path=self.path, line=line)
