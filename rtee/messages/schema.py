"""Messages as types: fields parsed from the definitions, encoding and decoding of any of them."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from rtee.errors import MessageError
from rtee.messages.cdr import SCALARS, Reader, Writer
from rtee.messages.definitions import DEFINITIONS

_LATER = {"rtee_msgs/msg/DeviceStatus": frozenset({"gain"})}
"""Sequences at the end of messages that older recordings do not have."""


@dataclass(frozen=True, slots=True)
class Field:
    """A field of a message.

    Attributes:
        name: Its name.
        kind: A primitive kind, ``string``, or the full name of a message.
        sequence: Whether it is a sequence of those.
        comment: What it is, as the definition says.
    """

    name: str
    kind: str
    sequence: bool
    comment: str = ""

    @property
    def nested(self) -> bool:
        """Whether it holds messages."""
        return "/" in self.kind

    @property
    def notation(self) -> str:
        """Its type as written in the definition."""
        return self.kind.replace("/msg/", "/") + ("[]" if self.sequence else "")


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
        writers = tuple((one.name, _writer_of(one)) for one in self.fields)
        readers = tuple((one.name, _reader_of(one)) for one in self.fields)
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

    def decode_older(self, data: bytes | bytearray | memoryview) -> dict[str, Any]:
        """Return the fields of a message that may have been recorded by an older version.

        Sequences that were added at its end since may be missing; they are empty then.

        Raises:
            MessageError: if the bytes are no such message.
        """
        reader = Reader(data)
        later = _LATER.get(self.name, frozenset())
        values = {
            name: [] if name in later and reader.ended else read(reader)
            for name, read in self._readers
        }
        reader.finish()
        return values

    def write(self, writer: Writer, values: Mapping[str, Any]) -> None:
        """Append a message to a writer; see `encode`."""
        if len(values) != len(self.fields):
            wrong = set(values).symmetric_difference(one.name for one in self.fields)
            raise MessageError(f"{self.name}: missing or unknown fields {sorted(wrong)}")
        name = ""
        try:
            for name, write in self._writers:
                write(writer, values[name])
        except (KeyError, TypeError, ValueError, AttributeError, struct.error) as error:
            if isinstance(error, MessageError):
                raise
            raise MessageError(f"{self.name}.{name}: {error}") from error

    def read(self, reader: Reader) -> dict[str, Any]:
        """Take a message from a reader; see `decode`."""
        return {name: read(reader) for name, read in self._readers}

    @property
    def parts(self) -> tuple[MessageType, ...]:
        """The types of its nested messages, each once, in order."""
        found: dict[str, MessageType] = {}
        for one in self.fields:
            if one.nested:
                inner = message_type(one.kind)
                for part in (inner, *inner.parts):
                    found.setdefault(part.name, part)
        return tuple(found.values())

    @property
    def schema(self) -> str:
        """Definition with those of its nested messages after it, as recordings carry it."""
        texts = [DEFINITIONS[self.name]]
        texts += [f"MSG: {_short(part.name)}\n{DEFINITIONS[part.name]}" for part in self.parts]
        return ("=" * 80 + "\n").join(texts)


def _short(name: str) -> str:
    return name.replace("/msg/", "/")


def _writer_of(field: Field) -> Write:
    kind = field.kind
    if field.nested:
        inner = message_type(kind)

        def write_all(writer: Writer, values: Any) -> None:
            writer.length(len(values))
            for value in values:
                inner.write(writer, value)

        return write_all if field.sequence else inner.write
    if kind == "string":
        return Writer.strings if field.sequence else Writer.string
    if field.sequence:
        return lambda writer, values: writer.array(kind, values)
    return lambda writer, value: writer.scalar(kind, value)


def _reader_of(field: Field) -> Read:
    kind = field.kind
    if field.nested:
        inner = message_type(kind)
        if field.sequence:
            return lambda reader: [inner.read(reader) for _ in range(reader.length(1))]
        return inner.read
    if kind == "string":
        return Reader.strings if field.sequence else Reader.string
    if field.sequence:
        return lambda reader: reader.array(kind)
    return lambda reader: reader.scalar(kind)


def parse(name: str, definition: str) -> MessageType:
    """Return the type that a definition describes.

    Raises:
        MessageError: if a line is outside the subset of the notation that is used here.
    """
    summary: list[str] = []
    fields: list[Field] = []
    for line in definition.splitlines():
        code, _, comment = line.partition("#")
        words = code.split()
        if not words:
            if not fields and comment:
                summary.append(comment.strip())
            continue
        if len(words) != 2:
            raise MessageError(f"{name}: no field definition: '{line}'")
        kind = words[0].removesuffix("[]")
        if "/" in kind:
            kind = "/msg/".join(kind.split("/"))
        elif kind != "string" and kind not in SCALARS:
            raise MessageError(f"{name}: unknown type '{kind}'")
        fields.append(Field(words[1], kind, words[0].endswith("[]"), comment.strip()))
    return MessageType(name, " ".join(summary), tuple(fields))


@cache
def message_type(name: str) -> MessageType:
    """Return a type of messages by its full name, ``rtee_msgs/msg/Goal`` or ``rtee_msgs/Goal``.

    Raises:
        MessageError: if there is no such type.
    """
    full = name if "/msg/" in name else "/msg/".join(name.split("/"))
    try:
        definition = DEFINITIONS[full]
    except KeyError:
        raise MessageError(f"there is no message type '{name}'") from None
    return parse(full, definition)
