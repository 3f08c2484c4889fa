"""Messages as types: fields parsed from the definitions, encoding and decoding of any of them."""

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
"""Stands before every definition but the first in a text of several, as in rosbag2's recordings."""

_DEEPEST = 20
"""Messages within messages that a recorded definition may have: rtee's have four, and each takes a
few of Python's nested calls."""

_MOST_FIELDS = 1000
"""Fields that a recorded definition may have with all nested ones: ten times those of the largest
message of rtee; more would only make a damaged or malicious file slow to read."""


def _full(name: str) -> str:
    return name if "/msg/" in name else "/msg/".join(name.split("/"))


def _short(name: str) -> str:
    return name.replace("/msg/", "/")


def sections(text: str, first: str = "") -> dict[str, str]:
    """Return the definitions in a text of several, by the full names of their messages.

    Args:
        text: The definitions, each after a rule and a line ``MSG: package/Name``.
        first: Name of the message that the text begins with, if it begins with one.
    """
    head, *rest = text.split(_RULE)
    found = {first: head} if first else {}
    for part in rest:
        name, _, definition = part.partition("\n")
        # Definitions name types without the folder `msg` that full names have.
        found[_full(name.removeprefix("MSG:").strip())] = definition
    return found


DEFINITIONS: Final = sections(Path(__file__).with_name("definitions.msg").read_text("utf-8"))
"""Full name of a message to its definition."""


