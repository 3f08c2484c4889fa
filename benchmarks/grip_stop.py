"""Measure how far an EGU's grip runs beyond a reference that ends before any object.

The emulated gripper closes from open to places at random, over a wire with its true time. The
reference jumps there at once, or moves there at a speed below that of the grip. The figures are
how far the fingers were beyond it at most, how far off they rest, and how many motions it took.

    python benchmarks/grip_stop.py [--tries 12]
"""

from __future__ import annotations

import asyncio
import random
import time
from dataclasses import dataclass

from common import Table, command_line

from rtee.buses.pool import BusPool
from rtee.testing import DeviceCase, Session, actuator
from rtee.types import JointKind, Reference

RATE = 25.0  # exchanges per second [Hz], as the driver has it unless told otherwise
SEED = 1
SLOW = 0.01  # speed of the moving reference [m/s]
ENDED = 0.5  # time after the reference in which the fingers come to rest [s]
AT_ONCE = 1.6  # time in which the slowest grip closes from open to the farthest place [s]
NEAREST, FARTHEST = 0.002, 0.03  # travel of a finger at the places [m]
GRIP_SPEEDS = (20.0, 50.0, 100.0)  # of the emulated gripper [mm/s]


@dataclass(frozen=True)
class Stop:
    """How a closing ended: beyond the reference at most, and off at rest [m]; motions."""

    beyond: float
    off: float
    motions: int


def case(grip_speed: float) -> DeviceCase:
    """Return a gripper with a speed of grips, of each finger [mm/s]."""
    finger = actuator(
        "left_finger_joint", 0.0, 0.040, kind=JointKind.PRISMATIC, velocity=0.1, effort=300.0
    )
    return DeviceCase(
        driver="schunk_egu",
        actuators=(finger,),
        options={"emulator": {"grip_speed": 2.0 * grip_speed}},
        rate=RATE,
    )


async def close(session: Session, goal: float, speed: float | None) -> Stop:
    """Close from open to a goal [m], at once or at a speed [m/s]."""
    await run(session, 0.0, 0.0, None)
    before = session.emulator.moves
    farthest, rest = await run(session, 0.0, goal, speed)
    return Stop(max(0.0, farthest - goal), abs(rest - goal), session.emulator.moves - before)


async def run(
    session: Session, start: float, goal: float, speed: float | None
) -> tuple[float, float]:
    """Follow a reference; return the largest and the last position [m]."""
    begun = due = time.monotonic()
    lasts = ENDED + (abs(goal - start) / speed if speed else AT_ONCE)
    farthest = position = 0.0
    while time.monotonic() < begun + lasts:
        way = min((time.monotonic() - begun) * speed, goal - start) if speed else goal - start
        state = await session.cycle(Reference.at([start + way]))
        if state is not None:
            position = float(state.position[0])
            farthest = max(farthest, position)
        due += 1.0 / RATE
        await asyncio.sleep(max(0.0, due - time.monotonic()))
    return farthest, position


async def measure(tries: int) -> None:
    """Measure and print, with so many places for each speed."""
    table = Table(
        "grip", "reference", "beyond, median", "most", "off at rest, most", "motions, median"
    )
    for grip_speed in GRIP_SPEEDS:
        for speed in (None, SLOW):
            chance = random.Random(SEED)
            async with Session(case(grip_speed), pool=BusPool(wire_time=True)) as session:
                await session.start()
                goals = [chance.uniform(NEAREST, FARTHEST) for _ in range(tries)]
                stops = [await close(session, goal, speed) for goal in goals]
            beyond = sorted(1e3 * stop.beyond for stop in stops)
            table.row(
                f"{grip_speed:g} mm/s",
                "at once" if speed is None else f"{1e3 * speed:g} mm/s",
                f"{beyond[tries // 2]:.2f} mm",
                f"{beyond[-1]:.2f} mm",
                f"{max(1e3 * stop.off for stop in stops):.2f} mm",
                sorted(stop.motions for stop in stops)[tries // 2],
            )


if __name__ == "__main__":
    asyncio.run(measure(command_line(__doc__, tries=12).parse_args().tries))
