"""Between the typed commands of `rtee.commands` and their one message, in recordings as anywhere.

The message says the kind in a word and holds a text and numbers by name. What each kind puts there
is said here and nowhere else; it must not change, since older recordings hold it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from rtee.commands import (
    Abort,
    Cancel,
    Command,
    CommandRecord,
    Freeze,
    Hold,
    Jog,
    SetAcceptsEffort,
    SetActive,
    SetGripEffort,
)
from rtee.errors import MessageError
from rtee.messages.convert import Data, header
from rtee.messages.goal import paired
from rtee.messages.schema import message_type

_COMMAND = message_type("rtee_msgs/msg/Command")

Plain = tuple[str, str, Mapping[str, float]]
"""Kind, text and numbers by name."""


def plain(command: Command) -> Plain:
    """Return a command as its message holds it."""
    match command:
        case Cancel(goal_id):
            return "cancel", goal_id, {}
        case Hold(reason):
            return "hold", reason, {}
        case Freeze(reason, actuators):
            return "freeze", reason, dict.fromkeys(actuators, 1.0)
        case Jog(positions, max_velocity):
            # repr: the shortest text from which the same number is read again, bit for bit.
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


def typed(kind: str, text: str, numbers: Mapping[str, float]) -> Command:
    """Return the command that a message holds; raises `MessageError` if it is none."""
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
    except (ValueError, KeyError) as error:
        raise MessageError(f"a command '{kind}' makes no sense: {error}") from None
    raise MessageError(f"unknown command '{kind[:50]}'")


def encode_command(record: CommandRecord, *, wall: int = 0) -> bytes:
    """Return a ``rtee_msgs/Command``; ``wall`` is its stamp since 1970 [ns]."""
    kind, text, numbers = plain(record.command)
    return _COMMAND.encode(
        {
            "header": header(wall),
            "tick": record.tick,
            "time": record.stamp,
            "kind": kind,
            "text": text,
            "name": list(numbers),
            "value": list(numbers.values()),
        }
    )


def decode_command(data: Data) -> CommandRecord:
    """Return the command in a ``rtee_msgs/Command``; raises `MessageError`."""
    return command_record_of(_COMMAND.decode(data))


def command_record_of(fields: Mapping[str, Any]) -> CommandRecord:
    """Return the command in decoded fields; raises `MessageError`."""
    numbers = paired("value", fields["name"], fields["value"].tolist())
    command = typed(fields["kind"], fields["text"], numbers)
    return CommandRecord(fields["tick"], fields["time"], command)
