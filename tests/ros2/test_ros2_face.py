"""What other nodes see of a hand that is a node of ROS 2."""

from __future__ import annotations

import math
import re
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs
from remote.serving import URDF, serving, until

from rtee.actions.library import ActionLibrary
from rtee.errors import ConfigError
from rtee.hand.config_schema import Distro, Ros2Settings
from rtee.hand.load import load_model
from rtee.hand.model import Hand
from rtee.remote.client import connect
from rtee.ros2 import Context
from rtee.ros2.diagnostics import Diagnostics, Level, health
from rtee.ros2.keys import Kind
from rtee.ros2.qos import LATCHED
from rtee.ros2.serving import Shown, shown, warnings
from rtee.ros2.session import configuration, overridden
from rtee.ros2.topics import description, ros_name
from rtee.sample import ActuatorState
from rtee.touch import TouchReading, TouchSensor
from rtee.types import DeviceStatus, Lifecycle

from .facing import a_hand_in_ros, facing, robot

pytestmark = pytest.mark.anyio

JOINT_STATE = "sensor_msgs/msg/JointState"
STRING = "std_msgs/msg/String"
WRENCH = "geometry_msgs/msg/WrenchStamped"
CONTROL = "control_msgs/msg/JointTrajectoryControllerState"


async def test_what_is_published(
    hand: Hand, library: ActionLibrary, settings: Ros2Settings
) -> None:
    settings = structs.replace(settings, tf=True)
    async with a_hand_in_ros(hand, library, settings) as (_, robot):
        told = await robot.listen("/robot_description", STRING, LATCHED)
        assert told[0].data == hand.urdf.text
        still = await robot.listen("/tf_static", "tf2_msgs/msg/TFMessage", LATCHED)
        assert [one.child_frame_id for one in still[0].transforms] == ["palm"]
        moving = await robot.listen("/tf", "tf2_msgs/msg/TFMessage")
        frames = [(one.header.frame_id, one.child_frame_id) for one in moving[0].transforms]
        assert frames == [(joint.parent, joint.child) for joint in hand.joints]
        feedback = robot.hear("/small/feedback", "rtee_msgs/msg/Feedback")
        results = robot.hear("/small/results", "rtee_msgs/msg/Result")
        events = robot.hear("/small/events", "rtee_msgs/msg/Event")
        # What is declared later is known later: these come once those above are listened to.
        states = await robot.listen("/joint_states", JOINT_STATE)
        control = await robot.listen("/small/controller_state", CONTROL)
        async with connect("small") as client:
            await client.do("fist")
            await client.stop()
        await until(lambda: bool(results and feedback and events))
        await until(lambda: abs(states[-1].position[0] - 1.5) < 0.02)
        state, controlled = states[-1], control[-1]
    assert state.name == list(hand.joint_names) == ["near", "far", "thumb", "push"]
    near, far = state.position[:2]
    assert far == pytest.approx(0.5 * near + 0.1)  # the mimic joint
    assert any(one.velocity[1] == pytest.approx(0.5 * one.velocity[0]) != 0.0 for one in states)
    assert math.isnan(state.effort[1])
    assert not math.isnan(state.effort[0])
    assert abs(time.time() - state.header.stamp.sec) < 60
    assert controlled.joint_names == list(hand.actuator_names)
    error = controlled.reference.positions - controlled.feedback.positions
    np.testing.assert_allclose(controlled.error.positions, error)
    assert (results[0].action, results[0].reached) == ("fist", True)
    assert "stop" in [event.kind for event in events]


async def test_a_node_of_the_graph(
    hand: Hand, library: ActionLibrary, settings: Ros2Settings
) -> None:
    settings = structs.replace(settings, namespace="left/arm")
    async with a_hand_in_ros(hand, library, settings) as (_, robot):
        wanted = {
            Kind.NODE: {"/left/arm/small"},
            Kind.PUBLISHER: {
                "/left/arm/joint_states",
                "/left/arm/robot_description",
                "/diagnostics",
            },
            Kind.SERVICE: {f"/left/arm/small/{name}" for name in ("stop", "open", "do/poke")},
        }
        await until(lambda: all(names <= robot.names(kind) for kind, names in wanted.items()))


async def test_forces_at_the_fingertips(
    hand: Hand, library: ActionLibrary, settings: Ros2Settings
) -> None:
    async with serving(hand, library) as served:
        sense = served.driver.sense

        async def felt() -> ActuatorState:
            return replace(await sense(), extras={"contact_force": np.array([1.5, math.nan])})

        served.driver.sense = felt  # what the kinematic driver measures, and forces
        await until(lambda: bool(served.loop.snapshot().channels))
        async with facing(Shown("small", settings, configured=hand)), robot(settings) as others:
            thumb = others.hear("/small/tip_forces/thumb", WRENCH)
            index = await others.listen("/small/tip_forces/index", WRENCH)
    assert (index[0].header.frame_id, index[0].wrench.force.z) == ("index_tip", 1.5)
    assert thumb == []  # nothing is measured there


