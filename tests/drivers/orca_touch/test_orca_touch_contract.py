"""The touch board passes what of the suite of all drivers concerns a device that only measures."""

from __future__ import annotations

from typing import ClassVar

from rtee.testing import DeviceCase, DriverContract, cycles
from tests.drivers.suites import few_faults


@few_faults
class TestOrcaTouch(DriverContract):
    case: ClassVar[DeviceCase] = DeviceCase(
        driver="orca_touch",
        actuators=(),
        options={"content": "resultants"},
        commands=lambda emulator: 0,
        homes=False,
        cycles=cycles(100),
    )
