"""Messages whose layout never changes between two ticks: packed once, then only filled in.

The names of joints and the lengths of arrays are constant while a hand runs, so every field stands
at the same offset in every message: writing one is putting the changing pieces between the constant
ones, and reading many of them is one view of all at once.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rtee.messages.cdr import HEADER, SCALARS, Reader
from rtee.messages.schema import Field, MessageType, message_type
from rtee.types import FloatArray

_SECOND = 1_000_000_000
_STAMP = struct.Struct("<iI")
_STAMP_OFFSET = len(HEADER)

JOINT_STATE = message_type("sensor_msgs/msg/JointState")
ACTUATOR_STATE = message_type("rtee_msgs/msg/ActuatorState")


def _numeric(field: Field) -> bool:
    return not field.nested and field.kind != "string"


def offsets(kind: MessageType, data: bytes) -> dict[str, tuple[int, int]]:
    """Return where the numbers of a message stand: field to offset [bytes] and count.

    Scalars count 1. Strings and nested messages are left out: their bytes are constant.

    Raises:
        MessageError: if the bytes are no such message.
    """
    found: dict[str, tuple[int, int]] = {}
    reader = Reader(data)
    for field in kind.fields:
        if not _numeric(field):
            MessageType(kind.name, "", (field,)).read(reader)
            continue
        size = SCALARS[field.kind].size
        if field.sequence:
            count = reader.array(field.kind).size
        else:
            reader.scalar(field.kind)
            count = 1
        found[field.name] = (len(data) - reader.remaining - count * size, count)
    reader.finish()
    return found


class Parts:
    """The bytes of one message, cut so that every field that changes is a part of its own.

    Attributes:
        parts: The pieces in order; joined they are the message.
        slots: Field to the index of its piece; ``stamp`` is the time in the header, which must be
            the message's first field.
    """

    def __init__(self, kind: MessageType, data: bytes) -> None:
        sizes = {field.name: SCALARS[field.kind].size for field in kind.fields if _numeric(field)}
        where = {"stamp": (_STAMP_OFFSET, _STAMP.size)} | {
            name: (offset, count * sizes[name])
            for name, (offset, count) in offsets(kind, data).items()
        }
        self.parts: list[bytes] = []
        self.slots: dict[str, int] = {}
        position = 0
        for name, (offset, size) in sorted(where.items(), key=lambda item: item[1][0]):
            self.parts.append(data[position:offset])
            self.slots[name] = len(self.parts)
            self.parts.append(data[offset : offset + size])
            position = offset + size
        self.parts.append(data[position:])


def stamp_bytes(wall_ns: int) -> bytes:
    """Return the bytes of the time in a header: since 1970 [ns]."""
    return _STAMP.pack(*divmod(wall_ns, _SECOND))


def joint_state_fields(names: Sequence[str], frame: str = "") -> dict[str, Any]:
    """Return the fields of a ``sensor_msgs/JointState`` full of zeros."""
    zeros = np.zeros(len(names))
    return {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": frame},
        "name": list(names),
        "position": zeros,
        "velocity": zeros,
        "effort": zeros,
    }


def actuator_state_fields(names: Sequence[str]) -> dict[str, Any]:
    """Return the fields of a ``rtee_msgs/ActuatorState`` full of zeros."""
    zeros = np.zeros(len(names))
    fields: Mapping[str, Any] = joint_state_fields(names)
    return dict(fields) | {
        "tick": 0,
        "time": 0.0,
        "current": zeros,
        "temperature": zeros,
        "grasped": np.full(len(names), -1, dtype=np.int8),
        "fresh": np.zeros(len(names), dtype=bool),
    }


class JointStateEncoder:
    """Encodes ``sensor_msgs/JointState`` of always the same joints.

    Args:
        names: The joints.
        frame: Frame in the header.
    """

    def __init__(self, names: Sequence[str], frame: str = "") -> None:
        self._size = 8 * len(names)
        data = Parts(JOINT_STATE, JOINT_STATE.encode(joint_state_fields(names, frame)))
        self._parts = data.parts
        self._slots = [data.slots[name] for name in ("stamp", "position", "velocity", "effort")]

    def encode(
        self, wall_ns: int, position: FloatArray, velocity: FloatArray, effort: FloatArray
    ) -> bytes:
        """Return the CDR bytes of a message.

        Args:
            wall_ns: Its stamp since 1970 [ns].
            position: Positions ``(n,)`` [rad | m], float64.
            velocity: Velocities ``(n,)`` [rad/s | m/s], float64.
            effort: Efforts ``(n,)`` [N·m | N], float64.

        Raises:
            ValueError: if an array has another length or type.
        """
        if not position.nbytes == velocity.nbytes == effort.nbytes == self._size:
            raise ValueError(f"{self._size // 8} values of float64 expected")
        parts = self._parts
        stamp, first, second, third = self._slots
        parts[stamp] = _STAMP.pack(*divmod(wall_ns, _SECOND))
        parts[first] = position.tobytes()
        parts[second] = velocity.tobytes()
        parts[third] = effort.tobytes()
        return b"".join(parts)