async def test_touch(hand: Hand, library: ActionLibrary, settings: Ros2Settings) -> None:
    pad = TouchSensor("pad", 2, link="thumb_tip", position=np.zeros((2, 3)), normal=np.eye(3)[:2])
    async with serving(hand, library) as served:
        sense, driver = served.driver.sense, served.driver
        driver.capabilities = replace(driver.capabilities, touch=(pad,))

        async def felt() -> ActuatorState:
            reading = TouchReading(np.array([0.5, 1.0]), time.monotonic())
            return replace(await sense(), touch=reading)

        driver.sense = felt  # what the kinematic driver measures, and touch
        async with facing(Shown("small", settings, configured=hand)), robot(settings) as others:
            touch = await others.listen("/small/touch", "rtee_msgs/msg/Touch")
            kind = "rtee_msgs/msg/TouchSensors"
            sensors = await others.listen("/small/touch_sensors", kind, LATCHED)
    assert (touch[0].name, touch[0].unit, list(touch[0].value)) == (["pad"], ["N"], [0.5, 1.0])
    assert list(touch[0].total) == [1.5]
    assert abs(time.time() - touch[0].header.stamp.sec) < 60
    [told] = sensors[0].sensors
    assert (told.name, told.link, told.finger) == ("pad", "thumb_tip", "thumb")
    assert list(told.normal) == [1.0, 0.0, 0.0, 0.0, 1.0, 0.0]


async def test_rate(hand: Hand, library: ActionLibrary, settings: Ros2Settings) -> None:
    async with a_hand_in_ros(hand, library, settings) as (_, robot):
        states = await robot.listen("/joint_states", JOINT_STATE)
        parameter = robot.context.interfaces.message("rcl_interfaces/msg/Parameter")
        for rate, accepted in ((20.0, True), (math.nan, False), (1e6, False)):
            asked = parameter(name="rate")
            asked.value.type, asked.value.double_value = 3, rate
            answer = await robot.call(
                "/small/set_parameters", "rcl_interfaces/srv/SetParameters", parameters=[asked]
            )
            assert answer.results[0].successful is accepted
        await until(
            lambda: len(states) > 1 and _between(states[-2:]) == pytest.approx(0.05, abs=1e-3)
        )


def _between(states: list) -> float:
    first, second = (one.header.stamp.sec + 1e-9 * one.header.stamp.nanosec for one in states)
    return second - first


async def test_parameters(hand: Hand, library: ActionLibrary, settings: Ros2Settings) -> None:
    async with a_hand_in_ros(hand, library, settings) as (served, robot):
        names = ["joints", "tolerance", "speed", "grip_effort", "limits.upper", "use_sim_time"]
        got = await robot.call(
            "/small/get_parameters", "rcl_interfaces/srv/GetParameters", names=names
        )
        described = await robot.call(
            "/small/describe_parameters", "rcl_interfaces/srv/DescribeParameters", names=names
        )
        parameter = robot.context.interfaces.message("rcl_interfaces/msg/Parameter")

        async def put(name: str, kind: int, field: str, value: object) -> str:
            asked = parameter(name=name)
            asked.value.type = kind
            setattr(asked.value, field, value)
            answer = await robot.call(
                "/small/set_parameters", "rcl_interfaces/srv/SetParameters", parameters=[asked]
            )
            return answer.results[0].reason

        assert "read-only" in await put("joints", 9, "string_array_value", ["a"])
        assert await put("grip_effort", 3, "double_value", 0.25) == ""
        await until(lambda: served.loop.controller.grip_effort == 0.25)
        assert await put("speed", 3, "double_value", 3.0) != ""
        # What another client changes is told, too.
        changes = robot.hear("/parameter_events", "rcl_interfaces/msg/ParameterEvent")
        async with connect("small") as client:
            await client.set_gains({"grip_effort": 0.75})
        told = "changed_parameters"
        await until(
            lambda: any(one.name == "grip_effort" for e in changes for one in getattr(e, told))
        )
    values = dict(zip(names, got.values, strict=True))
    assert values["joints"].string_array_value == list(hand.actuator_names)
    assert values["limits.upper"].double_array_value.tolist() == hand.upper.tolist()
    assert all(one.description for one in described.descriptors)
    assert [one.read_only for one in described.descriptors] == [
        True,
        False,
        False,
        False,
        True,
        True,
    ]


