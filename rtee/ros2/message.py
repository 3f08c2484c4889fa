"""Messages of ROS 2 as Python objects, and their bytes (CDR).

Each message has a class made from its definition: ``JointState(name=["a"], position=[0.5])``.
Fields that are not given are zero, empty, or the definition's default. Fields are attributes of the
message, constants attributes of the class. Sequences and arrays of numbers are decoded into NumPy
arrays, those of ``uint8``, ``byte`` and ``char`` into `bytes`; any sequence of the right kind is
encoded.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from rtee.errors import MessageError, suggestion
from rtee.messages.schema import EMPTY_FIELD, MessageType

_HEADER = 4
"""Length of the header of CDR bytes [bytes]."""


class Message:
    """Base class of messages; see the module for their fields.

    Attributes:
        STRUCTURE: Type of the message.
    """

    __slots__ = ()
    STRUCTURE: ClassVar[MessageType]

    def __init__(self, **fields: Any) -> None:
        for field in self.STRUCTURE.fields:
            name = field.name
            setattr(self, name, fields.pop(name) if name in fields else field.blank(0.0))
        if fields:
            wrong = next(iter(fields))
            known = {field.name for field in self.STRUCTURE.fields} - {EMPTY_FIELD}
            raise MessageError(
                f"{self.STRUCTURE.name} has no field '{wrong}'; {suggestion(wrong, known)}"
            )

    # Called only for names that are not fields.
    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"{self.STRUCTURE.name} has no field '{name}'")

    def __repr__(self) -> str:
        fields = ", ".join(
            f"{each.name}={getattr(self, each.name)!r}" for each in self.STRUCTURE.fields
        )
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
        return self.STRUCTURE.encode(self)

    @classmethod
    def decode(cls, data: bytes | bytearray | memoryview) -> Any:
        """Return the message that CDR bytes encode.

        Raises:
            MessageError: if the bytes do not encode such a message.
        """
        if len(data) == _HEADER and cls.STRUCTURE.fields[0].name == EMPTY_FIELD:
            data = bytes(data) + b"\0"  # dora-rs leaves out the byte of a message without fields
        try:
            return cls.STRUCTURE.decode(data)
        except MessageError as error:
            raise MessageError(f"not a valid {cls.STRUCTURE.name}: {error}") from None

    def to_dict(self) -> dict[str, Any]:
        """Return the fields by name, nested messages as dictionaries and arrays as lists."""
        return {each.name: _plain(getattr(self, each.name)) for each in self.STRUCTURE.fields}

    @classmethod
    def filled(cls, fields: Mapping[str, Any]) -> Any:
        """Return a message from the values of all its fields."""
        # Skip `__init__`, which would look for defaults.
        message = cls.__new__(cls)
        for name, value in fields.items():
            setattr(message, name, value)
        return message

    @classmethod
    def from_dict(cls, fields: Mapping[str, Any]) -> Any:
        """Return a message with these fields; nested messages are mappings, too.

        Raises:
            MessageError: if there is no such field, or a value does not fit its field.
        """
        if not isinstance(fields, Mapping):
            raise MessageError(f"{cls.STRUCTURE.name}: expected fields by name, not '{fields}'")
        inner = {field.name: field.inner for field in cls.STRUCTURE.fields}
        message = cls(**{name: _made(inner.get(name), value) for name, value in fields.items()})
        message.encode()  # to report a wrong value here, with its field
        return message


def _made(kind: MessageType | None, value: Any) -> Any:
    if kind is None:
        return value
    if isinstance(value, (list, tuple)):
        return [_made(kind, each) for each in value]
    return kind.message.from_dict(value)


def _plain(value: Any) -> Any:
    if isinstance(value, Message):
        return value.to_dict()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, (bytes, list, tuple)):
        return [_plain(each) for each in value]
    return value


def message_class(kind: MessageType) -> type[Message]:
    """Return the class of the messages of a type."""
    space: dict[str, Any] = dict(kind.constants)
    space |= {
        # With slots, a misspelt field raises an error instead of being ignored.
        "__slots__": tuple(field.name for field in kind.fields),
        "__module__": __name__,
        "__doc__": f"A message ``{kind.name}``.",
        "STRUCTURE": kind,
    }
    return type(kind.name.rpartition("/")[2], (Message,), space)
