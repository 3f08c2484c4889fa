"""The Modbus bus against slaves whose frames are not pymodbus's."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Sequence
from typing import Any

import pytest

from rtee.buses.faults import Faults
from rtee.buses.link import Line
from rtee.buses.modbus import ModbusBus, ModbusRefusal, UnitUnreachable
from rtee.buses.modbus_frames import rtu_frame
from rtee.buses.pool import BusPool
from rtee.buses.simulated import SimulatedLine
from rtee.errors import BusBroken, BusTimeout, FrameError
from tests.buses.devices import Framing, Refused, Registers, in_real_time

pytestmark = pytest.mark.anyio


@pytest.fixture(params=["/dev/ttyUSB9", "socket://192.0.2.1:54321", "tcp://192.0.2.1"])
def url(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
async def pool() -> AsyncIterator[BusPool]:
    async with BusPool(wire_time=False) as pool:
        yield pool


async def bus_in(pool: BusPool, url: str, owner: str = "a", unit: int = 9) -> ModbusBus:
    framing = "tcp" if url.startswith("tcp") else "rtu"
    return await pool.modbus(url, owner=owner, emulator=lambda: Registers(unit, framing))


async def test_registers_are_written_and_read(pool: BusPool, url: str) -> None:
    bus = await bus_in(pool, url)
    await bus.write(9, 10, [1, 2, 65535], deadline=1.0)
    assert await bus.read(9, 9, 5, deadline=1.0) == (0, 1, 2, 65535, 0)
    assert await bus.read(9, 11, 1, deadline=1.0, function=4) == (2,)


async def test_an_exchange_writes_before_it_reads(pool: BusPool, url: str) -> None:
    bus = await bus_in(pool, url)
    assert await bus.exchange(9, 20, [7, 8], 19, 4, deadline=1.0) == (0, 7, 8, 0)
    assert bus.counters.transactions == 1


async def test_a_refusal_carries_its_code(pool: BusPool, url: str) -> None:
    bus = await bus_in(pool, url)
    with pytest.raises(ModbusRefusal, match="for function 0x10: illegal data address") as caught:
        await bus.write(9, 50, [1], deadline=1.0)
    assert (caught.value.function, caught.value.code) == (0x10, 2)


class Gateway(Registers):
    """A gateway whose unit is not there."""

    def __init__(self, framing: Framing, code: int) -> None:
        super().__init__(9, framing)
        self.code = code

    def read(self, function: int, address: int, count: int, now: float) -> Sequence[int]:
        raise Refused(self.code)


@pytest.mark.parametrize("code", [10, 11])
async def test_a_gateway_that_reaches_nobody_is_no_slave(
    pool: BusPool, url: str, code: int
) -> None:
    framing: Framing = "tcp" if url.startswith("tcp") else "rtu"
    bus = await pool.modbus(url, owner="a", emulator=lambda: Gateway(framing, code))
    with pytest.raises(UnitUnreachable, match="unit 9: gateway"):
        await bus.read(9, 0, 1, deadline=1.0)


async def test_two_slaves_share_a_line(pool: BusPool) -> None:
    first = await bus_in(pool, "/dev/ttyUSB9", "a", 9)
    second = await bus_in(pool, "/dev/ttyUSB9", "b", 10)
    assert first is second
    await asyncio.gather(*(first.write(u, 0, [u], deadline=2.0) for u in (9, 10) for _ in range(5)))
    assert await first.read(9, 0, 1, deadline=1.0) == (9,)
    assert await first.read(10, 0, 1, deadline=1.0) == (10,)


async def test_silence_is_a_timeout(pool: BusPool, anyio_backend: object) -> None:
    bus = await bus_in(pool, "/dev/ttyUSB9")
    with pytest.raises(BusTimeout, match="unit 7: no answer within"):
        await bus.read(7, 0, 1, deadline=0.06, retries=2)
    retries = bus.counters.retries
    # In real time, a busy computer may leave none for the last of them.
    assert retries == 2 or (anyio_backend == "asyncio" and retries < 2)
    assert bus.counters.timeouts == retries + 1
    assert await bus.read(9, 0, 1, deadline=1.0) == (0,)


async def test_faults_are_retried_and_no_wrong_value_gets_through(pool: BusPool) -> None:
    bus = await bus_in(pool, "/dev/ttyUSB9")
    simulation = pool.simulation("a")
    simulation.faults = Faults(drop=0.05, corrupt=0.05, split=0.05, noise=0.05, seed=5)
    for value in range(100):
        # Of another length than the one before, whose answer may come after it was asked for again.
        count = 1 + value % 7
        got = await bus.exchange(9, 5, [value] * count, 5, count, deadline=2.0, retries=40)
        assert got == (value,) * count
    assert bus.counters.retries >= simulation.faults.injected["drop"] > 0


async def test_an_answer_that_comes_twice_is_not_taken_for_the_next_one(url: str) -> None:
    async with BusPool() as pool:
        bus = await bus_in(pool, url)
        pool.simulation("a").faults = Faults(duplicate=0.5, requests=False, seed=5)
        for value in range(60):
            got = await bus.exchange(9, 5, [value], 5, 1, deadline=2.0)
            assert got == (value,)
        assert bus.counters.retries == 0


async def test_a_late_answer_to_another_request_is_not_taken(pool: BusPool, url: str) -> None:
    bus = await bus_in(pool, url)
    await bus.write(9, 0, [11, 12, 13, 14], deadline=1.0)
    simulation = pool.simulation("a")
    simulation.faults = Faults(delay=1.0, delay_time=0.15, requests=False)
    with pytest.raises(BusTimeout):
        await bus.read(9, 0, 4, deadline=0.03, retries=0)
    with pytest.raises(BusTimeout):
        await bus.write(9, 2, [13], deadline=0.03, retries=0)
    simulation.faults = Faults()
    async with asyncio.timeout(5):
        while bus.counters.bytes_received < 24:
            assert await bus.read(9, 1, 2, deadline=1.0) == (12, 13)
            await bus.write(9, 3, [14], deadline=1.0)
    assert bus.counters.retries == 0


@in_real_time
async def test_what_came_before_a_request_is_no_answer_to_it() -> None:
    """Noise that looks like the answer is thrown away when the request goes out after it."""
    with SimulatedLine([Registers()]) as simulated:
        bus = ModbusBus(simulated.address, Line())
        await bus.connect()
        await bus.write(9, 0, [7], deadline=1.0)
        false = rtu_frame(9, b"\x03\x02\x00\x63")
        simulated.call(lambda: simulated._end.write(false))
        port: Any = bus._transport
        while port._serial.in_waiting < len(false):
            pass  # the kernel hands it over in its own time
        assert await bus.read(9, 0, 1, deadline=1.0, retries=0) == (7,)
        assert bus.counters.strays == len(false)
        await bus.close()


async def test_nothing_but_garbage_is_a_frame_error(pool: BusPool) -> None:
    bus = await bus_in(pool, "/dev/ttyUSB9")
    pool.simulation("a").faults = Faults(corrupt=1.0, requests=False)
    with pytest.raises(FrameError):
        await bus.read(9, 0, 1, deadline=1.0, retries=0)
    assert bus.counters.checksum_errors == 1


async def test_a_cancelled_request_stays_cancelled(pool: BusPool, url: str) -> None:
    bus = await bus_in(pool, url)
    pool.simulation("a").faults = Faults(drop=1.0)
    task = asyncio.create_task(bus.read(9, 0, 1, deadline=10.0))
    await asyncio.sleep(0.02)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    pool.simulation("a").faults = Faults()
    assert await bus.read(9, 0, 1, deadline=1.0) == (0,)


async def test_unplugging_ends_a_request_at_once_and_connecting_mends(
    pool: BusPool, url: str
) -> None:
    bus = await bus_in(pool, url)
    simulation = pool.simulation("a")
    simulation.faults = Faults(drop=1.0)
    task = asyncio.create_task(bus.read(9, 0, 1, deadline=30.0))
    await asyncio.sleep(0.02)
    simulation.unplug()
    with pytest.raises(BusBroken):
        await task
    with pytest.raises(BusBroken):
        await bus.connect()
    simulation.faults = Faults()
    simulation.replug()
    await bus.connect()
    assert await bus.read(9, 0, 1, deadline=1.0) == (0,)
    assert bus.counters.broken == 1


async def test_the_wire_takes_its_time() -> None:
    line = Line(9600)
    with SimulatedLine([Registers()], line=line) as simulated:
        bus = ModbusBus(simulated.address, line)
        await bus.connect()
        stamps: list[float] = []
        bus.trace = lambda name, direction, data, stamp: stamps.append(stamp)
        await bus.read(9, 0, 10, deadline=2.0)
        await bus.close()
    assert stamps[-1] - stamps[0] >= (8 + 25) * 10 / 9600


def test_another_master_agrees() -> None:
    minimalmodbus = pytest.importorskip("minimalmodbus")
    with SimulatedLine([Registers()]) as simulated:
        master = minimalmodbus.Instrument(simulated.address, 9)
        master.serial.timeout = 1.0
        try:
            master.write_registers(3, [4, 5, 6])
            master.write_register(6, 7, functioncode=6)
            assert master.read_registers(2, 6) == [0, 4, 5, 6, 7, 0]
            assert master.read_registers(3, 2, functioncode=4) == [4, 5]
            with pytest.raises(minimalmodbus.IllegalRequestError):
                master.write_register(50, 1)
        finally:
            master.serial.close()


async def test_a_cancellation_that_comes_together_with_the_answer_is_not_lost(
    pool: BusPool, url: str
) -> None:
    bus = await bus_in(pool, url)
    reading = asyncio.create_task(bus.read(9, 0, 2, deadline=5.0))
    # The trace is told of an answer before the answer is handed to who waits for it.
    bus.trace = lambda name, direction, data, stamp: direction == "rx" and reading.cancel()
    with pytest.raises(asyncio.CancelledError):
        await reading
    bus.trace = None
    assert await bus.read(9, 0, 2, deadline=1.0) == (0, 0)


async def test_a_shared_line_keeps_the_longest_gap() -> None:
    async with BusPool() as pool:
        gaps = []
        for owner, gap in (("a", None), ("b", 0.01), ("c", 0.005)):
            bus = await pool.modbus("/dev/ttyUSB9", owner=owner, gap=gap, emulator=Registers)
            gaps.append(bus.gap)
        assert bus.owners == {"a", "b", "c"}
    assert gaps == [0.00175, 0.01, 0.01]