async def test_diagnostics(hand: Hand, library: ActionLibrary, settings: Ros2Settings) -> None:
    kind = "diagnostic_msgs/msg/DiagnosticArray"
    async with a_hand_in_ros(hand, library, settings) as (_, robot):
        told = await robot.listen("/diagnostics", kind)
        first = {one.name: one for one in told[0].status}
        assert first["small: device sim"].level == Level.OK
        assert {pair.key for pair in first["small: loop"].values} >= {"rate [Hz]", "missed"}
    assert first["small: loop"].hardware_id == "small"


async def test_ticks_missed_before_the_node_came_do_not_warn(
    hand: Hand, library: ActionLibrary, settings: Ros2Settings
) -> None:
    async with (
        serving(hand, library),
        connect("small") as remote,
        Context.open(settings, {}) as context,
        shown(context, Shown("small", settings, configured=hand), remote) as parts,
    ):
        (diagnostics,) = (part for part in parts if isinstance(part, Diagnostics))
        status = await remote.status()
        told = []
        for missed in (7, 7, 9):
            clock = replace(status.statistics, missed=missed, dropped=0)
            message: Any = diagnostics.message(replace(status, statistics=clock), 0)
            told.append((message.status[0].level, message.status[0].message))
    assert [level for level, _ in told] == [Level.OK, Level.OK, Level.WARN]
    assert told[-1][1].startswith("2 ticks missed")


@pytest.mark.parametrize(
    ("lifecycle", "age", "level"),
    [
        (Lifecycle.ACTIVE, 0.01, Level.OK),
        (Lifecycle.ACTIVE, 5.0, Level.STALE),
        (Lifecycle.INACTIVE, 0.01, Level.WARN),
        (Lifecycle.FAULT, 0.01, Level.ERROR),
        (Lifecycle.UNCONFIGURED, math.inf, Level.STALE),
    ],
)
async def test_levels(lifecycle: Lifecycle, age: float, level: Level) -> None:
    status = DeviceStatus("svh", "schunk_svh", lifecycle, age=age, fault_name="too hot")
    found, said = health(status)
    assert found is level
    assert ("too hot" in said) == (level in (Level.WARN, Level.ERROR) or age == math.inf)


async def test_namespaces_and_names() -> None:
    one = Shown("one", Ros2Settings())
    two = Shown("two", Ros2Settings())
    assert any("share" in line for line in warnings([one, two]))
    assert all("check identities" in line for line in warnings([one]))
    assert "every user of this computer" in warnings([one])[0]
    elsewhere = Shown("one", Ros2Settings(router="tls/robot:7447"))
    assert "every user" not in warnings([elsewhere])[0]
    # Nobody comes to the node itself beside a router that only its user reaches.
    private = Ros2Settings(router="unixsock-stream//run/user/1/ros2.sock")
    assert "every user" not in warnings([Shown("one", private)])[0]
    assert configuration(private, {}).get_json("listen/endpoints") == "[]"
    parted = Shown("two", Ros2Settings(namespace="right"))
    assert len(warnings([one, parted])) == 1
    with pytest.raises(ConfigError, match="be the same node /a_b"):
        warnings([Shown("a-b", Ros2Settings()), Shown("a.b", Ros2Settings())])
    with pytest.raises(ConfigError, match="the command line: the namespace"):
        overridden(Ros2Settings(), {"namespace": "a b"})
    assert [ros_name(name) for name in ("a-b.c", "2f", "svh")] == ["a_b_c", "_2f", "svh"]
    changed = overridden(Ros2Settings(), {"distro": "humble", "domain": 3, "router": None})
    assert (changed.distro, changed.domain, changed.router) == (
        Distro.HUMBLE,
        3,
        Ros2Settings().router,
    )
    with pytest.raises(ConfigError, match="humble, not foxy"):
        overridden(Ros2Settings(), {"distro": "foxy"})


async def test_meshes_have_absolute_addresses(tmp_path: Path) -> None:
    folder = tmp_path / "a hand"
    (folder / "meshes").mkdir(parents=True)
    (folder / "meshes" / "palm.stl").write_bytes(b"")
    box = '<box size="0.01 0.01 0.03"/>'
    text = URDF.replace(box, '<mesh filename="meshes/palm.stl"/>', 1)
    text = text.replace(box, '<mesh filename="meshes/lost.stl"/>', 1)
    (folder / "small.urdf").write_text(text)
    found = re.findall(r'filename="(.*?)"', description(load_model(folder / "small.urdf"), text))
    assert found == [(folder / "meshes" / "palm.stl").as_uri(), "meshes/lost.stl"]
