"""xbot2_zmq: messages, the driver against the emulated server, and a client of raw bytes."""

from __future__ import annotations

import contextlib
import math
import struct
from typing import Any

import anyio
import numpy as np
import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st

from rtee import monotonic
from rtee.buses.parser import CodecError
from rtee.buses.pool import BusPool
from rtee.buses.simulated_zmq import SimulatedZmq
from rtee.drivers.xbot2 import codec
from rtee.drivers.xbot2.codec import Command, Control, State
from rtee.drivers.xbot2.driver import XBot2Driver
from rtee.drivers.xbot2.emulator import ServerProperties, XBot2Emulator
from rtee.errors import BusTimeout, ConfigError, HandshakeError, NotConnected
from rtee.hand.load import load_configured
from rtee.types import ActuatorSpec, DeviceSpec, JointKind, Reference
from tests.drivers.objects import obstruct
from tests.drivers.use import connecting

SHEET = bytes.fromhex(
    "0A13646167616E615F315F636C61775F6A6F696E7442040000003F6A0101"
)  # dagana_1_claw_joint to 0.5, by position

# --- messages ------------------------------------------------------------------------------------


def test_a_command_is_the_bytes_of_the_sheet() -> None:
    command = Command(("dagana_1_claw_joint",), (0.5,), (), (Control.POSITION,))
    assert command.to_bytes() == SHEET
    assert Command.from_bytes(SHEET) == command


def test_a_state_survives_its_bytes() -> None:
    state = State(7, ("a", "b"), (0.5, 1.0), (0.25, -0.5), (2.0, 4.0), (math.nan, math.nan))
    back = State.from_bytes(state.to_bytes((0.5, 1.0), 123))
    assert back is not None
    assert back.names == state.names
    assert back.position == state.position
    assert back.velocity == state.velocity
    assert back.effort == state.effort
    assert all(math.isnan(t) for t in back.temperature)


def test_fields_that_are_not_described_are_skipped() -> None:
    """An IMU message (field 4) and unknown fields of a joint state do no harm."""
    imu = bytes([0x08, 3, 0x22, 2, 0x08, 1])
    assert State.from_bytes(imu) is None
    state = State(1, ("a",), (0.5,), (0.0,), (0.0,), ())
    raw = state.to_bytes((0.5,), 1)
    inner_at = raw.index(0x1A)
    length = raw[inner_at + 1]
    battery = bytes([0x75]) + struct.pack("<f", 48.0)
    longer = raw[: inner_at + 1] + bytes([length + 5]) + raw[inner_at + 2 :] + battery
    found = State.from_bytes(longer)
    assert found is not None
    assert found.position == (0.5,)


@given(st.binary(max_size=80))
def test_any_bytes_are_read_or_refused(data: bytes) -> None:
    for read in (State.from_bytes, Command.from_bytes, codec.joint_names, codec.read_yaml):
        with contextlib.suppress(CodecError):
            read(data)


def test_lists_that_do_not_fit_are_refused() -> None:
    bad = Command(("a", "b"), (0.5,), (), (Control.POSITION,)).to_bytes()
    with pytest.raises(CodecError, match="1 values for 2 joints"):
        Command.from_bytes(bad)


@pytest.mark.parametrize("data", [["a", "b"], "a b", "a, b"])
def test_joint_names_are_taken_as_list_or_text(data: Any) -> None:
    assert codec.joint_names(codec.answer(True, data=data)) == ("a", "b")
    with pytest.raises(CodecError, match="refused: no"):
        codec.joint_names(codec.answer(False, "no"))


# --- driver --------------------------------------------------------------------------------------


def device(*names: str, **options: Any) -> DeviceSpec:
    return DeviceSpec(
        name="robot",
        hand="dagana",
        driver="xbot2",
        actuators=tuple(
            ActuatorSpec(n, JointKind.REVOLUTE, 0.0, 1.0, 2.0, 20.0, 400.0, 10.0, 0.0)
            for n in names or ("claw",)
        ),
        options=options,
        emulated=True,
    )


connected = connecting(XBot2Driver)


def server(pool: BusPool) -> XBot2Emulator:
    found = pool.played("dagana/robot")
    assert isinstance(found, XBot2Emulator)
    return found


async def settle(made: XBot2Driver, goal: list[float], **limits: Any) -> np.ndarray:
    for _ in range(200):
        state = await made.sense()
        if np.abs(state.position - goal).max() < 2e-3:
            break
        await made.move(Reference.at(goal, **limits))
        await anyio.sleep(0.01)
    return state.position


