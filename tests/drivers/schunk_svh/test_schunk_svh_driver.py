"""The SVH's driver against its emulator, bytes and all."""

from __future__ import annotations

import contextlib
import math
import struct
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest

from rtee import monotonic
from rtee.buses.pool import BusPool
from rtee.drivers.schunk_svh import codec
from rtee.drivers.schunk_svh.channels import CHANNELS
from rtee.drivers.schunk_svh.codec import Command, Packet
from rtee.drivers.schunk_svh.driver import SchunkSvhDriver
from rtee.drivers.schunk_svh.emulator import SchunkSvhEmulator
from rtee.errors import ConfigError, DeviceFault, HandshakeError, NotConnected
from rtee.types import ActuatorSpec, DeviceSpec, JointKind, Reference
from tests.drivers.objects import obstruct

PORT = "/dev/svh"
MOTION = {Command.SET_CONTROL_COMMAND, Command.SET_CONTROL_COMMAND_ALL}

pytestmark = pytest.mark.anyio


def device(
    names: list[str] | None = None, *, emulator: dict[str, Any] | None = None, **options: Any
):
    return DeviceSpec(
        name="svh",
        hand="schunk_svh",
        driver="schunk_svh",
        actuators=tuple(
            ActuatorSpec(
                f"left_hand_{c.name}", JointKind.REVOLUTE, 0.0, c.range, 1.0, 20.0, 400.0, 8.0, 0.0
            )
            for c in CHANNELS
            if names is None or c.name in names
        ),
        options={
            "port": PORT,
            "home": "on_connect",
            "deadline": 0.5,
            "emulator": {"haste": 100.0, "start": 0.1, **(emulator or {})},
            **options,
        },
        emulated=True,
    )


@contextlib.asynccontextmanager
async def driver(pool: BusPool, spec: DeviceSpec) -> AsyncIterator[SchunkSvhDriver]:
    made = SchunkSvhDriver(spec, pool)
    try:
        yield made
    finally:
        await made.close()
        await made.close()


def put(emulator: SchunkSvhEmulator, channel: int, closure: float, stiffness: float) -> None:
    """Put an object in the way of a channel, met at a closure; stiffness in mA per tick."""
    spec, contact = emulator.table[channel], emulator._at(channel, closure)
    obstruct(emulator.channels[channel].axis, contact, stiffness, -spec.direction)


def hand(pool: BusPool) -> SchunkSvhEmulator:
    found = pool.played("schunk_svh/svh")
    assert isinstance(found, SchunkSvhEmulator)
    return found


async def settle(made: SchunkSvhDriver, goal: np.ndarray) -> np.ndarray:
    end = monotonic.now() + 5.0
    while True:
        position = (await made.sense()).position
        await made.move(Reference.at(goal))
        if np.abs(position - goal).max() < 1e-3 or monotonic.now() > end:
            return position
        await anyio.sleep(0.002)


async def test_homes_moves_and_senses_all_channels_in_one_exchange() -> None:
    spec = device(emulator={"start": 0.03})
    async with BusPool() as pool, driver(pool, spec) as made:
        await made.configure()
        assert made.capabilities.identity["firmware"] == "1.2"
        assert not MOTION & set(hand(pool).packets)
        await made.activate()
        # The emulator knows where its stops are; homing has found them from the outside.
        assert made.stops == {c.index: hand(pool).stop_of(c.index) for c in CHANNELS}
        goal = np.array([0.5 * c.range for c in CHANNELS])
        assert await settle(made, goal) == pytest.approx(goal, abs=2e-3)
        for channel in CHANNELS:
            assert hand(pool).closure(channel.index) == pytest.approx(0.5, abs=0.02)
        before = dict(hand(pool).packets)
        for _ in range(10):
            await made.sense()
            await made.move(Reference.at(goal))
        spent = {c: n - before.get(c, 0) for c, n in hand(pool).packets.items()}
        assert spent.pop(Command.SET_CONTROL_COMMAND_ALL) == 10
        assert sum(spent.values()) <= 1


