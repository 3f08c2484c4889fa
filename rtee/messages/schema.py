"""Types of messages: their fields, parsed from the definitions, and their encoding and decoding."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtee.errors import MessageError
from rtee.messages.cdr import DTYPES, SCALARS, Reader, Writer

_RULE = "=" * 80 + "\n"
"""Line before every definition except the first in a text of several, as in files of rosbag2."""

_DEEPEST = 20
"""Deepest nesting of messages in a recorded definition: rtee's have four levels, and each level
takes a few nested calls of Python."""

_MOST_FIELDS = 1000
"""Most fields of a recorded definition with all nested ones: ten times those of rtee's largest
message; more would only make a damaged or malicious file slow to read."""


def _full(name: str) -> str:
    return name if "/msg/" in name else "/msg/".join(name.split("/"))


def _short(name: str) -> str:
    return name.replace("/msg/", "/")


def sections(text: str, first: str = "") -> dict[str, str]:
    """Return the definitions in a text of several, by the full names of their messages.

    Each is after a rule and a line ``MSG: package/Name``; the text may begin with that of
    ``first``.
    """
    head, *rest = text.split(_RULE)
    definitions = {first: head} if first else {}
    for part in rest:
        name, _, definition = part.partition("\n")
        # Definitions omit the folder `msg` of full names.
        definitions[_full(name.removeprefix("MSG:").strip())] = definition
    return definitions


DEFINITIONS: Final = sections(Path(__file__).with_name("definitions.msg").read_text("utf-8"))
"""Definitions by full name of the message."""


@dataclass(frozen=True, slots=True)
class Field:
    """A field of a message.

    Attributes:
        name: Name of the field.
        kind: A primitive kind, ``string``, or the full name of a message.
        sequence: Whether the field is a sequence.
        comment: Comment in the definition.
        inner: Type of the nested messages, if the field holds messages.
    """

    name: str
    kind: str
    sequence: bool
    comment: str = ""
    inner: MessageType | None = field(default=None, repr=False)

    @property
    def nested(self) -> bool:
        """Whether the field holds messages."""
        return self.inner is not None

    @property
    def notation(self) -> str:
        """The type as written in the definition."""
        return _short(self.kind) + ("[]" if self.sequence else "")

    @property
    def default(self) -> Any:
        """The value in messages of versions that did not define the field."""
        if self.sequence:
            return np.empty(0, DTYPES[self.kind]) if self.kind in DTYPES else []
        if self.inner is not None:
            return self.inner.completed({})
        # NaN means "not measured"; integers have no such value.
        return {"string": "", "bool": False, "float32": math.nan, "float64": math.nan}.get(
            self.kind, 0
        )

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
        summary: Comment at the begin of the definition.
        fields: The fields, in order.
    """

    name: str
    summary: str
    fields: tuple[Field, ...]
    _writers: tuple[tuple[str, Write], ...] = field(init=False, repr=False, compare=False)
    _readers: tuple[tuple[str, Read], ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Select the functions that write and read the fields."""
        writers = tuple((field.name, writer_of(field)) for field in self.fields)
        readers = tuple((field.name, reader_of(field)) for field in self.fields)
        # The only way to set an attribute of a frozen dataclass.
        object.__setattr__(self, "_writers", writers)
        object.__setattr__(self, "_readers", readers)

    def encode(self, values: Mapping[str, Any]) -> bytes:
        """Return the CDR bytes of a message.

        Args:
            values: Every field by name; nested messages are mappings, too.

        Raises:
            MessageError: if a field is missing, unknown, or has the wrong type.
        """
        writer = Writer()
        self.write(writer, values)
        return writer.done()

    def decode(self, data: bytes | bytearray | memoryview) -> dict[str, Any]:
        """Return the fields of a message by name.

        Sequences of numbers are arrays, sequences of strings or messages are lists, nested
        messages are dictionaries.

        Raises:
            MessageError: if the bytes are not such a message.
        """
        reader = Reader(data)
        values = self.read(reader)
        reader.finish()
        return values

    def completed(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the fields of a message of another version, with defaults for missing fields."""
        return {
            field.name: field.completed(values[field.name])
            if field.name in values
            else field.default
            for field in self.fields
        }

    def write(self, writer: Writer, values: Mapping[str, Any]) -> None:
        """Append a message to a writer; see `encode`."""
        # With the right number of values, an unknown field implies a missing one, found below.
        if len(values) != len(self.fields):
            wrong = set(values).symmetric_difference(field.name for field in self.fields)
            raise MessageError(f"{self.name}: missing or unknown fields {sorted(wrong)}")
        name = ""
        try:
            for name, write in self._writers:
                write(writer, values[name])
        except (KeyError, TypeError, ValueError, AttributeError, struct.error) as error:
            # A MessageError is a ValueError, too, and names the field of a nested message.
            if isinstance(error, MessageError):
                raise
            raise MessageError(f"{self.name}.{name}: {error}") from error

    def read(self, reader: Reader) -> dict[str, Any]:
        """Read a message; see `decode`."""
        return {name: read(reader) for name, read in self._readers}

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
    kind, inner = field.kind, field.inner
    if inner is not None:

        def write_all(writer: Writer, values: Any) -> None:
            writer.length(len(values))
            for value in values:
                inner.write(writer, value)

        return write_all if field.sequence else inner.write
    if kind == "string":
        return Writer.strings if field.sequence else Writer.string
    if field.sequence:
        return lambda writer, values: writer.array(kind, values)
    # Most numbers are of this kind; its own method saves looking the kind up.
    if kind == "float64":
        return Writer.double
    return lambda writer, value: writer.scalar(kind, value)


def reader_of(field: Field) -> Read:
    """Return a function that reads the values of a field."""
    kind, inner = field.kind, field.inner
    if inner is not None:
        if field.sequence:
            # A message takes at least one byte; its real size is known only after reading it.
            return lambda reader: [inner.read(reader) for _ in range(reader.length(1))]
        return inner.read
    if kind == "string":
        return Reader.strings if field.sequence else Reader.string
    if field.sequence:
        return lambda reader: reader.array(kind)
    if kind == "float64":
        return Reader.double
    return lambda reader: reader.scalar(kind)


def parse(
    name: str, definition: str, nested: Callable[[str], MessageType] | None = None
) -> MessageType:
    """Return the type of a definition; ``nested`` returns other types, by default `message_type`.

    Raises `MessageError` if a line is outside the supported subset of the notation.
    """
    summary: list[str] = []
    fields: list[Field] = []
    for line in definition.splitlines():
        code, _, comment = line.partition("#")
        words = code.split()
        if not words:
            # Comments before the first field describe the message.
            if not fields and comment:
                summary.append(comment.strip())
            continue
        if len(words) != 2:
            raise MessageError(f"{name}: no field definition: '{line}'")
        kind, inner = words[0].removesuffix("[]"), None
        if "/" in kind:
            kind = _full(kind)
            inner = (nested or message_type)(kind)
        elif kind != "string" and kind not in SCALARS:
            raise MessageError(f"{name}: unknown type '{kind}'")
        fields.append(Field(words[1], kind, words[0].endswith("[]"), comment.strip(), inner))
    return MessageType(name, " ".join(summary), tuple(fields))


@cache
def message_type(name: str) -> MessageType:
    """Return a type of messages by its full name, ``rtee_msgs/msg/Goal`` or ``rtee_msgs/Goal``.

    Raises:
        MessageError: if there is no such type.
    """
    full = _full(name)
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
            raise MessageError(f"{name}: the recorded definition makes no sense")
        return kind

    return type_of(known.name)


def _readable(recorded: MessageType) -> bool:
    """Return whether values of a recorded type can stand for those of the known one."""
    notations = {field.name: field.notation for field in recorded.fields}
    known = message_type(recorded.name).fields if recorded.name in DEFINITIONS else ()
    # A field may be missing or new, but not of another type, and a name that occurs twice would
    # lose one of its values.
    return len(notations) == len(recorded.fields) and all(
        notations.get(field.name, field.notation) == field.notation for field in known
    )
