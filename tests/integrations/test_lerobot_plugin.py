"""The plugin for LeRobot beside a running hand; LeRobot itself is played by its interface.

`make lerobot` runs it with LeRobot: tests/docs/test_lerobot_page.py.
"""

from __future__ import annotations

import importlib
import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from rtee.errors import ConfigError
from rtee.testing.human_hand import HumanHand
from rtee.testing.running import StartHand

FOLDER = Path(__file__).parents[2] / "integrations" / "lerobot"


class Config:
    """Stands for RobotConfig and TeleoperatorConfig (lerobot/robots/config.py)."""

    id: str | None = None

    @classmethod
    def register_subclass(cls, _name: str) -> Any:
        return lambda kind: kind


class Device:
    """Stands for Robot and Teleoperator."""

    def __init__(self, config: Any) -> None:
        self.id = config.id


NAMES: dict[str, dict[str, Any]] = {
    "lerobot": {},
    "lerobot.cameras": {"CameraConfig": object},
    "lerobot.cameras.utils": {"make_cameras_from_configs": lambda _: {}},
    "lerobot.robots": {"Robot": Device, "RobotConfig": Config},
    "lerobot.teleoperators": {},
    "lerobot.teleoperators.config": {"TeleoperatorConfig": Config},
    "lerobot.teleoperators.teleoperator": {"Teleoperator": Device},
    "lerobot.utils": {},
    "lerobot.utils.errors": {
        "DeviceAlreadyConnectedError": ConnectionError,
        "DeviceNotConnectedError": ConnectionError,
    },
}


@pytest.fixture
def plugin(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    for name, members in NAMES.items():
        module = ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.syspath_prepend(str(FOLDER))
    yield importlib.import_module("lerobot_robot_rtee")
    for name in [each for each in sys.modules if each.startswith("lerobot_robot_rtee")]:
        del sys.modules[name]


def test_a_hand_is_a_robot(plugin: Any, rtee_hand: StartHand, tmp_path: Path) -> None:
    watch = rtee_hand("robotiq_2f_85")
    robot = plugin.RteeHand(plugin.RteeHandConfig(hand="robotiq_2f_85"))
    assert list(robot.action_features) == ["finger_joint.pos"]
    assert {"finger_joint.pos", "right_outer_knuckle_joint.pos"} <= set(robot.observation_features)
    assert not robot.is_connected
    with pytest.raises(ConnectionError):
        robot.send_action({"finger_joint.pos": 0.1})
    robot.connect()
    assert watch.status().holder
    seen = robot.get_observation()
    assert seen.keys() == robot.observation_features.keys()
    assert all(map(math.isfinite, seen.values()))
    for wrong, why in (
        ({"finger_joint.pos": math.nan}, "nothing of it is sent"),
        ({"thumb.pos": 0.1}, "not one of robotiq_2f_85: it has thumb.pos; the hand takes finger_"),
    ):
        with pytest.raises(ConfigError, match=why):
            robot.send_action(wrong)
    assert robot.send_action({"finger_joint.pos": 0.2}) == {"finger_joint.pos": 0.2}
    (upper,) = (each.upper for each in watch.info().actuators)
    assert robot.send_action({"finger_joint.pos": 9.0}) == {"finger_joint.pos": upper}
    robot.stop()
    assert not robot.is_connected
    assert not watch.status().holder

    # Intensities, as of a gamepad.
    actions = ["PinchTight finger_1 finger_2"]
    pad = plugin.RteeGamepad(plugin.RteeGamepadConfig(actions=[f"lt={actions[0]}"]))
    pad._pad = SimpleNamespace(read=lambda: {"lt": 0.25})
    config = plugin.RteeHandConfig(actions=[actions[0]], observe=["position"])
    robot = plugin.RteeHand(config)
    assert robot.action_features == pad.action_features
    assert list(robot.observation_features) == ["finger_joint.pos"]
    robot.connect()
    assert robot.send_action(pad.get_action()) == {actions[0]: 0.25}
    robot.disconnect()
    with pytest.raises(ConfigError, match="does not know its touch now"):
        _ = plugin.RteeHand(plugin.RteeHandConfig(observe=["touch"])).observation_features

    # A person's hand.
    points = tmp_path / "hand.jsonl"
    frames = [{"t": 0.0, "points": HumanHand().points(pinch=(1, 0.02)).tolist()}]
    points.write_text("\n".join(map(json.dumps, frames)))
    follower = plugin.RteeLandmarks(plugin.RteeLandmarksConfig(source=str(points)))
    assert list(follower.action_features) == ["finger_joint.pos"]
    before = watch.state().positions["finger_joint"]
    follower.connect()
    follower._thread.join()
    assert follower.get_action()["finger_joint.pos"] > before
    follower.disconnect()
