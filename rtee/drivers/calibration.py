"""Calibration of a device, for drivers whose device has offsets or end stops to find."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Protocol, runtime_checkable

from rtee.drivers.base import Driver
from rtee.errors import ConfigError
from rtee.sample import FloatArray
from rtee.types import readonly


@runtime_checkable
class Calibrates(Protocol):
    """A driver whose device has offsets or end stops to find."""

    async def calibrate(
        self, path: Path, rest: FloatArray, ready: Callable[[str], Awaitable[None]]
    ) -> object:
        """Find the device's values and store them.

        Args:
            path: File to write.
            rest: The rest posture, in the order of the actuators [rad | m].
            ready: Called with an instruction for the user; returns when it has been followed.

        Returns:
            The calibration; its ``str`` is shown to the user.

        Raises:
            BusError: if the bus fails.
            CalibrationError: if the values found are not plausible.
            ConfigError: if the file cannot be written.
        """


async def calibrate(driver: Driver, path: Path, ready: Callable[[str], Awaitable[None]]) -> object:
    """Connect to a device, calibrate it, store the values and close the driver.

    Args:
        driver: The device's driver, not yet connected.
        path: File to write.
        ready: Called with an instruction for the user; returns when it has been followed.

    Raises:
        ConfigError: if the device needs no calibration, or the file cannot be written.
        RteeError: if the calibration fails.
    """
    if not isinstance(driver, Calibrates):
        raise ConfigError(
            f"device '{driver.spec.name}': '{driver.spec.driver}' needs no calibration"
        )
    try:
        await driver.configure()
        rest = readonly([actuator.rest for actuator in driver.spec.actuators])
        return await driver.calibrate(path, rest, ready)
    finally:
        await driver.close()