@pytest.mark.anyio
async def test_positions_are_commanded_and_told() -> None:
    spec = device("motor_finger1", "motor_thumb")
    async with BusPool() as pool, connected(pool, spec) as made:
        await made.activate()
        assert server(pool).commands == 0
        assert await settle(made, [0.7, 0.4]) == pytest.approx([0.7, 0.4], abs=2e-3)


@pytest.mark.anyio
async def test_a_closure_and_a_state_in_rad_are_mapped() -> None:
    """The gripper's interface takes the closure but tells the claw's angle."""
    joints = {"claw": {"joint": "dagana_1_claw_joint", "command": [0, 1], "state": [-1.5, 1.3]}}
    spec = device(joints=joints, emulator={"lower": -1.5, "upper": 1.3, "start": -0.1})
    async with BusPool() as pool, connected(pool, spec) as made:
        assert (await made.sense()).position[0] == pytest.approx(1.4 / 2.8, abs=1e-3)
        await made.move(Reference.at([0.25]))
        await anyio.sleep(0.1)
        assert server(pool).joints["dagana_1_claw_joint"].target == pytest.approx(0.25)


@pytest.mark.anyio
async def test_effort_control_closes_with_the_limit_and_then_stays() -> None:
    async with BusPool() as pool, connected(pool, device("a", "b", control="effort")) as made:
        obstruct(server(pool).joints["a"], 0.5, 100.0)
        limit = np.array([4.0, 3.0])
        for _ in range(80):
            await made.sense()
            await made.move(Reference.at([0.9, 0.6], max_effort=limit))
            await anyio.sleep(0.01)
        state = await made.sense()
        assert state.effort[0] == pytest.approx(4.0, abs=0.05)
        assert state.position == pytest.approx([0.54, 0.6], abs=0.01)


@pytest.mark.anyio
async def test_without_effort_nothing_moves_under_effort_control() -> None:
    """A limit of 0, as of a motor that is too hot, is no permission to use all there is."""
    async with BusPool() as pool, connected(pool, device("a", "b", control="effort")) as made:
        before = (await made.sense()).position.copy()
        for _ in range(30):
            await made.sense()
            await made.move(Reference.at([0.9, 0.6], max_effort=np.array([0.0, 3.0])))
            await anyio.sleep(0.01)
        state = await made.sense()
        assert state.effort[0] == 0.0
        assert state.position[0] == pytest.approx(before[0], abs=0.01)
        assert state.position[1] == pytest.approx(0.6, abs=0.01)


@pytest.mark.anyio
async def test_limited_control_sends_the_limit_beside_the_position() -> None:
    async with BusPool() as pool, connected(pool, device("a", "b", control="limited")) as made:
        taken: list[Command] = []
        feed = server(pool).feed

        def heard(data: bytes, now: float) -> list[bytes]:
            taken.append(Command.from_bytes(data))
            return feed(data, now)

        server(pool).feed = heard  # type: ignore[method-assign]
        obstruct(server(pool).joints["a"], 0.5, 100.0)

        async def push(*limits: float) -> np.ndarray:
            for _ in range(80):
                state = await made.sense()
                await made.move(Reference.at([0.9, 0.6], max_effort=limits))
                await anyio.sleep(0.01)
            return state.effort

        most = made.spec.actuators[0].effort
        await push(most, math.inf)
        assert taken[-1].control == (Control.POSITION, Control.POSITION)
        assert taken[-1].effort == ()
        effort = await push(0.4 * most, math.inf)
        assert taken[-1].control == (Control.POSITION | Control.EFFORT, Control.POSITION)
        assert taken[-1].effort == pytest.approx((0.4 * most, 0.0))
        assert effort[0] == pytest.approx(0.4 * most, abs=0.05)
        await push(most, math.inf)
        assert taken[-1].effort == pytest.approx((most, 0.0)), "what was limited must be told so"
        await made.stop()
        assert taken[-1].control[1] == Control.POSITION


@pytest.mark.anyio
async def test_connecting_to_a_joint_that_holds_sends_nothing() -> None:
    async with BusPool() as pool:
        async with connected(pool, device()) as first:
            await settle(first, [0.6])
        sent = server(pool).commands
        async with connected(pool, device()) as second:
            await second.activate()
            assert (await second.sense()).position == pytest.approx([0.6], abs=2e-3)
        assert server(pool).commands == sent


