"""Nodes of ROS 2 through a router: topics, services, the graph, parameters."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import anyio
import pytest
import zenoh

from rtee.errors import ConfigError, MessageError, MissingExtra, NoRouter
from rtee.hand.config_schema import Distro, Ros2Settings
from rtee.ros2 import LATCHED, Context, attachments
from rtee.ros2.hand_services import TypeDescriptions
from rtee.ros2.keys import Kind
from rtee.ros2.parameters import Parameter, Parameters
from rtee.ros2.session import configuration, domain_of, router_attempts

from .conftest import free_endpoint, open_router

pytestmark = pytest.mark.anyio

STRING = "std_msgs/msg/String"
JOINTS = "sensor_msgs/msg/JointState"
TRIGGER = "std_srvs/srv/Trigger"
KEY = (
    "0/hand/stop/std_srvs::srv::dds_::Trigger_/"
    "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"
)

Peer = Callable[[], zenoh.Session]


async def until(condition: Callable[[], bool]) -> None:
    """Wait until something is true; the test's timeout ends it."""
    while not condition():  # noqa: ASYNC110
        await anyio.sleep(0.005)


async def test_messages_arrive_numbered_without_gaps(settings: Ros2Settings, peer: Peer) -> None:
    samples: list[zenoh.Sample] = []
    _kept = peer().declare_subscriber("0/left/joint_states/**", samples.append)
    async with Context.open(settings, {}) as context:
        publisher = context.node("hand", "left").publisher("joint_states", JOINTS)
        await until(lambda: publisher.heard)
        for position in range(200):
            publisher.publish(publisher.type.message(name=["a"], position=[float(position)]))
        with pytest.raises(MessageError, match="not of std_msgs"):
            publisher.publish(context.interfaces.message(STRING)(data="a"))
        with pytest.raises(MessageError, match=r"JointState\.position"):
            publisher.publish(publisher.type.message(position="a"))
        publisher.publish(publisher.type.message())
        await until(lambda: len(samples) == 201)
        token = context.graph.of(Kind.PUBLISHER, "/left/joint_states")[0].token
    told = [attachments.decode(sample.attachment) for sample in samples]
    assert [one.sequence for one in told] == list(range(1, 202))
    assert {one.gid for one in told} == {attachments.gid(token)}
    assert str(samples[0].key_expr).split("/")[1:4] == [
        "left",
        "joint_states",
        "sensor_msgs::msg::dds_::JointState_",
    ]


async def test_those_who_come_later_get_what_was_latched(settings: Ros2Settings) -> None:
    async with Context.open(settings, {}) as one:
        publisher = one.node("hand").publisher("/robot_description", STRING, LATCHED)
        publisher.publish(publisher.type.message(data="old"))
        publisher.publish(publisher.type.message(data="new"))
        async with Context.open(settings, {}) as other:
            early: list[Any] = []
            late: list[Any] = []
            other.node("volatile").subscription("/robot_description", STRING, early.append)
            other.node("rviz").subscription("/robot_description", STRING, late.append, LATCHED)
            await until(lambda: bool(late))
            assert [message.data for message in late] == ["new"]
            assert not early
            publisher.publish(publisher.type.message(data="newer"))
            await until(lambda: bool(early))
            assert [message.data for message in early] == ["newer"]