async def test_does_not_home_unless_allowed() -> None:
    spec = device(["Pinky"], home="on_demand")
    async with BusPool() as pool, driver(pool, spec) as made:
        await made.configure()
        with pytest.raises(DeviceFault, match=r"not homed.*rtee run --home"):
            await made.activate()
        assert not MOTION & set(hand(pool).packets)
        assert np.isnan((await made.sense()).position).all()
        await made.recover()
        assert not MOTION & set(hand(pool).packets)
        await made.activate()
        assert np.isfinite((await made.sense()).position).all()


async def test_attaches_to_a_hand_that_holds_without_moving_it(tmp_path: Path) -> None:
    names = ["Pinky", "Ring_Finger"]
    spec = device(names, stops_file=str(tmp_path / "state" / "stops.json"))
    async with BusPool() as pool:
        async with driver(pool, spec) as first:
            await first.configure()
            await first.activate()
            held = await settle(first, np.array([0.4, 0.3]))
        axis = hand(pool).channels[7].axis
        put(hand(pool), 7, held[1] / 0.98, 0.5)
        axis.target = -1e5
        axis.advance(1.0)
        held[1] = 0.98 * hand(pool).closure(7)
        before, grip, target = dict(hand(pool).packets), axis.effort, axis.target
        assert abs(grip) > 100.0
        async with driver(
            pool, device(names, stops_file=str(tmp_path / "state" / "stops.json"), home="on_demand")
        ) as second:
            await second.configure()
            await second.activate()
            state = await second.sense()
            assert state.position == pytest.approx(held, abs=1e-3)
            changed = {c for c, n in hand(pool).packets.items() if n != before.get(c, 0)}
            limits = {Command.SET_POSITION_SETTINGS, Command.SET_CURRENT_SETTINGS}
            assert not changed & {*MOTION, *limits, Command.SET_CONTROLLER_STATE}
            for _ in range(3):
                weak = np.full(2, 0.05)
                await second.move(Reference.at(state.position, max_effort=weak))
                await second.sense()
            assert (axis.effort, axis.target) == (grip, target)
            changed = {c for c, n in hand(pool).packets.items() if n != before.get(c, 0)}
            assert not changed & limits, "a smaller current would let go"
            await second.move(Reference.at(state.position - 0.1, max_effort=weak))
            changed = {c for c, n in hand(pool).packets.items() if n != before.get(c, 0)}
            assert Command.SET_CURRENT_SETTINGS in changed


async def test_stops_of_another_power_up_are_not_believed(tmp_path: Path) -> None:
    file = tmp_path / "stops.json"
    async with BusPool() as pool:
        async with driver(pool, device(["Pinky"], stops_file=str(file))) as first:
            await first.configure()
            await first.activate()
        file.write_text('{"stops": {"7": 900000}}')
        async with driver(pool, device(["Pinky"], stops_file=str(file))) as second:
            await second.configure()
            assert not second.stops


async def test_a_power_cycle_costs_the_zero() -> None:
    async with BusPool() as pool, driver(pool, device(["Pinky"])) as made:
        await made.configure()
        await made.activate()
        assert made.stops
        pool.simulations[PORT].power_cycle()
        await made.configure()
        assert not made.stops


async def test_limits_are_sent_before_the_position() -> None:
    spec = device(["Thumb_Flexion", "Pinky", "Ring_Finger"])
    async with BusPool() as pool, driver(pool, spec) as made:
        await made.configure()
        await made.activate()
        sent: list[Packet] = []
        pool.buses[0].trace = lambda _, way, data, __: (
            sent.append(Packet.from_bytes(data)) if way == "tx" else None
        )
        slow = Reference.at(
            np.full(3, 0.3), max_effort=np.array([0.2, 0.1, 0.1]), max_velocity=np.full(3, 0.2)
        )
        start = [round(channel.axis.target) for channel in hand(pool).channels]
        moved = set()
        for _ in range(4):
            await made.move(slow)
            currents = {p.channel for p in sent if p.command is Command.SET_CURRENT_SETTINGS}
            rates = {p.channel for p in sent if p.command is Command.SET_POSITION_SETTINGS}
            targets = codec.Targets.from_bytes(sent[-1].data).ticks
            changed = {i for i in range(9) if targets[i] != start[i]}
            assert changed <= currents & rates
            moved |= changed
        assert moved == {0, 6, 7}
        thumb = next(
            codec.CurrentSettings.from_bytes(p.data)
            for p in sent
            if p.command is Command.SET_CURRENT_SETTINGS and p.channel == 0
        )
        assert thumb.maximum == pytest.approx((0.2 / 0.106 + 1.543) / 0.015, rel=1e-5)
        pinky = next(
            codec.PositionSettings.from_bytes(p.data)
            for p in sent
            if p.command is Command.SET_POSITION_SETTINGS and p.channel == 7
        )
        assert pinky.max_rate == pytest.approx(0.2 / 2.1778e-5, rel=1e-4)
        before = len(sent)
        await made.move(slow)
        assert len(sent) == before + 1