@pytest.mark.anyio
async def test_a_joint_that_holds_goes_on_holding_while_another_moves() -> None:
    """Its reference begins where it is measured, which would end its grip."""
    spec = device("thumb", "index")
    async with BusPool() as pool:
        async with connected(pool, spec) as first:
            obstruct(server(pool).joints["thumb"], 0.5, 200.0)
            thumb = server(pool).joints["thumb"]
            with anyio.fail_after(5.0):
                while (await first.sense()).position[0] < 0.5 or not thumb.blocked:
                    await first.move(Reference.at([0.9, 0.2]))
        gripped = thumb.target
        assert gripped == pytest.approx(0.9)
        async with connected(pool, spec) as second:
            await second.activate()
            here = float((await second.sense()).position[0])
            with anyio.fail_after(5.0):
                while (await second.sense()).position[1] < 0.69:
                    await second.move(Reference.at([here, 0.7]))
                assert thumb.target == gripped
                while (await second.sense()).position[0] > 0.31:
                    await second.move(Reference.at([0.3, 0.7]))


@pytest.mark.anyio
async def test_silence_is_noticed_and_stop_holds() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        await made.move(Reference.at([1.0]))
        await anyio.sleep(0.15)
        await made.stop()
        await anyio.sleep(0.15)
        where = (await made.sense()).position[0]
        assert where < 0.9
        server(pool).inject("silent")
        await anyio.sleep(0.4)
        with pytest.raises(BusTimeout, match="no state"):
            await made.sense()


@pytest.mark.anyio
@pytest.mark.parametrize(("rate", "late"), [(4.0, 0.49), (100.0, 0.25)])
async def test_a_state_may_be_late_by_a_period_and_a_repeated_packet(
    rate: float, late: float
) -> None:
    async with BusPool() as pool, connected(pool, device(rate=rate)) as made:
        while not (await made.sense()).fresh:
            pass
        server(pool).inject("silent")
        await anyio.sleep(late - 1.5 / rate)  # as long as `sense` waits for a new state
        assert not (await made.sense()).fresh
        await anyio.sleep(0.02)
        with pytest.raises(BusTimeout, match=r"no state for more than 0\.(5|26) s"):
            await made.sense()


@pytest.mark.anyio
async def test_the_server_may_go_and_come() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        wire = pool.simulation("dagana/robot")
        wire.unplug()
        with contextlib.suppress(Exception):
            for _ in range(50):
                await made.sense()
                await anyio.sleep(0.01)
        await made.close()
        wire.replug()
        await made.configure()
        assert (await made.sense()).fresh


@pytest.mark.anyio
async def test_what_is_missing_is_named() -> None:
    async with BusPool() as pool:
        with pytest.raises(HandshakeError, match=r"no claw; did you mean 'claws'"):
            async with connected(pool, device(emulator={"joints": ["claws"]})):
                pass
    async with BusPool() as pool, connected(pool, device(deadline=0.2)) as made:
        server(pool).inject("silent")
        with pytest.raises(NotConnected, match="xbot2_zmq does not answer"):
            await made.configure()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"address": "host:5556"}, "tcp://host"),
        ({"joints": {"clow": {}}}, "did you mean 'claw'"),
        ({"joints": {"claw": {"command": [1, 1]}}}, "must differ"),
    ],
)
@pytest.mark.anyio
async def test_mistakes_are_told(options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        XBot2Driver(device(**options), BusPool())


def test_the_emulator_has_the_joint_of_the_shipped_configuration() -> None:
    _, config = load_configured("dagana")
    options = config.devices["gripper"].options
    assert set(XBot2Emulator().joints) == {each["joint"] for each in options["joints"].values()}


def test_a_client_of_raw_bytes_talks_to_the_server() -> None:
    """Plain zmq and the sheet's bytes; the state is taken apart by hand."""
    emulated = XBot2Emulator(ServerProperties(joints=("dagana_1_claw_joint",)))
    simulation = SimulatedZmq(name="xbot2")
    simulation.emulators.append(emulated)
    with simulation, zmq.Context() as context:
        states, commands, service = (context.socket(k) for k in (zmq.SUB, zmq.PUB, zmq.REQ))
        with states, commands, service:
            for made, place in zip((states, commands, service), (0, 1, 2), strict=True):
                made.linger = 0
                made.connect(simulation.endpoints[place])
            states.subscribe(b"")
            states.rcvtimeo = service.rcvtimeo = 2000
            service.send(b"type: joint_names\n")
            assert b"dagana_1_claw_joint" in service.recv()
            service.send(b"[no mapping")
            assert b"success: false" in service.recv()
            end = monotonic.now() + 5.0
            position = math.inf
            while abs(position - 0.5) > 1e-3 and monotonic.now() < end:
                commands.send(SHEET)
                raw = states.recv()
                at = raw.index(b"\x0a\x04") + 2
                (position,) = struct.unpack("<f", raw[at : at + 4])
            assert position == pytest.approx(0.5, abs=1e-3)