async def test_services_answer_and_errors_are_empty_answers(settings: Ros2Settings) -> None:
    async with Context.open(settings, {}) as hand, Context.open(settings, {}) as user:
        trigger = hand.interfaces.service(TRIGGER)
        both, arrived = anyio.Event(), []

        async def stop(request: Any) -> Any:
            arrived.append(request)
            if len(arrived) == 2:
                both.set()
            await both.wait()  # ends only when the requests are handled side by side
            return trigger.response(success=True, message="stopped")

        async def fail(request: Any) -> Any:
            raise MessageError("it cannot")

        node = hand.node("hand")
        node.service("~/stop", trigger, stop)
        node.service("~/fail", trigger, fail)
        asking = user.node("user")
        client = asking.client("/hand/stop", trigger)
        await client.wait(300)
        answers: list[Any] = []

        async def ask() -> None:
            answers.append(await client.call(trigger.request(), 20))

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(ask)
            tasks.start_soon(ask)
        assert [(one.success, one.message) for one in answers] == [(True, "stopped")] * 2
        failed = await asking.client("/hand/fail", trigger).call(trigger.request(), 300)
        assert (failed.success, failed.message) == (False, "")
        assert "a request of /hand/fail fails" in hand.warning_log.count
        with pytest.raises(TimeoutError, match="no node offers the service /nothing"):
            await asking.client("/nothing", trigger).wait(0.05)
        with pytest.raises(MessageError, match="Trigger_Request expected"):
            await client.call(trigger.response())


async def test_a_client_of_others_gets_its_number_back(settings: Ros2Settings, peer: Peer) -> None:
    async with Context.open(settings, {}) as context:
        trigger = context.interfaces.service(TRIGGER)

        async def stop(request: Any) -> Any:
            return trigger.response(success=True)

        context.node("hand").service("~/stop", trigger, stop)
        other, gid, replies = peer(), bytes(range(16)), []
        request = trigger.request().encode()
        asked = attachments.encode(5, time.time_ns(), gid)
        while not replies:
            other.get(KEY, replies.append, payload=request, attachment=asked, timeout=5)
            await anyio.sleep(0.05)
        answer = replies[0].ok
        assert str(answer.key_expr) == KEY
        told = attachments.decode(answer.attachment)
        assert (told.sequence, told.gid) == (5, gid)
        assert trigger.response.decode(bytes(answer.payload)).success


async def test_the_graph_holds_what_there_is(settings: Ros2Settings, peer: Peer) -> None:
    async with Context.open(settings, {}) as hand, Context.open(settings, {}) as user:
        left, right = hand.node("hand", "left"), hand.node("hand", "right")
        left.publisher("joint_states", JOINTS)
        right.subscription("~/commands", STRING, print)
        user.node("user").client("/left/hand/stop", TRIGGER)
        await user.graph.ready()
        await user.graph.wait_until(lambda: len(user.graph.entities()) == 6)
        tokens = {(one.kind.value, one.node.full, one.topic) for one in user.graph.entities()}
        assert tokens == {
            ("NN", "/left/hand", ""),
            ("NN", "/right/hand", ""),
            ("NN", "/user", ""),
            ("MP", "/left/hand", "/left/joint_states"),
            ("MS", "/right/hand", "/right/hand/commands"),
            ("SC", "/user", "/left/hand/stop"),
        }
        numbers = [(one.node_id, one.entity_id) for one in hand.graph.nodes()]
        assert {("0", "0"), ("1", "1")} <= set(numbers)
        other = peer().liveliness()
        key = "@ros2_lv/0/a/0/1/MP/%/%/old/%left%joint_states"
        _kept = [
            other.declare_token(f"{key}/sensor_msgs::msg::dds_::JointState_/RIHS01_x/::,:,:,:,,")
        ]
        await user.graph.wait_until(
            lambda: (
                sorted(
                    (one.node.full, one.type_hash == user.interfaces.topic(JOINTS).hash)
                    for one in user.graph.entities()
                    if one.topic == "/left/joint_states"
                )
                == [("/left/hand", True), ("/old", False)]
            )
        )
        hand.discard(left)
        await user.graph.wait_until(
            lambda: "/left/hand" not in {one.node.full for one in user.graph.entities()}
        )


