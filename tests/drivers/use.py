"""Ways of using a driver that several tests share."""

from __future__ import annotations

import asyncio
import subprocess
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Any, TypeVar

from rtee_process import RTEE

from rtee.buses.pool import BusPool
from rtee.drivers.base import Driver
from rtee.sample import ActuatorState
from rtee.testing import Session
from rtee.types import DeviceSpec, Reference

D = TypeVar("D", bound=Driver)


def connecting(
    driver: type[D],
) -> Callable[[BusPool, DeviceSpec], AbstractAsyncContextManager[D]]:
    """Return a context manager that makes and configures a driver of this class."""

    @asynccontextmanager
    async def connected(pool: BusPool, spec: DeviceSpec) -> AsyncIterator[D]:
        made = driver(spec, pool)
        try:
            await made.configure()
            yield made
        finally:
            await made.close()
            # Drivers promise that closing again does no harm.
            await made.close()

    return connected


async def cycled(session: Session, goal: float, times: int = 100, **limits: Any) -> ActuatorState:
    """Send one actuator the same reference for many cycles; return what it measures then."""
    for _ in range(times):
        await session.cycle(Reference.at([goal], **limits))
        await asyncio.sleep(0.005)
    return await session.sense()


def lose(wire: Any, wanted: Callable[[bytes], bool], length: Callable[[bytes], int]) -> list[bytes]:
    """Have the first frame that is wanted lost on its way to the servos; return the lost ones."""
    lost: list[bytes] = []
    receive = wire.receive

    def received(data: bytes, now: float) -> None:
        if not lost and wanted(data):
            lost.append(data[: length(data)])
            data = data[length(data) :]
        if data:
            receive(data, now)

    wire.receive = received
    return lost


def set_id_command(*words: str, status: int = 0) -> str:
    """Run `rtee set-id` and return what it says; asserts its exit status."""
    run = subprocess.run(
        [*RTEE, "set-id", *words],
        capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip
    assert run.returncode == status, run.stdout + run.stderr
    assert "Traceback" not in run.stderr
    return run.stdout + run.stderr
