"""HERI II's boards pass the suite of all drivers."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from rtee.drivers.heri_ethercat.codec import TORQUE_PER_AMPERE
from rtee.testing import DeviceCase, DriverContract, actuator, cycles
from rtee.testing.session import Session, simulated_time

NAMES = ("motor_finger1", "motor_finger2", "motor_finger3", "motor_thumb")


def powered(emulator: Any) -> int:
    return sum(board.power for board in emulator.boards)


def limits(emulator: Any) -> list[float]:
    ampere = TORQUE_PER_AMPERE
    return [motor.max_effort * ampere for board in emulator.boards for motor in board.motors]


class TestHeriII(DriverContract):
    case = DeviceCase(
        driver="heri_ethercat",
        actuators=tuple(actuator(name, 0.0, 2.5, effort=3.3) for name in NAMES),
        options={"emulator": {"speed": 20.0}, "product": 0x13, "watchdog": 0.0},
        commands=powered,
        efforts=limits,
        max_efforts=[1.0, 1.0, 0.5, 0.5],
        fault="hardware",
        wire_faults=frozenset({"drop", "corrupt", "delay"}),
        cycles=cycles(100),
    )


@pytest.fixture
def anyio_backend() -> tuple[str, dict[str, Any]]:
    return simulated_time()


@pytest.mark.anyio
async def test_a_board_whose_program_hangs_measures_nothing_new() -> None:
    """Its EtherCAT controller goes on to send what it sent last."""
    async with Session(TestHeriII.case) as session:
        first = await session.start()
        for _ in range(3):
            await asyncio.sleep(0.001)
            assert (await session.sense()).fresh
        session.emulator.inject("hung")
        states = []
        for _ in range(5):
            await asyncio.sleep(0.001)
            states.append(await session.sense())
        assert not any(state.fresh for state in states[1:])
        assert len({state.stamp for state in states[1:]}) == 1, "as old as it is"
        assert states[-1].stamp > first.stamp
        session.emulator.clear()
        await asyncio.sleep(0.001)
        assert (await session.sense()).fresh
