"""Encode a tick as messages: its states and reference, and the transforms of links."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np

from rtee.hand.frames import JointFrames
from rtee.hand.model import Hand
from rtee.hand.transmission import Transmission
from rtee.log.chunks import MESSAGE, message_head
from rtee.log.settings import RecorderSettings
from rtee.messages.layout import (
    JOINT_ARRAYS,
    JOINT_STATE,
    STAMP,
    Template,
    TransformsEncoder,
    joint_state_fields,
    stamp_bytes,
)
from rtee.messages.state import actuator_state_pieces, actuator_state_template
from rtee.sample import FloatArray, TickRecord

_TIMES = struct.Struct("<IQQ")
"""The last part of a message record's head: sequence, log time and publish time [ns]."""

_HEAD = MESSAGE.size - _TIMES.size
"""The constant first part of that head [bytes]."""

_STEPS = float(2**36)
"""Transforms are rounded to steps of 1.5e-11 [m | 1], far below what can be seen or measured: their
last digits would only fill the files."""


class TickEncoder:
    """Encodes what was known at a tick into message records.

    In the joint states the actuators come first, so that their values repeat those of the actuator
    states in one piece, and the positions and velocities of the joints that follow them are rounded
    to single precision: both make recordings smaller, and they can be recomputed exactly.

    Args:
        joints: Names of all moving joints.
        actuators: Names of the actuators.
        transmission: From actuators to joints.
        channels: Identifiers of the channels of joint states, actuator states and reference.

    Attributes:
        layout: Channel and offset of each message record in the block.
    """

    def __init__(
        self,
        joints: Sequence[str],
        actuators: Sequence[str],
        transmission: Transmission,
        channels: tuple[int, int, int],
    ) -> None:
        following = [row for row, name in enumerate(joints) if name not in actuators]
        self._transmission = transmission
        self._following = np.array(following, dtype=np.intp)
        self._no_effort = np.full(len(following), np.nan).tobytes()
        self._sequence = 0
        fields = joint_state_fields([*actuators, *(joints[row] for row in following)])
        changing = (STAMP, *JOINT_ARRAYS)
        messages = (
            Template(JOINT_STATE, fields, changing),
            actuator_state_template(actuators),
            Template(JOINT_STATE, joint_state_fields(actuators), changing),
        )
        self.layout: list[tuple[int, int]] = []
        self._parts = [b""]  # constant and changing pieces by turns, as in a template
        self._size = 0
        for channel, message in zip(channels, messages, strict=True):
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
        # One copy of everything: a tick takes some ten microseconds to encode.
        block = b"".join(self._parts)
        if len(block) != self._size:
            raise ValueError("the arrays of a tick do not fit the hand")
        return block


def _rounded(values: FloatArray) -> bytes:
    return values.astype(np.float32).astype(np.float64).tobytes()


class LinkTransforms:
    """Encodes the poses of the links of moving joints.

    Args:
        hand: The hand.
        rate: Rate of its loop [Hz].
        settings: How often, among others.
    """

    def __init__(self, hand: Hand, rate: float, settings: RecorderSettings) -> None:
        self._frames = JointFrames(hand)
        self._transmission = hand.transmission
        self._last = hand.transmission.joints(hand.rest)
        parents, children = zip(*self._frames.moving, strict=True)
        self._encoder = TransformsEncoder(parents, children)
        every = rate / settings.tf_rate / settings.decimation if settings.tf_rate else 0.0
        self._turn = -1
        self._every = max(1, round(every)) * settings.decimation if settings.tf_rate else 0

    def due(self, tick: int) -> bool:
        """Whether they are to be recorded at a tick; a missed tick is made up for by the next."""
        # By turns, not by tick % every: a missed tick must not cost a whole turn.
        if not self._every or tick // self._every == self._turn:
            return False
        self._turn = tick // self._every
        return True

    def encode(self, position: FloatArray, wall_ns: int) -> bytes:
        """Return the CDR bytes of a ``tf2_msgs/TFMessage``.

        A joint that is not measured stays where it was last, at rest to begin with.

        Args:
            position: Actuator positions ``(n,)`` [rad | m]; ``NaN``: not measured.
            wall_ns: The time since 1970 [ns].
        """
        q = self._transmission.joints(position)
        self._last = q = np.where(np.isfinite(q), q, self._last)
        translation, rotation = self._frames.at(q)
        return self._encoder.encode(wall_ns, _stepped(translation), _stepped(rotation))


def _stepped(values: FloatArray) -> FloatArray:
    stepped: FloatArray = np.rint(values * _STEPS) / _STEPS
    return stepped
