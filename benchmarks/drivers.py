"""Every driver on its emulated wire: throughput beside the wire's limit, and a matrix of faults.

    python benchmarks/drivers.py [--seconds 3] [--cycles 10000] [--only NAME] [--no-matrix]

Throughput: sense and move as fast as the driver can, on a real transport (pty, TCP port, virtual
CAN) where bytes take the time they would take at the line's rate and the device takes its
turn-around. Counted are exchanges, that is states with a new stamp. The wire's limit is what no
program could exceed with the same bytes::

    exchanges / sum of (bytes * bits / baud + turn-around + silence before every request)

as the simulated wire has counted it: turn-around as modelled (SVH 0.5 ms, adapters of qb hands and
Dynamixels 1 ms, Modbus 3.5 characters but at least 1.75 ms), and the silence that Modbus RTU asks
of its master. ``rate`` is that of all seconds together, ``of it`` its share of the limit;
``median`` is that of the median exchange, which other programs on the machine disturb less.

The device at a serial line is played by a process of its own (`farend`) on the machine's last
processor, and the driver runs on the others: the device shall not take the driver's time. By how
much its last answer before a request was too late, on average, stands under ``end`` [µs]; ``of it``
and ``median`` do not forgive the driver that. ``but for it`` is ``of it`` with it taken off.

Devices without a wire of that kind (networks, process data) have no such limit; a device that sends
by itself (Allegro) has its own pace for one. Beside stands the rate that the driver itself names as
its best, which the loop does not exceed.

Matrix: at 5 % of each fault of the wire, so many cycles; then the cable pulled and put back, the
supply cut, the position stuck, another device answering. A cell says how many cycles succeeded, or
what became of the driver. Beside it a clock of 1 kHz runs in the same event loop, as another hand
would. Stretches without and with the fault alternate, and the medians over the stretches of each
kind of the lateness' p50 and p99 stand side by side, in µs.
"""

from __future__ import annotations

import argparse
import asyncio
import dataclasses
import gc
import importlib.util
import statistics
import sys
import time
from collections.abc import Awaitable, Callable
from pathlib import Path

from farend import ApartPool

from rtee.buses.faults import Faults
from rtee.drivers.schunk_svh.channels import CHANNELS
from rtee.errors import NotConnected, RteeError
from rtee.loop.clock import Clock
from rtee.testing import DeviceCase, DriverContract, Session, actuator
from rtee.testing.contract import NEEDS_CHECKSUMS, WIRE_FAULTS
from rtee.types import Reference

TESTS = Path(__file__).resolve().parents[1] / "tests" / "drivers"
OWN_PACE = frozenset({"allegro"})
"""Drivers of devices that send by themselves, at the rate that the driver names."""
ROUNDS = 8
"""Stretches of either kind in a cell of the matrix."""


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
                if isinstance(case, DeviceCase) and case.wire:
                    found[f"{file.parent.name}: {name.removeprefix('Test')}"] = case
    return {name: case for name, case in found.items() if only is None or only in name}


def whole_hands(devices: dict[str, DeviceCase], only: str | None) -> dict[str, DeviceCase]:
    """Return the devices, and those of which the tests drive a part as whole hands."""
    found = dict(devices)
    svh = found.get("schunk_svh: Svh")
    if svh is not None:
        every = tuple(actuator(f"hand_{c.name}", 0.0, c.range, effort=0.4) for c in CHANNELS)
        options = {**svh.options, "status_every": 50}
        nine = dataclasses.replace(svh, actuators=every, options=options)
        found["schunk_svh: nine channels"] = nine
        bare = {**options, "turnaround": 0.0}
        found["schunk_svh: the same, no turn-around"] = dataclasses.replace(nine, options=bare)
    three = found.get("onrobot_3fg: ThroughTheComputeBox")
    if three is not None:
        line = {**three.options, "port": "/dev/ttyUSB0"}
        del line["host"]
        found["onrobot_3fg: RTU"] = dataclasses.replace(three, options=line)
    small = found.get("dynamixel: Dynamixel")
    if small is not None:
        names = [f"joint_{i}" for i in range(16)]
        for baudrate in (1_000_000, 4_000_000):
            for fast in ("auto", "never"):
                what = f"dynamixel: 16 at {baudrate // 1_000_000} Mbaud, "
                what += "fast read" if fast == "auto" else "plain read"
                options = {
                    **small.options,
                    "servos": {n: {"id": i + 1} for i, n in enumerate(names)},
                    "baudrate": baudrate,
                    "fast": fast,
                    "health_every": 200,
                }
                joints = tuple(actuator(n, -1.0, 1.5, effort=0.5, rest=0.0) for n in names)
                found[what] = dataclasses.replace(small, actuators=joints, options=options)
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

    def taken(self) -> tuple[float, float] | None:
        """Return p50 and p99 since the last call [µs]."""
        found, self.values = sorted(self.values), []
        if len(found) < 20:
            return None
        return statistics.median(found), found[int(0.99 * (len(found) - 1))]


