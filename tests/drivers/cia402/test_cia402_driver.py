"""The CiA 402 driver against its emulator on a CAN bus."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from typing import Any

import anyio
import can
import canopen
import numpy as np
import pytest
from canopen.objectdictionary import ODVariable, datatypes
from canopen.profiles.p402 import BaseNode402

from rtee import monotonic
from rtee.buses.faults import Faults
from rtee.buses.pool import BusPool
from rtee.buses.simulated_can import SimulatedCan
from rtee.drivers.cia402 import cia301
from rtee.drivers.cia402.cia301 import Emergency, NmtState
from rtee.drivers.cia402.codec import State
from rtee.drivers.cia402.drive import DriveLink
from rtee.drivers.cia402.driver import Cia402Driver
from rtee.drivers.cia402.emulated_drive import DriveProperties
from rtee.drivers.cia402.emulator import Cia402Emulator
from rtee.errors import BusTimeout, ConfigError, DeviceFault, HandshakeError, NotConnected
from rtee.types import ActuatorSpec, DeviceSpec, JointKind, Reference
from tests.drivers.objects import obstruct
from tests.drivers.use import connecting

COUNTS = 4096 / (2 * np.pi)


def device(n: int = 1, *, kind: JointKind = JointKind.REVOLUTE, **options: Any) -> DeviceSpec:
    return DeviceSpec(
        name="gripper",
        hand="jaws",
        driver="cia402",
        actuators=tuple(
            ActuatorSpec(f"jaw{i}", kind, -1.0, 3.0, 8.0, 20.0, 400.0, 0.5, 0.0) for i in range(n)
        ),
        options={
            "nodes": {f"jaw{i}": {"id": 5 + i} for i in range(n)},
            "deadline": 0.3,
            **options,
        },
        emulated=True,
    )


connected = connecting(Cia402Driver)


def drives(pool: BusPool) -> Cia402Emulator:
    found = pool.played("jaws/gripper")
    assert isinstance(found, Cia402Emulator)
    return found


async def settle(made: Cia402Driver, goal: list[float], **limits: Any) -> np.ndarray:
    end = monotonic.now() + 5.0
    while True:
        state = await made.sense()
        await made.move(Reference.at(goal, **limits))
        if np.abs(state.position - goal).max() < 2e-3 or monotonic.now() > end:
            return state.position
        await anyio.sleep(0.01)


@pytest.mark.anyio
async def test_a_drive_that_another_master_stops_is_said_to_be_stopped() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        await made.activate()
        await made.sense()
        drives(pool).drives[5].node.state = NmtState.STOPPED
        # Its heartbeat tells its state.
        await anyio.sleep(0.15)
        sentence = r"node 5 \(it has left the operational state \(stopped by another master\)\)"
        with pytest.raises(BusTimeout, match=sentence):
            await made.sense()


@pytest.mark.anyio
async def test_a_drive_that_has_lost_the_hosts_heartbeat_says_so() -> None:
    async with BusPool() as pool, connected(pool, device(on_silence=0, watchdog=0.2)) as made:
        await made.activate()
        await made.sense()
        await anyio.sleep(0.5)
        with pytest.raises(BusTimeout, match=r"pre-operational: the host's heartbeat was lost"):
            await made.sense()
        await made.configure()
        await made.activate()
        assert await settle(made, [0.3]) == pytest.approx([0.3], abs=2e-3)


@pytest.mark.anyio
async def test_a_state_reported_during_set_up_does_not_explain_a_later_silence(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    set_up = DriveLink.set_up

    def reported(drive: DriveLink, *args: Any, **kwargs: Any) -> None:
        set_up(drive, *args, **kwargs)
        drive.nmt = NmtState.PRE_OPERATIONAL  # by a heartbeat

    monkeypatch.setattr(DriveLink, "set_up", reported)
    async with BusPool() as pool, connected(pool, device()) as made:
        assert [drive.absence for drive in made.link.drives] == [""]


@pytest.mark.anyio
async def test_an_emergency_without_a_fault_is_a_warning_until_it_ends() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        await made.activate()
        drive = drives(pool).drives[5]

        async def told(code: int) -> tuple[str, ...]:
            drive.emergencies.append(Emergency(code, cia301.error_register(code)))
            await made.sense()
            return (await made.sense()).warnings

        assert await told(0x4310) == (
            "node 5 (jaw0): emergency 4310h, over-temperature of the drive",
        )
        assert await told(0) == ()


@pytest.mark.anyio
@pytest.mark.parametrize("mode", ["profile_position", "cyclic_position"])
async def test_two_drives_move_and_tell_on_one_sync(mode: str) -> None:
    async with BusPool() as pool, connected(pool, device(2, mode=mode)) as made:
        assert made.capabilities.identity["model"] == "emulated CiA 402 drive"
        assert all(d.state is State.SWITCH_ON_DISABLED for d in drives(pool).drives.values())
        await made.activate()
        assert all(d.state is State.ENABLED for d in drives(pool).drives.values())
        assert await settle(made, [1.0, -0.5]) == pytest.approx([1.0, -0.5], abs=2e-3)
        assert drives(pool).drives[5].axis.position == pytest.approx(COUNTS, abs=2)
        sent: list[int] = []
        pool.buses[0].trace = lambda _, way, data, __: (
            sent.append(int.from_bytes(data[:4], "big")) if way == "tx" else None
        )
        for _ in range(3):
            await made.move(Reference.at([1.0, -0.5]))
            await made.sense()
        assert [i for i in sent if i != 0x77E] == [0x205, 0x206, 0x080] * 3


@pytest.mark.anyio
async def test_every_new_set_point_is_taken_in_profile_mode() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        await made.activate()
        for goal in (0.3, 0.31, 0.32, 0.33):
            await made.sense()
            await made.move(Reference.at([goal]))
        assert (await settle(made, [0.33]))[0] == pytest.approx(0.33, abs=2e-3)


@pytest.mark.anyio
async def test_limits_go_before_the_position_and_an_object_is_held_with_them() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        await made.activate()
        obstruct(drives(pool).drives[5].axis, 0.5 * COUNTS, 2.0)
        sent: list[int] = []
        pool.buses[0].trace = lambda _, way, data, __: (
            sent.append(int.from_bytes(data[:4], "big")) if way == "tx" else None
        )
        limits = {"max_effort": np.array([0.2]), "max_velocity": np.array([5.0])}
        await made.move(Reference.at([1.0], **limits))
        assert sent == [0x305, 0x205]
        await settle(made, [1.0], **limits)
        state = await made.sense()
        assert state.effort[0] == pytest.approx(0.2, rel=0.01)
        assert state.position[0] == pytest.approx(0.5 + 200 / COUNTS, abs=0.01)


@pytest.mark.anyio
@pytest.mark.parametrize("mode", ["profile_position", "cyclic_position"])
async def test_attaches_to_enabled_drives_without_moving_them(mode: str) -> None:
    async with BusPool() as pool:
        async with connected(pool, device(mode=mode)) as first:
            await first.activate()
            await settle(first, [0.7])
        await anyio.sleep(0.7)
        axis = drives(pool).drives[5].axis
        where, target = axis.position, axis.target
        assert drives(pool).drives[5].state is State.ENABLED
        async with connected(pool, device(mode=mode)) as second:
            await second.activate()
            assert (await second.sense()).position == pytest.approx([0.7], abs=2e-3)
            assert (axis.position, axis.target) == (where, target)
            assert await settle(second, [0.9]) == pytest.approx([0.9], abs=2e-3)


@pytest.mark.anyio
@pytest.mark.parametrize("mode", ["profile_position", "cyclic_position"])
async def test_what_is_held_is_not_dropped_by_attaching(mode: str) -> None:
    async with BusPool() as pool:
        async with connected(pool, device(mode=mode)) as first:
            await first.activate()
            obstruct(drives(pool).drives[5].axis, 0.5 * COUNTS, 2.0)
            await settle(first, [1.0], max_effort=np.array([0.2]))
        axis = drives(pool).drives[5].axis
        effort, target = axis.effort, axis.target
        assert effort == pytest.approx(400)
        async with connected(pool, device(mode=mode)) as second:
            await second.activate()
            here = (await second.sense()).position
            for _ in range(20):
                await second.move(Reference.at(here, max_effort=np.array([0.2])))
                here = (await second.sense()).position
            assert (axis.effort, axis.target) == (effort, target)
            assert await settle(second, [0.3]) == pytest.approx([0.3], abs=2e-3)


@pytest.mark.anyio
async def test_a_drive_that_misses_the_heartbeat_stops() -> None:
    async with BusPool() as pool, connected(pool, device(watchdog=0.1)) as made:
        assert made.capabilities.watchdog
        await made.activate()
        await made.sense()
        await anyio.sleep(0.25)
        assert drives(pool).drives[5].state is State.FAULT
        with pytest.raises(BusTimeout):
            await made.sense()


@pytest.mark.anyio
async def test_faults_are_named_and_recovered_without_motion() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        await made.activate()
        where = await settle(made, [0.4])
        drives(pool).inject("overcurrent")
        with pytest.raises(DeviceFault, match=r"node 5 \(jaw0\): overcurrent") as told:
            await made.sense()
        assert told.value.code == 0x2310
        assert told.value.hint == (
            "free the fingers, and check the motor's cable, then `rtee recover`"
        )
        with pytest.raises(DeviceFault, match="overcurrent"):
            await made.activate()
        with pytest.raises(DeviceFault, match="overcurrent"):
            await made.recover()
        drives(pool).clear()
        await made.recover()
        await made.activate()
        assert (await made.sense()).position == pytest.approx(where, abs=2e-3)
        assert await settle(made, [0.5]) == pytest.approx([0.5], abs=2e-3)


@pytest.mark.anyio
async def test_stop_holds_the_measured_pose_and_release_takes_the_voltage() -> None:
    async with BusPool() as pool, connected(pool, device(emulator={"speed": 2000})) as made:
        await made.activate()
        await made.move(Reference.at([3.0]))
        await made.sense()
        await anyio.sleep(0.1)
        await made.stop()
        where = (await made.sense()).position[0]
        await anyio.sleep(0.1)
        assert 0.1 < where < 2.0
        assert (await made.sense()).position[0] == pytest.approx(where, abs=0.05)
        await made.disable()
        assert drives(pool).drives[5].state is State.SWITCH_ON_DISABLED


@pytest.mark.anyio
@pytest.mark.parametrize("sampled", ["before", "after"])
async def test_stop_is_not_lost_behind_a_set_point_under_way(sampled: str) -> None:
    spec = device(emulator={"speed": 2000, "sampled": sampled})
    async with BusPool() as pool, connected(pool, spec) as made:
        await made.activate()
        for cycles in range(4):
            await settle(made, [0.0])
            await made.move(Reference.at([3.0]))
            for _ in range(cycles):
                await made.sense()
                await made.move(Reference.at([3.0]))
            await made.stop()
            assert drives(pool).drives[5].axis.target < COUNTS, cycles


@pytest.mark.anyio
async def test_old_news_of_homing_is_not_believed() -> None:
    nodes = {"jaw0": {"id": 5, "homing_method": 17}}
    emulator = {"homed": True, "lower": -500, "upper": 5000}
    spec = device(nodes=nodes, home="on_connect", emulator=emulator)
    async with BusPool() as pool, connected(pool, spec) as made:
        await made.activate()
        assert drives(pool).drives[5].axis.position == -500


@pytest.mark.anyio
async def test_homing_only_when_allowed() -> None:
    nodes = {"jaw0": {"id": 5, "homing_method": 17}}
    emulator = {"homed": False, "lower": -500, "upper": 5000}
    spec = device(nodes=nodes, emulator=emulator)
    async with BusPool() as pool, connected(pool, spec) as made:
        with pytest.raises(DeviceFault, match=r"not homed: jaw0.*rtee recover"):
            await made.activate()
        assert drives(pool).drives[5].axis.position == 0.0
        await made.recover()
        await made.activate()
        assert drives(pool).drives[5].homed
        assert drives(pool).drives[5].axis.position == -500
        assert await settle(made, [0.2]) == pytest.approx([0.2], abs=2e-3)
        pool.simulation("jaws/gripper").power_cycle()
        await anyio.sleep(0.02)
        await made.configure()
        with pytest.raises(DeviceFault, match="not homed"):
            await made.activate()


@pytest.mark.anyio
@pytest.mark.parametrize(("method", "home"), [(35, 0), (18, 5000), (1, -4096)])
async def test_home_is_the_zero_of_the_positions(method: int, home: int) -> None:
    nodes = {"jaw0": {"id": 5, "homing_method": method}}
    emulator = {"homed": False, "switches": [-5000, 5000]}
    spec = device(nodes=nodes, home="on_connect", emulator=emulator)
    async with BusPool() as pool, connected(pool, spec) as made:
        await made.activate()
        assert (await made.sense()).position == pytest.approx([0.0], abs=2e-3)
        assert drives(pool).drives[5].axis.position == home
        assert await settle(made, [0.2]) == pytest.approx([0.2], abs=2e-3)


@pytest.mark.anyio
async def test_a_homing_method_that_the_drive_lacks_is_a_fault() -> None:
    nodes = {"jaw0": {"id": 5, "homing_method": 3}}
    spec = device(nodes=nodes, home="on_connect", emulator={"homed": False})
    async with BusPool() as pool, connected(pool, spec) as made:
        with pytest.raises(DeviceFault, match="homing failed: jaw0"):
            await made.activate()


@pytest.mark.anyio
async def test_a_restarted_drive_has_to_be_set_up_anew() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        await made.activate()
        pool.simulation("jaws/gripper").power_cycle()
        await anyio.sleep(0.02)
        with pytest.raises((NotConnected, BusTimeout)):
            await made.sense()
        await made.configure()
        await made.activate()
        assert np.isfinite((await made.sense()).position).all()


class Losing(Faults):
    """Loses the first frames."""

    left = 2

    def copies(self) -> list[float]:
        self.left -= 1
        return [] if self.left >= 0 else [0.0]


@pytest.mark.anyio
async def test_lost_frames_do_not_end_the_set_up() -> None:
    spec = device(heartbeat=60.0, sdo_timeout=0.1)
    async with BusPool() as pool, connected(pool, spec) as made:
        await made.close()
        pool.simulation("jaws/gripper").faults = Losing()
        await made.configure()
        assert made.counters()["retries"] > 0


@pytest.mark.anyio
@pytest.mark.parametrize(
    ("options", "error", "sentence"),
    [
        ({"emulator": {"device_type": 401}}, HandshakeError, "profile 401"),
        ({"emulator": {"nodes": [9]}, "sdo_timeout": 0.05}, NotConnected, "node 5 .jaw0. does not"),
        (
            {"mode": "cyclic_position", "emulator": {"modes": [1]}},
            HandshakeError,
            "mode 8 in node 5, found modes 1",
        ),
        ({"nodes": {"jaw0": {"id": 5, "product": 7}}}, HandshakeError, "product 0x7 as node 5"),
        ({"emulator": {"increments": 0}}, HandshakeError, "give 'counts' per rad"),
    ],
)
async def test_other_devices_are_refused(
    options: dict[str, Any],
    error: type[Exception],
    sentence: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with BusPool() as pool:
        with pytest.raises(error, match=sentence):
            async with connected(pool, device(**options)):
                pass
    # The error says it; the canopen package logs its own words for it, too.
    assert not [record for record in caplog.records if record.name.startswith("canopen")]


@pytest.mark.parametrize(
    ("spec", "sentence"),
    [
        (device(nodes={"other": {"id": 1}}), "do not match: jaw0, other"),
        (device(2, nodes={"jaw0": {"id": 1}, "jaw1": {"id": 1}}), "same node id"),
        (device(kind=JointKind.PRISMATIC), "needs 'counts' per m"),
    ],
)
def test_mistakes_are_told(spec: DeviceSpec, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        Cia402Driver(spec, BusPool())


def _dictionary() -> canopen.ObjectDictionary:
    """The few objects that the package's own drive class needs."""
    found = canopen.ObjectDictionary()
    for index, kind in (
        (0x6040, datatypes.UNSIGNED16), (0x6041, datatypes.UNSIGNED16),
        (0x6060, datatypes.INTEGER8), (0x6061, datatypes.INTEGER8),
        (0x6064, datatypes.INTEGER32), (0x607A, datatypes.INTEGER32),
        (0x6098, datatypes.INTEGER8), (0x6502, datatypes.UNSIGNED32),
    ):  # fmt: skip
        variable = ODVariable(f"object {index:x}", index)
        variable.data_type = kind
        found.add_object(variable)
    return found


