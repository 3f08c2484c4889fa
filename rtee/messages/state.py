"""The state of a hand as one message: everything measured and sent in one tick."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtee.errors import MessageError
from rtee.messages.cdr import HEADER
from rtee.messages.convert import Data, header, wall_ns
from rtee.messages.layout import offsets
from rtee.messages.schema import message_type
from rtee.types import BoolArray, FloatArray

STATE = message_type("rtee_msgs/msg/State")

_ARRAYS = (
    "position",
    "velocity",
    "effort",
    "current",
    "temperature",
    "grasped",
    "fresh",
    "reference_position",
    "reference_velocity",
    "reference_effort",
)


@dataclass(frozen=True, slots=True)
class State:
    """What is known of a hand at one tick; arrays ``(n,)`` in the order of ``names``.

    Attributes:
        tick: Number of the tick.
        stamp: When it was due, CLOCK_MONOTONIC of the hand's computer [s].
        wall_ns: The same since 1970 [ns].
        names: The actuators.
        position: Measured [rad | m]; ``NaN``: not measured, as for the others.
        velocity: Measured [rad/s | m/s].
        effort: Measured [N·m | N].
        current: Measured [A].
        temperature: Measured [°C].
        grasped: The devices' own word: 1 holding, 0 not, -1 none given.
        fresh: Measured since the last tick.
        reference_position: Sent to the devices [rad | m].
        reference_velocity: Its velocity [rad/s | m/s].
        reference_effort: Effort limit sent [N·m | N]; ``inf``: the device's own.
        joint_names: All moving joints.
        joint_position: Their positions ``(m,)`` [rad | m].
        channels: Further measured channels, ``device/channel`` to values.
    """

    tick: int
    stamp: float
    wall_ns: int
    names: tuple[str, ...]
    position: FloatArray
    velocity: FloatArray
    effort: FloatArray
    current: FloatArray
    temperature: FloatArray
    grasped: NDArray[np.int8]
    fresh: BoolArray
    reference_position: FloatArray
    reference_velocity: FloatArray
    reference_effort: FloatArray
    joint_names: tuple[str, ...]
    joint_position: FloatArray
    channels: Mapping[str, FloatArray]

    @property
    def positions(self) -> dict[str, float]:
        """Measured positions by actuator [rad | m]."""
        return dict(zip(self.names, self.position.tolist(), strict=True))

    @property
    def joints(self) -> dict[str, float]:
        """Positions of all moving joints by name [rad | m]."""
        return dict(zip(self.joint_names, self.joint_position.tolist(), strict=True))


def encode_state(state: State) -> bytes:
    """Return a ``rtee_msgs/State``."""
    fields: dict[str, Any] = {name: getattr(state, name) for name in _ARRAYS}
    values = list(state.channels.values())
    return STATE.encode(
        fields
        | {
            "header": header(state.wall_ns),
            "tick": state.tick,
            "time": state.stamp,
            "name": state.names,
            "joint": state.joint_names,
            "joint_position": state.joint_position,
            "channel": list(state.channels),
            "channel_length": [len(value) for value in values],
            "channel_value": np.concatenate(values) if values else (),
        }
    )


_STAMP = struct.Struct("<iI")
_TICK_AND_TIME = struct.Struct("<Qd")
_DTYPES = {name: np.dtype(np.float64) for name in _ARRAYS} | {
    "grasped": np.dtype(np.int8),
    "fresh": np.dtype(np.bool_),
}


class StateEncoder:
    """Encodes states of always the same actuators and joints, many times faster.

    Args:
        names: The actuators.
        joints: All moving joints.
    """

    def __init__(self, names: Sequence[str], joints: Sequence[str]) -> None:
        self.names = tuple(names)
        self.joints = tuple(joints)
        self._gaps: dict[tuple[tuple[str, int], ...], list[bytes]] = {}

    def _layout(self, channels: tuple[tuple[str, int], ...]) -> list[bytes]:
        """Return the constant bytes between the arrays, for channels of these lengths."""
        zeros = np.zeros(len(self.names))
        data = encode_state(
            State(
                tick=0,
                stamp=0.0,
                wall_ns=0,
                names=self.names,
                joint_names=self.joints,
                joint_position=np.zeros(len(self.joints)),
                channels={name: np.zeros(length) for name, length in channels},
                **{name: zeros.astype(dtype) for name, dtype in _DTYPES.items()},
            )
        )
        where = offsets(STATE, data)
        gaps, end = [], where["time"][0] + 8
        for name in (*_ARRAYS, "joint_position", "channel_value"):
            offset, count = where[name]
            gaps.append(data[end:offset])
            end = offset + count * _DTYPES.get(name, _DTYPES["position"]).itemsize
        begin = len(HEADER) + _STAMP.size
        return [data[begin : where["tick"][0]], *gaps, data[end:]]

    def encode(self, state: State) -> bytes:
        """Return a ``rtee_msgs/State``; its names and joints must be those of the encoder."""
        values = list(state.channels.values())
        key = tuple((name, len(value)) for name, value in state.channels.items())
        gaps = self._gaps.get(key)
        if gaps is None:
            gaps = self._gaps.setdefault(key, self._layout(key))
        seconds, nanoseconds = divmod(state.wall_ns, 1_000_000_000)
        pieces = [
            HEADER,
            _STAMP.pack(seconds, nanoseconds),
            gaps[0],
            _TICK_AND_TIME.pack(state.tick, state.stamp),
        ]
        arrays = [getattr(state, name) for name in _ARRAYS]
        arrays.append(state.joint_position)
        for gap, array in zip(gaps[1:], arrays, strict=False):
            pieces += (gap, array.tobytes())
        pieces.append(gaps[-2])
        pieces += [value.tobytes() for value in values]
        pieces.append(gaps[-1])
        return b"".join(pieces)


def decode_state(data: Data) -> State:
    """Return the state in a ``rtee_msgs/State``; raises `MessageError`."""
    fields = STATE.decode(data)
    names, joints = tuple(fields["name"]), tuple(fields["joint"])
    lengths = [len(fields[name]) for name in _ARRAYS]
    if set(lengths) != {len(names)} or len(fields["joint_position"]) != len(joints):
        raise MessageError("the arrays of a state have different lengths")
    counts = fields["channel_length"].tolist()
    if len(counts) != len(fields["channel"]) or sum(counts) != len(fields["channel_value"]):
        raise MessageError("the channels of a state and their values do not match")
    split = np.split(fields["channel_value"], np.cumsum(counts)[:-1]) if counts else []
    return State(
        tick=fields["tick"],
        stamp=fields["time"],
        wall_ns=wall_ns(fields),
        names=names,
        joint_names=joints,
        joint_position=fields["joint_position"],
        channels=dict(zip(fields["channel"], split, strict=True)),
        **{name: fields[name] for name in _ARRAYS},
    )
