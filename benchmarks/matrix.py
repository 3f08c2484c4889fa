"""Try every driver with every fault: survived, named, recovered, and the lateness of another hand.

Faults of the wire last for so many cycles at 5 %, without the wire's time; then the cable is pulled
and put back, the supply cut, the position stuck, another device answers. Each pair of a driver and
a fault is a job of its own, several at a time.

* survived: share of the cycles that succeeded; nothing was raised in the others but what follows.
* named: what was raised, or what of it the bus mended and counted.
* recovered: afterwards the driver brings the device to a posture and measures it there.

Then, for each pair alone: a clock of 1 kHz runs in the driver's event loop, as another hand would,
while the driver exchanges at its pace (half of its best rate, at most 100 Hz) on a wire that takes
its time. Stretches without and with the fault alternate. The clock's lateness has a median (p50)
and a 99th percentile (p99) in each stretch; shown are the medians over the stretches, without and
with, and the 95 % interval of the median of the pairs' differences [µs]. It is ``unchanged`` if
both intervals end below 50 µs, a twentieth of the tick, ``LATER`` if one begins above, else ``not
shown``.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass

from common import Table
from devices import cases
from lateness import Beside, Lateness, verdict

from rtee.buses.faults import Faults
from rtee.buses.pool import BusPool
from rtee.errors import BusTimeout, FrameError, NotConnected, RteeError
from rtee.testing import DeviceCase, Session
from rtee.testing.contract import NEEDS_CHECKSUMS, WIRE_FAULTS
from rtee.types import Reference

SHARE = 0.05
"""Share of damaged messages, as in the contract suite."""
STRETCH = 0.15
"""Shortest stretch of a measurement of the lateness [s]: 150 ticks, of which one is a
percentile."""
FASTEST = 100.0
"""Pace of the driver while the lateness is measured, at most [Hz], as hands are usually driven."""
DEVICE, FAULT = 32, 14
"""Widths of the columns that name devices and faults [characters]."""
MENDED = ("retries", "timeouts", "checksum_errors", "strays")


@dataclass(frozen=True, slots=True)
class Outcome:
    """The outcome for a driver under a fault; ``good``: whether it is as required."""

    survived: str
    named: str
    recovered: str
    good: bool


def applies(case: DeviceCase, fault: str) -> bool:
    """Return whether a fault of the wire can happen to a device, and be noticed."""
    # Without checksums a damaged message is a valid one: no driver could notice it.
    if fault in NEEDS_CHECKSUMS and not case.checksums:
        return False
    return case.wire_faults is None or fault in case.wire_faults


def faulty(fault: str) -> Faults:
    """Return a wire with one fault."""
    faults = Faults(delay_time=0.003, seed=11)
    setattr(faults, fault, SHARE)
    return faults


async def wire_fault(case: DeviceCase, fault: str, cycles: int) -> Outcome:
    """Return the outcome for a driver of so many cycles on a faulty wire."""
    near, far = case.between()
    reference = Reference.at(list(far))
    raised: Counter[str] = Counter()
    async with Session(case) as session:
        await session.start()
        await session.reach(near)
        before = dict(session.driver.counters())
        session.wire.faults = faulty(fault)
        for _ in range(cycles):
            try:
                await session.driver.sense()
                await session.driver.move(reference)
            except (BusTimeout, FrameError) as error:
                raised[type(error).__name__] += 1
        session.wire.faults = Faults()
        after = session.driver.counters()
        back = session.near(await session.reach(near), near)
    mended = {name: after.get(name, 0) - before.get(name, 0) for name in MENDED}
    counts = [f"{count} {name}" for name, count in raised.items()]
    counts += [f"{count} {name}" for name, count in mended.items() if count]
    share = 1.0 - sum(raised.values()) / cycles
    survived = f"{100.0 * share:.1f} %"
    good = back and share >= case.share
    return Outcome(survived, ", ".join(counts) or "bears it", "yes" if back else "NO", good)


async def unplugged(session: Session, case: DeviceCase) -> Outcome:
    """Pull the cable and put it back."""
    await asyncio.to_thread(session.wire.unplug)
    name = await _error(session)
    await session.driver.close()
    await asyncio.to_thread(session.wire.replug)
    await session.start()
    return await _returned(session, case, name, good=name != "nothing")


async def powered(session: Session, case: DeviceCase) -> Outcome:
    """Cut the device's supply for a moment."""
    await asyncio.to_thread(session.wire.power_cycle)
    name = await _error(session)
    if name != "nothing":
        try:
            await session.driver.recover()
            await session.driver.activate()
        except NotConnected:  # it restarted and has to be connected to again
            await session.driver.close()
            await session.start()
    return await _returned(session, case, name, good=name != "nothing" or not case.homes)


async def stuck(session: Session, case: DeviceCase) -> Outcome:
    """Block the position, which must be measured as it is."""
    near, far = case.between()
    there = [float(q) for q in (await session.reach(near)).position]
    session.emulator.inject("stuck")
    for _ in range(10):
        await session.cycle(Reference.at(list(far)))
    same = session.near(await session.sense(), there)
    session.emulator.clear("stuck")
    return await _returned(session, case, "measured where it is" if same else "NO", good=same)


