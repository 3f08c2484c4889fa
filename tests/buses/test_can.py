"""The CAN and CANopen buses on python-can's virtual and udp_multicast interfaces."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator
from typing import cast

import pytest

from rtee.buses.can import CanBus
from rtee.buses.emulator import CanFrame, Emulator
from rtee.buses.faults import Faults
from rtee.buses.pool import BusPool
from rtee.buses.simulated_can import SimulatedCan
from rtee.errors import BusBroken, BusClosed, BusTimeout
from tests.buses.devices import CanCounter, in_real_time

pytestmark = pytest.mark.anyio


@pytest.fixture
async def pool() -> AsyncIterator[BusPool]:
    async with BusPool() as pool:
        yield pool


async def bus_in(pool: BusPool, owner: str = "a") -> CanBus:
    return await pool.can("can0", owner=owner, emulator=CanCounter)


def answer(frame: CanFrame) -> bool:
    return frame.id == 0x11


async def test_a_request_is_answered(pool: BusPool) -> None:
    bus = await bus_in(pool)
    found = await bus.request(CanFrame(0x10, b"abc"), answer, 1.0)
    assert (found.id, found.data) == (0x11, b"cba")


async def test_no_answer_is_a_timeout(pool: BusPool) -> None:
    bus = await bus_in(pool)
    with pytest.raises(BusTimeout, match="no answer to frame 0x12"):
        await bus.request(CanFrame(0x12), answer, 0.05, retries=2)
    assert bus.counters.retries == 2
    assert bus.counters.timeouts == 3


async def test_lost_frames_are_sent_again(pool: BusPool) -> None:
    bus = await bus_in(pool)
    pool.simulation("a").faults = Faults(drop=0.3, corrupt=0.1, delay=0.1, seed=3)
    for _ in range(20):
        await bus.request(CanFrame(0x10, b"1"), answer, 1.0, retries=50)
    assert bus.counters.retries > 0


async def test_frames_by_identifier_reach_their_listener_until_undone(pool: BusPool) -> None:
    bus = await bus_in(pool)
    beats: asyncio.Queue[CanFrame] = asyncio.Queue()
    undo = bus.subscribe(beats.put_nowait, 0x700)
    async with asyncio.timeout(5):
        assert [(await beats.get()).id for _ in range(3)] == [0x700] * 3
    undo()
    undo()
    while not beats.empty():
        beats.get_nowait()
    await bus.request(CanFrame(0x10, b"1"), answer, 1.0)
    await asyncio.sleep(0.03)
    assert beats.empty()


async def test_unplugging_breaks_and_connecting_mends(pool: BusPool) -> None:
    bus = await bus_in(pool)
    task = asyncio.create_task(bus.request(CanFrame(0x12), answer, 30.0))
    await asyncio.sleep(0.02)
    pool.simulation("a").unplug()
    with pytest.raises(BusBroken, match="unplugged"):
        await task
    with pytest.raises(BusBroken, match="adapter does not exist"):
        await bus.connect()
    pool.simulation("a").replug()
    await bus.connect()
    assert (await bus.request(CanFrame(0x10, b"z"), answer, 1.0)).data == b"z"


async def test_emulated_channels_belong_to_one_hand_each(pool: BusPool) -> None:
    left = await bus_in(pool, "left/motors")
    assert await bus_in(pool, "left/wrist") is left
    right = await bus_in(pool, "right/motors")
    assert right is not left
    await right.request(CanFrame(0x10, b"abc"), answer, 1.0)
    played = [cast("CanCounter", pool.played(f"{hand}/motors")) for hand in ("left", "right")]
    assert [one.heard for one in played] == [0, 1]


async def test_a_closed_bus_says_so(pool: BusPool) -> None:
    bus = await bus_in(pool)
    await bus.detach("a")
    with pytest.raises(BusClosed):
        bus.send_now(CanFrame(0x10))


async def test_an_interface_that_is_not_there_is_named() -> None:
    async with BusPool() as pool:
        with pytest.raises(BusBroken, match=r"no SocketCAN|no such CAN interface"):
            await pool.can("nocan7", owner="a")


@pytest.mark.parametrize(
    ("interface", "said"),
    [("socketcan", "no SocketCAN|no such CAN interface"), ("tin_can", "Unknown interface")],
)
@in_real_time
async def test_an_emulated_node_names_the_interface_that_is_not_there(
    interface: str, said: str
) -> None:
    with pytest.raises(BusBroken, match=said):
        SimulatedCan([], channel="nocan7", interface=interface).start()


@in_real_time
async def test_udp_multicast_carries_frames_too() -> None:
    channel = "239.74.163.77"
    try:
        simulation = SimulatedCan(
            [CanCounter()], channel=channel, interface="udp_multicast"
        ).start()
    except Exception as error:  # the machine may have no multicast route
        pytest.skip(f"no multicast here: {error}")
    try:
        async with BusPool() as pool:
            bus = await pool.can(channel, owner="a", interface="udp_multicast")
            try:
                found = await bus.request(CanFrame(0x10, b"net"), answer, 1.0, retries=3)
            except (BusTimeout, BusBroken) as error:
                pytest.skip(f"multicast does not come back here: {error}")
            assert found.data == b"ten"
    finally:
        simulation.close()


class Talkative(Emulator):
    """Answers every frame with the same identifier, as a LinkerHand does."""

    heard = 0

    def on_frame(self, frame: CanFrame, now: float) -> list[CanFrame]:
        self.heard += 1
        return [CanFrame(frame.id, frame.data + b"!")]

    def power_cycle(self, now: float) -> None:
        pass


@in_real_time
async def test_a_node_does_not_hear_itself_on_udp_multicast() -> None:
    channel, node = "239.74.163.78", Talkative()
    try:
        simulation = SimulatedCan([node], channel=channel, interface="udp_multicast").start()
    except Exception as error:  # the machine may have no multicast route
        pytest.skip(f"no multicast here: {error}")
    heard: list[CanFrame] = []
    try:
        async with BusPool() as pool:
            bus = await pool.can(channel, owner="a", interface="udp_multicast")
            bus.subscribe(heard.append)
            try:
                found = await bus.request(
                    CanFrame(0x27, b"x"), lambda frame: frame.data == b"x!", 1.0, retries=3
                )
            except (BusTimeout, BusBroken) as error:
                pytest.skip(f"multicast does not come back here: {error}")
            asked = node.heard
            # An echo would have been answered within the time of one exchange more.
            await bus.request(CanFrame(0x27, b"y"), lambda frame: frame.data == b"y!", 1.0)
            assert found.data == b"x!"
            assert node.heard == asked + 1
            assert b"x" not in {frame.data for frame in heard}
    finally:
        simulation.close()


@in_real_time
async def test_blocking_calls_have_a_deadline(pool: BusPool) -> None:
    import canopen

    bus = await pool.canopen("can3", owner="a", emulator=CanCounter)
    node = bus.network.add_node(5, canopen.ObjectDictionary())
    with pytest.raises(BusTimeout, match="No SDO response"):
        await bus.run(lambda: node.sdo.upload(0x1000, 0), 2.0)
    node.sdo.RESPONSE_TIMEOUT = 0.2
    with pytest.raises(BusTimeout, match=r"within 0\.050 s"):
        await bus.run(lambda: node.sdo.upload(0x1000, 0), 0.05)
    assert bus.network.nmt is not None


@pytest.mark.parametrize("cut", ["unplugged", "closed"])
async def test_a_blocking_call_ends_with_the_bus_s_own_error(pool: BusPool, cut: str) -> None:
    import canopen

    bus = await pool.canopen("can3", owner="a", emulator=CanCounter)
    node = bus.network.add_node(5, canopen.ObjectDictionary())
    began, go = asyncio.Event(), threading.Event()
    loop = asyncio.get_running_loop()

    def call() -> None:
        loop.call_soon_threadsafe(began.set)
        go.wait()
        node.sdo.upload(0x1000, 0)

    calling = asyncio.create_task(bus.run(call, 30.0))
    await began.wait()
    ending = asyncio.create_task(bus.close()) if cut == "closed" else None
    if ending is None:
        broken = asyncio.Event()
        bus.watch(broken.set)
        pool.simulation("a").unplug()
        await broken.wait()
    await asyncio.sleep(0)
    go.set()
    with pytest.raises(BusBroken if ending is None else BusClosed, match=r"unplugged|is closed"):
        await calling
    if ending is not None:
        await ending


async def test_a_blocking_call_s_own_error_is_kept(pool: BusPool) -> None:
    bus = await pool.canopen("can3", owner="a", emulator=CanCounter)

    def silent() -> None:
        raise BusTimeout(bus.name, "node 5 does not answer")

    with pytest.raises(BusTimeout, match="node 5"):
        await bus.run(silent, 2.0)
    assert bus.counters.timeouts == 1
