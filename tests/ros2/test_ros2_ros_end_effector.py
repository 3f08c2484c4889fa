"""The services of ROS End-Effector, asked as its programs ask them."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from remote.serving import make_hand, make_library, serving

import rtee
from rtee.hand.config_schema import Ros2Settings
from rtee.ros2 import Context
from rtee.ros2.ros_end_effector import RosEndEffector, name_here

pytestmark = pytest.mark.anyio


@pytest.fixture(autouse=True)
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RTEE_RUNTIME_DIR", str(tmp_path / "run"))


@asynccontextmanager
async def asking(settings: Ros2Settings, folder: Path) -> AsyncIterator[Any]:
    """A function that asks a hand's services."""
    hand = make_hand(folder)
    async with (
        serving(hand, make_library(hand, folder / "actions")),
        rtee.connect("small") as remote,
        Context.open(settings, {}) as here,
        Context.open(settings, {}) as there,
    ):
        RosEndEffector(here.node("ros_end_effector"), remote)
        node = there.node("program")

        async def ask(name: str, kind: str, **fields: Any) -> Any:
            client = node.client(f"/{name}", f"rosee_msg/srv/{kind}")
            await client.wait(300)
            return await client.call(client.type.request(**fields), 20)

        yield ask


async def test_programs_find_the_actions(settings: Ros2Settings, tmp_path: Path) -> None:
    async with asking(settings, tmp_path) as ask:

        async def names(**fields: Any) -> list[str]:
            answer = await ask("grasping_actions_available", "GraspingActionsAvailable", **fields)
            return [one.action_name for one in answer.grasping_actions]

        assert sorted(await names()) == ["pinchTight", "trig", "trig"]
        assert await names(action_name="pinchTight") == ["pinchTight"]
        assert await names(primitive_type=4, elements_involved=["thumb"]) == ["trig"]
        assert await names(primitive_type=2) == []
        assert sorted(await names(action_type=1)) == ["fist", "poke"]
        assert await names(action_type=1, action_name="poke") == ["poke"]
        assert await names(action_type=2) == ["wave"]
        assert await names(action_type=9) == []
        answer = await ask(
            "grasping_actions_available", "GraspingActionsAvailable", action_name="pinchTight"
        )
        pinch = answer.grasping_actions[0]
        assert (pinch.action_type, pinch.primitive_type) == (0, 0)
        assert pinch.elements_involved == ["index", "thumb"]
        counts = dict(
            zip(pinch.action_motor_count.name, pinch.action_motor_count.count, strict=True)
        )
        assert counts == {"near": 1, "thumb": 1, "push": 0}
        assert pinch.action_motor_positions[0].position.tolist() == [1.0, 0.8, 0.0]
        timed = await ask("grasping_actions_available", "GraspingActionsAvailable", action_type=2)
        wave = timed.grasping_actions[0]
        assert (wave.action_type, wave.primitive_type) == (3, 7)
        assert wave.inner_actions == ["up", "side"]
        assert wave.after_time_margins.tolist() == [0.05, 0.0]


async def test_programs_ask_about_primitives_and_the_hand(
    settings: Ros2Settings, tmp_path: Path
) -> None:
    async with asking(settings, tmp_path) as ask:
        kind = "GraspingPrimitiveAggregatedAvailable"
        found = (await ask("primitives_aggregated_available", kind)).primitives_aggregated
        told = {one.action_name: (one.selectable_names, one.max_selectable) for one in found}
        assert told == {
            "pinchTight": (["index", "thumb"], 2),
            "trig": (["index", "thumb"], 1),
        }
        for element, partners in (("index", ["thumb"]), ("nose", [])):
            answer = await ask(
                "selectable_finger_pair_info",
                "SelectablePairInfo",
                action_name="pinchTight",
                element_name=element,
            )
            assert answer.pair_elements == partners
        info = await ask("hand_info", "HandInfo", motor_positions=[0.5, 0.0, 0.0])
        assert info.motors_names == ["near", "thumb", "push"]
        assert info.motors_torque_limits.tolist() == [2.0, 3.0, 40.0]
        assert [one.size for one in info.transmission_matrix.layout.dim] == [4, 3]
        assert len(info.transmission_matrix.data) == 12


async def test_programs_add_a_generic_action(settings: Ros2Settings, tmp_path: Path) -> None:
    async with asking(settings, tmp_path) as ask:
        from rtee.ros2.types import interfaces

        known = interfaces()

        def new(name: str, positions: dict[str, float], counts: dict[str, int]) -> Any:
            return known.message("rosee_msg/msg/NewGenericGraspingAction")(
                action_name=name,
                action_motor_position=known.message("rosee_msg/msg/MotorPosition")(
                    name=list(positions), position=list(positions.values())
                ),
                action_motor_count=known.message("rosee_msg/msg/JointsInvolvedCount")(
                    name=list(counts), count=bytes(counts.values())
                ),
            )

        async def add(*what: Any) -> Any:
            name, kind = "new_generic_grasping_action", "NewGenericGraspingActionSrv"
            return await ask(name, kind, new_action=new(*what))

        where = {"near": 0.5, "thumb": 0.0}
        assert (await add("half", where, {})).accepted
        assert (await add("both", where, {"near": 1, "thumb": 1})).accepted
        for mask in ({"nose": 1}, {"near": 1, "thumb": 1, "push": 0}):
            assert "without a position" in (await add("wrong", where, mask)).error_msg
        uneven = new("uneven", where, {"near": 1})
        uneven.action_motor_count.name = ["near", "thumb"]
        name, kind = "new_generic_grasping_action", "NewGenericGraspingActionSrv"
        assert "fewer" in (await ask(name, kind, new_action=uneven)).error_msg
        answer = await add("wrong", {"nose": 1.0}, {})
        assert not answer.accepted
        assert "nose" in answer.error_msg
        answer = await ask("grasping_actions_available", "GraspingActionsAvailable", action_type=1)
        counts = {
            one.action_name: sum(one.action_motor_count.count) for one in answer.grasping_actions
        }
        assert counts["half"] == 1
        assert counts["both"] == 2


def test_names_are_understood_both_ways() -> None:
    assert name_here("pinchTight") == "PinchTight"
    assert name_here("multiplePinchTight_3") == "MultiPinchTight_3"
    assert name_here("singleJointMultipleTips_2") == "SingleJointMultipleTips_2"
    assert name_here("my_grasp") == "my_grasp"
