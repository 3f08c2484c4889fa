"""The serial bus against a simulated line: pty, socket and rfc2217."""

from __future__ import annotations

import asyncio
import os
import select
import socket
import threading
import time
from collections.abc import AsyncIterator, Callable

import pytest
import serial
import serial.rfc2217

from rtee.buses import link
from rtee.buses.faults import Faults
from rtee.buses.link import Line
from rtee.buses.pool import BusPool
from rtee.buses.serial import SerialBus
from rtee.buses.simulated import SimulatedLine
from rtee.errors import BusBroken, BusBusy, BusClosed, BusTimeout, ConfigError, FrameError
from tests.buses.devices import Echo, StarParser, frame_of, in_real_time

pytestmark = pytest.mark.anyio


@pytest.fixture(params=["/dev/ttyUSB9", "socket://192.0.2.1:54321"])
def url(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
async def pool() -> AsyncIterator[BusPool]:
    async with BusPool(wire_time=False) as pool:
        yield pool


async def bus_in(pool: BusPool, url: str, owner: str = "a") -> SerialBus:
    return await pool.serial(url, owner=owner, emulator=Echo)


async def test_a_request_is_answered(pool: BusPool, url: str) -> None:
    bus = await bus_in(pool, url)
    assert await bus.transact(frame_of(b"hello"), StarParser(), 1.0) == b"HELLO"
    assert bus.counters.transactions == 1
    assert bus.counters.bytes_sent == bus.counters.bytes_received == 8
    assert bus.counters.retries == bus.counters.timeouts == 0


async def test_silence_is_a_timeout_after_the_retries(pool: BusPool, url: str) -> None:
    bus = await bus_in(pool, url)
    with pytest.raises(BusTimeout, match=r"no answer within 2\.000 s"):
        await bus.transact(frame_of(b"?"), StarParser(), 2.0, retries=3)
    assert bus.counters.retries == 3
    assert bus.counters.timeouts == 4
    assert isinstance(pool.played("a"), Echo)
    assert await bus.transact(frame_of(b"x"), StarParser(), 1.0) == b"X"


async def test_garbage_only_is_a_frame_error(pool: BusPool, url: str) -> None:
    bus = await bus_in(pool, url)
    pool.simulation("a").faults = Faults(corrupt=1.0, requests=False)
    with pytest.raises(FrameError, match="no valid answer"):
        await bus.transact(frame_of(b"hello"), StarParser(), 1.0, retries=0)


async def test_a_lost_answer_is_asked_for_again(pool: BusPool, url: str) -> None:
    bus = await bus_in(pool, url)
    pool.simulation("a").faults = Faults(drop=0.3, seed=4)
    answers = [await bus.transact(frame_of(b"n"), StarParser(), 4.0, retries=20) for _ in range(8)]
    assert answers == [b"N"] * 8
    assert bus.counters.retries >= pool.simulation("a").faults.injected["drop"] > 0


async def test_an_answer_that_is_not_accepted_is_a_stray(pool: BusPool, url: str) -> None:
    bus = await bus_in(pool, url)
    with pytest.raises(FrameError):
        await bus.transact(frame_of(b"a"), StarParser(), 1.0, accept=lambda frame: frame == b"B")
    assert bus.counters.strays == 1 + bus.counters.retries


async def test_transactions_wait_for_each_other(pool: BusPool, url: str) -> None:
    bus = await bus_in(pool, url)
    texts = [b"t" * (n + 1) for n in range(9)]
    answers = await asyncio.gather(
        *(bus.transact(frame_of(text), StarParser(), 2.0) for text in texts)
    )
    assert answers == [text.upper() for text in texts]


async def test_a_deadline_holds_behind_who_waits_for_the_line(pool: BusPool, url: str) -> None:
    bus = await bus_in(pool, url)

    async def ask_twice() -> None:
        for sentence in ("no answer within", "the line was not free within"):
            with pytest.raises(BusTimeout, match=sentence):
                await bus.transact(frame_of(b"?"), StarParser(), 0.02, retries=0)

    asking = asyncio.create_task(ask_twice())
    await asyncio.sleep(0)
    # It waits when the first request gives up, and has the line when the second one comes.
    slow = asyncio.create_task(bus.transact(frame_of(b"?"), StarParser(), 30.0, retries=0))
    await asking
    assert not slow.done()
    slow.cancel()
    with pytest.raises(asyncio.CancelledError):
        await slow


async def test_a_cancelled_transaction_frees_the_line(pool: BusPool, url: str) -> None:
    bus = await bus_in(pool, url)
    task = asyncio.create_task(bus.transact(frame_of(b"?"), StarParser(), 10.0))
    await asyncio.sleep(0.01)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert await bus.transact(frame_of(b"y"), StarParser(), 1.0) == b"Y"


async def test_unplugging_breaks_and_connecting_mends(pool: BusPool, url: str) -> None:
    bus = await bus_in(pool, url)
    pool.simulation("a").unplug()
    with pytest.raises((BusBroken, BusTimeout)):
        await bus.transact(frame_of(b"a"), StarParser(), 0.5)
    with pytest.raises(BusBroken):
        await bus.transact(frame_of(b"a"), StarParser(), 0.5)
    assert not bus.connected
    with pytest.raises(BusBroken):
        await bus.connect()
    pool.simulation("a").replug()
    await bus.connect()
    assert await bus.transact(frame_of(b"a"), StarParser(), 1.0) == b"A"
    assert bus.counters.broken == 1
    assert bus.counters.opened == 2


async def test_unplugging_ends_a_transaction_under_way_at_once(pool: BusPool, url: str) -> None:
    bus = await bus_in(pool, url)
    task = asyncio.create_task(bus.transact(frame_of(b"?"), StarParser(), 30.0))
    await asyncio.sleep(0.02)
    pool.simulation("a").unplug()
    with pytest.raises(BusBroken, match="the link failed"):
        await task


async def test_plugging_a_hundred_times_leaks_nothing(pool: BusPool, url: str) -> None:
    bus = await bus_in(pool, url)
    simulation = pool.simulation("a")
    await bus.transact(frame_of(b"a"), StarParser(), 1.0)
    tasks, files = len(asyncio.all_tasks()), open_files()
    for _ in range(100):
        simulation.unplug()
        with pytest.raises((BusBroken, BusTimeout)):
            await bus.transact(frame_of(b"a"), StarParser(), 0.2, retries=0)
        simulation.replug()
        await bus.connect()
        assert await bus.transact(frame_of(b"a"), StarParser(), 1.0) == b"A"
    assert len(asyncio.all_tasks()) == tasks
    assert open_files() == files


def open_files() -> int:
    return len(os.listdir("/proc/self/fd"))


async def test_two_owners_share_and_the_last_one_closes(pool: BusPool, url: str) -> None:
    first = await bus_in(pool, url, "a")
    second = await bus_in(pool, url, "b")
    assert first is second
    assert first.owners == {"a", "b"}
    assert len(pool.simulation("a").emulators) == 2
    await first.detach("a")
    assert first.connected
    await first.detach("b")
    await first.detach("b")
    assert not first.connected
    with pytest.raises(BusClosed):
        await first.transact(frame_of(b"a"), StarParser(), 1.0)
    assert await bus_in(pool, url, "a") is not first


async def test_other_settings_are_refused(pool: BusPool, url: str) -> None:
    await bus_in(pool, url, "a")
    with pytest.raises(
        BusBusy, match="'a' already uses it with settings that differ from those of 'b'"
    ):
        await pool.serial(url, owner="b", baudrate=9600)


async def test_close_is_idempotent(pool: BusPool, url: str) -> None:
    bus = await bus_in(pool, url)
    await bus.close()
    await bus.close()
    await pool.aclose()
    await pool.aclose()


async def test_a_trace_shows_every_byte() -> None:
    seen: list[tuple[str, bytes]] = []
    async with BusPool(
        trace=lambda bus, direction, data, stamp: seen.append((direction, data)), wire_time=False
    ) as pool:
        bus = await bus_in(pool, "/dev/ttyUSB9")
        await bus.transact(frame_of(b"hi"), StarParser(), 1.0)
    assert seen == [("tx", frame_of(b"hi")), ("rx", frame_of(b"HI"))]


async def test_a_listener_hears_what_nobody_asked_for(pool: BusPool, url: str) -> None:
    bus = await bus_in(pool, url)
    heard: asyncio.Queue[bytes] = asyncio.Queue()
    bus.listen(heard.put_nowait)
    await bus.send(frame_of(b"psst"))
    found = b""
    async with asyncio.timeout(5):
        while len(found) < len(frame_of(b"PSST")):
            found += await heard.get()
    assert found == frame_of(b"PSST")


async def test_a_missing_port_is_named() -> None:
    async with BusPool() as pool:
        with pytest.raises(BusBroken, match="there is no such port"):
            await pool.serial("/dev/there-is-none", owner="a")
        assert pool.buses == ()


@in_real_time
async def test_a_port_that_nobody_serves_is_named() -> None:
    with SimulatedLine([], tcp=True) as line:
        address = line.address
    async with BusPool() as pool:
        with pytest.raises(BusBroken, match="connection refused"):
            await pool.serial(address, owner="a")


@in_real_time
async def test_an_address_without_a_port_is_a_mistake_of_the_user() -> None:
    async with BusPool() as pool:
        with pytest.raises(ConfigError, match="write it as 'socket://host:port'"):
            await pool.serial("socket://somewhere", owner="a")


async def test_a_port_in_use_by_another_program_is_busy() -> None:
    with SimulatedLine([Echo()]) as line:
        async with BusPool() as one, BusPool() as other:
            await one.serial(line.address, owner="a")
            with pytest.raises(BusBusy, match="another program"):
                await other.serial(line.address, owner="b")


async def test_a_cancelled_open_leaves_no_file_open() -> None:
    with SimulatedLine([Echo()]) as line:
        files = open_files()
        for turns in range(40):
            bus = SerialBus(line.address, Line())
            task = asyncio.create_task(bus.connect())
            for _ in range(turns % 4):
                await asyncio.sleep(0)
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            await bus.close()
        async with asyncio.timeout(5):
            while open_files() > files:  # noqa: ASYNC110 - files have no event
                await asyncio.sleep(0.01)


@in_real_time
@pytest.mark.filterwarnings("ignore:set.* is deprecated:DeprecationWarning")  # pyserial's own
async def test_a_port_of_another_computer_by_rfc2217() -> None:
    with SimulatedLine([Echo()], tcp=True) as line, PortServer(line.address) as server:
        async with BusPool() as pool:
            bus = await pool.serial(server.address, owner="a")
            for text in (b"hello", b"again", b"\xff\xff"):
                found = await bus.transact(frame_of(text), StarParser(), 3.0)
                assert found == text.upper()
            server.hang_up()
            async with asyncio.timeout(10):
                while bus.connected:  # noqa: ASYNC110 - what breaks a link tells nobody
                    await asyncio.sleep(0.01)
            with pytest.raises(BusBroken):
                await bus.transact(frame_of(b"x"), StarParser(), 0.5)


class PortServer:
    """Offers a port by RFC 2217, as serial servers do, with pyserial's own server side."""

    def __init__(self, port: str) -> None:
        self._port = serial.serial_for_url(port, 115200, timeout=0.01)
        self._server = socket.create_server(("127.0.0.1", 0))
        self._peer: socket.socket | None = None
        self._ended = False
        self._thread = threading.Thread(target=self._serve, daemon=True)

    @property
    def address(self) -> str:
        return f"rfc2217://127.0.0.1:{self._server.getsockname()[1]}"

    def __enter__(self) -> PortServer:
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._ended = True
        self._thread.join(5)
        self._server.close()
        self._port.close()

    def hang_up(self) -> None:
        self._ended = True

    def _serve(self) -> None:
        self._server.settimeout(5)
        peer, _ = self._server.accept()
        peer.settimeout(0.005)
        with peer:
            manager = serial.rfc2217.PortManager(self._port, SocketFile(peer))
            while not self._ended:
                data = self._port.read(self._port.in_waiting or 1)
                if data:
                    peer.sendall(b"".join(manager.escape(data)))
                try:
                    received = peer.recv(1024)
                except TimeoutError:
                    continue
                if not received:
                    return
                self._port.write(b"".join(manager.filter(received)))


class SocketFile:
    def __init__(self, peer: socket.socket) -> None:
        self.write = peer.sendall


async def test_the_gap_before_a_request_is_kept() -> None:
    with SimulatedLine([Echo()]) as line:
        bus = SerialBus(line.address, Line(), gap=0.01)
        await bus.connect()
        stamps: list[float] = []
        bus.trace = lambda name, direction, data, stamp: stamps.append(stamp)
        for _ in range(3):
            await bus.transact(frame_of(b"a"), StarParser(), 1.0)
        await bus.close()
    sent, received = stamps[0::2], stamps[1::2]
    assert all(after - before >= 0.01 for before, after in zip(received, sent[1:], strict=False))


async def test_a_request_waits_until_bytes_stop_coming(monkeypatch: pytest.MonkeyPatch) -> None:
    with SimulatedLine([Echo()]) as line:
        bus = SerialBus(line.address, Line())
        await bus.connect()
        await bus.transact(frame_of(b"a"), StarParser(), 1.0)
        sent = bus.counters.bytes_sent
        # Longer than the test lasts: whenever the wait is over, something has come meanwhile.
        bus.gap = 1000.0
        over: list[Callable[[], None]] = []
        monkeypatch.setattr(bus._pause, "start", lambda due, callback: over.append(callback))
        asking = asyncio.create_task(bus.transact(frame_of(b"b"), StarParser(), 30.0))
        await asyncio.sleep(0)
        for _ in range(3):
            over.pop()()
            assert bus.counters.bytes_sent == sent
        bus.gap = 0.0
        over.pop()()
        assert await asking == b"B"
        await bus.close()


@in_real_time
async def test_a_port_that_is_slow_to_close_holds_up_only_who_closes_it(
    pool: BusPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus, go, waited = await bus_in(pool, "/dev/ttyUSB9"), threading.Event(), list[bool]()
    original = link._close

    def slow(port: object) -> None:
        waited.append(go.wait(10.0))
        original(port)

    monkeypatch.setattr(link, "_close", slow)
    closing = asyncio.ensure_future(bus.detach("a"))
    again = asyncio.ensure_future(bus_in(pool, "/dev/ttyUSB9"))
    await asyncio.sleep(0.01)
    assert not closing.done(), "who closes waits until the port is given back"
    assert not again.done(), "and so does who opens it again"
    go.set()
    await closing
    assert waited == [True], "the event loop went on meanwhile"
    assert await (await again).transact(frame_of(b"x"), StarParser(), 1.0) == b"X"


def test_an_answer_that_nobody_read_is_lost_when_the_port_is_closed() -> None:
    with SimulatedLine([Echo()]) as line:
        first = os.open(line.address, os.O_RDWR | os.O_NOCTTY)
        os.write(first, frame_of(b"old"))
        assert select.select([first], [], [], 5.0)[0], "the answer has come"
        os.close(first)
        while line.call(lambda: line._end.heard):
            time.sleep(0.001)  # a port opened again before the line sees it closed stays open
        second = os.open(line.address, os.O_RDWR | os.O_NOCTTY)
        os.write(second, frame_of(b"new"))
        assert read_to(second, b"#") == frame_of(b"NEW")
        os.close(second)


def test_an_answer_that_comes_while_nobody_listens_is_lost() -> None:
    echo = Echo()
    echo.turnaround = 0.05
    with SimulatedLine([echo]) as line:
        first = os.open(line.address, os.O_RDWR | os.O_NOCTTY)
        os.write(first, frame_of(b"old"))
        os.close(first)
        while not echo.heard or line.call(line.wire.next_due) is not None:
            time.sleep(0.005)
        assert echo.heard == [b"old"], "what was sent arrives, though who sent it has left"
        second = os.open(line.address, os.O_RDWR | os.O_NOCTTY)
        os.write(second, frame_of(b"new"))
        assert read_to(second, b"#") == frame_of(b"NEW")
        os.close(second)


def read_to(file: int, end: bytes) -> bytes:
    found = b""
    while not found.endswith(end) and select.select([file], [], [], 5.0)[0]:
        found += os.read(file, 100)
    return found