@contextlib.contextmanager
def foreign(emulated: Cia402Emulator, channel: str) -> Iterator[BaseNode402]:
    """Have the package's own 402 class and notifier on the bus; nothing of the driver's."""
    with (
        SimulatedCan([emulated], channel=channel),
        can.Bus(interface="virtual", channel=channel) as bus,
        can.Notifier(bus, [], timeout=0.05) as notifier,
    ):
        network = canopen.Network(bus)
        network.notifier = notifier
        for listener in network.listeners:
            notifier.add_listener(listener)
        node = BaseNode402(5, _dictionary())
        node.sdo.RESPONSE_TIMEOUT = 5.0  # a busy computer answers later than a drive
        network.add_node(node)
        node.nmt.state = "OPERATIONAL"
        yield node


@pytest.mark.parametrize(("method", "home"), [(35, 300), (37, 300), (18, 900), (17, -900)])
def test_the_canopen_package_homes_the_emulator(method: int, home: int) -> None:
    drives = DriveProperties(nodes=(5,), start=300.0, homed=False, switches=(-900.0, 900.0))
    emulated = Cia402Emulator(drives)
    with foreign(emulated, f"cia402-homing-{method}") as node:
        node.sdo[0x6098].raw = method
        assert node.homing(timeout=5)
        assert node.sdo[0x6064].raw == 0
        assert emulated.drives[5].axis.position == home


