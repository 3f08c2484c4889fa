"""Hashes of types (RIHS01) and the descriptions from which they are computed.

A hash is the SHA-256 of the type's description as JSON, with the descriptions of all types that it
refers to, sorted by name (REP 2016). Two programs exchange messages only if their hashes agree.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable
from typing import Any, Final

from rtee.ros2.notation import PRIMITIVES, Structure

PREFIX: Final = "RIHS01_"
"""Prefix of every hash: the version of the algorithm."""

NO_HASH: Final = "TypeHashNotSupported"
"""Text that Humble, which has no hashes, writes instead of one."""

# Numbers of ``type_description_interfaces/msg/FieldType``.
_NESTED = 1
_BOUNDED_STRING = 21

Description = dict[str, Any]
"""Description of a type: a tree of mappings, lists, texts and integers."""


def describe(structure: Structure) -> Description:
    """Return a structure as an ``IndividualTypeDescription``."""
    fields = []
    for member in structure.members:
        number = PRIMITIVES.get(member.base, _NESTED)
        # PRIMITIVES is indexed by the base's name, of which the bound is not a part.
        if member.longest:
            number = _BOUNDED_STRING
        # rosidl leaves default values out of the hash.
        fields.append(
            {
                "name": member.name,
                "type": {
                    "type_id": number + member.many.value,
                    "capacity": member.capacity,
                    "string_capacity": member.longest,
                    "nested_type_name": member.base if member.nested else "",
                },
            }
        )
    return {"type_name": structure.name, "fields": fields}


def referred(structure: Structure, find: Callable[[str], Structure]) -> list[Structure]:
    """Return all structures that one refers to, directly or not, sorted by name."""
    structures: dict[str, Structure] = {}

    def visit(names: Iterable[str]) -> None:
        for name in names:
            if name not in structures:
                structures[name] = find(name)
                visit(member.base for member in structures[name].members if member.nested)

    visit(member.base for member in structure.members if member.nested)
    return [structures[name] for name in sorted(structures)]


def description(structure: Structure, find: Callable[[str], Structure]) -> Description:
    """Return the ``TypeDescription`` of a structure, with all structures that it refers to.

    ``find`` returns a structure by its full name.
    """
    others = [describe(other) for other in referred(structure, find)]
    return {"type_description": describe(structure), "referenced_type_descriptions": others}


def type_hash(structure: Structure, find: Callable[[str], Structure]) -> str:
    """Return the hash of a structure: ``RIHS01_`` and 64 hexadecimal digits."""
    # Separators and order are hashed, too, and must be those of rosidl.
    text = json.dumps(description(structure, find), separators=(", ", ": "))
    return PREFIX + hashlib.sha256(text.encode()).hexdigest()
