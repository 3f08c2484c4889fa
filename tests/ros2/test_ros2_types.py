"""Types of ROS 2: definitions, hashes, and the bytes of messages."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtee.errors import MessageError
from rtee.messages.schema import Field, Many, MessageType, parse
from rtee.ros2.message import Message, message_class
from rtee.ros2.types import Interfaces, interfaces, split, type_hash

HASHES = [line.split() for line in Path(__file__).with_name("hashes.txt").read_text().splitlines()]
"""Names and hashes of types, as rosidl's generated headers and public documents have them."""

EVERY = sorted(interfaces().texts)


def everything(distro: str = "jazzy") -> list[str]:
    """The full names of all messages, requests, responses and parts of actions."""
    known, found = interfaces(distro), []
    for name in EVERY:
        kind = name.split("/")[1]
        if kind == "msg":
            found.append(name)
        elif kind == "srv":
            found += [f"{name}_{part}" for part in ("Request", "Response", "Event")]
        else:
            made = known.action(name)
            found += [made.feedback_message.name]
            found += [f"{name}_{part}" for part in ("Goal", "Result", "Feedback")]
            for service in ("SendGoal", "GetResult"):
                found += [f"{name}_{service}_{part}" for part in ("Request", "Response")]
    return found


def test_hashes_are_those_of_rosidl() -> None:
    known = interfaces()
    assert {name: known.hash(name) for name, _ in HASHES} == dict(HASHES)


def test_feedback_of_trajectories_has_another_hash_in_newer_distributions() -> None:
    hashes = {
        distro: interfaces(distro)
        .action("control_msgs/action/FollowJointTrajectory")
        .feedback_message.hash[:20]
        for distro in ("jazzy", "kilted", "rolling", "humble")
    }
    assert hashes == {
        "jazzy": "RIHS01_80398fcb9674a",
        "kilted": "RIHS01_95618cc73912d",
        "rolling": "RIHS01_95618cc73912d",
        "humble": "TypeHashNotSupported",
    }
    same = "control_msgs/action/FollowJointTrajectory_SendGoal"
    assert interfaces("rolling").hash(same) == interfaces("jazzy").hash(same)


def test_hashes_of_messages_are_those_of_rosbags() -> None:
    typesys = pytest.importorskip("rosbags.typesys", reason="needs the extra rosbags")
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    # rosbags counts a char as a type of its own; services whose hashes are known hold this one.
    names = [name for name in EVERY if name in store.types and "ServiceEventInfo" not in name]
    assert len(names) > 50
    known = interfaces()
    assert {name: known.hash(name) for name in names} == {
        name: store.hash_rihs01(name) for name in names
    }


def _random(kind: type[Message], rng: random.Random) -> Any:
    return kind(**{one.name: _value(one, rng) for one in kind.STRUCTURE.fields})


def _value(field: Field, rng: random.Random) -> Any:
    def one() -> Any:
        if field.inner is not None:
            return _random(field.inner.message, rng)
        if field.kind == "string":
            return "".join(rng.choices("aä€/ ", k=rng.randrange(6)))
        if field.kind == "bool":
            return rng.random() < 0.5
        if field.kind.startswith("float"):
            return float(np.float32(rng.uniform(-1e3, 1e3)))
        return rng.randrange(100)

    if field.many is Many.ONE:
        return one()
    count = field.capacity if field.many is Many.ARRAY else rng.randrange(field.capacity or 4)
    values = [one() for _ in range(count)]
    return bytes(values) if field.kind in {"uint8", "char", "byte"} else values


def test_every_message_comes_back_from_its_bytes() -> None:
    for name in everything():
        rng = random.Random(name)
        kind = interfaces().message(name)
        for message in (kind(), *(_random(kind, rng) for _ in range(3))):
            back = kind.decode(message.encode())
            assert back == message, name
            assert repr(back)
            assert kind.from_dict(message.to_dict()) == message, name


def test_bytes_are_those_of_rosbags() -> None:
    typesys = pytest.importorskip("rosbags.typesys", reason="needs the extra rosbags")
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    rng, tried = random.Random(1), 0
    for name in EVERY:
        if name not in store.types:
            continue
        message = _random(interfaces().message(name), rng)
        data = message.encode()
        theirs = store.deserialize_cdr(data, name)
        assert bytes(store.serialize_cdr(theirs, name)) == data, name
        tried += 1
    assert tried > 50


def test_a_message_without_members_is_one_byte() -> None:
    trigger = interfaces().service("std_srvs/srv/Trigger")
    assert trigger.request().encode() == bytes.fromhex("0001000000")


def test_the_feedback_of_a_recorded_exchange_is_read() -> None:
    kind = interfaces().action("control_msgs/action/GripperCommand").feedback_message.message
    payload = bytes.fromhex("00010000" + "59dfa126" * 4 + "7b14ae47e17a943f000000000000f03f0000")
    message = kind.decode(payload)
    assert message.goal_id.uuid == bytes.fromhex("59dfa126" * 4)
    assert (message.feedback.position, message.feedback.effort) == (0.02, 1.0)
    assert message.encode() == payload


