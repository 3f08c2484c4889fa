"""Between the dataclasses of `rtee.types` and the bytes of their messages."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

from rtee.errors import MessageError
from rtee.messages.goal import paired, stage_of
from rtee.messages.schema import message_type
from rtee.types import (
    DeviceStatus,
    Event,
    Feedback,
    Goal,
    Lifecycle,
    LoopStatistics,
    Result,
)

Data = bytes | bytearray | memoryview

_SECOND = 1_000_000_000
_FEEDBACK = message_type("rtee_msgs/msg/Feedback")
_RESULT = message_type("rtee_msgs/msg/Result")
_EVENT = message_type("rtee_msgs/msg/Event")
_DEVICE_STATUS = message_type("rtee_msgs/msg/DeviceStatus")
_LOOP_STATISTICS = message_type("rtee_msgs/msg/LoopStatistics")
_STRING = message_type("std_msgs/msg/String")


def _names(kind: type, *converted: str) -> tuple[str, ...]:
    """Return the attributes that are fields of the message as they are."""
    return tuple(field.name for field in dataclasses.fields(kind) if field.name not in converted)


_GOAL_FIELDS = _names(Goal, "elements", "kind", "effort", "timeout", "stage")
_RESULT_FIELDS = _names(Result, "grasped_fingers", "position")
_DEVICE_FIELDS = _names(DeviceStatus, "lifecycle", "identity", "counters", "gains")
_STATISTICS_FIELDS = _names(LoopStatistics)


def header(wall_ns: int, frame: str = "") -> dict[str, Any]:
    """Return the fields of a header for a time since 1970 [ns]."""
    seconds, nanoseconds = divmod(wall_ns, _SECOND)
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame}


def wall_ns(fields: Mapping[str, Any]) -> int:
    """Return the time since 1970 [ns] in the header of a decoded message."""
    stamp = fields["header"]["stamp"]
    return int(stamp["sec"]) * _SECOND + int(stamp["nanosec"])


def _taken(source: object, names: Sequence[str]) -> dict[str, Any]:
    return {name: getattr(source, name) for name in names}


def _numbers(what: str, names: Sequence[str], values: Any) -> dict[str, float]:
    return paired(what, names, values.tolist())


def goal_of(fields: Mapping[str, Any]) -> Goal:
    """Return the goal in the fields of a decoded ``rtee_msgs/Goal``; raises `MessageError`."""
    return Goal(
        **{name: fields[name] for name in _GOAL_FIELDS},
        kind=fields["kind"] or None,
        elements=tuple(fields["elements"]),
        effort=_numbers("effort", fields["effort_name"], fields["effort"]),
        timeout=None if math.isnan(fields["timeout"]) else fields["timeout"],
        stage=stage_of(fields["stage"]),
    )


def encode_feedback(feedback: Feedback, *, wall: int = 0) -> bytes:
    """Return a ``rtee_msgs/Feedback``; ``wall`` is its stamp since 1970 [ns]."""
    return _FEEDBACK.encode(
        {
            "header": header(wall),
            "time": feedback.stamp,
            "goal_id": feedback.goal_id,
            "progress": feedback.progress,
            "inner": feedback.inner,
            "inner_name": list(feedback.inner_progress),
            "inner_progress": list(feedback.inner_progress.values()),
        }
    )


def decode_feedback(data: Data) -> Feedback:
    """Return the feedback in a ``rtee_msgs/Feedback``; raises `MessageError`."""
    return feedback_of(_FEEDBACK.decode(data))


def feedback_of(fields: Mapping[str, Any]) -> Feedback:
    """Return the feedback in decoded fields; raises `MessageError`."""
    return Feedback(
        goal_id=fields["goal_id"],
        progress=fields["progress"],
        inner=fields["inner"],
        inner_progress=_numbers("inner_progress", fields["inner_name"], fields["inner_progress"]),
        stamp=fields["time"],
    )


def encode_result(result: Result, *, time: float = 0.0, wall: int = 0) -> bytes:
    """Return a ``rtee_msgs/Result``.

    Args:
        result: The result.
        time: When it was known, CLOCK_MONOTONIC [s].
        wall: The same since 1970 [ns].
    """
    return _RESULT.encode(
        _taken(result, _RESULT_FIELDS)
        | {
            "header": header(wall),
            "time": time,
            "grasped_fingers": result.grasped_fingers,
            "position_name": list(result.position),
            "position": list(result.position.values()),
        }
    )


def decode_result(data: Data) -> Result:
    """Return the result in a ``rtee_msgs/Result``; raises `MessageError`."""
    return result_of(_RESULT.decode(data))


def result_of(fields: Mapping[str, Any]) -> Result:
    """Return the result in decoded fields; raises `MessageError`."""
    return Result(
        **{name: fields[name] for name in _RESULT_FIELDS},
        grasped_fingers=tuple(fields["grasped_fingers"]),
        position=_numbers("position", fields["position_name"], fields["position"]),
    )


def encode_event(event: Event, *, wall: int = 0) -> bytes:
    """Return a ``rtee_msgs/Event``; ``wall`` is its stamp since 1970 [ns]."""
    return _EVENT.encode(
        {
            "header": header(wall),
            "time": event.stamp,
            "kind": event.kind,
            "source": event.source,
            "text": event.text,
            "severity": event.severity,
        }
    )


def decode_event(data: Data) -> Event:
    """Return the event in a ``rtee_msgs/Event``; raises `MessageError`."""
    return event_of(_EVENT.decode(data))


def event_of(fields: Mapping[str, Any]) -> Event:
    """Return the event in decoded fields."""
    return Event(
        kind=fields["kind"],
        source=fields["source"],
        text=fields["text"],
        stamp=fields["time"],
        severity=fields["severity"],
    )


def device_status_fields(status: DeviceStatus, *, wall: int = 0) -> dict[str, Any]:
    """Return the fields of a ``rtee_msgs/DeviceStatus``, to nest it in another message."""
    return _taken(status, _DEVICE_FIELDS) | {
        "header": header(wall),
        "lifecycle": str(status.lifecycle),
        "identity_name": list(status.identity),
        "identity_value": list(status.identity.values()),
        "counter_name": list(status.counters),
        "counter_value": list(status.counters.values()),
        "gain": status.gains,
    }


def encode_device_status(status: DeviceStatus, *, wall: int = 0) -> bytes:
    """Return a ``rtee_msgs/DeviceStatus``; ``wall`` is its stamp since 1970 [ns]."""
    return _DEVICE_STATUS.encode(device_status_fields(status, wall=wall))


def decode_device_status(data: Data) -> DeviceStatus:
    """Return the status in a ``rtee_msgs/DeviceStatus``; raises `MessageError`."""
    return device_status_of(_DEVICE_STATUS.decode(data))


def device_status_of(fields: Mapping[str, Any]) -> DeviceStatus:
    """Return the status in decoded fields; raises `MessageError`."""
    try:
        lifecycle = Lifecycle(fields["lifecycle"])
    except ValueError:
        raise MessageError(f"unknown lifecycle '{fields['lifecycle']}'") from None
    return DeviceStatus(
        **{name: fields[name] for name in _DEVICE_FIELDS},
        lifecycle=lifecycle,
        identity=paired("identity", fields["identity_name"], fields["identity_value"]),
        counters=paired("counter", fields["counter_name"], fields["counter_value"].tolist()),
        gains=tuple(fields["gain"]),
    )


def loop_statistics_fields(statistics: LoopStatistics, *, wall: int = 0) -> dict[str, Any]:
    """Return the fields of a ``rtee_msgs/LoopStatistics``, to nest it in another message."""
    return _taken(statistics, _STATISTICS_FIELDS) | {"header": header(wall)}


def encode_loop_statistics(statistics: LoopStatistics, *, wall: int = 0) -> bytes:
    """Return a ``rtee_msgs/LoopStatistics``; ``wall`` is its stamp since 1970 [ns]."""
    return _LOOP_STATISTICS.encode(loop_statistics_fields(statistics, wall=wall))


def decode_loop_statistics(data: Data) -> LoopStatistics:
    """Return the statistics in a ``rtee_msgs/LoopStatistics``; raises `MessageError`."""
    return loop_statistics_of(_LOOP_STATISTICS.decode(data))


def loop_statistics_of(fields: Mapping[str, Any]) -> LoopStatistics:
    """Return the statistics in decoded fields."""
    return LoopStatistics(**{name: fields[name] for name in _STATISTICS_FIELDS})


def encode_string(text: str) -> bytes:
    """Return a ``std_msgs/String``."""
    return _STRING.encode({"data": text})


def decode_string(data: Data) -> str:
    """Return the text in a ``std_msgs/String``; raises `MessageError`."""
    return str(_STRING.decode(data)["data"])
