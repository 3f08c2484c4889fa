"""The SVH passes the suite of all drivers."""

from __future__ import annotations

from typing import Any

import numpy as np

from rtee.drivers.schunk_svh.channels import CHANNELS
from rtee.drivers.schunk_svh.codec import Command
from rtee.testing import DeviceCase, DriverContract, actuator, cycles

USED = (CHANNELS[3],)


def moves(emulator: Any) -> int:
    counts = emulator.packets
    return counts.get(Command.SET_CONTROL_COMMAND, 0) + counts.get(
        Command.SET_CONTROL_COMMAND_ALL, 0
    )


def limits(emulator: Any) -> list[float]:
    return [c.to_effort(-c.direction * emulator.channels[c.index].current.maximum) for c in USED]


class TestSvh(DriverContract):
    case = DeviceCase(
        driver="schunk_svh",
        actuators=tuple(actuator(f"hand_{c.name}", 0.0, c.range, effort=0.4) for c in USED),
        options={
            "home": "on_connect",
            "status_every": 15,
            "deadline": 0.1,
            "emulator": {"haste": 300.0, "start": 0.05},
        },
        commands=moves,
        efforts=limits,
        max_efforts=[0.3],
        fault="driver_fault",
        cycles=cycles(100),
    )

    async def test_the_first_state_is_measured(self) -> None:
        """Switched off and connected again it has to be homed, and stands where that leaves it."""
        async with self.session() as session:
            await session.start()
            await session.reach(self.case.between()[0])
            await session.driver.disable()
            await session.driver.close()
            again = await session.start()
            idle = [c.to_rad(c.idle(0), c.zero(0)) for c in USED]
            assert again.fresh
            assert session.near(again, idle)

    async def test_connecting_identifies_and_moves_nothing(self) -> None:
        """Positions are not known before homing, and homing is not a part of connecting."""
        async with self.session() as session:
            await session.connect()
            assert session.driver.capabilities.identity
            assert np.isnan((await session.driver.sense()).position).all()
            assert moves(session.emulator) == 0
