"""For authors of drivers: one suite of tests that every driver passes, and simulated buses.

Describe the device by a `DeviceCase` and derive from `DriverContract`::

    from rtee.testing import DeviceCase, DriverContract, actuator


    class TestMyGripper(DriverContract):
        case = DeviceCase(
            driver="my_package.driver:MyDriver",
            emulator="my_package.emulator:MyEmulator",
            actuators=(actuator("finger_joint", 0.0, 0.8),),
            options={"port": "/dev/my-gripper"},
        )
"""

from rtee.testing.case import DeviceCase, actuator, cycles
from rtee.testing.contract import DriverContract
from rtee.testing.session import Session, open_files

__all__ = ["DeviceCase", "DriverContract", "Session", "actuator", "cycles", "open_files"]
