"""Messages with the state of a hand at one tick: measurements, references and further channels."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np

from rtee.errors import MessageError
from rtee.messages.cdr import SCALARS
from rtee.messages.codec import Data, channel_fields, channels_of, header, wall_ns
from rtee.messages.layout import STAMP, Template, stamp_bytes
from rtee.messages.schema import message_type
from rtee.sample import COLUMNS, MEASURED, FloatArray, TickRecord

ACTUATOR_STATE = message_type("rtee_msgs/msg/ActuatorState")
STATE = message_type("rtee_msgs/msg/State")

ACTUATOR_COLUMNS = (*MEASURED, "grasped", "fresh")
"""The quantities in a ``rtee_msgs/ActuatorState``, in order."""

UNKNOWN_GRIP = (math.nan, math.nan, math.nan, "")
"""Opening, force, its error and the source of the estimate, where none is known."""

_GRIP_FIELDS = ("opening", "force", "force_error")
_TICK, _TIME = SCALARS["uint64"], SCALARS["float64"]
_actuator_arrays = attrgetter(*ACTUATOR_COLUMNS)
_arrays = attrgetter(*COLUMNS)


@dataclass(frozen=True, slots=True, kw_only=True)
class State(TickRecord):
    """State of a hand at one tick, with the names of its actuators and joints.

    Attributes:
        names: Names of the actuators, in the order of the arrays.
        joint_names: Names of all moving joints.
        joint_position: Positions of the joints ``(m,)`` [rad | m].
        opening: Opening of the fingertips of the last action that has openings [m]; ``None``:
            unknown.
        force: Estimated force between the fingertips [N]; ``None``: unknown.
        force_error: Error of the estimate [N]; ``None``: unknown.
        force_source: Source of the estimate, as in `rtee.types.Result`.
    """

    names: tuple[str, ...]
    joint_names: tuple[str, ...]
    joint_position: FloatArray
    opening: float | None = None
    force: float | None = None
    force_error: float | None = None
    force_source: str = ""

    @property
    def positions(self) -> dict[str, float]:
        """Measured positions by actuator [rad | m]."""
        return dict(zip(self.names, self.position.tolist(), strict=True))

    def observation(self) -> dict[str, float]:
        """Return the measured quantities as ``position.<actuator>`` and so on.

        The keys are those of `Hand.observation_features`; ``NaN``: not measured.
        """
        columns = {name: getattr(self, name).tolist() for name in MEASURED}
        return {
            f"{name}.{own}": values[i]
            for name, values in columns.items()
            for i, own in enumerate(self.names)
        }

    @property
    def joints(self) -> dict[str, float]:
        """Positions of all moving joints by name [rad | m]."""
        return dict(zip(self.joint_names, self.joint_position.tolist(), strict=True))


def _fields(names: Sequence[str], columns: Iterable[str]) -> dict[str, Any]:
    arrays = {name: np.zeros(len(names), COLUMNS[name].dtype) for name in columns}
    return {"header": header(0), "tick": 0, "time": 0.0, "name": list(names), **arrays}


def actuator_state_fields(names: Sequence[str]) -> dict[str, Any]:
    """Return the fields of a ``rtee_msgs/ActuatorState`` full of zeros."""
    return _fields(names, ACTUATOR_COLUMNS)


def actuator_state_template(names: Sequence[str]) -> Template:
    """Return the template of ``rtee_msgs/ActuatorState`` for these actuators.

    The changing pieces are the stamp and the `actuator_state_pieces`.
    """
    changing = (STAMP, "tick", "time", *ACTUATOR_COLUMNS)
    return Template(ACTUATOR_STATE, actuator_state_fields(names), changing)


def actuator_state_pieces(record: TickRecord) -> list[bytes]:
    """Return the changing pieces of a message except the stamp."""
    arrays = [array.tobytes() for array in _actuator_arrays(record)]
    return [_TICK.pack(record.tick), _TIME.pack(record.stamp), *arrays]


class StateEncoder:
    """Encodes ``rtee_msgs/State`` for a constant set of actuators and joints, by their names."""

    def __init__(self, names: Sequence[str], joints: Sequence[str]) -> None:
        self._fields = _fields(names, COLUMNS)
        self._fields |= {"joint": list(joints), "joint_position": np.zeros(len(joints))}
        self._fields |= dict.fromkeys(_GRIP_FIELDS, 0.0)
        self._templates: dict[tuple[str, tuple[tuple[str, int], ...]], Template] = {}

    def _template(self, channels: Mapping[str, FloatArray], source: str) -> Template:
        """Return the template for channels of these names and lengths, and a source of force."""
        key = source, tuple((name, len(values)) for name, values in channels.items())
        # One for each set of channels and each source, whose names are in the constant pieces.
        template = self._templates.get(key)
        if template is None:
            names = ("channel", "channel_length", "channel_value")
            fields = self._fields | dict(zip(names, channel_fields(channels), strict=True))
            fields["force_source"] = source
            changing = (
                *(STAMP, "tick", "time", *COLUMNS, "joint_position", "channel_value"),
                *_GRIP_FIELDS,
            )
            template = self._templates[key] = Template(STATE, fields, changing)
        return template

    def encode(
        self,
        record: TickRecord,
        joint_position: FloatArray,
        grip: tuple[float, float, float, str] = UNKNOWN_GRIP,
    ) -> bytes:
        """Return the bytes of a message.

        The positions ``(m,)`` [rad | m] are of all moving joints. The grip is the opening of the
        fingertips [m], the force between them and its error [N], and the source of the estimate.
        Raises `ValueError` if an array has another length or type.
        """
        times = stamp_bytes(record.wall_ns), _TICK.pack(record.tick), _TIME.pack(record.stamp)
        arrays = [array.tobytes() for array in (*_arrays(record), joint_position)]
        channels = b"".join([values.tobytes() for values in record.channels.values()])
        *numbers, source = grip
        packed_grip = [SCALARS["float64"].pack(number) for number in numbers]
        template = self._template(record.channels, source)
        return template.filled((*times, *arrays, channels, *packed_grip))


def decode_state(data: Data) -> State:
    """Return the state in a ``rtee_msgs/State``; raise `MessageError` if it is invalid."""
    fields = STATE.decode(data)
    names, joints = tuple(fields["name"]), tuple(fields["joint"])
    lengths = {len(fields[name]) for name in COLUMNS}
    # Users index all arrays of a state by the same names, so that all lengths must agree.
    if lengths != {len(names)} or len(fields["joint_position"]) != len(joints):
        raise MessageError("the arrays of a state have different lengths")
    return State(
        tick=fields["tick"],
        stamp=fields["time"],
        wall_ns=wall_ns(fields),
        names=names,
        joint_names=joints,
        joint_position=fields["joint_position"],
        channels=channels_of(fields["channel"], fields["channel_length"], fields["channel_value"]),
        force_source=fields["force_source"],
        # Messages have no optional numbers.
        **{name: fields[name] for name in _GRIP_FIELDS if not math.isnan(fields[name])},
        **{name: fields[name] for name in COLUMNS},
    )
