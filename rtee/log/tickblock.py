"""The messages of one tick: joint states, actuator states and reference, packed only once."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtee.hand.transmission import Transmission
from rtee.log.chunks import MESSAGE, message_head
from rtee.loop.observer import TickRecord
from rtee.messages.layout import (
    ACTUATOR_STATE,
    JOINT_STATE,
    Template,
    actuator_state_fields,
    joint_state_fields,
)

_TIMES = struct.Struct("<IQQ")
_TIMES_OFFSET = MESSAGE.size - _TIMES.size


@dataclass(frozen=True, slots=True)
class TickChannels:
    """Identifiers of the channels that get a message at every tick."""

    joint_states: int
    actuator_states: int
    reference: int


class JointMap:
    """Positions and velocities of all joints, joint by joint.

    Other than a product with the transmission's matrix it keeps what one actuator does not measure
    (``NaN``) from the joints of the others.
    """

    def __init__(self, transmission: Transmission) -> None:
        couplings = transmission.couplings
        self._follows = np.array([coupling.actuator or 0 for coupling in couplings], dtype=np.intp)
        self._factor = transmission.matrix[np.arange(len(couplings)), self._follows]
        self._offset = transmission.offset
        self._standing = np.flatnonzero([coupling.actuator is None for coupling in couplings])
        self._curved = [
            (row, coupling.actuator, coupling)
            for row, coupling in enumerate(couplings)
            if coupling.actuator is not None and not coupling.linear
        ]

    def fill(
        self, record: TickRecord, position: NDArray[np.float64], velocity: NDArray[np.float64]
    ) -> None:
        """Write joint positions and velocities ``(m,)`` into the arrays given."""
        position[:] = record.position[self._follows] * self._factor + self._offset
        velocity[:] = record.velocity[self._follows] * self._factor
        if self._standing.size:
            position[self._standing] = self._offset[self._standing]
            velocity[self._standing] = 0.0
        for row, actuator, coupling in self._curved:
            where, slope = coupling.dual(float(record.position[actuator]))
            position[row] = where
            velocity[row] = slope * record.velocity[actuator]


class TickEncoder:
    """Encodes what was known at a tick into message records.

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
        self._map = JointMap(transmission)
        self._driven = [joints.index(name) for name in actuators]
        self._sequence = 0
        messages = (
            (channels.joint_states, JOINT_STATE, joint_state_fields(joints)),
            (channels.actuator_states, ACTUATOR_STATE, actuator_state_fields(actuators)),
            (channels.reference, JOINT_STATE, joint_state_fields(actuators)),
        )
        encoded = [(channel, kind, kind.encode(fields)) for channel, kind, fields in messages]
        self._block = bytearray(sum(MESSAGE.size + len(data) for _, _, data in encoded))
        self.layout: list[tuple[int, int]] = []
        templates: list[Template] = []
        begin = 0
        for channel, kind, data in encoded:
            self._block[begin : begin + MESSAGE.size] = message_head(channel, 0, 0, len(data))
            templates.append(Template(kind, data, self._block, begin + MESSAGE.size))
            self.layout.append((channel, begin))
            begin += MESSAGE.size + len(data)
        self._templates = templates
        self._joints, self._actuators, self._reference = (t.views for t in templates)
        self._joints["effort"][:] = math.nan

    def encode(self, record: TickRecord, wall_ns: int) -> bytearray:
        """Return the message records of a tick; the buffer is used again at the next one.

        A mimic joint has no effort of its own: ``NaN``.

        Args:
            record: What was known at the tick.
            wall_ns: Its time [ns since 1970].
        """
        sequence = self._sequence = (self._sequence + 1) & 0xFFFFFFFF
        block = self._block
        for (_, begin), template in zip(self.layout, self._templates, strict=True):
            _TIMES.pack_into(block, begin + _TIMES_OFFSET, sequence, wall_ns, wall_ns)
            template.stamp(wall_ns)
        joints = self._joints
        self._map.fill(record, joints["position"], joints["velocity"])
        joints["effort"][self._driven] = record.effort
        actuators = self._actuators
        actuators["tick"][0] = record.tick
        actuators["time"][0] = record.stamp
        actuators["position"][:] = record.position
        actuators["velocity"][:] = record.velocity
        actuators["effort"][:] = record.effort
        actuators["current"][:] = record.current
        actuators["temperature"][:] = record.temperature
        actuators["grasped"][:] = record.grasped
        actuators["fresh"][:] = record.fresh
        reference = self._reference
        reference["position"][:] = record.reference_position
        reference["velocity"][:] = record.reference_velocity
        reference["effort"][:] = record.reference_effort
        return block