@dataclass(frozen=True, slots=True)
class Field:
    """A field of a message.

    Attributes:
        name: Its name.
        kind: A primitive kind, ``string``, or the full name of a message.
        sequence: Whether it is a sequence of those.
        comment: What it is, as the definition says.
        inner: The type of the messages that it holds, if it holds messages.
    """

    name: str
    kind: str
    sequence: bool
    comment: str = ""
    inner: MessageType | None = field(default=None, repr=False)

    @property
    def nested(self) -> bool:
        """Whether it holds messages."""
        return self.inner is not None

    @property
    def notation(self) -> str:
        """Its type as written in the definition."""
        return _short(self.kind) + ("[]" if self.sequence else "")

    @property
    def default(self) -> Any:
        """What it holds in a message that was written before it was defined."""
        if self.sequence:
            return np.empty(0, DTYPES[self.kind]) if self.kind in DTYPES else []
        if self.inner is not None:
            return self.inner.completed({})
        # NaN means `not measured`; integers have no such value.
        return {"string": "", "bool": False, "float32": math.nan, "float64": math.nan}.get(
            self.kind, 0
        )

    def completed(self, value: Any) -> Any:
        """Return what it holds in a message of another version; see `MessageType.completed`."""
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

    How each field is written and read is worked out once: a goal's way to the hand is short.

    Attributes:
        name: Full name, such as ``sensor_msgs/msg/JointState``.
        summary: What it is, as the definition says.
        fields: Its fields, in order.
    """

    name: str
    summary: str
    fields: tuple[Field, ...]
    _writers: tuple[tuple[str, Write], ...] = field(init=False, repr=False, compare=False)
    _readers: tuple[tuple[str, Read], ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Work out how the fields are written and read."""
        writers = tuple((one.name, writer_of(one)) for one in self.fields)
        readers = tuple((one.name, reader_of(one)) for one in self.fields)
        # The only way to set an attribute of a frozen dataclass.
        object.__setattr__(self, "_writers", writers)
        object.__setattr__(self, "_readers", readers)

    def encode(self, values: Mapping[str, Any]) -> bytes:
        """Return the CDR bytes of a message.

        Args:
            values: Every field by name; nested messages are mappings, too.

        Raises:
            MessageError: if a field is missing, unknown, or of the wrong kind.
        """
        writer = Writer()
        self.write(writer, values)
        return writer.done()

    def decode(self, data: bytes | bytearray | memoryview) -> dict[str, Any]:
        """Return the fields of a message by name.

        Sequences of numbers are arrays, sequences of strings or messages are lists, nested
        messages are dictionaries.

        Raises:
            MessageError: if the bytes are no such message.
        """
        reader = Reader(data)
        values = self.read(reader)
        reader.finish()
        return values

    def completed(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the fields of a message of another version, with defaults for what it lacks."""
        return {
            one.name: one.completed(values[one.name]) if one.name in values else one.default
            for one in self.fields
        }

    def write(self, writer: Writer, values: Mapping[str, Any]) -> None:
        """Append a message to a writer; see `encode`."""
        # With as many values, an unknown field leaves another one missing, which raises below.
        if len(values) != len(self.fields):
            wrong = set(values).symmetric_difference(one.name for one in self.fields)
            raise MessageError(f"{self.name}: missing or unknown fields {sorted(wrong)}")
        name = ""
        try:
            for name, write in self._writers:
                write(writer, values[name])
        except (KeyError, TypeError, ValueError, AttributeError, struct.error) as error:
            # A MessageError is a ValueError, too; that of a nested message names its field.
            if isinstance(error, MessageError):
                raise
            raise MessageError(f"{self.name}.{name}: {error}") from error

    def read(self, reader: Reader) -> dict[str, Any]:
        """Read a message; see `decode`."""
        return {name: read(reader) for name, read in self._readers}

    @property
    def parts(self) -> tuple[MessageType, ...]:
        """The types of its nested messages, each once, in order."""
        found: dict[str, MessageType] = {}
        for one in self.fields:
            if one.inner is not None:
                for part in (one.inner, *one.inner.parts):
                    found.setdefault(part.name, part)
        return tuple(found.values())

    @property
    def schema(self) -> str:
        """Definition with those of its nested messages after it, as recordings carry it."""
        texts = [DEFINITIONS[self.name]]
        texts += [f"MSG: {_short(part.name)}\n{DEFINITIONS[part.name]}" for part in self.parts]
        return _RULE.join(texts)


def writer_of(field: Field) -> Write:
    """Return what writes the values of a field."""
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
    # Most numbers are of this kind: a method of its own saves looking the kind up.
    if kind == "float64":
        return Writer.double
    return lambda writer, value: writer.scalar(kind, value)


def reader_of(field: Field) -> Read:
    """Return what reads the values of a field."""
    kind, inner = field.kind, field.inner
    if inner is not None:
        if field.sequence:
            # Every message takes a byte at least; how many it takes, only reading it tells.
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
    """Return the type that a definition describes.

    Args:
        name: Its full name.
        definition: The definition.
        nested: Returns the type of a nested message by its full name; `message_type` unless given.

    Raises:
        MessageError: if a line is outside the subset of the notation that is used here.
    """
    summary: list[str] = []
    fields: list[Field] = []
    for line in definition.splitlines():
        code, _, comment = line.partition("#")
        words = code.split()
        if not words:
            # Comments of lines before the first field are about the whole message.
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
    """Return a type of messages as a recording defines it, which may be of another version.

    Types of ROS itself are the same everywhere and are not read from there.

    Args:
        name: Its full name.
        schema: Its definition in the recording, with those of its nested messages.

    Raises:
        MessageError: if there is no such type, or the definition makes no sense.
    """
    known = message_type(name)
    # The usual case needs no parsing.
    if not known.name.startswith("rtee_msgs/") or schema == known.schema:
        return known
    texts = sections(schema, known.name)
    count = depth = 0

    def made(full: str) -> MessageType:
        nonlocal count, depth
        if full not in texts:
            return message_type(full)
        definition = texts.pop(full)  # a message that holds itself finds no definition any more
        depth += 1
        if depth > _DEEPEST:
            raise MessageError(f"{name}: the recorded definition is nested too deeply")
        found = parse(full, definition, made)
        depth -= 1
        # Back again, since other fields may be of this type, too.
        texts[full] = definition
        # Counted at every use: types that are used twice at each level double the work each time.
        count += len(found.fields)
        if count > _MOST_FIELDS:
            raise MessageError(f"{name}: the recorded definition has too many fields")
        notations = {one.name: one.notation for one in found.fields}
        # Readers expect our types: a field may be missing or new, but not of another type.
        ours = message_type(full).fields if full in DEFINITIONS else ()
        changed = [
            one.name for one in ours if notations.get(one.name, one.notation) != one.notation
        ]
        # A name that occurs twice would lose one of the two values.
        if changed or len(notations) != len(found.fields):
            raise MessageError(f"{name}: the recorded definition makes no sense")
        return found

    return made(known.name)
