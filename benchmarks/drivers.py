"""Measure every driver on its emulated wire: throughput beside the wire's limit, and faults.

    python benchmarks/drivers.py [--seconds 3] [--cycles 10000] [--only NAME] [--no-matrix]
    python benchmarks/drivers.py --processor [--cycles 250] [--only NAME]

Throughput: sense and move as fast as the driver can, on a real transport (pty, TCP port, virtual
CAN) where bytes take the time they would take at the line's rate and the device takes its
turn-around. Counted are exchanges, that is states with a new stamp. The wire's limit is what no
program could exceed with the same bytes::

    exchanges / sum of (bytes * bits / baud + turn-around + silence before every request)

as the simulated wire has counted it: turn-around as modelled (SVH 0.5 ms, adapters of qb hands and
Dynamixels 1 ms, Modbus 3.5 characters but at least 1.75 ms), and the silence that Modbus RTU asks
of its master. ``rate`` is that of all seconds together, ``of it`` its share of the limit;
``median`` is that of the median exchange, which other programs on the machine disturb less.

A separate process (`farend`) on the machine's last processor emulates the device of a serial line,
and the driver runs on the other processors: the device must not take the driver's time. The wire's
time begins when the driver writes; the way to the device through the pseudo-terminal is not
counted, the way back is: a program that only writes and reads reaches 92 % of the qb hand's limit.
Column ``end`` [µs] is the mean delay of the device's last answer before a request; ``of it`` and
``median`` include it, ``but for it`` is ``of it`` without it.

Devices without a wire of that kind (networks, process data) have no such limit; the limit of a
device that sends by itself (Allegro) is its own pace. The next column is the rate that the driver
itself names as its best, which the loop does not exceed.

Processor: the processor time of one exchange, sense and move, of the driver and its emulated device
together, in simulated time [µs]. Other programs disturb it little, so that versions can be compared
by turns on a busy computer.

Matrix: see `matrix`. The survival of the faults is tried several at a time, as emulated devices
mostly wait; the lateness of another hand afterwards, one fault at a time and nothing beside.
"""

from __future__ import annotations

import asyncio
import statistics
import time
from collections.abc import Callable

import anyio
from common import Table, command_line
from devices import as_the_loop, cases, whole_hands
from farend import ApartPool
from matrix import matrix

from rtee.buses.simulated_time import SimulatedTimeLoop
from rtee.loop.realtime import backend_options
from rtee.testing import DeviceCase, Session
from rtee.types import Reference

OWN_PACE = frozenset({"allegro"})
"""Drivers of devices that send by themselves, at the rate that the driver names."""

STREAMS = frozenset({"orca_touch"})
"""Drivers of devices that send without being asked and take no references: the wire limits no
exchange."""


async def throughput(case: DeviceCase, seconds: float) -> list[object]:
    """Return the cells of a row of the table, without the device's name."""
    async with ApartPool() as pool, Session(case, pool=pool) as session:
        await session.start()
        near, far = case.between()
        for goal in (near, far):
            await session.reach(goal)
        here = [float(q) for q in (await session.sense()).position]
        goals = [
            Reference.at(
                # References that differ in every exchange, within ±5 % of the way: a driver may
                # skip equal ones.
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
                # A device that is silent for a second must not count as one long exchange.
                elif now - before > 1.0:
                    before = now
            taken, need, said = time.perf_counter() - start, used() - began, pool.late()
            middle = await middling(session, goals, used)
        best = session.driver.capabilities.best_rate
        if case.driver in OWN_PACE:
            need, middle = fresh / best, 1.0 / best
        limit = mean = share = end = but = "–"
        # Less of the time than this on the wire: the wire is not what limits it.
        if need > 0.02 * taken:
            limit = f"{fresh / need:.0f}"
            mean = f"{100.0 * need / taken:.0f} %"
            share = f"{100.0 * middle / statistics.median(times):.0f} %"
        if said[0] > answers:
            end = f"{1e6 * (said[1] - late) / (said[0] - answers):.0f}"
            but = f"{100.0 * need / (taken - (said[1] - late)):.0f} %"
        return [f"{fresh / taken:.0f}", limit, mean, share, end, but, f"{best:.0f}", failed]


async def middling(session: Session, goals: list[Reference], used: Callable[[], float]) -> float:
    """Return the wire's time of the median exchange [s]; exchanges differ in length."""
    needs: list[float] = []
    while len(needs) < 30:
        before = used()
        await session.cycle(goals[len(needs)])
        needs.append(used() - before)
    return statistics.median(needs)


async def processor(case: DeviceCase, cycles: int) -> float:
    """Return the processor time of an exchange in simulated time [µs]."""
    async with Session(case) as session:
        await session.start()
        middle = [(a.lower + a.upper) / 2 for a in session.spec.actuators]
        goals = [Reference.at([q + step for q in middle]) for step in (0.0, 0.001)]
        for number in range(-20, cycles):
            if number == 0:
                begun = time.process_time()
            await session.cycle(goals[number % 2])
            await asyncio.sleep(0.002)
        return (time.process_time() - begun) / cycles * 1e6


async def _row(case: DeviceCase, seconds: float) -> list[object]:
    try:
        async with asyncio.timeout(60):
            return await throughput(case, seconds)
    except Exception as error:
        return [*"–––––––", f"FAILED: {type(error).__name__}: {error}"[:90]]


def main() -> None:
    arguments = command_line(
        __doc__,
        seconds=3.0,
        cycles=10_000,
        rounds=12,
        jobs=4,
        only=str,
        no_matrix=False,
        no_throughput=False,
        processor=False,
    ).parse_args()
    devices = cases(None)
    as_the_loop()
    if arguments.processor:
        table = Table("device", "µs", widths=(44, 6))
        for name, case in devices.items():
            if not arguments.only or arguments.only in name:
                loop = SimulatedTimeLoop()
                table.row(name, f"{loop.run_until_complete(processor(case, arguments.cycles)):.0f}")
                loop.close()
        return
    if not arguments.no_throughput:
        head = ("rate", "limit", "of it", "median", "end", "but for it", "driver", "failed")
        table = Table("device", *head, widths=(44, 5, 5, 6, 6, 4, 10, 6))
        for name, case in whole_hands(devices, arguments.only).items():
            if case.driver in STREAMS:
                continue
            table.row(
                name, *anyio.run(_row, case, arguments.seconds, backend_options=backend_options())
            )
    if not arguments.no_matrix:
        wanted = [name for name in devices if not arguments.only or arguments.only in name]
        matrix(wanted, arguments.cycles, arguments.rounds, arguments.jobs)


if __name__ == "__main__":
    main()
