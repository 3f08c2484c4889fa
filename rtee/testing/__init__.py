"""Tools for authors of drivers: a test suite that every driver must pass, and simulated buses.

Describe the device by a `DeviceCase` and derive from `DriverContract`::

    from rtee.testing import DeviceCase, DriverContract, actuator


    class TestMyGripper(DriverContract):
        case = DeviceCase(
            driver="my_package.driver:MyDriver",
            emulator="my_package.emulator:MyEmulator",
            actuators=(actuator("finger_joint", 0.0, 0.8),),
            options={"port": "/dev/my-gripper"},
        )

The suite runs on simulated time: driver, emulator and wire share the time of the event loop
`simulated_time`, which jumps to the next timer instead of waiting for it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rtee.errors import needing_extra
from rtee.testing.case import DeviceCase, actuator, cycles
from rtee.testing.session import Session, open_files, simulated_time

if TYPE_CHECKING:
    from rtee.testing.contract import DriverContract

__all__ = [
    "DeviceCase",
    "DriverContract",
    "Session",
    "actuator",
    "cycles",
    "open_files",
    "simulated_time",
]


def __getattr__(name: str) -> Any:
    # Imported when first used: it needs pytest, which writing a skeleton and fuzzing do not.
    if name == "DriverContract":
        with needing_extra("the contract suite", "test"):
            from rtee.testing.contract import DriverContract
        return DriverContract
    raise AttributeError(f"module 'rtee.testing' has no attribute '{name}'")
