"""Hashes of types (RIHS01) and the descriptions from which they are computed.

A hash is the SHA-256 of the type's description as JSON, with the descriptions of all types that it
refers to, sorted by name (REP 2016). Two programs exchange messages only if their hashes agree.
"""

from __future__ import annotations

import hashlib
import json
from typing import Any, Final

from rtee.messages.schema import Field, MessageType

PREFIX: Final = "RIHS01_"
"""Prefix of every hash: the version of the algorithm."""

NO_HASH: Final = "TypeHashNotSupported"
"""Text that Humble, which has no hashes, writes instead of one."""

_PRIMITIVES: Final = {
    "int8": 2,
    "uint8": 3,
    "int16": 4,
    "uint16": 5,
    "int32": 6,
    "uint32": 7,
    "int64": 8,
    "uint64": 9,
    "float32": 10,
    "float64": 11,
    "char": 3,
    "bool": 15,
    "byte": 16,
    "string": 17,
}
"""Numbers of primitive types in ``type_description_interfaces/msg/FieldType``; a ``char`` counts as
``uint8`` (REP 2016). Wide strings are missing, since no message for hands has one."""

_NESTED: Final = 1
_BOUNDED_STRING: Final = 21

Description = dict[str, Any]
"""Description of a type: a tree of mappings, lists, texts and integers."""


def _describe(kind: MessageType) -> Description:
    """Return a type as an ``IndividualTypeDescription``."""
    # rosidl leaves default values out of the hash.
    fields = [
        {
            "name": field.name,
            "type": {
                "type_id": _number(field) + field.many.value,
                "capacity": field.capacity,
                "string_capacity": field.longest,
                "nested_type_name": field.kind if field.nested else "",
            },
        }
        for field in kind.fields
    ]
    return {"type_name": kind.name, "fields": fields}


def _number(field: Field) -> int:
    return _BOUNDED_STRING if field.longest else _PRIMITIVES.get(field.kind, _NESTED)


def referred(kind: MessageType) -> list[MessageType]:
    """Return all types that one refers to, directly or not, sorted by name."""
    return sorted(kind.parts, key=lambda part: part.name)


def description(kind: MessageType) -> Description:
    """Return the ``TypeDescription`` of a type, with all types that it refers to."""
    others = [_describe(other) for other in referred(kind)]
    return {"type_description": _describe(kind), "referenced_type_descriptions": others}


def type_hash(kind: MessageType) -> str:
    """Return the hash of a type: ``RIHS01_`` and 64 hexadecimal digits."""
    # Separators and order are hashed, too, and must be those of rosidl.
    text = json.dumps(description(kind), separators=(", ", ": "))
    return PREFIX + hashlib.sha256(text.encode()).hexdigest()