async def test_feels_an_object_and_holds_it() -> None:
    async with BusPool() as pool, driver(pool, device(["Ring_Finger"])) as made:
        await made.configure()
        await made.activate()
        put(hand(pool), 6, 0.5, 2.0)
        end = monotonic.now() + 5.0
        state = await made.sense()
        while state.current[0] > -0.299 and monotonic.now() < end:
            await made.move(Reference.at(np.array([0.9])))
            await anyio.sleep(0.001)
            state = await made.sense()
        assert state.position[0] == pytest.approx(0.49, abs=0.02)
        assert state.current[0] == pytest.approx(-0.3, abs=0.01)
        assert state.effort[0] == pytest.approx((300 * 0.007 - 0.073) * 0.104, rel=0.02)


async def test_stop_holds_the_measured_pose_and_release_lets_go() -> None:
    async with BusPool() as pool, driver(pool, device(["Pinky"])) as made:
        await made.configure()
        await made.activate()
        await made.move(Reference.at(np.array([0.9]), max_velocity=np.array([0.02])))
        await made.move(Reference.at(np.array([0.9]), max_velocity=np.array([0.02])))
        await made.stop()
        where = (await made.sense()).position[0]
        assert where < 0.8
        await anyio.sleep(0.05)
        assert (await made.sense()).position[0] == pytest.approx(where, abs=0.05)
        await made.disable()
        assert not any(channel.axis.enabled for channel in hand(pool).channels)


@pytest.mark.parametrize("echo", [False, True])
async def test_a_driver_fault_is_named_and_recovered_without_motion(echo: bool) -> None:
    spec = device(["Pinky", "Thumb_Flexion"], emulator={"latch_echo": echo}, status_every=1)
    async with BusPool() as pool, driver(pool, spec) as made:
        await made.configure()
        await made.activate()
        before = await made.sense()
        hand(pool).inject("driver_fault")
        with pytest.raises(DeviceFault, match="rtee recover") as told:
            await made.sense()
        assert told.value.recoverable
        hand(pool).clear()
        moved = hand(pool).packets.get(Command.SET_CONTROL_COMMAND, 0)
        await made.recover()
        assert hand(pool).packets.get(Command.SET_CONTROL_COMMAND, 0) == moved
        # Where the fault cannot be told from a cut supply, the hand has to be homed again.
        assert bool(made.stops) is not echo
        await made.activate()
        if not echo:
            assert (await made.sense()).position == pytest.approx(before.position, abs=1e-3)
        assert all(hand(pool).channels[i].axis.enabled for i in (0, 7))


async def test_a_cut_supply_is_a_fault_that_needs_homing() -> None:
    spec = device(["Pinky"], home="on_demand", status_every=1)
    async with BusPool() as pool, driver(pool, spec) as made:
        await made.configure()
        await made.recover()
        await made.activate()
        pool.simulation("schunk_svh/svh").power_cycle()
        with pytest.raises(DeviceFault, match="switched off: Pinky"):
            await made.sense()
        with pytest.raises(DeviceFault, match="not homed"):
            await made.activate()


async def test_over_temperature_is_a_warning() -> None:
    spec = device(["Pinky"], status_every=1)
    async with BusPool() as pool, driver(pool, spec) as made:
        await made.configure()
        await made.activate()
        hand(pool).inject("over_temperature")
        assert "over-temperature" in (await made.sense()).warnings[0]