def test_the_canopen_package_hears_of_a_homing_error() -> None:
    with foreign(Cia402Emulator(DriveProperties(nodes=(5,))), "cia402-homing-3") as node:
        node.sdo[0x6098].raw = 3
        assert not node.homing(timeout=5)
        assert node.sdo[0x6041].raw & 0x3400 == 0x2400


def test_the_canopen_package_drives_the_emulator_by_sdo() -> None:
    with foreign(Cia402Emulator(DriveProperties(nodes=(5,))), "cia402-other") as node:
        node.sdo[0x6060].raw = 1
        for word, state in ((6, 0x21), (7, 0x23), (15, 0x27)):
            node.sdo[0x6040].raw = word
            time.sleep(0.01)
            assert node.sdo[0x6041].raw & 0x6F == state
        node.sdo[0x607A].raw = 1234
        node.sdo[0x6040].raw = 0x1F
        end = monotonic.now() + 3.0
        while node.sdo[0x6064].raw != 1234 and monotonic.now() < end:
            time.sleep(0.01)
        assert node.sdo[0x6064].raw == 1234
        assert node.sdo.upload(0x1008, 0) == b"emulated CiA 402 drive"
        with pytest.raises(canopen.SdoAbortedError, match="0x06020000"):
            node.sdo.upload(0x2345, 0)
