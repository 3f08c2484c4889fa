"""The kinematic driver passes the suite of all drivers, as far as it has no wire."""

from __future__ import annotations

from rtee.testing import DeviceCase, DriverContract, actuator


class TestKinematic(DriverContract):
    case = DeviceCase(
        driver="kinematic",
        actuators=(actuator("finger", -0.2, 1.5, rest=0.0), actuator("thumb", 0.0, 1.0)),
        wire=False,
    )