async def test_homing_that_meets_no_stop_fails_and_switches_off() -> None:
    spec = device(["Pinky"], home_timeout=0.5)
    async with BusPool() as pool, driver(pool, spec) as made:
        await made.configure()
        hand(pool).inject("stuck")
        hand(pool).channels[7].axis.gain = 0.0
        told: set[str] = set()
        async with anyio.create_task_group() as watching:

            async def watch() -> None:
                while True:
                    told.add(made.doing)
                    await anyio.sleep(0.005)

            watching.start_soon(watch)
            begun = monotonic.now()
            with pytest.raises(
                DeviceFault, match=r"Pinky does not move.*`rtee recover` homes again"
            ):
                await made.activate()
            # With the time that switching on and off takes.
            assert 0.5 <= monotonic.now() - begun < 1.5
            watching.cancel_scope.cancel()
        assert "homing Pinky, 1 of 1" in told
        assert made.doing == ""
        assert not hand(pool).channels[7].axis.enabled
        hand(pool).clear()
        hand(pool).channels[7].axis.gain = math.inf
        await made.recover()
        await made.activate()
        assert np.isfinite((await made.sense()).position).all()


async def test_another_device_is_refused() -> None:
    spec = device(["Pinky"], emulator={"name": "ABC"})
    async with BusPool() as pool, driver(pool, spec) as made:
        with pytest.raises(HandshakeError, match="expected an SVH, found 'ABC'"):
            await made.configure()


async def test_a_silent_port_is_named() -> None:
    async with BusPool() as pool, driver(pool, device(["Pinky"])) as made:
        await made.configure()
        hand(pool).inject("silent")
        with pytest.raises(NotConnected, match="24 V"):
            await made.configure()


async def test_firmware_two_keeps_its_own_controllers() -> None:
    spec = device(["Pinky"], emulator={"firmware": (2, 3)})
    async with BusPool() as pool, driver(pool, spec) as made:
        await made.configure()
        assert hand(pool).packets[Command.GET_CURRENT_SETTINGS] == 1
        await made.activate()
        assert hand(pool).packets[Command.SET_CURRENT_SETTINGS] >= 1


async def test_natural_replies_without_echoed_index_are_understood() -> None:
    spec = device(["Pinky"], emulator={"padded": False, "echo_index": False})
    async with BusPool() as pool, driver(pool, spec) as made:
        await made.configure()
        await made.activate()
        assert math.isfinite((await made.sense()).position[0])


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"prot": "/dev/x"}, "unknown option 'prot'"),
        ({"home": "always"}, "option 'home'"),
        ({"channels": {"Wrist": {}}}, "unknown channel 'Wrist'"),
    ],
)
def test_mistakes_in_options_are_told(options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        SchunkSvhDriver(device(**options), BusPool())


def test_an_actuator_that_is_no_channel_is_told() -> None:
    stranger = ActuatorSpec("wrist", JointKind.REVOLUTE, 0, 1, 1, 1, 1, 1, 0)
    spec = DeviceSpec("svh", "hand", "schunk_svh", (stranger,))
    with pytest.raises(ConfigError, match="actuator 'wrist' is not one of the SVH's"):
        SchunkSvhDriver(spec, BusPool())


def test_the_emulator_answers_a_client_that_knows_only_the_sheet() -> None:
    """Every packet gets exactly one reply with its address; settings come back as set."""
    svh = SchunkSvhEmulator()
    request = bytes.fromhex("4CAA033140 00".replace(" ", "")) + bytes.fromhex("204E") + bytes(62)
    request += bytes([0x6E, 0x6E])
    (reply,) = svh.feed(request, 0.0)
    assert reply[:6] == bytes.fromhex("4CAA03314000")
    assert len(reply) == 72
    assert reply[-2] == sum(reply[6:-2]) % 256
    broken = bytearray(request)
    broken[7] ^= 1
    assert svh.feed(bytes(broken), 0.01) == []
    assert len(svh.feed(request + request, 0.02)) == 2
    assert svh.early == 2


@pytest.mark.parametrize("command", [Command.SET_POSITION_SETTINGS, Command.SET_CURRENT_SETTINGS])
def test_the_emulator_takes_no_settings_that_are_no_numbers(command: Command) -> None:
    svh = SchunkSvhEmulator()
    before = svh.channels[3].position, svh.channels[3].current
    wrong = struct.pack("<10f", *[math.nan] * 10)
    assert len(svh.feed(Packet(command, 3, wrong).to_bytes(), 0.0)) == 1
    assert (svh.channels[3].position, svh.channels[3].current) == before
