"""Twitch a hand to show which one it is."""

from __future__ import annotations

import asyncio
import math

from rtee.buses.retry import patiently
from rtee.drivers.base import Driver
from rtee.errors import BusTimeout, FrameError
from rtee.sample import ActuatorState
from rtee.types import Reference

_MISSES = 5
"""Number of exchanges that may fail in a row, so that a lost frame does not stop the motion."""
_STEP = 0.02
"""Time between two references during a twitch [s], long enough for every bus."""


async def twitch(
    driver: Driver, *, share: float = 0.06, times: int = 3, period: float = 0.6
) -> ActuatorState:
    """Move every actuator slowly by a small amount and back.

    This activates the device; the driver refuses a device that must be homed first.

    Args:
        driver: The device's driver, not yet connected; it is closed afterwards.
        share: Amplitude as a share of each actuator's range.
        times: Number of twitches.
        period: Time of one twitch [s].

    Returns:
        The last state.

    Raises:
        RteeError: if the device cannot be moved.
    """
    try:
        await driver.configure()
        await patiently(driver.activate)
        state = await patiently(driver.sense)
        start = [float(q) for q in state.position]
        away = [_away(driver, i, q, share) for i, q in enumerate(start)]
        for _ in range(times):
            await _glide(driver, start, away, period / 2)
            await _glide(driver, away, start, period / 2)
        return await patiently(driver.sense)
    finally:
        try:
            await driver.stop()
        finally:
            await driver.close()


def _away(driver: Driver, index: int, position: float, share: float) -> float:
    """Return the far end of an actuator's twitch, towards the middle of its range."""
    spec = driver.spec.actuators[index]
    if not (math.isfinite(spec.lower) and math.isfinite(spec.upper)):
        return position + share
    middle = (spec.lower + spec.upper) / 2
    return position + math.copysign(share * (spec.upper - spec.lower), middle - position)


async def _glide(driver: Driver, start: list[float], end: list[float], time: float) -> None:
    steps = max(2, round(time / _STEP))
    missed = 0
    for n in range(1, steps + 1):
        # Half a cosine, which begins and ends at rest.
        part = (1.0 - math.cos(math.pi * n / steps)) / 2.0
        goal = [a + part * (b - a) for a, b in zip(start, end, strict=True)]
        try:
            await driver.sense()
            await driver.move(Reference.at(goal))
            missed = 0
        except (BusTimeout, FrameError):
            missed += 1
            if missed > _MISSES:
                raise
        await asyncio.sleep(_STEP)
