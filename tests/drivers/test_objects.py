"""An object between the fingers of every emulated device, put there in the same words."""

from __future__ import annotations

from typing import Any

import pytest

from rtee.drivers.emulator_server import Player
from rtee.drivers.emulators import emulator_names, make_emulator
from rtee.drivers.objects import STIFFNESS, Closing, ObjectInHand, grasping
from rtee.errors import ConfigError
from rtee.running.prepare import RunOptions, prepare


@pytest.mark.parametrize(
    ("text", "closure", "width", "stiffness"),
    [
        ("0.4", 0.4, None, STIFFNESS),
        (0.4, 0.4, None, STIFFNESS),
        (1, 1.0, None, STIFFNESS),
        ("50mm", 0.0, 0.05, STIFFNESS),
        (" 5 cm ", 0.0, 0.05, STIFFNESS),
        ("0.05m:20", 0.0, 0.05, 20.0),
        ("0.5:1e3", 0.5, None, 1e3),
    ],
)
def test_an_object_is_a_width_or_a_part_of_the_way(
    text: object, closure: float, width: float | None, stiffness: float
) -> None:
    obj = ObjectInHand.parse(text)
    assert (obj.closure, obj.stiffness) == (closure, stiffness)
    assert obj.width == (None if width is None else pytest.approx(width))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("ball", "cannot be read; write 0.4"),
        ("", "cannot be read"),
        (None, "cannot be read"),
        (True, "cannot be read"),
        ("1e999mm", "cannot be read"),
        ("1.2.3", "cannot be read"),
        ("0.4:0", "stiffness is 0.1 to 1e6"),
        ("0.4:hard", "cannot be read"),
        ("-0.1", "0 to 1 of the travel, not at -0.1"),
        (50, "a width needs a unit, such as 50mm"),
    ],
)
def test_what_is_no_object_is_refused(text: object, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        ObjectInHand.parse(text)


def settled(one: Closing) -> None:
    """Close a motor with all its effort, for long."""
    axis: Any = one.motor
    axis.enabled = True
    axis.max_effort = one.effort
    axis.target = one.closed
    axis.advance(30.0)


@pytest.mark.parametrize(
    "name", [n for n in emulator_names() if n not in ("allegro", "orca_touch")]
)
def test_every_device_closes_as_far_as_its_object_lets_it(name: str) -> None:
    emulator = make_emulator(name, {"emulator": {"object": "0.6:25"}})
    closings = grasping(emulator).closings()
    assert closings
    for one in closings:
        settled(one)
        # Full effort presses 1/25 of the way into it.
        assert one.part == pytest.approx(0.64, abs=0.005)
        # A servo of proportional gain does not reach its limit over the rest of the way.
        assert 0.8 * one.effort < abs(one.motor.effort) <= one.effort  # type: ignore[attr-defined]
    grasping(emulator).remove_object()
    for one in closings:
        settled(one)
        assert one.part == pytest.approx(1.0, abs=0.01)
    with pytest.raises(ConfigError, match="further than the object is wide; open them first"):
        grasping(emulator).place_object(ObjectInHand(0.5))


def test_the_joints_of_a_torque_controlled_hand_are_stopped_too() -> None:
    emulator: Any = make_emulator("allegro", {"emulator": {"object": "0.5"}})
    joints = [joint.obstacle is not None for joint in emulator.joints]
    assert joints == [False, True, True, True] * 4
    joint = emulator.joints[1]
    joint.torque = 0.7
    for _ in range(5000):
        joint.advance(0.0005, emulator.properties)
    assert joint.angle / 1.6 == pytest.approx(0.52, abs=0.005)


def opening(gripper: Any, hand: str) -> float:
    """The opening at the object by the hand's own table, which comes from its meshes."""
    ready = prepare(hand, RunOptions())
    (spec,) = ready.hand.actuators
    part = (gripper.axis.obstacle.contact - 3) / 227
    grasp = ready.library.find("Grasp", ())
    end = grasp.waypoints[-1].position[spec.name]
    return ready.library.openings.of(grasp).at(part * spec.upper / end)


@pytest.mark.parametrize(
    ("name", "options", "width", "measured"),
    [
        ("robotiq_2f", {}, "50mm", lambda e: opening(e, "robotiq_2f_85")),
        ("robotiq_2f", {"model": "2f_140"}, "70mm", lambda e: opening(e, "robotiq_2f_140")),
        ("onrobot_3fg", {}, "50mm", lambda e: e.axis.obstacle.contact - 0.0126),
        ("onrobot_3fg", {"grip": "internal"}, "9cm", lambda e: e.axis.obstacle.contact + 0.0126),
    ],
)  # fmt: skip
def test_a_width_is_where_the_fingertips_are_so_far_apart(
    name: str, options: dict[str, Any], width: str, measured: Any
) -> None:
    emulator = make_emulator(name, {**options, "emulator": {"object": width}})
    assert measured(emulator) == pytest.approx(ObjectInHand.parse(width).width, abs=3e-4)


def test_an_internal_grip_opens_into_its_object() -> None:
    emulator: Any = make_emulator("onrobot_3fg", {"grip": "internal", "emulator": {"object": 0.5}})
    assert emulator.axis.position == pytest.approx(0.020)
    assert emulator.axis.obstacle.closing == 1.0


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("robotiq_2f", "90mm", "90 mm wide does not fit the fingers"),
        ("qb_softhand", "50mm", "give the fraction of the travel"),
        ("schunk_svh", "0.1", "open them first"),
    ],
)
def test_what_does_not_fit_is_said(name: str, text: str, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        make_emulator(name, {"emulator": {"object": text}})


def test_the_object_stays_where_it_is_through_a_power_cycle() -> None:
    emulator: Any = make_emulator("schunk_svh", {"emulator": {"object": 0.7}})
    index = next(n for n, c in enumerate(emulator.channels) if c.axis.obstacle is not None)
    emulator.power_cycle(1.0)
    axis = emulator.channels[index].axis
    way = emulator.closings()[0]
    assert (axis.obstacle.contact - way.opened) / (way.closed - way.opened) == pytest.approx(
        0.7, abs=1e-3
    )


def test_it_is_put_and_taken_away_by_typing() -> None:
    with Player("robotiq_2f") as player:
        gripper: Any = player.emulator
        assert player.command("object 50mm") == ""
        assert gripper.axis.obstacle is not None
        assert player.command("object") == ""
        assert gripper.axis.obstacle is None
        assert "cannot be read" in player.command("object huge")
        assert "object SIZE" in player.command("help")


def test_it_is_given_to_all_emulated_devices_of_a_hand() -> None:
    ready = prepare("robotiq_2f_85", RunOptions(emulated=True, object_in_hand="50mm"))
    assert [d.spec.options["emulator"] for d in ready.devices] == [{"object": "50mm"}]
    with pytest.raises(ConfigError, match="no device of hand 'robotiq_2f_85' is emulated"):
        prepare("robotiq_2f_85", RunOptions(driver="kinematic", object_in_hand="50mm"))
    with pytest.raises(ConfigError, match="cannot be read"):
        prepare("robotiq_2f_85", RunOptions(emulated=True, object_in_hand="sphere:0.03"))
