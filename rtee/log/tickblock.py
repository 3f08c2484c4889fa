"""The messages of one tick: joint states, actuator states and reference, packed only once."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtee.hand.transmission import Transmission
from rtee.log.chunks import MESSAGE, message_head
from rtee.messages.layout import (
    JOINT_ARRAYS,
    JOINT_STATE,
    STAMP,
    Template,
    joint_state_fields,
    stamp_bytes,
)
from rtee.messages.state import actuator_state_pieces, actuator_state_template
from rtee.sample import TickRecord
from rtee.types import FloatArray

_TIMES = struct.Struct("<IQQ")
"""End of a message record's head: sequence, log time and publish time [ns]."""

_HEAD = MESSAGE.size - _TIMES.size


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
        self._no_effort = np.full(len(following), np.nan).tobytes()
        self._sequence = 0
        fields = joint_state_fields([*actuators, *(joints[row] for row in following)])
        changing = (STAMP, *JOINT_ARRAYS)
        messages = (
            (channels.joint_states, Template(JOINT_STATE, fields, changing)),
            (channels.actuator_states, actuator_state_template(actuators)),
            (channels.reference, Template(JOINT_STATE, joint_state_fields(actuators), changing)),
        )
        self.layout: list[tuple[int, int]] = []
        self._parts = [b""]  # constant and changing pieces by turns, as in a template
        self._size = 0
        for channel, message in messages:
            self.layout.append((channel, self._size))
            self._parts[-1] += message_head(channel, 0, 0, message.size)[:_HEAD]
            self._parts += (b"", *message.parts)
            self._size += MESSAGE.size + message.size

    def encode(self, record: TickRecord, wall_ns: int) -> bytes:
        """Return the message records of a tick.

        A joint that follows has no effort of its own: ``NaN``.

        Args:
            record: What was known at the tick.
            wall_ns: Its time [ns since 1970].

        Raises:
            ValueError: if the arrays do not fit the hand.
        """
        self._sequence = (self._sequence + 1) & 0xFFFFFFFF
        times, stamp = _TIMES.pack(self._sequence, wall_ns, wall_ns), stamp_bytes(wall_ns)
        followed = self._transmission.joints(record.position)[self._following]
        moved = self._transmission.velocities(record.position, record.velocity)[self._following]
        measured = actuator_state_pieces(record)
        position, velocity, effort = measured[2:5]
        self._parts[1::2] = [
            times,
            stamp,
            position + _rounded(followed),
            velocity + _rounded(moved),
            effort + self._no_effort,
            times,
            stamp,
            *measured,
            times,
            stamp,
            record.reference_position.tobytes(),
            record.reference_velocity.tobytes(),
            record.reference_effort.tobytes(),
        ]
        block = b"".join(self._parts)
        if len(block) != self._size:
            raise ValueError("the arrays of a tick do not fit the hand")
        return block


def _rounded(values: FloatArray) -> bytes:
    return values.astype(np.float32).astype(np.float64).tobytes()
