"""Every driver on its emulated wire: throughput beside the wire's limit, and a matrix of faults.

    python benchmarks/drivers.py [--seconds 3] [--cycles 10000] [--only NAME] [--no-matrix]

Throughput: sense and move as fast as the driver can, on a real transport (pty, TCP port, virtual
CAN) where bytes take the time they would take at the line's rate and the device takes its
turn-around. Beside it stands the limit that the driver computes from its bytes.

Matrix: at 5 % of each fault of the wire, so many cycles; then the cable pulled and put back, the
supply cut, the position stuck, another device answering. A cell says how many cycles succeeded, or
what became of the driver. Beside the faults of the wire a clock of 1 kHz runs in the same event
loop, as another hand would; its lateness stands in the last lines, and beside it that of the clock
alone.
"""

from __future__ import annotations

import argparse
import asyncio
import gc
import importlib.util
import statistics
import sys
import time
from pathlib import Path
from typing import Any

from rtee.buses.faults import Faults
from rtee.buses.pool import BusPool
from rtee.errors import NotConnected, RteeError
from rtee.loop.clock import Clock
from rtee.testing import DeviceCase, DriverContract, Session
from rtee.testing.contract import NEEDS_CHECKSUMS, WIRE_FAULTS
from rtee.types import Reference

TESTS = Path(__file__).resolve().parents[1] / "tests" / "drivers"


def cases(only: str | None) -> dict[str, DeviceCase]:
    """Return the devices that the tests describe."""
    found: dict[str, DeviceCase] = {}
    for file in sorted(TESTS.glob("*/test_*_contract.py")):
        spec = importlib.util.spec_from_file_location(f"bench_{file.stem}", file)
        if spec is None or spec.loader is None:
            continue
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
        for name, value in vars(module).items():
            if isinstance(value, type) and issubclass(value, DriverContract):
                case = getattr(value, "case", None)
                if isinstance(case, DeviceCase):
                    found[f"{file.parent.name}: {name.removeprefix('Test')}"] = case
    return {name: case for name, case in found.items() if only is None or only in name}


class Lateness:
    """A clock of 1 kHz in the same event loop, as another hand would have."""

    def __init__(self) -> None:
        self.values: list[float] = []
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Lateness:
        self._task = asyncio.create_task(self._run())
        return self

    async def __aexit__(self, *exc: object) -> None:
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def _run(self) -> None:
        async for tick in Clock(1000.0):
            self.values.append((tick.woken_ns - tick.due_ns) * 1e-3)

    def text(self) -> str:
        found = sorted(self.values)
        if not found:
            return "no ticks"
        p99 = found[int(0.99 * (len(found) - 1))]
        return f"p50 {statistics.median(found):.0f} µs, p99 {p99:.0f} µs, max {found[-1]:.0f} µs"


async def throughput(case: DeviceCase, seconds: float) -> tuple[float, float, int]:
    """Return the limit and the rate reached [Hz], and the cycles that failed."""
    async with BusPool(wire_time=True) as pool, Session(case, pool=pool) as session:
        state = await session.start()
        near, far = case.between()
        for goal in (near, far):
            await session.reach(goal)
        limit = session.driver.capabilities.best_rate
        here = [float(q) for q in (await session.sense()).position]
        await session.cycle(Reference.at(here))
        done = failed = 0
        start = time.perf_counter()
        while time.perf_counter() - start < seconds:
            wobble = 1e-3 * ((done % 100) - 50)
            goal = [q + wobble * (f - n) for q, n, f in zip(here, near, far, strict=True)]
            state = await session.cycle(Reference.at(goal))
            done += 1
            failed += state is None
        return limit, (done - failed) / (time.perf_counter() - start), failed


