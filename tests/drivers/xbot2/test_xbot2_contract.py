"""Joints behind XBot2 pass the suite of all drivers."""

from __future__ import annotations

from dataclasses import replace

from rtee.testing import DeviceCase, DriverContract, actuator, cycles
from tests.drivers.objects import obstruct
from tests.drivers.suites import same_wire


class TestXBot2(DriverContract):
    case = DeviceCase(
        driver="xbot2",
        actuators=(actuator("claw", 0.0, 1.0), actuator("other", 0.0, 1.0)),
        options={"emulator": {"rate": 500.0, "speed": 10.0}, "deadline": 1.0, "rate": 50.0},
        grip_object=lambda emulator: obstruct(emulator.joints["claw"], 0.15, 200.0),
        commands=lambda emulator: emulator.commands,
        homes=False,
        wire_faults=frozenset({"drop", "corrupt", "duplicate", "delay"}),
        answers=False,
        cycles=cycles(100),
    )


@same_wire
class TestXBot2WithLimits(DriverContract):
    case = replace(
        TestXBot2.case,
        options={**TestXBot2.case.options, "control": "limited"},
        efforts=lambda emulator: [axis.max_effort for axis in emulator.axes],
        max_efforts=[0.5, 0.8],
    )
