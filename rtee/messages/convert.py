"""Convert the dataclasses of `rtee.types` and `rtee.commands` to messages and back."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from rtee.commands import (
    Abort,
    BeginStream,
    Cancel,
    Command,
    CommandRecord,
    EndStream,
    Freeze,
    Hold,
    Jog,
    SetAcceptsEffort,
    SetActive,
    SetGripEffort,
    StreamSample,
    StreamTargets,
)
from rtee.errors import MessageError
from rtee.messages.codec import As, Codec, field, mapping, optional, paired, word
from rtee.messages.schema import message_type
from rtee.objects.description import ObjectDescription, ObjectPart
from rtee.objects.shape import Table
from rtee.types import (
    Aim,
    DeviceStatus,
    Event,
    Feedback,
    Lifecycle,
    LoopStatistics,
    Result,
    Shortfall,
)

_STRING = message_type("std_msgs/msg/String")


_SHORTFALL = word(
    "shortfall",
    Shortfall,
    "shortfall '{:.50}' must be end_of_motion, effort_limit, unknown or empty",
)
_AIM = word("aim", Aim, "aim '{:.50}' must be posture, object or contact")

FEEDBACK = Codec(
    "rtee_msgs/msg/Feedback",
    Feedback,
    stamp=field("time"),
    inner_progress=mapping("inner_name", "inner_progress"),
)
"""Feedback in CDR."""
RESULT = Codec(
    "rtee_msgs/msg/Result",
    Result,
    grasped_fingers=field("grasped_fingers", tuple),
    position=mapping("position_name", "position"),
    elements=field("elements", tuple),
    opening=optional("opening"),
    # 0 in recordings from before this field existed.
    opening_error=As(
        {"opening_error": lambda value: math.nan if value is None else value},
        lambda value: value or None if value == value else None,
    ),
    force=optional("force"),
    force_error=optional("force_error"),
    force_asked=optional("force_asked"),
    shortfall=_SHORTFALL,
    within=As(
        {"within": lambda within: -1 if within is None else int(within)},
        lambda number: None if number < 0 else number == 1,
    ),
    touched=field("touched", tuple),
    # Empty in recordings of goals without an aim.
    aim=As({"aim": str}, lambda text: _AIM.unpack(text or Aim.POSTURE)),
)
"""Results of goals in CDR."""
EVENT = Codec("rtee_msgs/msg/Event", Event, stamp=field("time"))
"""Events in CDR."""
DEVICE_STATUS = Codec(
    "rtee_msgs/msg/DeviceStatus",
    DeviceStatus,
    lifecycle=word("lifecycle", Lifecycle, "unknown lifecycle '{}'"),
    identity=mapping("identity_name", "identity_value"),
    counters=mapping("counter_name", "counter_value"),
    gains=field("gain", tuple),
    gain_values=field("gain_value", tuple),
)
"""Statuses of devices in CDR."""
LOOP_STATISTICS = Codec("rtee_msgs/msg/LoopStatistics", LoopStatistics)
"""Statistics of the loop in CDR."""


def _part_fields(parts: Sequence[ObjectPart]) -> list[dict[str, Any]]:
    return [
        {
            "kind": part.kind,
            "size": list(part.size),
            "pose": part.pose,
            "vertex": part.vertices.ravel(),
            "face": part.faces.ravel(),
        }
        for part in parts
    ]


def _parts(entries: Sequence[Mapping[str, Any]]) -> tuple[ObjectPart, ...]:
    try:
        return tuple(
            ObjectPart(
                entry["kind"],
                tuple(float(value) for value in entry["size"]),
                np.asarray(entry["pose"], np.float64),
                np.asarray(entry["vertex"], np.float32).reshape(-1, 3),
                np.asarray(entry["face"], np.uint32).reshape(-1, 3),
            )
            for entry in entries
        )
    except ValueError as error:
        raise MessageError(f"the object cannot be drawn: {error}") from None


OBJECT = Codec("rtee_msgs/msg/Object", ObjectDescription, parts=As({"parts": _part_fields}, _parts))


def table_fields(table: Table | None) -> list[dict[str, Any]]:
    """Return the tables of a ``rtee_msgs/GraspRequest``: one, or none."""
    if table is None:
        return []
    return [{"up": table.up or (), "height": () if table.height is None else (table.height,)}]


def table_of(entries: Sequence[Mapping[str, Any]]) -> Table | None:
    """Return the table that message fields describe; raises `ConfigError` for an invalid one."""
    for entry in entries:
        up, height = (tuple(map(float, entry[name])) for name in ("up", "height"))
        return Table(up or None, *height)  # type: ignore[arg-type]
    return None


Plain = tuple[str, str, Mapping[str, float]]
"""Kind of a command, text and numbers by name."""

_EFFORT = "effort "
"""Prefix of the names of effort limits among the numbers of a stream."""


def plain(command: Command) -> Plain:
    """Return kind, text and numbers of the message for a command.

    Only this function and `typed` define them. They must not change, since older recordings have
    them.
    """
    match command:
        case Cancel(goal_id):
            return "cancel", goal_id, {}
        case Hold(reason):
            return "hold", reason, {}
        case Freeze(reason, actuators):
            # Only the names matter, but the message has a number for each of them.
            return "freeze", reason, dict.fromkeys(actuators, 1.0)
        case Jog(positions, max_velocity):
            # repr gives the shortest text that reads back as the same number, bit for bit.
            limit = "" if math.isinf(max_velocity) else repr(float(max_velocity))
            return "jog", limit, positions
        case SetGripEffort(fraction):
            return "holding", "", {"effort": fraction}
        case SetActive(active):
            return "active", "", {name: float(flag) for name, flag in active.items()}
        case SetAcceptsEffort(accepts):
            return "accepts", "", {name: float(flag) for name, flag in accepts.items()}
        case Abort(reason, actuators):
            return "fail", reason, dict.fromkeys(actuators, 1.0)
        case BeginStream(stream, rate, deadline, max_lag, effort):
            times = {"rate": rate, "deadline": deadline, "max_lag": max_lag}
            return "stream", stream, times | {f"{_EFFORT}{name}": e for name, e in effort.items()}
        case EndStream(stream, reason):
            return "end", f"{stream} {reason}", {}
        case StreamSample():
            raise MessageError("a sample of a stream has its own message type")


def typed(kind: str, text: str, numbers: Mapping[str, float]) -> Command:
    """Return the command in a message; raise `MessageError` if the message is invalid."""
    try:
        match kind:
            case "cancel":
                return Cancel(text)
            case "hold":
                return Hold(text)
            case "freeze":
                return Freeze(text, tuple(numbers))
            case "jog":
                return Jog(numbers, float(text) if text else math.inf)
            case "holding":
                return SetGripEffort(numbers["effort"])
            case "active":
                return SetActive({name: bool(flag) for name, flag in numbers.items()})
            case "accepts":
                return SetAcceptsEffort({name: bool(flag) for name, flag in numbers.items()})
            case "fail":
                return Abort(text, tuple(numbers))
            case "stream":
                rate, deadline, lag = (numbers[k] for k in ("rate", "deadline", "max_lag"))
                effort = {
                    name.removeprefix(_EFFORT): value
                    for name, value in numbers.items()
                    if name.startswith(_EFFORT)
                }
                return BeginStream(text, rate, deadline, lag, effort)
            case "end":
                stream, _, reason = text.partition(" ")
                return EndStream(stream, reason)
    except (ValueError, KeyError) as error:
        raise MessageError(f"the command '{kind}' is not valid: {error}") from None
    # The text comes from a file or the network and may have any length.
    raise MessageError(f"unknown command '{kind[:50]}'")


COMMAND = Codec(
    "rtee_msgs/msg/Command",
    CommandRecord,
    stamp=field("time"),
    command=As(
        {
            "kind": lambda command: plain(command)[0],
            "text": lambda command: plain(command)[1],
            "name": lambda command: list(plain(command)[2]),
            "value": lambda command: list(plain(command)[2].values()),
        },
        lambda kind, text, names, values: typed(kind, text, paired("value", names, values)),
    ),
)
"""Recorded commands in CDR."""


def _sample(**fields: Any) -> StreamSample:
    """Return the sample with these fields of a ``rtee_msgs/StreamSample``."""
    actuators = fields["actuator"]
    return StreamSample(
        fields["stream"],
        fields["stamp"],
        fields["arrival"],
        paired("value", fields["target"], fields["value"]),
        paired("velocity", fields["velocity_name"], fields["velocity"]),
        paired("position", actuators, fields["position"]),
        paired("rate", actuators, fields["rate"]),
    )


_SAMPLE_FIELDS: Mapping[str, Callable[[StreamSample], Any]] = {
    "stream": lambda sample: sample.stream,
    "stamp": lambda sample: sample.stamp,
    "arrival": lambda sample: sample.arrival,
    "target": lambda sample: list(sample.targets),
    "value": lambda sample: list(sample.targets.values()),
    "velocity_name": lambda sample: list(sample.velocity),
    "velocity": lambda sample: list(sample.velocity.values()),
    "actuator": lambda sample: list(sample.positions),
    "position": lambda sample: list(sample.positions.values()),
    # In the order of the positions, with which they share the list of names.
    "rate": lambda sample: [sample.velocities[name] for name in sample.positions],
}

STREAM_SAMPLE = Codec(
    "rtee_msgs/msg/StreamSample",
    CommandRecord,
    stamp=field("time"),
    command=As(
        _SAMPLE_FIELDS,
        lambda *values: _sample(**dict(zip(_SAMPLE_FIELDS, values, strict=True))),
    ),
)
STREAM_TARGETS = Codec(
    "rtee_msgs/msg/StreamTargets",
    StreamTargets,
    targets=mapping("target", "value"),
    velocity=mapping("velocity_name", "velocity"),
)


def encode_string(text: str) -> bytes:
    """Return a ``std_msgs/String``."""
    return _STRING.encode({"data": text})
