"""Messages whose layout never changes between two ticks: packed once, then only filled in.

The names of joints and the lengths of arrays are constant while a hand runs, so every field stands
at the same offset in every message. A layout holds the bytes of one message with views of its
fields; writing a message is filling the views, and reading many of them is a view of all at once.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtee.messages.cdr import DTYPES, HEADER, SCALARS, Reader
from rtee.messages.schema import MessageType, message_type
from rtee.types import FloatArray

_SECOND = 1_000_000_000
_STAMP = struct.Struct("<iI")
_STAMP_OFFSET = len(HEADER)

JOINT_STATE = message_type("sensor_msgs/msg/JointState")
ACTUATOR_STATE = message_type("rtee_msgs/msg/ActuatorState")


def offsets(kind: MessageType, data: bytes) -> dict[str, tuple[int, int]]:
    """Return where the numbers of a message stand: field to offset [bytes] and count.

    Scalars count 1. Strings and nested messages are left out: their bytes are constant.

    Raises:
        MessageError: if the bytes are no such message.
    """
    found: dict[str, tuple[int, int]] = {}
    reader = Reader(data)
    for field in kind.fields:
        if field.nested or field.kind == "string":
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


class Template:
    """The bytes of one message in a buffer, with its fields as arrays to be filled.

    Attributes:
        buffer: The bytes; they may be part of a larger buffer.
        views: Its fields of numbers by name, each an array on the buffer.
    """

    def __init__(
        self, kind: MessageType, data: bytes, buffer: bytearray | None = None, start: int = 0
    ) -> None:
        self.buffer = bytearray(data) if buffer is None else buffer
        if buffer is not None:
            buffer[start : start + len(data)] = data
        self._start = start
        self.views: dict[str, NDArray[Any]] = {}
        kinds = {field.name: field.kind for field in kind.fields}
        for name, (offset, count) in offsets(kind, data).items():
            dtype = DTYPES[kinds[name]]
            self.views[name] = np.frombuffer(
                self.buffer, dtype=dtype, count=count, offset=start + offset
            )

    def stamp(self, wall_ns: int) -> None:
        """Fill in the time of the header, which must be the first field: since 1970 [ns]."""
        _STAMP.pack_into(self.buffer, self._start + _STAMP_OFFSET, *divmod(wall_ns, _SECOND))


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
        data = JOINT_STATE.encode(joint_state_fields(names, frame))
        self._size = 8 * len(names)
        where = offsets(JOINT_STATE, data)
        begin = _STAMP_OFFSET + _STAMP.size
        position, velocity, effort = (where[key][0] for key in ("position", "velocity", "effort"))
        count = self._size
        self._before = data[begin:position]
        self._first_gap = data[position + count : velocity]
        self._second_gap = data[velocity + count : effort]

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
        seconds, nanoseconds = divmod(wall_ns, _SECOND)
        return b"".join(
            (
                HEADER,
                _STAMP.pack(seconds, nanoseconds),
                self._before,
                position.tobytes(),
                self._first_gap,
                velocity.tobytes(),
                self._second_gap,
                effort.tobytes(),
            )
        )