async def wire_fault(case: DeviceCase, fault: str, cycles: int, lateness: Lateness) -> str:
    """Return how many of the cycles succeeded, or what was raised."""
    if fault in NEEDS_CHECKSUMS and not case.checksums:
        return "n/a"
    near, far = case.between()
    try:
        async with Session(case) as session:
            await session.start()
            await session.reach(near)
            faults = Faults(delay_time=0.003, seed=11)
            setattr(faults, fault, 0.05)
            session.wire.faults = faults
            done = 0
            async with lateness:
                for _ in range(cycles):
                    done += await session.cycle(Reference.at(list(far))) is not None
            session.wire.faults = Faults()
            back = session.near(await session.reach(near), near)
            return f"{100.0 * done / cycles:.1f}%" + ("" if back else " lost")
    except RteeError as error:
        return type(error).__name__


async def unplugged(case: DeviceCase) -> str:
    """Return what a pulled cable was called, and whether it came back."""
    async with Session(case) as session:
        await session.start()
        session.wire.unplug()
        name = await _error(session)
        await session.driver.close()
        session.wire.replug()
        await session.start()
        return f"{name}, back"


async def powered(case: DeviceCase) -> str:
    """Return what a power cycle was called, and whether it came back."""
    async with Session(case) as session:
        await session.start()
        session.wire.power_cycle()
        name = await _error(session)
        if name == "unnoticed":
            return "kept on"
        try:
            await session.driver.recover()
            await session.driver.activate()
        except NotConnected:  # it started anew and has to be connected to again
            await session.driver.close()
            await session.start()
        await session.sense()
        return f"{name}, back"


async def stuck(case: DeviceCase) -> str:
    """Return whether a stuck position is measured as it is."""
    near, far = case.between()
    async with Session(case) as session:
        await session.start()
        there = await session.reach(near)
        session.emulator.inject("stuck")
        for _ in range(10):
            await session.cycle(Reference.at(list(far)))
        state = await session.sense()
        same = session.near(state, [float(q) for q in there.position])
        return "seen" if same else "NOT SEEN"


async def wrong_device(case: DeviceCase) -> str:
    """Return what another device was called."""
    async with Session(case) as session:
        await session.before(lambda emulator: emulator.inject("wrong_device"))
        try:
            await session.driver.configure()
        except RteeError as error:
            return type(error).__name__
        return "TAKEN"


async def _error(session: Session) -> str:
    for _ in range(200):
        try:
            state = await session.driver.sense()
            await session.driver.move(Reference.at(state.position))
        except TimeoutError:
            continue
        except RteeError as error:
            return type(error).__name__
        await asyncio.sleep(0.002)
    return "unnoticed"


async def _tried(test: Any) -> str:
    try:
        async with asyncio.timeout(120):
            return str(await test)
    except Exception as error:
        return f"FAILED: {type(error).__name__}: {error}"[:60]


OTHERS = {"unplug": unplugged, "power": powered, "stuck": stuck, "wrong device": wrong_device}


async def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--cycles", type=int, default=10_000)
    parser.add_argument("--only")
    parser.add_argument("--no-matrix", action="store_true")
    arguments = parser.parse_args()
    devices = cases(arguments.only)
    gc.collect()
    gc.freeze()  # as the loop does
    print(f"{'throughput':44} {'limit':>8} {'reached':>8} {'share':>6}  failed")
    for name, case in devices.items():
        try:
            limit, rate, failed = await throughput(case, arguments.seconds)
        except Exception as error:
            print(f"{name:44} {type(error).__name__}: {error}"[:110])
            continue
        print(f"{name:44} {limit:7.0f}  {rate:7.0f}  {100 * rate / limit:5.0f}%  {failed}")
    if arguments.no_matrix:
        return
    columns = (*WIRE_FAULTS, "unplug", "power", "stuck", "wrong device")
    print(f"\n5 % faults, {arguments.cycles} cycles each")
    worst = Lateness()
    for name, case in devices.items():
        print(name)
        for column in columns:
            if column in WIRE_FAULTS:
                cell = await _tried(wire_fault(case, column, arguments.cycles, worst))
            else:
                cell = await _tried(OTHERS[column](case))
            print(f"    {column:14} {cell}", flush=True)
    async with Lateness() as alone:
        await asyncio.sleep(5.0)
    print(f"\na clock of 1 kHz beside the faults: {worst.text()}")
    print(f"the same clock alone:               {alone.text()}")


if __name__ == "__main__":
    asyncio.run(main())
