"""The services of a hand's node: what they move, and what they tell."""

from __future__ import annotations

import anyio
import numpy as np
import pytest
from remote.serving import serving, until

from rtee.actions.library import ActionLibrary
from rtee.hand.config_schema import Ros2Settings
from rtee.hand.model import Hand
from rtee.remote.client import connect
from rtee.ros2 import Context
from rtee.ros2.hand_services import CHANGED, Services
from rtee.ros2.keys import Kind
from rtee.ros2.serving import Shown, shown
from rtee.types import Intensity, Named

from .facing import Robot, a_hand_in_ros

pytestmark = pytest.mark.anyio

TRIGGER = "std_srvs/srv/Trigger"


def offered(robot: Robot) -> set[str]:
    """Return the names of the services of actions in the graph."""
    begin = "/small/do/"
    return {n.removeprefix(begin) for n in robot.names(Kind.SERVICE) if n.startswith(begin)}


async def test_triggers(hand: Hand, library: ActionLibrary, settings: Ros2Settings) -> None:
    async with a_hand_in_ros(hand, library, settings) as (served, robot):
        done = await robot.call("/small/do/pinch_tight_index_thumb", TRIGGER)
        assert done.success
        assert "PinchTight index thumb: reached" in done.message
        goal = served.watcher.goals[-1]
        assert goal.what == Named("PinchTight", ("index", "thumb"), "primitive")
        np.testing.assert_allclose(served.loop.snapshot().position, [1.0, 0.8, 0.0], atol=0.02)
        opened = await robot.call("/small/open", TRIGGER)
        assert opened.success
        stopped = await robot.call("/small/stop", TRIGGER)
        assert (stopped.success, stopped.message) == (True, "all devices have stopped")
        assert "stop" in [event.kind for event in served.watcher.events]
        recovered = await robot.call("/small/recover", TRIGGER)
        assert recovered.success
        async with connect("small") as client, client.lease():
            refused = await robot.call("/small/do/fist", TRIGGER)
        assert not refused.success
        assert "is held by" in refused.message


async def test_goals_have_the_parameters(
    hand: Hand, library: ActionLibrary, settings: Ros2Settings
) -> None:
    async with a_hand_in_ros(hand, library, settings) as (served, robot):
        parameter = robot.context.interfaces.message("rcl_interfaces/msg/Parameter")
        asked = []
        for name, value in (("speed", 0.5), ("tolerance", 0.02), ("intensity", 0.4)):
            asked.append(parameter(name=name))
            asked[-1].value.type, asked[-1].value.double_value = 3, value
        kind = "rcl_interfaces/srv/SetParametersAtomically"
        answer = await robot.call("/small/set_parameters_atomically", kind, parameters=asked)
        assert answer.result.successful
        assert (await robot.call("/small/do/poke", TRIGGER)).success
        goal = served.watcher.goals[-1]
    assert (goal.speed, goal.to) == (0.5, Intensity(0.4, tolerance=0.02))


async def test_actions_come_and_move(
    hand: Hand, library: ActionLibrary, settings: Ros2Settings
) -> None:
    async with a_hand_in_ros(hand, library, settings) as (_, robot):
        await until(lambda: "poke" in offered(robot))
        made = await robot.call(
            "/small/new_generic_action",
            "rtee_msgs/srv/NewGenericAction",
            name="Point",
            actuator=["near"],
            position=[0.7],
        )
        assert made.accepted
        await until(lambda: "point" in offered(robot))
        assert (await robot.call("/small/do/point", TRIGGER)).success
        async with connect("small") as client:
            await client.rename_action("Point", "Show")
            await until(lambda: "show" in offered(robot) and "point" not in offered(robot))
            await client.remove_action("Show")
            await until(lambda: "show" not in offered(robot))
        for actuator, position in ((["near"], [99.0]), (["near"], []), (["elbow"], [0.1])):
            refused = await robot.call(
                "/small/new_generic_action",
                "rtee_msgs/srv/NewGenericAction",
                name="Wrong",
                actuator=actuator,
                position=position,
            )
            assert not refused.accepted
            assert refused.reason


async def test_an_action_that_comes_while_the_node_is_made(
    hand: Hand, library: ActionLibrary, settings: Ros2Settings
) -> None:
    async with (
        serving(hand, library),
        connect("small") as remote,
        Context.open(settings, {}) as context,
        shown(context, Shown("small", settings, configured=hand), remote) as parts,
        anyio.create_task_group() as group,
    ):
        events = remote.events()
        await remote.add_generic("late", {"near": 0.3})
        assert (await anext(events)).kind == CHANGED  # nobody is told of it again
        (services,) = (part for part in parts if isinstance(part, Services))
        group.start_soon(services.run)
        await until(lambda: "late" in services._offered)
        group.cancel_scope.cancel()


async def test_what_there_is_to_know(
    hand: Hand, library: ActionLibrary, settings: Ros2Settings
) -> None:
    async with a_hand_in_ros(hand, library, settings) as (_, robot):

        async def ask(service: str, type_: str, **fields: object) -> object:
            return await robot.call(f"/small/{service}", f"rtee_msgs/srv/{type_}", **fields)

        actions = (await ask("list_actions", "ListActions", kind="primitive")).actions
        groups = (await ask("primitives_aggregated", "PrimitivesAggregated", name="trig")).groups
        partners = await ask(
            "selectable_partners", "SelectablePartners", action="PinchTight", element="index"
        )
        info = (await ask("get_hand_info", "GetHandInfo", name=["near"], position=[0.5])).info
        openings = (await ask("list_openings", "ListOpenings")).openings
        # A client of ROS 2 waits without end: what is refused has an empty answer.
        beyond = await ask("get_hand_info", "GetHandInfo", name=["near"], position=[99.0])
        nobody = await ask("selectable_partners", "SelectablePartners", action="Dance")
        nothing = await ask("list_actions", "ListActions", kind="wish")
        request = robot.context.interfaces.message("rtee_msgs/msg/GraspRequest").from_dict
        plans, refused = [
            await ask(
                "plan_grasps",
                "PlanGrasps",
                request=request({"object": "sphere:0.03", "table": [{"up": [0.0, 0.0, z]}]}),
            )
            for z in (1.0, 0.0)
        ]
    assert {action.name for action in actions} == {"Trig", "PinchTight"}
    assert [(group.name, group.selectable) for group in groups] == [("Trig", ["index", "thumb"])]
    assert partners.partners == ["thumb"]
    assert (info.name, info.posture.tolist()) == ("small", [0.5, 0.0, 0.0])
    assert info.urdf == hand.urdf.text
    assert openings == []
    assert (plans.accepted, refused.accepted) == (False, False)
    assert "it has no hand.yaml" in plans.reason  # the process that plans was asked
    assert "a table's normal" in refused.reason
    assert (beyond.info.name, nobody.partners, nothing.actions) == ("", [], [])
