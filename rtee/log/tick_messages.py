"""Encode a tick as messages: states, reference, and the transforms of links."""

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
"""Layout of the end of a message record's head: sequence, log time and publish time [ns]."""

_HEAD = MESSAGE.size - _TIMES.size
"""Length of the constant begin of that head [bytes]."""

_STEPS = float(2**36)
"""Number of steps per unit to which transforms are rounded: steps of 1.5e-11 [m | 1] are far below
any measurement, and rounded digits compress better."""


class TickEncoder:
    """Encodes the record of a tick into message records.

    In the joint states, the actuators come first, so that their values repeat those of the actuator
    states in one piece. Positions and velocities of the joints that follow actuators are rounded to
    single precision. Both make recordings smaller, and the exact values can be recomputed.

    The channels are those of joint states, actuator states and reference; `layout` has channel and
    offset of each message record in the block.
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
        # Constant and changing pieces alternate, as in a template; the changing ones are odd.
        self._parts = [b""]
        self._size = 0
        for channel, message in zip(channels, messages, strict=True):
            self.layout.append((channel, self._size))
            self._parts[-1] += message_head(channel, 0, 0, message.size)[:_HEAD]
            self._parts += (b"", *message.parts)
            self._size += MESSAGE.size + message.size

    def encode(self, record: TickRecord, wall_ns: int) -> bytes:
        """Return the message records of a tick at a time [ns since 1970].

        A joint that follows an actuator has no effort of its own, hence ``NaN``. Raises
        `ValueError` if the arrays do not fit the hand.
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
        # A single copy, which keeps the encoding of a tick at some 10 µs.
        block = b"".join(self._parts)
        if len(block) != self._size:
            raise ValueError("the arrays of a tick do not fit the hand")
        return block


def _rounded(values: FloatArray) -> bytes:
    return values.astype(np.float32).astype(np.float64).tobytes()


class LinkTransforms:
    """Encodes the poses of the links of moving joints, at the rate in the recorder's settings.

    ``rate`` is that of the hand's loop [Hz].
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
        """Return whether to record transforms at a tick, or at the next one after a missed tick."""
        # With tick % every, a missed tick would skip a whole period.
        if not self._every or tick // self._every == self._turn:
            return False
        self._turn = tick // self._every
        return True

    def encode(self, position: FloatArray, wall_ns: int) -> bytes:
        """Return the CDR bytes of a ``tf2_msgs/TFMessage`` at a time since 1970 [ns].

        An actuator without a position ``(n,)`` [rad | m], which is ``NaN``, keeps its last one,
        at first the rest position.
        """
        q = self._transmission.joints(position)
        self._last = q = np.where(np.isfinite(q), q, self._last)
        translation, rotation = self._frames.at(q)
        return self._encoder.encode(wall_ns, _stepped(translation), _stepped(rotation))


def _stepped(values: FloatArray) -> FloatArray:
    stepped: FloatArray = np.rint(values * _STEPS) / _STEPS
    return stepped
