from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from rtee import messages
from rtee.commands import (
    Abort,
    Cancel,
    CommandRecord,
    Freeze,
    Hold,
    Jog,
    SetAcceptsEffort,
    SetActive,
    SetGripEffort,
)
from rtee.errors import MessageError
from rtee.messages import convert, message_type
from rtee.messages.codec import wall_ns
from rtee.messages.convert import typed
from rtee.messages.goals import with_new_id
from rtee.messages.schema import recorded_type
from rtee.types import (
    Around,
    DeviceStatus,
    Event,
    Feedback,
    Fingers,
    FirstContact,
    Force,
    Goal,
    Intensity,
    Lifecycle,
    LoopStatistics,
    Named,
    Opening,
    Result,
    Shortfall,
    Stage,
    TipSpeed,
    new_goal_id,
)

GOAL = Goal(
    Named("PinchTight", ("thumb", "index"), kind="primitive"),
    Intensity(0.6, stage=Stage.PRE_GRASP, tolerance=0.02),
    speed=0.5,
    effort={"thumb_flexion": 0.25},
    timeout=3.0,
    goal_id="0123",
    client="tests",
)
FEEDBACK = Feedback("0123", 0.25, "close", {"open": 1.0, "close": 0.1}, 12.5)
RESULT = Result(
    "0123",
    "PinchTight",
    reached=False,
    stalled=True,
    grasped=True,
    grasped_fingers=("index",),
    reason="none – ünïcode",
    error=0.5,
    duration=1.25,
    position={"thumb_flexion": 0.75},
    opening=0.03,
    opening_error=0.001,
    force=1.5,
    force_error=0.25,
    force_source="effort",
    force_asked=4.0,
    shortfall=Shortfall.END_OF_MOTION,
)
EVENT = Event("mark", "user", "the drill slipped", 99.5, "warning")
COMMANDS = (
    Cancel("0123"),
    Hold("a client asked to hold"),
    Freeze("the loop ended"),
    Freeze("rejected", ("thumb_flexion",)),
    Jog({"thumb_flexion": 0.5}),
    Jog({"thumb_flexion": 0.5, "index": -1.0}, 0.1 + 0.2),
    SetGripEffort(0.3),
    SetActive({"thumb_flexion": True, "index": False}),
    SetAcceptsEffort({"thumb_flexion": False}),
    Abort("the device is lost", ("index",)),
)
STATUS = DeviceStatus(
    "svh",
    "schunk_svh",
    Lifecycle.FAULT,
    identity={"firmware": "1.0"},
    rate=99.5,
    every=10,
    age=0.01,
    exchanges=2**40,
    overruns=1,
    errors=2,
    reconnects=3,
    counters={"bytes": 123456789012},
    fault_code=-5,
    fault_name="overcurrent",
    recoverable=True,
    hint="let it cool",
    message="motor 3",
    gains=("kp", "kd"),
)
STATISTICS = LoopStatistics(1000.0, 999.9, 10, 1, *[x / 8 for x in range(8)], dropped=4)

PAIRS: list[tuple[Callable[..., bytes], Callable[[bytes], Any], Any]] = [
    (messages.GOAL.encode, messages.GOAL.decode, GOAL),
    (
        messages.GOAL.encode,
        messages.GOAL.decode,
        replace(GOAL, what=Named("fist"), timeout=None, effort={}),
    ),
    (convert.FEEDBACK.encode, convert.FEEDBACK.decode, FEEDBACK),
    (convert.FEEDBACK.encode, convert.FEEDBACK.decode, Feedback("1", 1.0)),
    (convert.RESULT.encode, convert.RESULT.decode, RESULT),
    (convert.EVENT.encode, convert.EVENT.decode, EVENT),
    *(
        (convert.COMMAND.encode, convert.COMMAND.decode, CommandRecord(7, 12.25, command))
        for command in COMMANDS
    ),
    (convert.DEVICE_STATUS.encode, convert.DEVICE_STATUS.decode, STATUS),
    (convert.DEVICE_STATUS.encode, convert.DEVICE_STATUS.decode, replace(STATUS, age=math.inf)),
    (convert.LOOP_STATISTICS.encode, convert.LOOP_STATISTICS.decode, STATISTICS),
    (
        messages.encode_string,
        lambda data: message_type("std_msgs/String").decode(data)["data"],
        "<robot/>",
    ),
]


@pytest.mark.parametrize(("encode", "decode", "value"), PAIRS)
def test_what_is_decoded_is_what_was_encoded(
    encode: Callable[..., bytes], decode: Callable[[bytes], Any], value: Any
) -> None:
    assert decode(encode(value)) == value


@pytest.mark.parametrize(
    ("kind", "text", "numbers", "reason"),
    [
        ("dance", "", {}, "unknown command 'dance'"),
        ("jog", "fast", {"thumb_flexion": 0.5}, "'jog' is not valid: .*'fast'"),
        ("holding", "", {}, "'holding' is not valid: 'effort'"),
    ],
)
def test_what_is_no_command_is_said(
    kind: str, text: str, numbers: dict[str, float], reason: str
) -> None:
    with pytest.raises(MessageError, match=reason):
        typed(kind, text, numbers)


def test_stamps_are_kept() -> None:
    fields = message_type("rtee_msgs/Goal").decode(
        messages.GOAL.encode(GOAL, time=7.25, wall=1_700_000_000_123_456_789)
    )
    assert fields["time"] == 7.25
    assert wall_ns(fields) == 1_700_000_000_123_456_789


