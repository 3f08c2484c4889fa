"""Calibration of a device, for drivers that have something to calibrate."""

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
            ready: Called with what the user is to do; returns when it is done.

        Returns:
            What was found; its text is shown.

        Raises:
            BusError: if the bus fails.
            CalibrationError: if what was found cannot be right.
            ConfigError: if the file cannot be written.
        """


async def calibrate(driver: Driver, path: Path, ready: Callable[[str], Awaitable[None]]) -> object:
    """Connect to a device, calibrate it and store the values; closes the driver.

    Args:
        driver: The device's driver, not yet connected.
        path: File to write.
        ready: Called with what the user is to do; returns when it is done.

    Raises:
        ConfigError: if the device has nothing to calibrate, or the file cannot be written.
        RteeError: if it cannot be done.
    """
    if not isinstance(driver, Calibrates):
        raise ConfigError(
            f"device '{driver.spec.name}': '{driver.spec.driver}' has nothing to calibrate"
        )
    try:
        await driver.configure()
        rest = readonly([actuator.rest for actuator in driver.spec.actuators])
        return await driver.calibrate(path, rest, ready)
    finally:
        await driver.close()
