"""Answers that come too late, on lines whose answers do not identify their request."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Any

import pytest

from rtee.buses.pool import BusPool
from rtee.buses.retry import patiently
from rtee.buses.simulated import SimulatedLine
from rtee.drivers.emulators import make_emulator
from rtee.drivers.registry import find_driver
from tests.buses.devices import in_real_time
from tests.drivers.test_worn_contract import suite_of

pytestmark = pytest.mark.anyio


async def positions(driver: Any) -> list[float]:
    """Return the positions that a driver measures; those of an SVH that is not homed in ticks."""
    if driver.spec.driver == "schunk_svh":
        return list((await driver.link.feedback_all()).positions)
    return list((await driver.sense()).position)


def inwards(motor: Any) -> float:
    """Return the position a little nearer to the middle of a motor's travel, if it has any."""
    low, high = motor.lower, motor.upper
    if not math.isfinite(high - low):
        return float(motor.position + 30.0)
    step = 0.02 * (high - low)
    return float(motor.position + (step if motor.position < (low + high) / 2.0 else -step))


def arrive(pool: BusPool, count: int) -> None:
    """Wait until the port has received bytes, which the event loop must not read meanwhile."""
    [(bus, *_)] = pool._buses.values()
    while bus._transport._serial.in_waiting < count:
        time.sleep(0.001)


@in_real_time
@pytest.mark.parametrize(
    ("family", "properties"),
    [
        ("ability_hand", {}),
        ("feetech", {}),
        ("inspire_rh56", {}),
        ("qb_softhand", {}),
        ("schunk_svh", {"echo_index": False}),
    ],
)
async def test_a_late_answer_is_not_taken_for_the_next(
    family: str, properties: dict[str, Any]
) -> None:
    """As after a pause of this process: it waits in the computer when the next request leaves."""
    spec = suite_of(family).case.spec("device")
    emulated = {**spec.options.get("emulator", {}), **properties}
    emulator = make_emulator(family, {**spec.options, "emulator": emulated})
    received: list[bytes] = []

    def trace(bus: str, direction: str, data: bytes, stamp: float) -> None:
        if direction == "tx":
            received.clear()
        else:
            received.append(data)

    with SimulatedLine([emulator], wire_time=False) as line:
        real = {**spec.options, "port": line.address, "emulator": {}}
        async with BusPool() as pool:
            pool.trace = trace
            driver: Any = find_driver(family)(replace(spec, options=real, emulated=False), pool)
            await patiently(driver.configure)
            # Long, for busy computers.
            getattr(driver, "_pace", driver.link).deadline = 5.0
            before = await patiently(lambda: positions(driver))
            late = b"".join(received)

            def move() -> None:
                for motor in emulator.axes:
                    motor.position = motor.target = inwards(motor)
                line._end.write(late)

            line.call(move)
            arrive(pool, len(late))
            after = await positions(driver)
            await driver.close()
    assert all(new != old for new, old in zip(after, before, strict=True))
