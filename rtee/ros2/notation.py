"""Parser of ROS 2's definitions of messages, services and actions, and the known definitions.

A definition has one line per field, ``TYPE NAME [DEFAULT]``, or constant, ``TYPE NAME = VALUE``;
the parts of a service (request, response) and of an action (goal, result, feedback) are separated
by ``---``. The definitions are in ``rtee/ros2/interfaces``, with one file per package, except those
of recordings (`rtee.messages.schema.DEFINITIONS`), which include rtee's own package ``rtee_msgs``.
"""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass
from enum import Enum
from functools import cache
from importlib.resources import files
from typing import Any, Final

from rtee.errors import MessageError
from rtee.messages.schema import DEFINITIONS

EMPTY_MEMBER: Final = "structure_needs_at_least_one_member"
"""The only member, a ``uint8``, of a definition without members: C has no empty structures."""

PRIMITIVES: Final = {
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
"""Primitive types and their numbers in ``type_description_interfaces/msg/FieldType``; a ``char``
counts as ``uint8`` (REP 2016). Wide strings are missing, since no message for hands has one."""

_RULE = "=" * 80 + "\n"
"""Line between two definitions of a file."""

_PARTS = {"MSG": 1, "SRV": 2, "ACTION": 3}
"""Number of parts of a definition."""

_FIELD = re.compile(
    r"(?P<base>[A-Za-z][\w/]*)(<=(?P<chars>\d+))?(?P<many>\[((?P<bounded><=)?(?P<count>\d+))?\])?"
    r"\s+(?P<name>\w+)\s*(?P<constant>=)?\s*(?P<value>.*)"
)


class Many(Enum):
    """Number of values of a field; each member is the offset of a type's number in a hash."""

    ONE = 0
    ARRAY = 48
    BOUNDED = 96
    SEQUENCE = 144


@dataclass(frozen=True, slots=True)
class Member:
    """A field of a message.

    Attributes:
        name: Name of the field.
        base: A primitive type, or the full name of a message.
        many: Single value, array or sequence.
        capacity: Length of an array, largest length of a bounded sequence, otherwise 0.
        longest: Largest length of its strings [characters]; 0: no bound.
        default: Default value; ``None``: zero or empty.
    """

    name: str
    base: str
    many: Many = Many.ONE
    capacity: int = 0
    longest: int = 0
    default: Any = None

    @property
    def nested(self) -> bool:
        """Whether the field holds messages."""
        return self.base not in PRIMITIVES

    @property
    def notation(self) -> str:
        """The type as written in a definition."""
        bound = f"<={self.longest}" if self.longest else ""
        many = {
            Many.ONE: "",
            Many.ARRAY: f"[{self.capacity}]",
            Many.BOUNDED: f"[<={self.capacity}]",
            Many.SEQUENCE: "[]",
        }[self.many]
        return self.base.replace("/msg/", "/") + bound + many


@dataclass(frozen=True, slots=True)
class Structure:
    """A message, or a part of a service or action.

    Attributes:
        name: Full name, such as ``std_srvs/srv/SetBool_Request``.
        members: The fields, at least one; see `EMPTY_MEMBER`.
        constants: The constants, by name.
    """

    name: str
    members: tuple[Member, ...]
    constants: tuple[tuple[str, Any], ...] = ()


def _value(text: str, base: str) -> Any:
    """Return a constant or default as written in a definition."""
    if base == "bool":
        return text.lower() in {"true", "1"}
    # Strings may be written without quotes.
    if base == "string" and text[:1] not in {'"', "'"}:
        return text
    value = ast.literal_eval(text)
    # Floats may be written as whole numbers: `float64 w 1`.
    return float(value) if base.startswith("float") and isinstance(value, int) else value


def parse(name: str, text: str) -> Structure:
    """Return the structure of a definition without ``---``.

    The package of the full name is that of types named without one. Raises `MessageError` if a line
    defines neither a field nor a constant.
    """
    package = name.partition("/")[0]
    members: list[Member] = []
    constants: list[tuple[str, Any]] = []
    for line in text.splitlines():
        code = line.partition("#")[0].strip()
        if not code:
            continue
        match = _FIELD.fullmatch(code)
        if match is None:
            raise MessageError(f"{name}: no field definition: '{line}'")
        base, value = match["base"], match["value"].strip()
        try:
            given = _value(value, base) if value else None
        except (ValueError, SyntaxError) as error:
            raise MessageError(f"{name}: no value: '{line}'") from error
        if match["constant"]:
            constants.append((match["name"], given))
            continue
        if base not in PRIMITIVES:
            if "/" not in base and base in {"wstring", "wchar", "time", "duration"}:
                raise MessageError(f"{name}: the type '{base}' is not supported")
            base = full_name(base if "/" in base else f"{package}/{base}")
        many = Many.ONE
        if match["many"]:
            many = Many.BOUNDED if match["bounded"] else Many.ARRAY
            many = many if match["count"] else Many.SEQUENCE
        capacity, longest = int(match["count"] or 0), int(match["chars"] or 0)
        members.append(Member(match["name"], base, many, capacity, longest, given))
    if not members:
        members.append(Member(EMPTY_MEMBER, "uint8"))
    return Structure(name, tuple(members), tuple(constants))


def full_name(name: str, kind: str = "msg") -> str:
    """Return ``std_msgs/msg/String`` for ``std_msgs/String`` and for itself."""
    return name if name.count("/") != 1 else name.replace("/", f"/{kind}/")


def split(name: str, text: str) -> list[str]:
    """Return the parts of a definition; raise `MessageError` if their number is wrong."""
    kind = name.split("/")[1].upper()
    parts: list[list[str]] = [[]]
    for line in text.splitlines():
        if line.strip() == "---":
            parts.append([])
        else:
            parts[-1].append(line)
    if len(parts) != _PARTS["MSG" if kind == "MSG" else kind]:
        raise MessageError(f"{name}: {len(parts)} parts separated by ---")
    return ["\n".join(part) + "\n" if part else "" for part in parts]


def _read(text: str) -> dict[str, str]:
    texts = {}
    for section in text.split(_RULE)[1:]:
        head, _, definition = section.partition("\n")
        kind, _, name = head.partition(": ")
        texts[full_name(name.strip(), kind.lower())] = definition
    return texts


_NEWER = {"kilted": "control_msgs_6", "rolling": "control_msgs_6"}
"""Files of definitions that differ from those of Jazzy, by distribution: control_msgs 6.3 added the
index of the current point to FollowJointTrajectory's feedback."""


@cache
def definitions(distro: str = "jazzy") -> dict[str, str]:
    """Return the definitions of all interfaces of a distribution, by full name."""
    newer = f"{_NEWER.get(distro)}.txt"
    differing = set(_NEWER.values())
    texts = dict(DEFINITIONS)
    folder = files("rtee.ros2").joinpath("interfaces")
    for file in sorted(folder.iterdir(), key=lambda file: file.name):
        # A file of newer distributions would replace definitions of Jazzy.
        if file.name.endswith(".txt") and file.name.removesuffix(".txt") not in differing:
            texts |= _read(file.read_text("utf-8"))
    if distro in _NEWER:
        texts |= _read(folder.joinpath(newer).read_text("utf-8"))
    return texts