@pytest.mark.parametrize(
    "goal",
    [
        GOAL,
        replace(GOAL, what=Named("fist"), timeout=None, effort={}, client="größer"),
        Goal(Fingers(), Around(0.03, 0.0, 0.01), TipSpeed(0.05), Force(2.0, 5.0)),
        Goal(Fingers(("index",)), Opening(0.03), 0.5, Force(2.0)),
        Goal(Named("fist"), FirstContact(0.02)),
    ],
)
def test_a_goal_is_written_and_read_as_its_definition_says(goal: Goal) -> None:
    kind = message_type("rtee_msgs/Goal")
    data = messages.GOAL.encode(goal, time=7.25, wall=1_700_000_000_123_456_789)
    fields = kind.decode(data)
    assert kind.encode(fields) == data
    assert messages.GOAL.of(fields) == messages.GOAL.decode(data) == goal


@pytest.mark.parametrize("client", ["", "größer"])
def test_a_goal_with_another_identifier_is_the_same_otherwise(client: str) -> None:
    goal, other = replace(GOAL, goal_id=new_goal_id(), client=client), new_goal_id()
    changed = with_new_id(messages.GOAL.encode(goal), other)
    assert changed == messages.GOAL.encode(replace(goal, goal_id=other))


@pytest.mark.parametrize("wrong", [{"goal_id": 1}, {"effort": {"near": None}}, {"what": "fist"}])
def test_a_goal_with_a_value_of_the_wrong_kind_is_no_message(wrong: dict[str, Any]) -> None:
    with pytest.raises(MessageError):
        messages.GOAL.encode(replace(GOAL, **wrong))


def _with(name: str, encoded: bytes, **changes: Any) -> bytes:
    kind = message_type(name)
    return kind.encode(kind.decode(encoded) | changes)


@pytest.mark.parametrize(
    ("decode", "data", "text"),
    [
        (
            messages.GOAL.decode,
            _with("rtee_msgs/Goal", messages.GOAL.encode(GOAL), stage="half"),
            "stage 'half' must be",
        ),
        (
            messages.GOAL.decode,
            _with("rtee_msgs/Goal", messages.GOAL.encode(GOAL), effort=[]),
            "effort: 1 names for 0 values",
        ),
        (
            convert.FEEDBACK.decode,
            _with("rtee_msgs/Feedback", convert.FEEDBACK.encode(FEEDBACK), inner_name=["a", "a"]),
            "a name occurs twice",
        ),
        (
            convert.DEVICE_STATUS.decode,
            _with("rtee_msgs/DeviceStatus", convert.DEVICE_STATUS.encode(STATUS), lifecycle="?"),
            "unknown lifecycle",
        ),
        (convert.RESULT.decode, b"\x00\x01\x00\x00" + b"\xff" * 40, "sequence|string|bytes"),
        (convert.EVENT.decode, b"", "CDR header"),
    ],
)
def test_what_makes_no_sense_is_refused(
    decode: Callable[[bytes], Any], data: bytes, text: str
) -> None:
    with pytest.raises(MessageError, match=text):
        decode(data)


@pytest.mark.parametrize("text", ["", "a", "ab", "abc", "abcd"])
def test_a_status_written_before_devices_told_their_gains_is_read(text: str) -> None:
    status = replace(STATUS, gains=(), message=text)
    kind = message_type("rtee_msgs/DeviceStatus")
    fields = kind.decode(convert.DEVICE_STATUS.encode(status))
    del fields["gain"], fields["gain_value"]
    definition, rule, nested = kind.schema.partition("=" * 80)
    without = "".join(line for line in definition.splitlines(True) if " gain" not in line)
    older = recorded_type(kind.name, without + rule + nested)
    assert [field.name for field in older.fields] == [field.name for field in kind.fields][:-2]
    data = older.encode(fields)
    assert convert.DEVICE_STATUS.of(kind.completed(older.decode(data))) == status
    with pytest.raises(MessageError):
        kind.decode(data)
    with pytest.raises(MessageError):
        older.decode(data[:-9])


@pytest.mark.parametrize(
    ("missing", "read"),
    [
        (("opening_error",), {"opening_error": None}),
        (("force_asked", "shortfall"), {"force_asked": None, "shortfall": Shortfall.NONE}),
    ],
)
def test_a_result_written_before_it_had_all_fields_is_read(
    missing: tuple[str, ...], read: dict[str, Any]
) -> None:
    kind = message_type("rtee_msgs/Result")
    fields = kind.decode(convert.RESULT.encode(RESULT))
    for name in missing:
        del fields[name]
    rows = kind.schema.splitlines(True)
    older = recorded_type(kind.name, "".join(r for r in rows if not any(n in r for n in missing)))
    again = convert.RESULT.of(kind.completed(older.decode(older.encode(fields))))
    assert again == replace(RESULT, **read)


def test_a_recorded_definition_that_is_nested_too_deeply_is_refused() -> None:
    name = "rtee_msgs/msg/ActuatorState"
    texts = ["my_msgs/T0 nested\n"]
    rule = "=" * 80 + "\n"
    texts += [f"{rule}MSG: my_msgs/T{k}\nmy_msgs/T{k + 1} nested\n" for k in range(1000)]
    texts.append(f"{rule}MSG: my_msgs/T1000\nbool last\n")
    with pytest.raises(MessageError, match="nested too deeply"):
        recorded_type(name, "".join(texts))
