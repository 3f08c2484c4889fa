"""The messages of one tick: joint states, actuator states and reference, packed only once."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtee.hand.transmission import Transmission
from rtee.log.chunks import MESSAGE, message_head
from rtee.loop.observer import TickRecord
from rtee.messages.layout import (
    ACTUATOR_STATE,
    JOINT_STATE,
    Parts,
    actuator_state_fields,
    joint_state_fields,
    stamp_bytes,
)
from rtee.types import FloatArray

_TIMES = struct.Struct("<IQQ")
_TICK = struct.Struct("<Q")
_TIME = struct.Struct("<d")
_TIMES_OFFSET = MESSAGE.size - _TIMES.size


@dataclass(frozen=True, slots=True)
class TickChannels:
    """Identifiers of the channels that get a message at every tick."""

    joint_states: int
    actuator_states: int
    reference: int


class TickEncoder:
    """Encodes what was known at a tick into message records.

    In the joint states the actuators stand first, so that their values repeat those of the actuator
    states in one piece, and the positions and velocities of the joints that follow them are rounded
    to single precision: both make recordings smaller, and they can be computed anew exactly.

    Args:
        joints: Names of all moving joints.
        actuators: Names of the actuators.
        transmission: From actuators to joints.
        channels: The channels.

    Attributes:
        layout: Channel and offset of each message record in the block.
    """

    def __init__(
        self,
        joints: Sequence[str],
        actuators: Sequence[str],
        transmission: Transmission,
        channels: TickChannels,
    ) -> None:
        following = [row for row, name in enumerate(joints) if name not in actuators]
        self._transmission = transmission
        self._following = np.array(following, dtype=np.intp)
        joints = [*actuators, *(joints[row] for row in following)]
        self._sequence = 0
        messages = (
            (channels.joint_states, JOINT_STATE, joint_state_fields(joints)),
            (channels.actuator_states, ACTUATOR_STATE, actuator_state_fields(actuators)),
            (channels.reference, JOINT_STATE, joint_state_fields(actuators)),
        )
        self._parts: list[bytes] = []
        self._slots: list[dict[str, int]] = []
        self.layout: list[tuple[int, int]] = []
        begin = 0
        for channel, kind, fields in messages:
            data = kind.encode(fields)
            head = message_head(channel, 0, 0, len(data))
            pieces = Parts(kind, data)
            first = len(self._parts)
            self._parts += [head[:_TIMES_OFFSET], head[_TIMES_OFFSET:], *pieces.parts]
            slots = {name: first + 2 + index for name, index in pieces.slots.items()}
            self._slots.append(slots | {"times": first + 1})
            self.layout.append((channel, begin))
            begin += MESSAGE.size + len(data)
        self._size = begin
        self._no_effort = np.full(len(following), math.nan).tobytes()

    def encode(self, record: TickRecord, wall_ns: int) -> bytes:
        """Return the message records of a tick.

        A joint that follows has no effort of its own: ``NaN``.

        Args:
            record: What was known at the tick.
            wall_ns: Its time [ns since 1970].
        """
        sequence = self._sequence = (self._sequence + 1) & 0xFFFFFFFF
        parts = self._parts
        joints, actuators, reference = self._slots
        times = _TIMES.pack(sequence, wall_ns, wall_ns)
        stamp = stamp_bytes(wall_ns)
        for slots in self._slots:
            parts[slots["times"]] = times
            parts[slots["stamp"]] = stamp
        position = record.position.tobytes()
        velocity = record.velocity.tobytes()
        effort = record.effort.tobytes()
        followed = self._transmission.joints(record.position)[self._following]
        moved = self._transmission.velocities(record.position, record.velocity)[self._following]
        parts[joints["position"]] = position + _rounded(followed)
        parts[joints["velocity"]] = velocity + _rounded(moved)
        parts[joints["effort"]] = effort + self._no_effort
        parts[actuators["tick"]] = _TICK.pack(record.tick)
        parts[actuators["time"]] = _TIME.pack(record.stamp)
        parts[actuators["position"]] = position
        parts[actuators["velocity"]] = velocity
        parts[actuators["effort"]] = effort
        parts[actuators["current"]] = record.current.tobytes()
        parts[actuators["temperature"]] = record.temperature.tobytes()
        parts[actuators["grasped"]] = record.grasped.tobytes()
        parts[actuators["fresh"]] = record.fresh.tobytes()
        parts[reference["position"]] = record.reference_position.tobytes()
        parts[reference["velocity"]] = record.reference_velocity.tobytes()
        parts[reference["effort"]] = record.reference_effort.tobytes()
        block = b"".join(parts)
        if len(block) != self._size:
            raise ValueError("the arrays of a tick do not fit the hand")
        return block


def _rounded(values: FloatArray) -> bytes:
    return values.astype(np.float32).astype(np.float64).tobytes()