class Beside:
    """Lateness of another hand without and with a fault, in alternating stretches."""

    def __init__(self, clock: Lateness) -> None:
        self._clock = clock
        self._stretches: dict[bool, list[tuple[float, float]]] = {False: [], True: []}

    def begin(self) -> None:
        """Forget what came before this stretch."""
        self._clock.taken()

    def end(self, *, fault: bool) -> None:
        """Note the stretch since `begin`."""
        taken = self._clock.taken()
        if taken is not None:
            self._stretches[fault].append(taken)

    def __str__(self) -> str:
        texts = []
        for which in (False, True):
            found = self._stretches[which]
            if not found:
                return ""
            p50, p99 = (statistics.median(values) for values in zip(*found, strict=True))
            texts.append(f"{p50:4.0f} {p99:6.0f}")
        return "   ".join(texts)


async def throughput(case: DeviceCase, seconds: float) -> str:
    """Return a row of the table."""
    async with ApartPool() as pool, Session(case, pool=pool) as session:
        await session.start()
        near, far = case.between()
        for goal in (near, far):
            await session.reach(goal)
        here = [float(q) for q in (await session.sense()).position]
        goals = [
            Reference.at(
                [q + 1e-3 * (i - 50) * (f - n) for q, n, f in zip(here, near, far, strict=True)]
            )
            for i in range(100)
        ]
        await session.cycle(goals[50])
        bus = pool.buses[0]
        gap = float(getattr(bus, "gap", 0.0))

        def used() -> float:
            return pool.busy() + gap * bus.counters.transactions

        with pool.processors():
            began, (answers, late) = used(), pool.late()
            done = failed = fresh = 0
            times: list[float] = []
            stamp = 0.0
            start = before = time.perf_counter()
            while before - start < seconds:
                state = await session.cycle(goals[done % 100])
                done += 1
                now = time.perf_counter()
                if state is None:
                    failed += 1
                elif state.stamp != stamp:
                    stamp = state.stamp
                    fresh += 1
                    times.append(now - before)
                    before = now
                elif now - before > 1.0:
                    before = now
            taken, need, said = time.perf_counter() - start, used() - began, pool.late()
            middle = await middling(session, goals, used)
        best = session.driver.capabilities.best_rate
        if case.driver in OWN_PACE:
            need, middle = fresh / best, 1.0 / best
        limit = mean = share = end = but = "–"
        if need > 0.02 * taken:
            limit = f"{fresh / need:.0f}"
            mean = f"{100.0 * need / taken:.0f} %"
            share = f"{100.0 * middle / statistics.median(times):.0f} %"
        if said[0] > answers:
            end = f"{1e6 * (said[1] - late) / (said[0] - answers):.0f}"
            but = f"{100.0 * need / (taken - (said[1] - late)):.0f} %"
        row = f"{fresh / taken:7.0f} {limit:>8} {mean:>7} {share:>7} {end:>5} {but:>11}"
        return f"{row} {best:8.0f}  {failed}"


async def middling(session: Session, goals: list[Reference], used: Callable[[], float]) -> float:
    """Return what the median exchange takes of the wire [s]; not every one carries the same."""
    needs: list[float] = []
    while len(needs) < 30:
        before = used()
        await session.cycle(goals[len(needs)])
        needs.append(used() - before)
    return statistics.median(needs)