async def wrong_device(session: Session, case: DeviceCase) -> Outcome:
    """Let another device answer."""
    await session.driver.close()
    session.emulator.inject("wrong_device")
    name = "NOTHING, TAKEN"
    try:
        await session.driver.configure()
    except RteeError as error:
        name = type(error).__name__
    session.emulator.clear("wrong_device")
    await session.driver.close()
    await session.start()
    return await _returned(session, case, name, good=name != "NOTHING, TAKEN")


async def _returned(session: Session, case: DeviceCase, name: str, *, good: bool) -> Outcome:
    near, _ = case.between()
    back = session.near(await session.reach(near), near)
    return Outcome("yes", name, "yes" if back else "NO", good and back)


async def _error(session: Session) -> str:
    """Return the name of the error that the device leads to; a time-out only if it lasts."""
    # A single time-out is mended in the next cycle and is not a finding.
    end, name = time.monotonic() + 0.5, "nothing"
    while time.monotonic() < end:
        try:
            state = await session.driver.sense()
            await session.driver.move(Reference.at(state.position))
            name = "nothing"
        except (BusTimeout, FrameError) as error:
            name = type(error).__name__
        except RteeError as error:
            return type(error).__name__
        await asyncio.sleep(0.002)
    return name


Trial = Callable[[Session, DeviceCase], Awaitable[Outcome]]
TRIALS: dict[str, Trial] = {
    "unplug": unplugged,
    "power": powered,
    "stuck": stuck,
    "wrong device": wrong_device,
}


def job(name: str, fault: str, cycles: int) -> Outcome:
    """Return the outcome for a driver under a fault; runs in a process of its own."""
    case = cases(name)[name]

    async def test() -> Outcome:
        async with asyncio.timeout(600):
            if fault not in TRIALS:
                return await wire_fault(case, fault, cycles)
            async with Session(case) as session:
                await session.start()
                return await TRIALS[fault](session, case)

    try:
        return asyncio.run(test())
    # Anything else is a result as well: the table must show it and not end.
    except Exception as error:
        return Outcome("NO", f"{type(error).__name__}: {error}"[:60], "NO", good=False)


async def beside(case: DeviceCase, fault: str, rounds: int) -> Beside:
    """Return another hand's lateness without and with a fault."""
    async with Lateness() as clock, BusPool() as pool, Session(case, pool=pool) as session:
        found = Beside(clock)
        await session.start()
        near, far = case.between()
        await session.reach(near)
        period = 1.0 / min(FASTEST, session.driver.capabilities.best_rate / 2.0)
        for number in range(rounds):
            goal = Reference.at(list(far if number % 2 else near))
            # The order alternates, too, so that a drift of the computer cancels out.
            for now in (False, True) if number % 2 else (True, False):
                found.begin()
                end = time.monotonic() + STRETCH
                if fault not in TRIALS:
                    session.wire.faults = faulty(fault) if now else Faults()
                elif now:
                    await TRIALS[fault](session, case)
                await _exchanged(session, goal, period, end)
                found.end(fault=now)
            session.wire.faults = Faults()
    return found


async def _exchanged(session: Session, goal: Reference, period: float, end: float) -> None:
    due = time.monotonic()
    while (now := time.monotonic()) < end:
        await session.cycle(goal)
        due = max(due + period, now)
        await asyncio.sleep(max(0.0, due - time.monotonic()))


def matrix(names: list[str], cycles: int, rounds: int, jobs: int) -> None:
    """Try every driver with every fault and print the outcomes."""
    devices = cases(None)
    pairs = [
        (name, fault)
        for name in names
        for fault in (*WIRE_FAULTS, *TRIALS)
        if fault in TRIALS or applies(devices[name], fault)
    ]
    print(f"\n5 % faults, {cycles} cycles each\n")
    table = Table(
        "device",
        "fault",
        "survived",
        "recovered",
        "named",
        "good",
        widths=(DEVICE, FAULT, 8, 9, 40),
    )
    # Not forked: event loops and threads of this process must not be inherited.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context) as workers:
        done: dict[tuple[str, str], Future[Outcome]] = {
            pair: workers.submit(job, *pair, cycles) for pair in pairs
        }
        bad = 0
        for pair in pairs:
            found = done[pair].result()
            bad += not found.good
            said = (found.survived, found.recovered, found.named, "yes" if found.good else "BAD")
            table.row(*pair, *said)
    print(f"\n{len(pairs) - bad} of {len(pairs)} as they must be")
    if not rounds:
        return
    print(f"\nanother hand's lateness [µs], {rounds} stretches of either kind\n")
    heads = [f"{p} {what}" for p in ("p50", "p99") for what in ("without", "with", "change")]
    table = Table(
        "device", "fault", *heads, "verdict", widths=(DEVICE, FAULT, 11, 8, 13, 11, 8, 13)
    )
    words: Counter[str] = Counter()
    for pair in pairs:
        try:
            differences = asyncio.run(beside(devices[pair[0]], pair[1], rounds)).differences()
        except Exception as error:
            table.row(*pair, *"––––––", f"failed: {type(error).__name__}: {error}"[:90])
            words["failed"] += 1
            continue
        said = verdict(differences)
        words[said] += 1
        table.row(*pair, *(cell for each in differences for cell in each.cells()), said)
    print("\n" + ", ".join(f"{count} {word}" for word, count in words.most_common()))
