"""Goals and their bytes, field by field.

A goal's way to the hand shall be short, and code that has not run for a while costs many times what
it costs warm: so here is as little of it as can be. What it makes is what `MessageType` makes.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Any

from rtee.errors import MessageError
from rtee.messages.cdr import HEADER, Reader, Writer
from rtee.types import Goal, Stage

_SECOND = 1_000_000_000
_BEGIN = struct.Struct("<4siII4xd")
"""Encapsulation, stamp, the empty frame's length and closing NUL, time."""


def encode_goal(goal: Goal, *, time: float = 0.0, wall: int = 0) -> bytes:
    """Return a ``rtee_msgs/Goal``.

    Args:
        goal: The goal.
        time: When it was taken, CLOCK_MONOTONIC [s].
        wall: The same since 1970 [ns].

    Raises:
        MessageError: if a value of it is of the wrong kind.
    """
    try:
        writer = Writer(_BEGIN.pack(HEADER, *divmod(wall, _SECOND), 1, time))
        text, number = writer.string, writer.double
        for value in (goal.goal_id, goal.client, goal.action, goal.kind or ""):
            text(value)
        writer.strings(goal.elements)
        number(goal.intensity)
        writer.strings(goal.effort)
        writer.length(len(goal.effort))
        for limit in goal.effort.values():
            number(limit)
        number(goal.tolerance)
        number(goal.speed)
        number(math.nan if goal.timeout is None else goal.timeout)
        text(goal.stage)
    except (TypeError, ValueError, AttributeError, struct.error) as error:
        if isinstance(error, MessageError):
            raise
        raise MessageError(f"rtee_msgs/msg/Goal: {error}") from error
    return writer.done()


def decode_goal(data: bytes | bytearray | memoryview) -> Goal:
    """Return the goal in a ``rtee_msgs/Goal``; raises `MessageError`."""
    reader = Reader(data)
    text, number = reader.string, reader.double
    reader.skip(8)
    text()
    number()
    goal_id, client, action, kind = text(), text(), text(), text()
    elements = tuple(reader.strings())
    intensity = number()
    names = reader.strings()
    values = [number() for _ in range(reader.length(8))]
    tolerance, speed, timeout = number(), number(), number()
    stage = text()
    reader.finish()
    return Goal(
        action,
        elements,
        kind or None,
        intensity,
        paired("effort", names, values) if names or values else {},
        tolerance,
        speed,
        None if math.isnan(timeout) else timeout,
        stage_of(stage),
        goal_id,
        client,
    )


def stage_of(name: str) -> Stage:
    """Return the stage of that name; raises `MessageError`."""
    try:
        return Stage(name)
    except ValueError:
        raise MessageError(f"stage '{name}' is none of both, pre_grasp, grasp") from None


def paired(what: str, names: Sequence[str], values: Sequence[Any]) -> dict[str, Any]:
    """Return values by name; raises `MessageError` unless each name has one value, and once."""
    if len(names) != len(values):
        raise MessageError(f"{what}: {len(names)} names for {len(values)} values")
    if len(set(names)) != len(names):
        raise MessageError(f"{what}: a name occurs twice")
    return dict(zip(names, values, strict=True))