async def wire_fault(case: DeviceCase, fault: str, cycles: int, clock: Lateness) -> str:
    """Return how many of the cycles succeeded, or what was raised, and the lateness beside."""
    if fault in NEEDS_CHECKSUMS and not case.checksums:
        return "n/a"
    if case.wire_faults is not None and fault not in case.wire_faults:
        return "n/a"
    near, far = case.between()
    reference = Reference.at(list(far))
    beside = Beside(clock)
    try:
        async with Session(case) as session:
            await session.start()
            await session.reach(near)
            faults = Faults(delay_time=0.003, seed=11)
            setattr(faults, fault, 0.05)
            none, done = Faults(), 0
            stretch = max(1, cycles // ROUNDS)
            for _ in range(ROUNDS):
                for now in (none, faults):
                    session.wire.faults = now
                    beside.begin()
                    for _ in range(stretch):
                        found = await session.cycle(reference) is not None
                        done += found and now is faults
                    beside.end(fault=now is faults)
            session.wire.faults = Faults()
            back = session.near(await session.reach(near), near)
            share = 100.0 * done / (ROUNDS * stretch)
            return f"{share:.1f}%{'' if back else ' lost'}".ljust(28) + str(beside)
    except RteeError as error:
        return type(error).__name__


async def unplugged(session: Session, case: DeviceCase) -> str:
    """Return what a pulled cable was called, and whether it came back."""
    await asyncio.to_thread(session.wire.unplug)
    name = await _error(session)
    await session.driver.close()
    await asyncio.to_thread(session.wire.replug)
    await session.start()
    return f"{name}, back"


async def powered(session: Session, case: DeviceCase) -> str:
    """Return what a power cycle was called, and whether it came back."""
    await asyncio.to_thread(session.wire.power_cycle)
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


async def stuck(session: Session, case: DeviceCase) -> str:
    """Return whether a stuck position is measured as it is."""
    near, far = case.between()
    there = await session.reach(near)
    session.emulator.inject("stuck")
    for _ in range(10):
        await session.cycle(Reference.at(list(far)))
    state = await session.sense()
    same = session.near(state, [float(q) for q in there.position])
    session.emulator.clear("stuck")
    return "seen" if same else "NOT SEEN"


async def wrong_device(session: Session, case: DeviceCase) -> str:
    """Return what another device was called."""
    await session.driver.close()
    session.emulator.inject("wrong_device")
    try:
        await session.driver.configure()
    except RteeError as error:
        return type(error).__name__
    finally:
        session.emulator.clear("wrong_device")
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


Trial = Callable[[Session, DeviceCase], Awaitable[str]]
TRIALS: dict[str, Trial] = {
    "unplug": unplugged,
    "power": powered,
    "stuck": stuck,
    "wrong device": wrong_device,
}


async def device_fault(case: DeviceCase, trial: Trial, clock: Lateness) -> str:
    """Return what came of a fault, in each of some rounds, and the lateness beside."""
    beside = Beside(clock)
    said: list[str] = []
    async with Session(case) as session:
        for _ in range(ROUNDS):
            await session.driver.close()
            await session.start()
            beside.begin()
            begun = time.monotonic()
            text = await trial(session, case)
            taken = max(0.1, time.monotonic() - begun)
            beside.end(fault=True)
            if text not in said:
                said.append(text)
            await session.driver.close()
            await session.start()
            here = Reference.at((await session.sense()).position)
            beside.begin()
            begun = time.monotonic()
            while time.monotonic() - begun < taken:
                await session.cycle(here)
            beside.end(fault=False)
    return "; ".join(said).ljust(28) + str(beside)


async def _tried(test: Awaitable[str]) -> str:
    try:
        async with asyncio.timeout(600):
            return await test
    except Exception as error:
        return f"FAILED: {type(error).__name__}: {error}"[:90]


async def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--cycles", type=int, default=10_000)
    parser.add_argument("--only")
    parser.add_argument("--no-matrix", action="store_true")
    parser.add_argument("--no-throughput", action="store_true")
    arguments = parser.parse_args()
    devices = cases(None)
    gc.collect()
    gc.freeze()  # as the loop does
    if not arguments.no_throughput:
        head = f"{'rate':>7} {'limit':>8} {'of it':>7} {'median':>7} {'end':>5} {'but for it':>11}"
        head += f" {'driver':>8}  failed"
        print(f"{'device':44} {head}")
        for name, case in whole_hands(devices, arguments.only).items():
            row = await _tried(throughput(case, arguments.seconds))
            print(f"{name:44} {row}", flush=True)
    if arguments.no_matrix:
        return
    print(f"\n5 % faults, {arguments.cycles} cycles each, and the other hand's lateness [µs]")
    print(f"{'':18} {'came of it':28}{'without: p50 p99':>11}   with: p50 p99")
    for name, case in devices.items():
        if arguments.only and arguments.only not in name:
            continue
        print(name)
        async with Lateness() as clock:
            for fault in WIRE_FAULTS:
                cell = await _tried(wire_fault(case, fault, arguments.cycles, clock))
                print(f"    {fault:14} {cell}", flush=True)
            for fault, trial in TRIALS.items():
                cell = await _tried(device_fault(case, trial, clock))
                print(f"    {fault:14} {cell}", flush=True)


if __name__ == "__main__":
    asyncio.run(main())
