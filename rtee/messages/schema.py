"""Types of messages: their fields, parsed from ROS 2's definitions, and their bytes.

A definition has one line per field, ``TYPE NAME [DEFAULT]``, or constant, ``TYPE NAME = VALUE``,
and a comment behind ``#``.
"""

from __future__ import annotations

import ast
import math
import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from functools import cache, partial
from operator import getitem
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtee.errors import MessageError
from rtee.messages.cdr import DTYPES, SCALARS, Reader, Writer

EMPTY_FIELD: Final = "structure_needs_at_least_one_member"
"""The only field, a ``uint8``, of a definition without fields: C has no empty structures."""

_RULE = "=" * 80 + "\n"
"""Line before every definition except the first in a text of several, as in files of rosbag2."""

_DEEPEST = 20
"""Deepest nesting of messages in a recorded definition: rtee's have four levels, and each level
takes a few nested calls of Python."""

_MOST_FIELDS = 1000
"""Most fields of a recorded definition with all nested ones: ten times those of rtee's largest
message; more would only make a damaged or malicious file slow to read."""

_OCTETS = ("uint8", "byte", "char")
"""Kinds whose sequences are `bytes`."""

_FLOATS = ("float64", "float32")
_BLANK = {"string": "", "bool": False}

_LONGEST_VALUE = 200
"""Most characters read of a constant or default: anybody may write definitions in recordings."""

_WRONG = (TypeError, ValueError, AttributeError, struct.error)
"""Errors that values of a wrong type raise."""

_FIELD = re.compile(
    r"(?P<kind>[A-Za-z][\w/]*)(<=(?P<longest>\d+))?(?P<many>\[((?P<most><=)?(?P<count>\d+))?\])?"
    r"\s+(?P<name>\w+)\s*(?P<constant>=)?\s*(?P<value>.*)"
)


def full_name(name: str, kind: str = "msg") -> str:
    """Return ``std_msgs/msg/String`` for ``std_msgs/String`` and for itself."""
    return name if name.count("/") != 1 else name.replace("/", f"/{kind}/")


def _short(name: str) -> str:
    return name.replace("/msg/", "/")


def sections(text: str, first: str = "") -> dict[str, str]:
    """Split a text of several definitions; return them by full name.

    A rule and a line such as ``MSG: package/Name`` precede each definition. The text may begin with
    the definition of ``first``, which has no such head.
    """
    head, *rest = text.split(_RULE)
    definitions = {first: head} if first else {}
    for part in rest:
        title, _, definition = part.partition("\n")
        # Definitions omit the folder, such as `msg`, of full names.
        kind, _, name = title.rpartition(":")
        definitions[full_name(name.strip(), kind.lower() or "msg")] = definition
    return definitions


DEFINITIONS: Final = sections(Path(__file__).with_name("definitions.msg").read_text("utf-8"))
"""Definitions by full name of the message."""


class Many(Enum):
    """Number of values of a field; each member is the offset of a type's number in a hash."""

    ONE = 0
    ARRAY = 48
    BOUNDED = 96
    SEQUENCE = 144


@dataclass(frozen=True, slots=True)
class Field:
    """A field of a message.

    Attributes:
        name: Name of the field.
        kind: A primitive kind, ``string``, or the full name of a message.
        many: Single value, array or sequence.
        capacity: Length of an array, largest length of a bounded sequence, otherwise 0.
        longest: Largest length of its strings [characters]; 0: no bound.
        default: Default value; ``None``: zero or empty.
        comment: Comment in the definition.
        inner: Type of the nested messages, if the field holds messages.
    """

    name: str
    kind: str
    many: Many = Many.ONE
    capacity: int = 0
    longest: int = 0
    default: Any = None
    comment: str = ""
    inner: MessageType | None = field(default=None, repr=False)

    @property
    def nested(self) -> bool:
        """Whether the field holds messages."""
        return self.inner is not None

    @property
    def sequence(self) -> bool:
        """Whether the field holds several values."""
        return self.many is not Many.ONE

    @property
    def notation(self) -> str:
        """The type as written in the definition."""
        bound = f"<={self.longest}" if self.longest else ""
        many = {
            Many.ONE: "",
            Many.ARRAY: f"[{self.capacity}]",
            Many.BOUNDED: f"[<={self.capacity}]",
            Many.SEQUENCE: "[]",
        }
        return _short(self.kind) + bound + many[self.many]

    def blank(self, number: float) -> Any:
        """Return the default value; ``number`` for a floating-point field without a default."""
        if self.default is not None:
            # A new list for each message, since fields may be changed.
            return list(self.default) if isinstance(self.default, list) else self.default
        if self.many is Many.ONE:
            if self.inner is not None:
                return self.inner.blank(number)
            return number if self.kind in _FLOATS else _BLANK.get(self.kind, 0)
        count = self.capacity if self.many is Many.ARRAY else 0
        if self.inner is not None:
            return [self.inner.blank(number) for _ in range(count)]
        if self.kind in _OCTETS:
            return bytes(count)
        return [""] * count if self.kind == "string" else np.zeros(count, DTYPES[self.kind])

    def completed(self, value: Any) -> Any:
        """Return the value in a message of another version; see `MessageType.completed`."""
        if self.inner is None:
            return value
        return (
            list(map(self.inner.completed, value)) if self.sequence else self.inner.completed(value)
        )