async def test_a_killed_process_leaves_nothing(settings: Ros2Settings) -> None:
    text = (
        "import anyio, sys\n"
        "from rtee.hand.config_schema import Ros2Settings\n"
        "from rtee.ros2.node import Context\n"
        "async def main():\n"
        "    async with Context.open(Ros2Settings(router=sys.argv[1]), {}) as context:\n"
        "        context.node('doomed').publisher('a', 'std_msgs/msg/String')\n"
        "        await anyio.sleep_forever()\n"
        "anyio.run(main)\n"
    )
    async with (
        Context.open(settings, {}) as context,
        await anyio.open_process([sys.executable, "-c", text, settings.router]) as process,
    ):
        await context.graph.wait_until(lambda: len(context.graph.entities()) == 2)
        process.kill()
        await context.graph.wait_until(lambda: not context.graph.entities())


async def test_a_router_that_is_lost_is_told_once_and_found_again(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO", logger="rtee.ros2")
    endpoint = free_endpoint()
    async with Context.open(Ros2Settings(router=endpoint), {}) as context:
        context.node("hand").publisher("a", STRING)
        assert not context.connected
        for _ in range(2):
            with open_router(endpoint) as router:
                await until(lambda: context.connected)
                found: list[str] = []
                while len(found) < 2:
                    replies = router.liveliness().get("@ros2_lv/**")
                    found = [str(one.ok.key_expr) for one in replies if one.ok]
                    await anyio.sleep(0.05)
                assert {token.split("/")[5] for token in found} == {"NN", "MP"}
                await until(lambda: caplog.messages[-1].endswith("is there"))
            await until(lambda: not context.connected)
            await until(lambda: not caplog.messages[-1].endswith("is there"))
        words = ["no router" if "no router" in text else text[-8:] for text in caplog.messages]
    assert words == ["no router", "is there", "no router", "is there", "no router"]


async def test_who_needs_the_router_is_told_that_it_is_missing() -> None:
    nobody = Ros2Settings(router=free_endpoint())
    with pytest.raises(NoRouter, match="no router of ROS 2 at tcp/127"):
        async with Context.open(nobody, {}, router_needed=True):
            pass
    # It waited for ever, in silence; the sentence names the router that counts.
    elsewhere = free_endpoint()
    client = {"ZENOH_CONFIG_OVERRIDE": f'mode="client";connect/endpoints=["{elsewhere}"]'}
    with pytest.raises(NoRouter, match=f"no router of ROS 2 at {elsewhere}:"):
        async with Context.open(nobody, client, router_needed=True):
            pass


async def test_humble_has_no_hashes(settings: Ros2Settings) -> None:
    humble = Ros2Settings(router=settings.router, distro=Distro.HUMBLE)
    async with Context.open(humble, {}) as one, Context.open(humble, {}) as other:
        got: list[Any] = []
        publisher = one.node("hand").publisher("a", STRING)
        other.node("user").subscription("a", STRING, got.append)
        TypeDescriptions(one.node("old"))
        await until(lambda: publisher.heard)
        publisher.publish(publisher.type.message(data="x"))
        await until(lambda: bool(got))
        await other.graph.ready()
        hashes = {each.type_hash for each in other.graph.entities() if each.topic}
        assert hashes == {"TypeHashNotSupported"}


def test_the_environment_is_read_as_by_rmw(tmp_path: Any) -> None:
    settings = Ros2Settings(domain=3)
    assert (domain_of(settings, {}), domain_of(settings, {"ROS_DOMAIN_ID": "7"})) == (3, 7)
    for wrong in ("x", "-1", "233", "1.5", "000000001999999", "9" * 5000):
        with pytest.raises(ConfigError, match="ROS_DOMAIN_ID"):
            domain_of(settings, {"ROS_DOMAIN_ID": wrong})
    attempts = "ZENOH_ROUTER_CHECK_ATTEMPTS"
    assert [router_attempts(each) for each in ({}, {attempts: "0"}, {attempts: "-1"})] == [1, 0, -1]
    with pytest.raises(ConfigError, match=attempts):
        router_attempts({attempts: "often"})

    override = {"ZENOH_CONFIG_OVERRIDE": 'mode="client"; connect/endpoints=["tcp/a:1"]'}
    config = configuration(settings, override)
    assert config.get_json("mode") == '"client"'
    assert config.get_json("connect/endpoints") == '["tcp/a:1"]'
    file = tmp_path / "session.json5"
    file.write_text('{mode: "peer", connect: {endpoints: ["tcp/b:2"]}}')
    config = configuration(settings, {"ZENOH_SESSION_CONFIG_URI": str(file)})
    assert config.get_json("connect/endpoints") == '["tcp/b:2"]'
    for wrong, what in (
        ({"ZENOH_SESSION_CONFIG_URI": str(tmp_path / "none")}, "No such file"),
        ({"ZENOH_CONFIG_OVERRIDE": "mode"}, "PATH/KEY=VALUE"),
        ({"ZENOH_CONFIG_OVERRIDE": "mode=7"}, "not a setting of Zenoh"),
        ({"ZENOH_CONFIG_OVERRIDE": 'mode="no"'}, "not JSON5, or not a valid value"),
    ):
        with pytest.raises(ConfigError, match=what):
            configuration(settings, wrong)
    with pytest.raises(ConfigError, match="anyone who reaches tcp/robot:7447 could move the hand"):
        configuration(Ros2Settings(router="tcp/robot:7447"), {})
    with pytest.raises(ConfigError, match="'robot' is not an endpoint"):
        configuration(Ros2Settings(router="robot"), {})
    for name in ("left hand", "2nd/hand"):
        with pytest.raises(ValueError, match=f"without a digit at its start, not '{name}'"):
            Ros2Settings(namespace=name)
    far = configuration(Ros2Settings(router="tcp/robot:7447"), {}, insecure=True)
    assert far.get_json("mode") == '"client"'


async def test_parameters_are_read_changed_and_described(settings: Ros2Settings) -> None:
    async with Context.open(settings, {}) as hand, Context.open(settings, {}) as user:
        changes: list[float] = []
        refused = lambda value: (_ for _ in ()).throw(MessageError("not now"))  # noqa: E731
        parameters = Parameters(
            hand.node("hand"),
            [
                Parameter("rate", 100.0, "Rate [Hz]", 1.0, 1000.0, change=changes.append),
                Parameter("filter.order", 2, "Order", 1, 4),
                Parameter("serial", "A1", read_only=True),
                Parameter("gains", [1.0, 2.0], lower=0.0),
                Parameter("locked", False, change=refused),
                Parameter("names", ["a"]),
            ],
        )
        asking, kinds = user.node("user"), user.interfaces
        events: list[Any] = []
        asking.subscription("/parameter_events", "rcl_interfaces/msg/ParameterEvent", events.append)

        async def ask(name: str, service: str, **fields: Any) -> Any:
            client = asking.client(f"/hand/{name}", f"rcl_interfaces/srv/{service}")
            await client.wait(300)
            return await client.call(client.type.request(**fields), 10)

        listed = await ask("list_parameters", "ListParameters")
        assert listed.result.names == ["filter.order", "gains", "locked", "names", "rate", "serial"]
        assert listed.result.prefixes == ["filter"]
        listed = await ask("list_parameters", "ListParameters", prefixes=["filter"])
        assert listed.result.names == ["filter.order"]
        listed = await ask("list_parameters", "ListParameters", depth=1)
        assert "filter.order" not in listed.result.names

        names = ["rate", "filter.order", "serial", "gains", "none"]
        got = await ask("get_parameters", "GetParameters", names=names)
        assert [each.type for each in got.values] == [3, 2, 4, 8, 0]
        assert got.values[0].double_value == 100.0
        types = await ask("get_parameter_types", "GetParameterTypes", names=names)
        assert types.types == bytes([3, 2, 4, 8, 0])
        told = (await ask("describe_parameters", "DescribeParameters", names=names)).descriptors
        assert (told[0].description, told[0].floating_point_range[0].to_value) == ("Rate [Hz]", 1e3)
        assert (told[1].integer_range[0].from_value, told[2].read_only) == (1, True)
        assert told[4].type == 0

        value, parameter = (
            kinds.message(f"rcl_interfaces/msg/{one}") for one in ("ParameterValue", "Parameter")
        )

        def setting(name: str, **fields: Any) -> Any:
            return parameter(name=name, value=value(**fields))

        wanted = [
            setting("rate", type=3, double_value=50.0),
            setting("rate", type=2, integer_value=60),
            setting("rate", type=3, double_value=2000.0),
            setting("rate", type=3, double_value=float("nan")),
            setting("serial", type=4, string_value="B"),
            setting("gains", type=8, double_array_value=[3.0]),
            setting("gains", type=8, double_array_value=[3.0, -1.0]),
            setting("filter.order", type=4, string_value="2"),
            setting("rate", type=99),
            setting("locked", type=1, bool_value=True),
            setting("none", type=1, bool_value=True),
            setting("names", type=8),
            setting("names", type=9),
        ]
        results = (await ask("set_parameters", "SetParameters", parameters=wanted)).results
        assert [n for n, each in enumerate(results) if each.successful] == [0, 1, 5, 12]
        assert "outside 1 to 1000" in results[2].reason
        assert "read-only" in results[4].reason
        assert results[9].reason == "not now"
        assert "setting it to 'double_array' is not allowed" in results[11].reason
        assert parameters.values["names"] == []  # an array of strings still, though it has none
        got = await ask("get_parameters", "GetParameters", names=["names"])
        assert [each.type for each in got.values] == [9]
        assert parameters.values["rate"] == 60.0
        assert changes == [50.0, 60.0]

        both = [setting("rate", type=3, double_value=70.0), wanted[9]]
        answer = await ask("set_parameters_atomically", "SetParametersAtomically", parameters=both)
        assert not answer.result.successful
        assert parameters.values["rate"] == 60.0
        assert changes == [50.0, 60.0, 70.0, 60.0]

        parameters.update({"rate": 30.0, "serial": "A1"})
        await until(
            lambda: bool(events) and events[-1].changed_parameters[0].value.double_value == 30.0
        )
        assert [each.name for each in events[-1].changed_parameters] == ["rate"]
        assert events[-1].node == "/hand"


async def test_types_are_described(settings: Ros2Settings) -> None:
    async with Context.open(settings, {}) as hand, Context.open(settings, {}) as user:
        TypeDescriptions(hand.node("hand"))
        service = "type_description_interfaces/srv/GetTypeDescription"
        client = user.node("user").client("/hand/get_type_description", service)
        await client.wait(300)
        for name in (JOINTS, "rtee_msgs/action/Grasp_SendGoal", "std_srvs/srv/Trigger"):
            known = hand.interfaces.hash(name)
            answer = await client.call(client.type.request(type_name=name, type_hash=known), 10)
            assert answer.successful
            assert answer.type_description.to_dict()["type_description"]["type_name"] == name
            sources = {one.type_name: one.encoding for one in answer.type_sources}
            assert sources[name] == {JOINTS: "msg", TRIGGER: "srv"}.get(name, "implicit")
        wrong = client.type.request(type_name=JOINTS, type_hash="RIHS01_0")
        assert "another hash" in (await client.call(wrong, 10)).failure_reason
        missing = await client.call(client.type.request(type_name="a/msg/B"), 10)
        assert "no type 'a/msg/B'" in missing.failure_reason


async def test_without_xxhash_the_extra_is_named(
    settings: Ros2Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "xxhash", None)
    with pytest.raises(
        MissingExtra, match=r'ROS 2 needs the extra .ros2.: pip install .*\[ros2\]"'
    ):
        async with Context.open(settings, {}):
            pass
