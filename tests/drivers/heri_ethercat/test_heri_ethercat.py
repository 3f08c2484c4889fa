"""HERI II's boards: process data, the start and stop sequences, faults, pressures."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Any, cast

import anyio
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee import monotonic
from rtee.buses.ethercat import EthercatBus, PysoemRing, Ring, SlaveState
from rtee.buses.faults import Faults
from rtee.buses.parser import CodecError
from rtee.buses.pool import BusPool
from rtee.drivers.heri_ethercat import codec
from rtee.drivers.heri_ethercat.codec import Command, Fault, Order, Reply
from rtee.drivers.heri_ethercat.driver import HeriEthercatDriver
from rtee.drivers.heri_ethercat.emulator import HeriEthercatEmulator
from rtee.errors import BusBroken, BusTimeout, ConfigError, DeviceFault, HandshakeError
from rtee.types import ActuatorSpec, DeviceSpec, JointKind, Reference
from tests.drivers.objects import obstruct
from tests.drivers.use import connecting

NAMES = ("motor_finger1", "motor_finger2", "motor_finger3", "motor_thumb")
COMMAND = bytes.fromhex(
    "0000003F0000A03F00000000" + "0000" * 5 + "0000" + "3412" + "0000" + "00000000"
)
REPLY = bytes.fromhex(
    "DBF9FE3E3BDF9F3F0C00F9FF6400C8002C019001F401580296005A000000050000000000 0000".replace(" ", "")
)

# --- process data --------------------------------------------------------------------------------


def test_the_command_is_that_of_the_sheet() -> None:
    command = Command((0.5, 1.25), stamp=0x1234)
    assert len(COMMAND) == 32
    assert command.to_bytes() == COMMAND
    assert Command.from_bytes(COMMAND) == command


def test_the_reply_is_that_of_the_sheet() -> None:
    assert len(REPLY) == 38
    reply = Reply.from_bytes(REPLY)
    assert reply.positions == pytest.approx((0.498, 1.249), abs=1e-6)
    assert reply.velocities == pytest.approx((0.012, -0.007))
    assert reply.pressures == (100, 200, 300, 400, 500, 600)
    assert reply.currents == pytest.approx((0.150, 0.090))
    assert (reply.fault, reply.round_trip) == (0, 5)
    assert reply.to_bytes() == REPLY


@given(st.binary(max_size=48))
def test_any_data_is_read_or_refused(data: bytes) -> None:
    for read, size in ((Command.from_bytes, 32), (Reply.from_bytes, 38)):
        if len(data) == size:
            read(data)
        else:
            with pytest.raises(CodecError):
                read(data)


@given(
    st.tuples(st.floats(-3, 3, width=32), st.floats(-3, 3, width=32)),
    st.floats(-30, 30),
    st.floats(-30, 30),
)
def test_units_have_inverses(
    positions: tuple[float, float], velocity: float, torque: float
) -> None:
    back = Command.from_bytes(Command(positions, velocity, torque).to_bytes())
    assert back.positions == positions
    assert back.velocity == pytest.approx(velocity, abs=5.01e-4)
    assert back.torque == pytest.approx(torque, abs=5.01e-4)


def test_acknowledgements_and_faults_are_read() -> None:
    assert codec.acknowledged(struct.pack("<H", 0x78A5), Order.POWER_ON) is True
    assert codec.acknowledged(struct.pack("<H", 0xAAA5), Order.POWER_ON) is False
    assert codec.acknowledged(struct.pack("<H", 0x785A), Order.POWER_ON) is None
    with pytest.raises(CodecError):
        codec.acknowledged(b"", Order.POWER_ON)
    assert codec.faults_of(0x8000) == Fault(0)
    assert codec.faults_of(0x8280) == Fault.HARDWARE
    assert codec.words(Fault.HARDWARE | Fault.ENCODER_1) == "encoder 1, hardware"
    cure = "check the encoders' cables and switch the boards off and on"
    assert codec.cure(Fault.HARDWARE | Fault.ENCODER_1) == cure
    assert all(codec.cure(fault) for fault in codec.faults_of(0xFFFF))


# --- driver --------------------------------------------------------------------------------------


def device(*names: str, **options: Any) -> DeviceSpec:
    return DeviceSpec(
        name="hand",
        hand="heri_ii",
        driver="heri_ethercat",
        actuators=tuple(
            ActuatorSpec(n, JointKind.REVOLUTE, 0.0, 2.5, 2.0, 15.0, 300.0, 3.3, 0.0)
            for n in names or NAMES
        ),
        options={"deadline": 0.5, "watchdog": 1.0, **options},
        emulated=True,
    )


connected = connecting(HeriEthercatDriver)


def hand(pool: BusPool) -> HeriEthercatEmulator:
    found = pool.played("heri_ii/hand")
    assert isinstance(found, HeriEthercatEmulator)
    return found


async def settle(made: HeriEthercatDriver, goal: list[float]) -> np.ndarray:
    end = monotonic.now() + 5.0
    while True:
        state = await made.sense()
        await made.move(Reference.at(goal))
        if np.abs(state.position - goal).max() < 2e-3 or monotonic.now() > end:
            return state.position
        await anyio.sleep(0.002)


async def hold(made: HeriEthercatDriver, goal: list[float]) -> None:
    for _ in range(5):
        await made.sense()
        await made.move(Reference.at(goal))


@pytest.mark.anyio
async def test_four_motors_of_two_boards_move_by_name() -> None:
    names = (NAMES[3], *NAMES[:3])
    async with BusPool() as pool, connected(pool, device(*names)) as made:
        assert "unverified" in made.capabilities.identity["model"]
        assert hand(pool).state is SlaveState.OPERATIONAL
        assert not any(board.power for board in hand(pool).boards)
        await made.activate()
        goal = [1.5, 0.4, 0.8, 1.2]
        assert await settle(made, goal) == pytest.approx(goal, abs=2e-3)
        motors = [m.position for board in hand(pool).boards for m in board.motors]
        assert motors == pytest.approx([0.4, 0.8, 1.2, 1.5], abs=2e-3)
        before = made.counters()["transactions"]
        await made.move(Reference.at(goal))
        await made.sense()
        assert made.counters()["transactions"] == before + 1


@pytest.mark.anyio
async def test_boards_that_left_operation_are_brought_back_before_they_get_power() -> None:
    async with BusPool() as pool, connected(pool, device(watchdog=0.2)) as made:
        hand(pool).state = SlaveState.SAFE_OPERATIONAL
        hand(pool)._dropped = True
        with pytest.raises(BusTimeout):
            await made.move(Reference.at([0.3] * 4))
        await made.activate()
        assert hand(pool).state is SlaveState.OPERATIONAL
        assert (await made.sense()).position == pytest.approx([0.3] * 4, abs=1e-3)


@pytest.mark.anyio
async def test_activation_does_not_jump_and_pressures_are_told() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        await made.activate()
        await anyio.sleep(0.05)
        assert (await made.sense()).position == pytest.approx([0.3] * 4, abs=1e-3)
        obstruct(hand(pool).boards[0].motors[1], 0.8, 10.0)
        end = monotonic.now() + 5.0
        state = await made.sense()
        while state.current[1] < 0.995 and monotonic.now() < end:
            await made.move(Reference.at([0.3, 1.6, 0.3, 0.3]))
            await anyio.sleep(0.002)
            state = await made.sense()
        assert state.current[1] == pytest.approx(1.0, abs=0.01)
        assert state.effort[1] == pytest.approx(codec.TORQUE_PER_AMPERE, rel=0.01)
        pressure = state.extras["pressure"].reshape(4, 3)
        assert (pressure[1] > 0).all()
        assert not pressure[[0, 2, 3]].any()


@pytest.mark.anyio
async def test_references_stay_within_the_limits() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        await made.activate()
        await made.move(Reference.at([9.0, -9.0, 0.3, 0.3]))
        targets = [m.target for m in hand(pool).boards[0].motors]
        assert targets == pytest.approx([2.5, 0.0])


@pytest.mark.anyio
async def test_the_torque_reference_of_a_board_is_the_smaller_limit_of_its_motors() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        assert "max_effort" in made.capabilities.accepts
        await made.activate()
        motors = [motor for board in hand(pool).boards for motor in board.motors]
        frames: list[Command] = []
        take = hand(pool).cycle

        def heard(outputs: Any, now: float) -> Any:
            frames[:] = [Command.from_bytes(data) for data in outputs[:2]]
            return take(outputs, now)

        hand(pool).cycle = heard  # type: ignore[method-assign]
        obstruct(hand(pool).boards[0].motors[0], 0.5, 10.0)
        obstruct(hand(pool).boards[1].motors[1], 0.5, 10.0)
        there = [1.0, 0.3, 0.3, 1.0]

        async def push(limits: list[float]) -> np.ndarray:
            for _ in range(150):
                state = await made.sense()
                await made.move(Reference.at(there, max_effort=limits))
                await anyio.sleep(0.004)
            return state.effort

        effort = await push([1.0, 2.0, math.inf, 3.3])
        assert [frame.torque for frame in frames] == [1.0, 0.0], "a motor's whole limit is none"
        assert frames[0].to_bytes()[10:12] == (1000).to_bytes(2, "little")
        assert effort[0] == pytest.approx(1.0, abs=0.02)
        assert motors[3].max_effort == hand(pool).properties.current
        effort = await push([3.3, 3.3, 1e-9, 3.3])
        assert [frame.torque for frame in frames] == [0.0, 0.001], "next to nothing is not none"
        assert effort[0] > 2.0
        assert effort[3] < 0.1


@pytest.mark.anyio
async def test_without_limits_the_torque_reference_stays_zero() -> None:
    async with BusPool() as pool, connected(pool, device(limit_torque=False)) as made:
        assert "max_effort" not in made.capabilities.accepts
        assert "limit_torque" in made.capabilities.refuses["max_effort"]
        await made.activate()
        await made.move(Reference.at([0.4] * 4, max_effort=[1.0] * 4))
        current = hand(pool).properties.current
        assert {m.max_effort for board in hand(pool).boards for m in board.motors} == {current}


@pytest.mark.anyio
async def test_faults_are_named_and_acknowledged() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        await made.activate()
        where = await settle(made, [0.6] * 4)
        hand(pool).inject("hardware")
        with pytest.raises(DeviceFault, match="board 0: hardware") as told:
            await hold(made, [0.6] * 4)
        assert told.value.code == Fault.HARDWARE
        with pytest.raises(DeviceFault, match="hardware"):
            await made.examine()
        with pytest.raises(DeviceFault, match="hardware"):
            await made.recover()
        hand(pool).clear()
        await made.recover()
        await made.activate()
        assert (await made.sense()).position == pytest.approx(where, abs=0.05)
        assert await settle(made, [0.5] * 4) == pytest.approx([0.5] * 4, abs=2e-3)


@pytest.mark.anyio
async def test_heat_is_a_warning() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        await made.activate()
        hand(pool).inject("hot")
        await made.move(Reference.at([0.3] * 4))
        assert "hot" in (await made.sense()).warnings[0]


@pytest.mark.anyio
async def test_release_takes_the_power_and_stop_holds() -> None:
    spec = device(emulator={"speed": 0.5}, watchdog=0.0)
    async with BusPool() as pool, connected(pool, spec) as made:
        await made.activate()
        await made.move(Reference.at([2.0] * 4))
        await anyio.sleep(0.1)
        await made.stop()
        where = (await made.sense()).position
        await anyio.sleep(0.1)
        assert (await made.sense()).position == pytest.approx(where, abs=0.02)
        assert (where < 1.0).all()
        await made.disable()
        assert not any(board.power for board in hand(pool).boards)


@pytest.mark.anyio
async def test_a_board_that_refuses_does_not_keep_the_power_of_the_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        await made.activate()
        first, *others = hand(pool).boards
        monkeypatch.setattr(first, "obey", lambda code: False)
        with pytest.raises(DeviceFault, match="board 0 refuses 'power off'"):
            await made.disable()
        assert first.power
        assert others
        assert not any(board.power for board in others)


@pytest.mark.anyio
async def test_lost_frames_and_a_pulled_cable_are_told() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        await made.activate()
        wire = pool.simulation("heri_ii/hand")
        wire.faults = Faults(drop=1.0)
        with pytest.raises(BusTimeout, match="not every slave"):
            await made.move(Reference.at([0.3] * 4))
        wire.faults = Faults()
        await made.move(Reference.at([0.3] * 4))
        wire.unplug()
        with pytest.raises(BusBroken, match="no slave answers"):
            await made.move(Reference.at([0.3] * 4))


@pytest.mark.anyio
@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"emulator": {"boards": 1}}, "2 boards at eth0, found 1 slaves"),
        ({"product": 0x99}, "product 0x99 as slave 0, found product 0x13"),
    ],
)
async def test_another_network_is_refused(options: dict[str, Any], sentence: str) -> None:
    async with BusPool() as pool:
        with pytest.raises(HandshakeError, match=sentence):
            async with connected(pool, device(**options)):
                pass


@pytest.mark.parametrize(
    ("motors", "sentence"),
    [({"a": 0}, "missing: b"), ({"a": 1, "b": 1}, "two have the same")],
)
def test_mistakes_are_told(motors: dict[str, int], sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        HeriEthercatDriver(device("a", "b", motors=motors), BusPool())


def test_a_network_interface_that_is_not_there_is_told() -> None:
    pytest.importorskip("pysoem")
    with pytest.raises(OSError, match="raw sockets"):
        PysoemRing("no-such-interface").open()


@pytest.mark.anyio
async def test_emulated_networks_belong_to_one_hand_each() -> None:
    async with BusPool() as pool:
        left = await pool.ethercat("eth1", owner="left/boards", emulator=HeriEthercatEmulator)
        right = await pool.ethercat("eth1", owner="right/boards", emulator=HeriEthercatEmulator)
        assert right is not left
        await right.run(lambda ring: ring.request(SlaveState.OPERATIONAL, 1.0), 2.0)
        played = [
            cast("HeriEthercatEmulator", pool.played(f"{hand}/boards"))
            for hand in ("left", "right")
        ]
        assert [one.state for one in played] == [SlaveState.PRE_OPERATIONAL, SlaveState.OPERATIONAL]


@pytest.mark.anyio
async def test_a_ring_that_cannot_be_opened_is_closed() -> None:
    class Dead:
        closed = 0

        def open(self) -> int:
            raise OSError("no slaves")

        def close(self) -> None:
            self.closed += 1

    ring = Dead()
    bus = EthercatBus("eth9", cast("Callable[[], Ring]", lambda: ring))
    for attempt in range(3):
        with pytest.raises(BusBroken, match="no slaves"):
            await bus.connect()
        assert ring.closed == attempt + 1
    await bus.close()