Write = Callable[[Writer, Any], None]
Read = Callable[[Reader], Any]


@dataclass(frozen=True, slots=True)
class MessageType:
    """A type of messages.

    Selects the functions that write and read each field once, to keep messages fast.

    Attributes:
        name: Full name, such as ``sensor_msgs/msg/JointState``.
        fields: The fields, in order.
        summary: Comment at the beginning of the definition.
        constants: The constants, by name.
        makes: Makes the class of messages, whose ``filled`` makes one of its fields by name.
        message: That class; ``None``: messages are dictionaries.
    """

    name: str
    fields: tuple[Field, ...]
    summary: str = ""
    constants: tuple[tuple[str, Any], ...] = ()
    makes: Callable[[MessageType], Any] | None = field(default=None, repr=False, compare=False)
    message: Any = field(init=False, repr=False, compare=False)
    _writers: tuple[tuple[str, Write], ...] = field(init=False, repr=False, compare=False)
    _readers: tuple[tuple[str, Read], ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Make the class, and select the functions that write and read the fields."""
        writers = tuple((field.name, writer_of(field)) for field in self.fields)
        readers = tuple((field.name, reader_of(field)) for field in self.fields)
        # The only way to set an attribute of a frozen dataclass.
        object.__setattr__(self, "message", self.makes and self.makes(self))
        object.__setattr__(self, "_writers", writers)
        object.__setattr__(self, "_readers", readers)

    def encode(self, values: Any) -> bytes:
        """Return the CDR bytes of a message.

        Args:
            values: Every field by name, or the attributes; nested messages likewise.

        Raises:
            MessageError: if a field is missing, unknown, or has the wrong type.
        """
        writer = Writer()
        self.write(writer, values)
        return writer.done()

    def decode(self, data: bytes | bytearray | memoryview) -> Any:
        """Return a message: its fields by name, or as attributes.

        Sequences of numbers are arrays, those of bytes `bytes`, those of strings or messages lists,
        nested messages dictionaries.

        Raises:
            MessageError: if the bytes are not such a message.
        """
        reader = Reader(data)
        values = self.read(reader)
        reader.finish()
        return values

    def blank(self, number: float) -> Any:
        """Return a message of default values; see `Field.blank`."""
        values = {field.name: field.blank(number) for field in self.fields}
        return values if self.message is None else self.message.filled(values)

    def completed(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the fields of a message of another version, with defaults for missing fields."""
        return {
            # NaN means "not measured"; integers have no such value.
            field.name: field.completed(values[field.name])
            if field.name in values
            else field.blank(math.nan)
            for field in self.fields
        }

    def write(self, writer: Writer, values: Any) -> None:
        """Append a message to a writer; see `encode`."""
        get: Callable[[Any, str], Any] = getattr if self.message is not None else getitem
        name = ""
        try:
            # With the right number of values, an unknown field implies a missing one, found below.
            if self.message is None and len(values) != len(self.fields):
                names = {field.name for field in self.fields}
                wrong = sorted(map(str, names.symmetric_difference(values.keys())))
                raise MessageError(f"{self.name}: missing or unknown fields {wrong}")
            for name, write in self._writers:
                write(writer, get(values, name))
        except MessageError:  # which already names the field of a nested message
            raise
        except (*_WRONG, LookupError, OverflowError) as error:
            raise self.misfit(name, values) from error

    def misfit(self, name: str, values: Any) -> MessageError:
        """Return the error for values of which that of a field has the wrong type."""
        if not isinstance(values, self.message or Mapping):
            return MessageError(
                f"the fields of a {self.name} by name expected, not {values!r:.100}"
            )
        field = next(field for field in self.fields if field.name == name)
        kind = f"a {field.kind}" if field.many is Many.ONE else f"a list of {field.kind}s"
        value = values.get(name) if isinstance(values, Mapping) else getattr(values, name)
        return MessageError(f"{self.name}.{name}: {kind} expected, not {value!r:.100}")

    def read(self, reader: Reader) -> Any:
        """Read a message; see `decode`."""
        values = {name: read(reader) for name, read in self._readers}
        return values if self.message is None else self.message.filled(values)

    @property
    def parts(self) -> tuple[MessageType, ...]:
        """The types of nested messages, each once, in order."""
        types: dict[str, MessageType] = {}
        for inner in (each.inner for each in self.fields):
            for part in () if inner is None else (inner, *inner.parts):
                types.setdefault(part.name, part)
        return tuple(types.values())

    @property
    def schema(self) -> str:
        """The definition followed by those of nested messages, as in recordings."""
        texts = [DEFINITIONS[self.name]]
        texts += [f"MSG: {_short(part.name)}\n{DEFINITIONS[part.name]}" for part in self.parts]
        return _RULE.join(texts)


def writer_of(field: Field) -> Write:
    """Return a function that writes the values of a field."""
    kind, many = field.kind, field.many
    write_one: Write
    if field.inner is not None:
        write_one = field.inner.write
    elif kind == "string":
        write_one = _bounded_writer(field.longest) if field.longest else Writer.string
        if many is Many.SEQUENCE and not field.longest:
            return Writer.strings
    elif many is Many.SEQUENCE and kind not in _OCTETS:
        return lambda writer, values: writer.array(kind, values)
    elif field.sequence:
        return _numbers_writer(field)
    # Most numbers are of this kind; its own method saves looking the kind up.
    elif kind == "float64":
        return Writer.double
    else:
        return lambda writer, value: writer.scalar(kind, value)
    if many is Many.ONE:
        return write_one

    def write_all(writer: Writer, values: Any) -> None:
        # These are also sequences, whose elements would be written one by one.
        if isinstance(values, (str, bytes)):
            raise TypeError(f"a list of {kind}s expected")
        _check_count(field, len(values))
        if many is not Many.ARRAY:
            writer.length(len(values))
        for value in values:
            write_one(writer, value)

    return write_all


def _bounded_writer(longest: int) -> Write:
    def write(writer: Writer, value: str) -> None:
        if len(value) > longest:
            raise ValueError(f"at most {longest} characters expected")
        writer.string(value)

    return write


def _numbers_writer(field: Field) -> Write:
    def write(writer: Writer, values: Any) -> None:
        # NumPy would take bytes for a single value instead of a sequence.
        if isinstance(values, (bytes, bytearray)):
            values = np.frombuffer(values, np.uint8)
        _check_count(field, len(values))
        if field.many is Many.ARRAY:
            writer.fixed(field.kind, values)
        else:
            writer.array(field.kind, values)

    return write


def reader_of(field: Field) -> Read:
    """Return a function that reads the values of a field."""
    kind, many = field.kind, field.many
    read_one: Read
    if field.inner is not None:
        read_one = field.inner.read
    elif kind == "string":
        if many is Many.SEQUENCE:
            return Reader.strings
        read_one = Reader.string
    elif field.sequence:
        return _numbers_reader(field)
    elif kind == "float64":
        return Reader.double
    else:
        return partial(Reader.scalar, kind=kind)
    if many is Many.ONE:
        return read_one
    if many is Many.ARRAY:
        return lambda reader: [read_one(reader) for _ in range(field.capacity)]

    def read_all(reader: Reader) -> list[Any]:
        # A message takes at least one byte; its real size is known only after reading it.
        count = reader.length(1)
        _check_count(field, count)
        return [read_one(reader) for _ in range(count)]

    return read_all


def _numbers_reader(field: Field) -> Read:
    kind, many = field.kind, field.many
    octets = kind in _OCTETS
    if many is Many.SEQUENCE and not octets:
        return lambda reader: reader.array(kind)

    def read(reader: Reader) -> Any:
        array = many is Many.ARRAY
        values = reader.fixed(kind, field.capacity) if array else reader.array(kind)
        _check_count(field, len(values))
        return values.tobytes() if octets else values

    return read


def _check_count(field: Field, count: int) -> None:
    """Raise `MessageError` if a number of values does not fit a field."""
    if field.many is Many.ARRAY and count != field.capacity:
        raise MessageError(f"{field.name}: {field.capacity} values expected, not {count}")
    if field.many is Many.BOUNDED and count > field.capacity:
        raise MessageError(f"{field.name}: at most {field.capacity} values expected, not {count}")


def _value(text: str, kind: str) -> Any:
    """Return a constant or default as written in a definition."""
    if kind == "bool":
        return text.lower() in {"true", "1"}
    # Strings may be written without quotes.
    if kind == "string" and text[:1] not in {'"', "'"}:
        return text
    value = ast.literal_eval(text[:_LONGEST_VALUE])
    # Floats may be written as whole numbers: `float64 w 1`.
    return float(value) if kind.startswith("float") and isinstance(value, int) else value


def parse(
    name: str,
    definition: str,
    nested: Callable[[str], MessageType] | None = None,
    makes: Callable[[MessageType], Any] | None = None,
) -> MessageType:
    """Return the type of a definition.

    Args:
        name: Full name, whose package is that of types named without one.
        definition: The definition, without ``---``.
        nested: Returns other types by their full names; by default `message_type`.
        makes: See `MessageType`.

    Raises:
        MessageError: if a line defines neither a field nor a constant, or has an unknown type.
    """
    summary: list[str] = []
    fields: list[Field] = []
    constants: list[tuple[str, Any]] = []
    for line in definition.splitlines():
        code, _, comment = map(str.strip, line.partition("#"))
        if not code:
            # Comments before the first field describe the message.
            if comment and not fields:
                summary.append(comment)
            continue
        match = _FIELD.fullmatch(code)
        if match is None:
            raise MessageError(f"{name}: not a field definition: '{line}'")
        kind, value = match["kind"], match["value"]
        try:
            given = _value(value, kind) if value else None
        except (ValueError, SyntaxError, RecursionError, MemoryError) as error:
            raise MessageError(f"{name}: not a value: '{line}'") from error
        if match["constant"]:
            constants.append((match["name"], given))
            continue
        inner = None
        if kind != "string" and kind not in SCALARS:
            kind = full_name(kind if "/" in kind else f"{name.partition('/')[0]}/{kind}")
            inner = (nested or message_type)(kind)
        many = Many.ONE
        if match["many"]:
            many = (
                Many.BOUNDED if match["most"] else Many.ARRAY if match["count"] else Many.SEQUENCE
            )
        capacity, longest = int(match["count"] or 0), int(match["longest"] or 0)
        fields.append(Field(match["name"], kind, many, capacity, longest, given, comment, inner))
    fields = fields or [Field(EMPTY_FIELD, "uint8")]
    return MessageType(name, tuple(fields), " ".join(summary), tuple(constants), makes)


@cache
def message_type(name: str) -> MessageType:
    """Return a type of messages by its full name, ``rtee_msgs/msg/Goal`` or ``rtee_msgs/Goal``.

    Raises:
        MessageError: if there is no such type.
    """
    full = full_name(name)
    try:
        definition = DEFINITIONS[full]
    except KeyError:
        raise MessageError(f"there is no message type '{name}'") from None
    return parse(full, definition)


def recorded_type(name: str, schema: str) -> MessageType:
    """Return a type of messages by its definition in a recording, maybe of another version.

    The definition comes with those of nested messages. Types of ROS itself never differ and are not
    read from it. Raises `MessageError` if there is no such type, or the definition is invalid.
    """
    known = message_type(name)
    # The usual case needs no parsing.
    if not known.name.startswith("rtee_msgs/") or schema == known.schema:
        return known
    texts = sections(schema, known.name)
    count = depth = 0

    def type_of(full: str) -> MessageType:
        nonlocal count, depth
        if full not in texts:
            return message_type(full)
        definition = texts.pop(full)  # removed, so that a message nested in itself is an error
        depth += 1
        if depth > _DEEPEST:
            raise MessageError(f"{name}: the recorded definition is nested too deeply")
        kind = parse(full, definition, type_of)
        depth -= 1
        # Put back, since other fields may be of this type, too.
        texts[full] = definition
        # Counted at every use, since types used twice at each level double the work per level.
        count += len(kind.fields)
        if count > _MOST_FIELDS:
            raise MessageError(f"{name}: the recorded definition has too many fields")
        if not _readable(kind):
            raise MessageError(f"{name}: the recorded definition is not valid")
        return kind

    return type_of(known.name)


def _readable(recorded: MessageType) -> bool:
    """Return whether values of a recorded type can be read as the known type."""
    notations = {field.name: field.notation for field in recorded.fields}
    known = message_type(recorded.name).fields if recorded.name in DEFINITIONS else ()
    # A field may be missing or new, but not of another type, and a name that occurs twice would
    # lose one of its values.
    return len(notations) == len(recorded.fields) and all(
        notations.get(field.name, field.notation) == field.notation for field in known
    )
