"""Messages of ROS 2 as Python objects, and their bytes (CDR).

Each message has a class made from its definition: ``JointState(name=["a"], position=[0.5])``.
Fields that are not given are zero, empty, or the definition's default. Fields are attributes of the
message, constants attributes of the class. Sequences and arrays of numbers are decoded into NumPy
arrays, those of ``uint8``, ``byte`` and ``char`` into `bytes`; any sequence of the right kind is
encoded.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from rtee.errors import MessageError
from rtee.messages.cdr import DTYPES, SCALARS, Reader, Writer
from rtee.ros2.notation import EMPTY_MEMBER, Many, Member, Structure

_HEADER = 4
"""Length of the header of CDR bytes [bytes]."""

_OCTETS = ("uint8", "byte", "char")
_KINDS = {name: name for name in SCALARS} | {"byte": "uint8", "char": "uint8"}

Write = Callable[[Writer, Any], None]
Read = Callable[[Reader], Any]
Find = Callable[[str], "type[Message]"]


class Message:
    """Base class of messages; see the module for their fields.

    Attributes:
        STRUCTURE: Definition of the message.
    """

    __slots__ = ()
    STRUCTURE: ClassVar[Structure]
    _WRITERS: ClassVar[tuple[tuple[str, Write], ...]]
    _READERS: ClassVar[tuple[tuple[str, Read], ...]]
    _DEFAULTS: ClassVar[Mapping[str, Callable[[], Any]]]
    _INNER: ClassVar[Mapping[str, type[Message]]]

    def __init__(self, **fields: Any) -> None:
        for name, default in self._DEFAULTS.items():
            setattr(self, name, fields.pop(name) if name in fields else default())
        if fields:
            raise MessageError(f"{self.STRUCTURE.name} has no field '{next(iter(fields))}'")

    # Called only for names that are not fields.
    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"{self.STRUCTURE.name} has no field '{name}'")

    def __repr__(self) -> str:
        fields = ", ".join(f"{name}={getattr(self, name)!r}" for name in self._DEFAULTS)
        return f"{type(self).__name__}({fields})"

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Message) or other.STRUCTURE != self.STRUCTURE:
            return NotImplemented
        # Compare the bytes, since a list and an array of the same numbers are equal fields.
        return self.encode() == other.encode()

    __hash__ = None  # type: ignore[assignment]  # it can be changed

    def encode(self) -> bytes:
        """Return the CDR bytes of the message.

        Raises:
            MessageError: if a value does not fit its field.
        """
        writer = Writer()
        self._write(writer)
        return writer.done()

    @classmethod
    def decode(cls, data: bytes | bytearray | memoryview) -> Any:
        """Return the message of CDR bytes.

        Raises:
            MessageError: if the bytes are not those of such a message.
        """
        reader = Reader(data)
        try:
            if len(data) == _HEADER and cls.STRUCTURE.members[0].name == EMPTY_MEMBER:
                return cls()  # dora-rs leaves out the byte of a message without fields
            message = cls._read(reader)
            reader.finish()
        except MessageError as error:
            raise MessageError(f"no {cls.STRUCTURE.name}: {error}") from None
        return message

    def to_dict(self) -> dict[str, Any]:
        """Return the fields by name, nested messages as dictionaries and arrays as lists."""
        return {name: _plain(getattr(self, name)) for name in self._DEFAULTS}

    @classmethod
    def from_dict(cls, fields: Mapping[str, Any]) -> Any:
        """Return a message with these fields; nested messages are mappings, too.

        Raises:
            MessageError: if there is no such field, or a value does not fit its field.
        """
        if not isinstance(fields, Mapping):
            raise MessageError(f"{cls.STRUCTURE.name}: fields by name expected, not '{fields}'")
        values = {}
        for name, value in fields.items():
            inner = cls._INNER.get(name)
            if inner is not None and isinstance(value, (list, tuple)):
                value = [inner.from_dict(each) for each in value]
            elif inner is not None:
                value = inner.from_dict(value)
            values[name] = value
        message = cls(**values)
        message.encode()  # to report a wrong value here, with its field
        return message

    def _write(self, writer: Writer) -> None:
        write_fields(self, writer, self)

    @classmethod
    def _read(cls, reader: Reader) -> Any:
        # Skip `__init__`, all of whose defaults would be replaced.
        message = cls.__new__(cls)
        for name, read in cls._READERS:
            setattr(message, name, read(reader))
        return message


def write_fields(kind: Message | type[Message], writer: Writer, message: Any) -> None:
    """Append the fields of a message; raise `MessageError` if a value does not fit its field."""
    name = ""
    try:
        for name, write in kind._WRITERS:  # noqa: SLF001 - of the same module
            write(writer, getattr(message, name))
    except MessageError:  # which already names the innermost field
        raise
    except (TypeError, ValueError, AttributeError, OverflowError, struct.error) as error:
        raise MessageError(f"{kind.STRUCTURE.name}.{name}: {error}") from error


def _plain(value: Any) -> Any:
    if isinstance(value, Message):
        return value.to_dict()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, (bytes, list, tuple)):
        return [_plain(each) for each in value]
    return value


def message_class(structure: Structure, find: Find) -> type[Message]:
    """Return the class of a message; ``find`` returns that of a nested one by its full name."""
    inner = {member.name: find(member.base) for member in structure.members if member.nested}
    members = structure.members
    space: dict[str, Any] = dict(structure.constants)
    space |= {
        # With slots, a misspelt field raises an error instead of being ignored.
        "__slots__": tuple(member.name for member in members),
        "__module__": __name__,
        "__doc__": f"A message ``{structure.name}``.",
        "STRUCTURE": structure,
        "_INNER": inner,
        "_DEFAULTS": {m.name: _default(m, inner.get(m.name)) for m in members},
        "_WRITERS": tuple((m.name, _writer(m, inner.get(m.name))) for m in members),
        "_READERS": tuple((m.name, _reader(m, inner.get(m.name))) for m in members),
    }
    return type(structure.name.rpartition("/")[2], (Message,), space)


def _default(member: Member, inner: type[Message] | None) -> Callable[[], Any]:
    """Return a function that makes the default value of a field."""
    given, base, count = member.default, member.base, member.capacity
    if given is not None:
        # A new list for each message, since fields may be changed.
        return (lambda: list(given)) if isinstance(given, (list, tuple)) else (lambda: given)
    if member.many is not Many.ONE:
        count = count if member.many is Many.ARRAY else 0
        if inner is not None:
            return lambda: [inner() for _ in range(count)]
        if base in _OCTETS:
            return lambda: bytes(count)
        if base == "string":
            return lambda: [""] * count
        return lambda: np.zeros(count, DTYPES[_KINDS[base]])
    if inner is not None:
        return inner
    return {"string": str, "bool": bool, "float32": float, "float64": float}.get(base, int)


def _sized(member: Member, values: Sequence[Any]) -> None:
    """Raise `ValueError` if the length of a sequence or array does not fit its type."""
    count, capacity = len(values), member.capacity
    if member.many is Many.ARRAY and count != capacity:
        raise ValueError(f"{capacity} values expected, not {count}")
    if member.many is Many.BOUNDED and count > capacity:
        raise ValueError(f"at most {capacity} values expected, not {count}")


def _text(member: Member, value: str) -> None:
    if not isinstance(value, str):
        raise TypeError(f"a text expected, not {value!r}")
    if member.longest and len(value) > member.longest:
        raise ValueError(f"at most {member.longest} characters expected")


def _writer(member: Member, inner: type[Message] | None) -> Write:
    """Return a function that writes the values of a field."""
    if inner is not None:

        def write_one(writer: Writer, value: Any) -> None:
            write_fields(inner, writer, value)

    elif member.base == "string":

        def write_one(writer: Writer, value: Any) -> None:
            _text(member, value)
            writer.string(value)

    else:
        kind = _KINDS[member.base]
        if member.many is not Many.ONE:
            return _numbers_writer(member, kind)
        # Most numbers of a hand are doubles; their own method saves a look-up for each.
        if kind == "float64":
            return Writer.double
        return lambda writer, value: writer.scalar(kind, value)
    if member.many is Many.ONE:
        return write_one

    def many(writer: Writer, values: Any) -> None:
        # These are sequences, too, whose elements would be written one by one.
        if isinstance(values, (str, bytes)):
            raise TypeError("a list expected")
        _sized(member, values)
        if member.many is not Many.ARRAY:
            writer.length(len(values))
        for value in values:
            write_one(writer, value)

    return many


def _numbers_writer(member: Member, kind: str) -> Write:
    def write(writer: Writer, values: Any) -> None:
        # NumPy would take bytes for a single value instead of a sequence.
        if isinstance(values, (bytes, bytearray)):
            values = np.frombuffer(values, np.uint8)
        _sized(member, values)
        if member.many is Many.ARRAY:
            writer.fixed(kind, values)
        else:
            writer.array(kind, values)

    return write


def _reader(member: Member, inner: type[Message] | None) -> Read:
    """Return a function that reads the values of a field."""
    read_one: Read
    if inner is not None:
        read_one = inner._read  # noqa: SLF001 - of the same module
    elif member.base == "string":
        read_one = Reader.string
    else:
        kind = _KINDS[member.base]
        if member.many is not Many.ONE:
            return _numbers_reader(member, kind)
        read_one = Reader.double if kind == "float64" else lambda reader: reader.scalar(kind)
    if member.many is Many.ONE:
        return read_one
    if member.many is Many.ARRAY:
        return lambda reader: [read_one(reader) for _ in range(member.capacity)]
    # Least size of an element [bytes]: a string has 4 for its length and a closing NUL.
    least = 5 if member.base == "string" else 1

    def many(reader: Reader) -> list[Any]:
        count = reader.length(least)
        if member.many is Many.BOUNDED and count > member.capacity:
            raise MessageError(f"{count} values where at most {member.capacity} may be")
        return [read_one(reader) for _ in range(count)]

    return many


def _numbers_reader(member: Member, kind: str) -> Read:
    octets = member.base in _OCTETS

    def read(reader: Reader) -> Any:
        if member.many is Many.ARRAY:
            values = reader.fixed(kind, member.capacity)
        else:
            values = reader.array(kind)
            if member.many is Many.BOUNDED and len(values) > member.capacity:
                raise MessageError(f"{len(values)} values where at most {member.capacity} may be")
        return values.tobytes() if octets else values

    return read
