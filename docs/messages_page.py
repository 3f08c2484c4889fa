"""The reference of the messages, ``docs/reference/messages.md``, made from their definitions.

``python docs/messages_page.py`` writes it; a test keeps it current.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from rtee.messages.requests import REQUESTS, STATES
from rtee.messages.schema import DEFINITIONS, MessageType, message_type
from rtee.messages.topics import PUBLISHED, TYPES, log_topic, network_key

PAGE = Path(__file__).parent / "reference" / "messages.md"
_HEAD = """\
# Messages

Recordings and the network share one vocabulary: ROS 2 messages, encoded as CDR (little-endian, XCDR
version 1). Types that ROS 2 has are its own, the others are in the package `rtee_msgs`. Every
recording carries the definitions, so that other software needs nothing else to read it.

Units are SI: metres, radians, seconds, newtons, newton metres, amperes; temperatures are in °C.
`NaN` means "not measured" or "not given". All arrays of a message go with its `name`: order by
name, not by number. `time` is CLOCK_MONOTONIC of the hand's computer, which never jumps;
`header.stamp` is the same moment since 1970.

In Python, `rtee.messages.message_type("rtee_msgs/Goal")` encodes and decodes any of them, and
`rtee.messages.typestore.typestore()` is a type store of `rosbags` with all of them, given the
extra `rosbags`.

<!-- Made by `python docs/messages_page.py`; a test keeps it current. -->
"""
_CONSTANT = (
    "std_msgs/msg/",
    "sensor_msgs/msg/",
    "geometry_msgs/msg/",
    "tf2_msgs/msg/",
    "builtin_interfaces/msg/",
)


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _link(name: str) -> str:
    short = name.replace("/msg/", "/")
    return f"[`{short}`](#{_anchor(name)})"


def _anchor(name: str) -> str:
    return name.replace("/msg/", "/").lower().replace("/", "")


def _topics() -> Iterator[str]:
    yield "## Topics\n"
    yield "| in a recording | on the network | type |"
    yield "| --- | --- | --- |"
    for name, kind in TYPES.items():
        key = f"`{network_key('HAND', name)}`" if name in PUBLISHED else ""
        yield f"| `{log_topic('HAND', name)}` | {key} | {_link(kind)} |"
    stream = network_key("HAND", f"{STATES}/N")
    yield f"| | `{stream}` | {_link('rtee_msgs/msg/State')}, every N ticks, once asked for |"


def _requests() -> Iterator[str]:
    yield "## Requests\n"
    yield "A request is a Zenoh query whose payload is the question. A refusal is an error reply"
    yield f"with a {_link('rtee_msgs/msg/Reply')} that says why not.\n"
    yield "| key | question | answer | |"
    yield "| --- | --- | --- | --- |"
    for request in REQUESTS.values():
        question, answer = _link(request.question.name), _link(request.answer.name)
        yield f"| `{request.key('HAND')}` | {question} | {answer} | {_cell(request.text)} |"


def _type(kind: MessageType) -> Iterator[str]:
    yield f"### {kind.name.replace('/msg/', '/')}\n"
    yield f"{kind.summary}\n"
    yield "| field | type | |"
    yield "| --- | --- | --- |"
    for field in kind.fields:
        notation = f"`{field.notation}`"
        if field.nested:
            notation = _link(field.kind) + ("`[]`" if field.sequence else "")
        yield f"| `{field.name}` | {notation} | {_cell(field.comment)} |"


def page() -> str:
    """Return the page."""
    kinds = [message_type(name) for name in DEFINITIONS]
    own = [kind for kind in kinds if not kind.name.startswith(_CONSTANT)]
    standard = [kind for kind in kinds if kind.name.startswith(_CONSTANT)]
    blocks = [_HEAD, "\n".join(_topics()), "\n".join(_requests()), "## Types of rtee_msgs"]
    blocks += ["\n".join(_type(kind)) for kind in own]
    blocks.append("## Types of ROS 2 that are used")
    blocks += ["\n".join(_type(kind)) for kind in standard]
    return "\n\n".join(block.strip("\n") for block in blocks) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page())
