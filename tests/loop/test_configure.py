"""From hand.yaml to settings and devices."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from rtee.errors import ConfigError
from rtee.hand.config import HandConfig
from rtee.hand.config_schema import Behaviour, ProfileKind
from rtee.hand.model import Hand
from rtee.hand.validation import validated
from rtee.loop.settings import (
    DeviceChoice,
    LoopSettings,
    device_settings,
    loop_settings,
    realtime_settings,
)

INDEX = ["index_tip", "index_base"]


def config(**more: Any) -> HandConfig:
    return validated(HandConfig, {"name": "small", "urdf": "small.urdf", **more})


def test_the_defaults_of_hand_yaml_are_those_of_the_loop() -> None:
    assert loop_settings(config()) == LoopSettings()
    assert not realtime_settings(config()).enabled
    assert realtime_settings(config(), enabled=True).priority == 80


def test_everything_is_taken_over() -> None:
    given = config(
        profile={"kind": "filter", "bandwidth": 3.0},
        loop={
            "rate": 500,
            "goal_timeout": 4.0,
            "stall": {"time": 0.3, "speed": 0.1},
            "grasp": {"effort": 0.3, "grip_effort": 0.5, "grip_after": 1.5},
        },
        safety={"on_exit": "open", "on_client_lost": "disable", "max_step": 0.01},
        thermal={
            "warn": 50.0,
            "derate": 55.0,
            "disable": 65.0,
            "nominal_current": {"defaults": 0.4},
            "time_constant": 12.0,
            "ambient": 20.0,
        },
        realtime={"enabled": True, "priority": 60, "cpus": [1], "lock_memory": False},
    )
    settings = loop_settings(given, rate=250.0)
    assert settings.rate == 250.0
    assert loop_settings(given).rate == 500.0
    assert settings.goal_timeout == 4.0
    assert (settings.profile.kind, settings.profile.bandwidth) == (ProfileKind.FILTER, 3.0)
    assert (settings.stall.time, settings.stall.speed) == (0.3, 0.1)
    grasp = settings.grasp
    assert (grasp.effort, grasp.grip_effort, grasp.grip_after) == (0.3, 0.5, 1.5)
    assert settings.safety.on_exit is Behaviour.OPEN
    assert settings.safety.on_client_lost is Behaviour.DISABLE
    assert settings.safety.max_step == 0.01
    assert (settings.thermal.warn, settings.thermal.disable) == (50.0, 65.0)
    assert settings.thermal.nominal_current == {"defaults": 0.4}
    assert (settings.thermal.time_constant, settings.thermal.ambient) == (12.0, 20.0)
    realtime = realtime_settings(given)
    assert (realtime.enabled, realtime.priority, realtime.cpus) == (True, 60, (1,))
    assert not realtime.lock_memory


@pytest.mark.parametrize("rate", [0.5, 2000.5, float("nan")])
def test_a_rate_out_of_range_is_refused(rate: float) -> None:
    with pytest.raises(ConfigError, match="1 to 2000 Hz"):
        loop_settings(config(), rate=rate)


DEVICES = {
    "left": {"driver": "dynamixel", "actuators": INDEX, "every": 3, "reconnect": "active"},
    "right": {"driver": "cia402", "actuators": ["thumb_base", "thumb_slide"], "deadline": 0.1},
}


def test_the_devices_of_hand_yaml(hand: Hand) -> None:
    given = config(devices=DEVICES, driver="devices")
    choice = DeviceChoice(source="hand.yaml", lines={"left": 7})
    left, right = device_settings(hand, given, 400.0, choice)
    assert left.spec.name == "left"
    assert [a.name for a in left.spec.actuators] == ["index_base", "index_tip"], "the hand's order"
    assert (left.spec.every, left.spec.rate, left.spec.source) == (3, 400.0, "hand.yaml:7")
    assert left.reconnect_active
    assert not right.reconnect_active
    assert right.spec.deadline == 0.1


def test_kinematic_drives_everything(hand: Hand) -> None:
    choice = DeviceChoice("kinematic", options=(("time_constant", 0.1),))
    (only,) = device_settings(hand, config(devices=DEVICES), 1000.0, choice)
    assert only.spec.driver == "kinematic"
    assert only.spec.actuators == hand.actuators
    assert only.spec.options == {"time_constant": 0.1}


def test_a_drivers_name_picks_its_devices_and_stand_ins_do_the_rest(hand: Hand) -> None:
    choice = DeviceChoice("cia402", emulated=True)
    picked, rest = device_settings(hand, config(devices=DEVICES), 1000.0, choice)
    assert (picked.spec.name, picked.spec.emulated) == ("right", True)
    assert rest.spec.driver == "kinematic"
    assert [a.name for a in rest.spec.actuators] == ["index_base", "index_tip"]


def test_a_driver_that_hand_yaml_does_not_use_gets_all_actuators(hand: Hand) -> None:
    (only,) = device_settings(hand, config(), 1000.0, DeviceChoice("my.module:Driver"))
    assert (only.spec.name, only.spec.driver) == ("Driver", "my.module:Driver")
    assert only.spec.actuators == hand.actuators


def test_options_given_count_before_those_of_hand_yaml(hand: Hand) -> None:
    port = (("port", "/dev/ttyUSB7"),)
    device = {"driver": "svh", "options": {"port": "/dev/ttyUSB0", "retries": 1}}
    given = config(devices={"all": device})
    (only,) = device_settings(hand, given, 1000.0, DeviceChoice("devices", options=port))
    assert only.spec.options == {"port": "/dev/ttyUSB7", "retries": 1}
    with pytest.raises(ConfigError, match=r"--option is for one device, and .* has left, right"):
        device_settings(
            hand, config(devices=DEVICES), 1000.0, DeviceChoice("devices", options=port)
        )


def test_emulated_means_the_devices(hand: Hand) -> None:
    chosen = device_settings(hand, config(devices=DEVICES), 1000.0, DeviceChoice(emulated=True))
    assert [device.spec.emulated for device in chosen] == [True, True]
    assert [device.spec.deadline for device in chosen] == [None, 0.1]


def test_an_ideal_device_is_waited_for_on_a_busy_computer(hand: Hand) -> None:
    choice = DeviceChoice(emulated=True, ideal=True)
    chosen = device_settings(hand, config(devices=DEVICES), 1000.0, choice)
    assert [device.spec.deadline for device in chosen] == [1.0, 0.1], "hand.yaml counts"


def test_a_hand_without_devices_says_what_to_do(hand: Hand) -> None:
    with pytest.raises(ConfigError, match=r"no devices; give it some under 'devices:' in a\.yaml"):
        device_settings(hand, config(), 1000.0, DeviceChoice("devices", source="a.yaml"))


def test_an_actuator_without_a_device_is_named(hand: Hand) -> None:
    given = config(devices={"left": DEVICES["left"]})
    with pytest.raises(ConfigError, match="no device drives the actuator 'thumb_base'"):
        device_settings(hand, given, 1000.0, DeviceChoice("devices", source=str(Path("a.yaml"))))
