"""Keys, tokens, QoS and attachments: what the ROS graph is written in."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from zenoh.ext import Int64, z_serialize

from rtee.errors import ConfigError, MessageError
from rtee.ros2 import attachments
from rtee.ros2.attachments import Attachment
from rtee.ros2.keys import Entity, Kind, NodeName, key_expression, node_name, parse_token, ros_type
from rtee.ros2.qos import DEFAULT, LATCHED, PARAMETERS, Qos, Reliability, parse_chunk

TRIGGER = "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"


def test_keys_are_written_as_rmw_zenoh_does() -> None:
    name = "/gripper/gripper_cmd/_action/send_goal"
    key = key_expression(0, name, "control_msgs/action/GripperCommand_SendGoal", "RIHS01_6b")
    assert key == (
        "0/gripper/gripper_cmd/_action/send_goal/"
        "control_msgs::action::dds_::GripperCommand_SendGoal_/RIHS01_6b"
    )


def test_tokens_are_written_as_rmw_zenoh_does() -> None:
    node = node_name("server", "/ns")
    entity = Entity("0", "22290d7f", "1", "1", Kind.NODE, node)
    assert entity.token == "@ros2_lv/0/22290d7f/1/1/NN/%/%ns/server"
    service = Entity(
        *("0", "22290d7f", "1", "2", Kind.SERVICE, node),
        topic=node.resolve("~/stop"),
        type="std_srvs/srv/Trigger",
        type_hash=TRIGGER,
        qos=DEFAULT,
    )
    assert service.token == (
        "@ros2_lv/0/22290d7f/1/2/SS/%/%ns/server/%ns%server%stop/"
        f"std_srvs::srv::dds_::Trigger_/{TRIGGER}/::,10:,:,:,,"
    )
    assert [parse_token(each.token) for each in (entity, service)] == [entity, service]
    assert parse_token("@ros2_lv/0/a/0/0/NN/%/%/talker") == Entity(
        *("0", "a", "0", "0", Kind.NODE, NodeName("talker"))
    )


@pytest.mark.parametrize(
    ("qos", "chunk"),
    [
        (DEFAULT, "::,10:,:,:,,"),
        (Qos(depth=5, reliability=Reliability.BEST_EFFORT), "2::,5:,:,:,,"),
        (LATCHED, ":1:,1:,:,:,,"),
        (PARAMETERS, "::,1000:,:,:,,"),
        (Qos(depth=42), "::,:,:,:,,"),
    ],
)
def test_qos_is_written_as_rmw_zenoh_does(qos: Qos, chunk: str) -> None:
    assert qos.chunk == chunk
    assert parse_chunk(chunk) == qos


def test_names_are_resolved_as_in_ros() -> None:
    node = node_name("hand", "left")
    assert node == NodeName("hand", "/left")
    assert node.full == "/left/hand"
    assert node_name("hand").full == "/hand"
    names = {"/joint_states": "/joint_states", "a/b": "/left/a/b", "~/stop": "/left/hand/stop"}
    assert {name: node.resolve(name) for name in names} == names
    for wrong in ("", "a b", "1a", "a//b", "~a", "a/", "ä", "a/*", "x" * 300):
        with pytest.raises(ConfigError):
            node.resolve(wrong)
    for name, namespace in (("a/b", ""), ("", ""), ("a", "b c")):
        with pytest.raises(ConfigError):
            node_name(name, namespace)


def test_newer_tokens_are_read() -> None:
    token = (
        "@ros2_lv/7/z/3/4/MS/%/%/cam/%image/sensor_msgs::msg::dds_::Image_/RIHS01_a/9:8:7,x:,:,:,,"
    )
    entity = parse_token(f"{token}/buffers/more")
    assert entity is not None
    assert entity.more == ("buffers", "more")
    assert (entity.type, entity.topic) == ("sensor_msgs/msg/Image", "/image")
    assert entity.qos == Qos(depth=42, reliability=9, durability=8, history=7)


def test_tokens_that_make_no_sense_are_none() -> None:
    for token in (
        "",
        "@ros2_lv",
        "@ros2_lv/0/a/0/0/NN/%/%",
        "@ros2_lv/0/a/0/0/XX/%/%/talker",
        "@ros2_lv/0/a/0/1/MP/%/%/talker/%chatter",
        "@ros2_lv/0/a/0/1/MP/%/%/talker/%chatter/type//::,:,:,:,,",
        "@ros2_lv/0/a/0/0/NN/%/%/" + "x" * 3000,
    ):
        assert parse_token(token) is None, token
    assert ros_type("odd::type") == "odd::type"


@given(st.text(alphabet="@ros2_lv/0aMPSNC%:,1:9ä*", max_size=120))
def test_no_text_breaks_the_parser(text: str) -> None:
    for token in (
        text,
        f"@ros2_lv/{text}",
        f"@ros2_lv/0/a/0/1/MP/%/%/n/%t/a::b::dds_::C_/h/{text}",
    ):
        entity = parse_token(token)
        assert entity is None or entity.kind in Kind
    assert isinstance(parse_chunk(text), Qos)


def test_no_qos_breaks_the_parser() -> None:
    rng = random.Random(4)
    for _ in range(2000):
        numbers = [str(rng.choice(["", -1, 0, 1, 5, 10**30, "x", "¹"])) for _ in range(10)]
        seps = [rng.choice(":,;/") for _ in numbers]
        chunk = "".join(a + b for a, b in zip(numbers, seps, strict=True))
        assert parse_chunk(chunk).depth >= 0


def test_attachments_are_those_of_zenoh() -> None:
    gid = bytes(range(16))
    data = Attachment(7, 123456789, gid).encode()
    assert data == bytes(z_serialize((Int64(7), Int64(123456789), gid)))
    assert attachments.decode(data) == Attachment(7, 123456789, gid)


@pytest.mark.parametrize(
    "data", [None, b"", bytes(32), bytes(33), bytes(34), b"\xff" * 33, bytes(10_000_000)]
)
def test_other_attachments_are_refused(data: bytes | None) -> None:
    with pytest.raises(MessageError):
        attachments.decode(data)


def test_the_gid_is_the_hash_of_the_token() -> None:
    # XXH3-128 of no bytes is 99aa06d3014798d86001c324468d497f, as its specification has it.
    assert attachments.gid("").hex() == "7f498d4624c30160d8984701d306aa99"