def _damaged(data: bytes, rng: random.Random) -> list[bytes]:
    found = [data[:length] for length in range(len(data))][-200:]
    for _ in range(100):
        some = bytearray(data)
        for _ in range(rng.randrange(1, 4)):
            byte = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
            some[rng.randrange(len(some))] = byte
        found.append(bytes(some))
    found += [rng.randbytes(rng.randrange(64)) for _ in range(20)]
    return [*found, data + bytes(9), b"\x00\x01\x00\x00" + b"\xff" * 64]


def test_damaged_bytes_are_refused_or_another_message() -> None:
    refused = 0
    for name in everything():
        rng = random.Random(name)
        kind = interfaces().message(name)
        for data in _damaged(_random(kind, rng).encode(), rng):
            try:
                message = kind.decode(data)
            except MessageError:
                refused += 1
                continue
            assert isinstance(message.encode(), bytes), name
    assert refused > 1000


def test_long_messages_and_lengths_are_refused() -> None:
    kind = interfaces().message("std_msgs/msg/Float64MultiArray")
    with pytest.raises(MessageError, match="is more than any message has"):
        kind.decode(b"\x00\x01\x00\x00" + bytes(64 * 1024 * 1024))
    huge = b"\x00\x01\x00\x00" + bytes(8) + b"\xff\xff\xff\xff"
    with pytest.raises(MessageError, match="4294967295 elements"):
        kind.decode(huge)


def test_wrong_fields_are_told() -> None:
    known = interfaces()
    joints = known.message("sensor_msgs/msg/JointState")
    with pytest.raises(MessageError, match="no field 'postion'"):
        joints(postion=[1.0])
    # The byte that such a message has in C is no field to give.
    with pytest.raises(MessageError, match="Trigger_Request has no field 'a'; there are none"):
        known.service("std_srvs/srv/Trigger").request(a=1)
    with pytest.raises(MessageError, match=r"JointState\.name"):
        joints(name="a").encode()
    with pytest.raises(MessageError, match=r"JointState\.position"):
        joints(position=["a"]).encode()
    with pytest.raises(MessageError, match="16 values expected, not 3"):
        known.message("unique_identifier_msgs/msg/UUID")(uuid=b"abc").encode()
    descriptor = known.message("rcl_interfaces/msg/ParameterDescriptor")
    ranged = known.message("rcl_interfaces/msg/IntegerRange")
    with pytest.raises(MessageError, match="at most 1 values"):
        descriptor(integer_range=[ranged(), ranged()]).encode()
    with pytest.raises(MessageError, match="fields by name"):
        joints.from_dict([1])
    for asked, given, hint in (
        (
            known.service,
            "std_msgs/Strin",
            "std_msgs/srv/Strin'; did you mean 'std_msgs/msg/String'",
        ),
        (known.service, "std_srvs/Trig", "std_srvs/srv/Trig'; did you mean 'std_srvs/srv/Trigger'"),
        (known.action, "rtee_msgs/Gras", "rtee_msgs/action/Gras'; did you mean"),
    ):
        with pytest.raises(MessageError, match=f"there is no type '{hint}"):
            asked(given)
    with pytest.raises(MessageError, match="did you mean 'std_msgs/msg/String'"):
        known.topic("std_msgs/msg/Strin")


def test_definitions_with_everything_are_read() -> None:
    text = """
    # a comment
    int8 LOW = -3          # a constant
    string WORD = "plain"
    string<=5[<=2] few
    float64[3] three [1.0, 2.0, 3.0]
    Other[] others
    wide/Thing thing
    """
    nested: list[str] = []

    def empty(name: str) -> MessageType:
        nested.append(name)
        return MessageType(name, ())

    structure = parse("some_msgs/msg/Odd", text, empty)
    assert nested == ["some_msgs/msg/Other", "wide/msg/Thing"]
    assert dict(structure.constants) == {"LOW": -3, "WORD": "plain"}
    assert [one.notation for one in structure.fields] == [
        "string<=5[<=2]",
        "float64[3]",
        "some_msgs/Other[]",
        "wide/Thing",
    ]
    assert structure.fields[1].default == [1.0, 2.0, 3.0]
    for wrong in ("wstring text", "float64", "float64[x] a", "int8 A = b"):
        with pytest.raises(MessageError):
            parse("some_msgs/msg/Odd", wrong)
    with pytest.raises(MessageError, match="3 parts"):
        split("a/srv/B", "---\n---\n")


def test_defaults_and_constants_are_those_of_the_definition() -> None:
    known = interfaces()
    status = known.message("action_msgs/msg/GoalStatus")
    assert status.STATUS_SUCCEEDED == 4
    goal = known.action("rtee_msgs/action/Grasp").goal()
    assert (goal.intensity, goal.stage, list(goal.force)) == (1.0, "both", [])
    assert known.service("type_description_interfaces/srv/GetTypeDescription").request()


def test_a_description_is_what_its_hash_is_made_of() -> None:
    known = Interfaces("jazzy")
    description = known.description("sensor_msgs/msg/JointState")
    assert description["type_description"]["type_name"] == "sensor_msgs/msg/JointState"
    assert [one["type_name"] for one in description["referenced_type_descriptions"]] == [
        "builtin_interfaces/msg/Time",
        "std_msgs/msg/Header",
    ]
    structure = known.structure("std_msgs/msg/String")
    assert type_hash(structure).startswith("RIHS01_df668c")
    assert message_class(structure)(data="a").encode()[-2:] == b"a\0"
