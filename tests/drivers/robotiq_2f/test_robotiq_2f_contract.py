"""The 2F passes the suite of all drivers: RTU on a line, RTU through a socket, and TCP."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from rtee.drivers.robotiq_2f.codec import MODELS, Scale
from rtee.testing import DeviceCase, DriverContract, actuator

SCALE = Scale(MODELS["2f_85"], 0.0, 0.82)


def begun_with(emulator: Any) -> list[float]:
    return [SCALE.effort(emulator.begun.force)]


RTU = DeviceCase(
    driver="robotiq_2f",
    actuators=(actuator("finger_joint", 0.0, 0.82, effort=25.0),),
    options={
        "port": "/dev/ttyUSB0",
        "home": "on_connect",
        "emulator": {"activation_time": 0.05},
    },
    hold=lambda emulator: emulator.hold(),
    commands=lambda emulator: emulator.moves,
    efforts=begun_with,
    max_efforts=[12.0],
    fault="overcurrent",
    cycles=300,
)


class TestRtu(DriverContract):
    case = RTU


class TestRtuThroughASocket(DriverContract):
    case = replace(RTU, options={**RTU.options, "port": "socket://192.0.2.1:54321"}, cycles=100)


class TestTcp(DriverContract):
    case = replace(
        RTU,
        options={
            **RTU.options,
            "port": "tcp://192.0.2.1",
            "register_base": 0,
            "function": 4,
        },
        checksums=False,
        cycles=100,
    )
