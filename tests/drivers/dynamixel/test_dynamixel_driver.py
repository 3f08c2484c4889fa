"""The Dynamixel driver (dynamixel-sdk) against the emulated servos (our own bytes)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest

from rtee import monotonic
from rtee.buses.faults import Faults
from rtee.buses.pool import BusPool
from rtee.drivers.dynamixel import table
from rtee.drivers.dynamixel.codec import (
    BROADCAST,
    STATUS,
    Hardware,
    Instruction,
    StatusPacket,
    crc16,
)
from rtee.drivers.dynamixel.driver import DynamixelDriver
from rtee.drivers.dynamixel.emulator import DynamixelEmulator
from rtee.drivers.dynamixel.table import Mode
from rtee.drivers.servo_lines import ServoScale, ServoScales
from rtee.errors import (
    BusError,
    BusTimeout,
    CalibrationError,
    ConfigError,
    DeviceFault,
    HandshakeError,
    NotConnected,
)
from rtee.types import ActuatorSpec, DeviceSpec, JointKind, Mechanism, Reference
from tests.drivers.objects import obstruct
from tests.drivers.use import connecting, lose

pytestmark = pytest.mark.anyio
WRITES = {Instruction.WRITE, Instruction.SYNC_WRITE, Instruction.REBOOT}


def device(n: int = 2, *, limits: tuple[float, float] = (-1.0, 2.0), **options: Any) -> DeviceSpec:
    return DeviceSpec(
        name="line",
        hand="leap_hand",
        driver="dynamixel",
        actuators=tuple(
            ActuatorSpec(f"j{i}", JointKind.REVOLUTE, *limits, 8.0, 20.0, 400.0, 0.5, 0.0)
            for i in range(n)
        ),
        options={
            "port": "/dev/dxl",
            "deadline": 0.3,
            "retries": 9,
            "servos": {f"j{i}": {"id": i} for i in range(n)},
            **options,
        },
        emulated=True,
    )


connected = connecting(DynamixelDriver)


def line(pool: BusPool) -> DynamixelEmulator:
    found = pool.played("leap_hand/line")
    assert isinstance(found, DynamixelEmulator)
    return found


def written(pool: BusPool) -> int:
    return sum(line(pool).counts.get(kind, 0) for kind in WRITES)


async def settle(made: DynamixelDriver, goal: list[float], **limits: Any) -> np.ndarray:
    end = monotonic.now() + 5.0
    while True:
        state = await made.sense()
        await made.move(Reference.at(goal, **limits))
        if np.abs(state.position - goal).max() < 2e-3 or monotonic.now() > end:
            return state.position
        await anyio.sleep(0.002)


@pytest.mark.parametrize("fast", ["auto", "never"])
async def test_moves_and_senses_in_one_read_and_one_write(fast: str) -> None:
    servos = {"j0": {"id": 0}, "j1": {"id": 1, "direction": -1}}
    spec = device(fast=fast, servos=servos, health_every=100_000)
    async with BusPool() as pool, connected(pool, spec) as made:
        assert written(pool) == 0
        assert made.capabilities.identity["model"] == "2 x XL330-M288"
        await made.activate()
        assert await settle(made, [0.5, 0.7]) == pytest.approx([0.5, 0.7], abs=2e-3)
        servos = line(pool).servos
        assert servos[0].axis.position == pytest.approx(2048 + 0.5 / table.RAD_PER_PULSE, abs=2)
        assert servos[1].axis.position == pytest.approx(2048 - 0.7 / table.RAD_PER_PULSE, abs=2)
        await made.sense()
        retries = -1
        while retries != made.counters()["retries"]:
            retries = made.counters()["retries"]
            before = dict(line(pool).counts)
            await made.move(Reference.at([0.5, 0.7]))
            state = await made.sense()
            spent = {c: k - before.get(c, 0) for c, k in line(pool).counts.items()}
        read = Instruction.FAST_SYNC_READ if fast == "auto" else Instruction.SYNC_READ
        assert {c: k for c, k in spent.items() if k} == {read: 1, Instruction.SYNC_WRITE: 1}
        assert state.temperature == pytest.approx([25.0, 25.0], abs=1.0)
        assert state.extras["voltage"] == pytest.approx([5.0, 5.0])


async def test_servos_without_fast_read_are_read_the_plain_way() -> None:
    spec = device(emulator={"fast": False})
    async with BusPool() as pool, connected(pool, spec) as made:
        assert made.capabilities.identity["read"] == "sync read"
        assert np.isfinite((await made.sense()).position).all()


async def test_activation_sets_up_and_powers_where_they_stand() -> None:
    spec = device(
        p=600, d=200, current=0.35,
        servos={"j0": {"id": 0, "p": 450}, "j1": {"id": 1, "current": 0.2}},
        emulator={"servo": {"start": 2300.0}},
    )  # fmt: skip
    async with BusPool() as pool, connected(pool, spec) as made:
        await made.activate()
        for number, (p, current) in enumerate(((450, 350), (600, 200))):
            servo = line(pool).servos[number]
            assert servo.get(table.OPERATING_MODE) == Mode.CURRENT_BASED_POSITION
            assert servo.get(table.RETURN_DELAY) == 0
            assert servo.get(table.POSITION_P) == p
            assert servo.get(table.POSITION_D) == 200
            assert servo.get(table.GOAL_CURRENT) == current
            assert servo.get(table.GOAL_POSITION) == 2300
            assert servo.get(table.TORQUE) == 1
        await anyio.sleep(0.05)
        assert (await made.sense()).position == pytest.approx(
            [252 * table.RAD_PER_PULSE] * 2, abs=2e-3
        )


async def test_attaches_to_powered_servos_without_a_write_of_motion() -> None:
    async with BusPool() as pool:
        async with connected(pool, device()) as first:
            await first.activate()
            await settle(first, [0.4, 0.6])
        goals = [s.get(table.GOAL_POSITION) for s in line(pool).servos.values()]
        async with connected(pool, device()) as second:
            before = line(pool).counts.get(Instruction.WRITE, 0)
            await second.activate()
            assert (await second.sense()).position == pytest.approx([0.4, 0.6], abs=2e-3)
            assert line(pool).counts.get(Instruction.WRITE, 0) == before
        assert goals == [s.get(table.GOAL_POSITION) for s in line(pool).servos.values()]


async def test_limits_are_written_before_the_position_and_only_when_they_change() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        await made.activate()
        sent: list[bytes] = []
        pool.buses[0].trace = lambda _, way, data, __: sent.append(data) if way == "tx" else None
        limits = {"max_effort": np.array([0.1, 0.2]), "max_velocity": np.array([1.0, 2.0])}
        await made.move(Reference.at([0.1, 0.1], **limits))
        addresses = [int.from_bytes(packet[8:10], "little") for packet in sent]
        assert addresses == [102, 112, 116]
        first = int.from_bytes(sent[0][13:15], "little")
        assert first == round(0.1 / (0.52 / 1.47) * 1000)
        sent.clear()
        await made.move(Reference.at([0.2, 0.2], **limits))
        assert [packet[8] for packet in sent] == [116]


async def test_an_object_is_held_with_the_effort_limit() -> None:
    async with BusPool() as pool, connected(pool, device(1)) as made:
        await made.activate()
        obstruct(line(pool).servos[0].axis, 2048 + 300, 5.0)
        limit = np.array([0.15])
        end = monotonic.now() + 5.0
        state = await made.sense()
        while state.effort[0] < 0.98 * limit[0] and monotonic.now() < end:
            await made.move(Reference.at([1.2], max_effort=limit))
            await anyio.sleep(0.002)
            state = await made.sense()
        assert state.effort == pytest.approx(limit, rel=0.02)
        assert state.current == pytest.approx(limit / (0.52 / 1.47), rel=0.02)
        assert state.position[0] == pytest.approx((300 + 424 / 5) * table.RAD_PER_PULSE, abs=0.01)


async def test_a_joint_across_the_wrap_is_read_in_its_turn() -> None:
    spec = device(1, servos={"j0": {"id": 0, "zero": 4000}}, emulator={"servo": {"start": 4200.0}})
    async with BusPool() as pool, connected(pool, spec) as made:
        # After power-up the servo reads 104, a turn less than where it stands.
        assert line(pool).servos[0].position == 104
        assert (await made.sense()).position[0] == pytest.approx(200 * table.RAD_PER_PULSE)
        await made.activate()
        await settle(made, [-0.5])
        assert line(pool).servos[0].axis.position == pytest.approx(
            4000 - 0.5 / table.RAD_PER_PULSE, abs=3
        )


async def test_limits_tell_the_turn_of_a_mechanism_that_has_several() -> None:
    spec = device(
        1,
        limits=(1.0, 6.0),
        servos={"j0": {"id": 0, "zero": 0}},
        emulator={"servo": {"start": 5.5 / table.RAD_PER_PULSE}},
    )
    wide = replace(spec, mechanisms={"j0": Mechanism(-6.28, 6.28, 0.5)})
    async with BusPool() as pool, connected(pool, wide) as made:
        assert (await made.sense()).position[0] == pytest.approx(5.5, abs=table.RAD_PER_PULSE)


async def test_a_range_across_the_wrap_is_refused_in_position_mode() -> None:
    spec = device(1, mode="position", servos={"j0": {"id": 0, "zero": 4000}})
    async with BusPool() as pool:
        with pytest.raises(ConfigError, match="crosses the turn"):
            async with connected(pool, spec):
                pass


async def test_a_joint_far_outside_its_limits_is_a_wrong_calibration() -> None:
    spec = device(1, limits=(-0.2, 0.2), emulator={"servo": {"start": 3000.0}})
    async with BusPool() as pool:
        with pytest.raises(CalibrationError, match="two ids are swapped"):
            async with connected(pool, spec):
                pass


async def test_missing_and_wrong_servos_are_named() -> None:
    servos = {f"j{i}": {"id": i, "model": 1200} for i in range(4)}
    spec = device(
        4, servos=servos,
        emulator={"ids": [0, 1, 3], "special": {1: {"model": 1240}}},
    )  # fmt: skip
    async with BusPool() as pool:
        with pytest.raises(HandshakeError) as told:
            async with connected(pool, spec):
                pass
        assert "expected servos 0 to 3, found no 2; 1 (j1) is XC330-M288, not XL330-M288" in str(
            told.value
        )


async def test_a_model_that_is_not_known_is_driven_with_the_units_given() -> None:
    servo = {"id": 0, "model": 1000, "current_unit": 0.00269, "torque_per_ampere": 2.0}
    spec = device(1, servos={"j0": servo}, emulator={"servo": {"model": 1000}})
    async with BusPool() as pool, connected(pool, spec) as made:
        assert {"current", "effort"} <= made.capabilities.measures
        await made.activate()
        await made.move(Reference.at([0.1], max_effort=np.array([0.538])))
        await made.sense()  # answered after what was written before
        assert line(pool).servos[0].get(table.GOAL_CURRENT) == 100


async def test_a_reversed_drive_mode_is_named() -> None:
    spec = device(1, emulator={"servo": {"drive_mode": 1}})
    async with BusPool() as pool:
        with pytest.raises(HandshakeError, match="drive mode 1; its sense of rotation"):
            async with connected(pool, spec):
                pass


async def test_a_silent_line_is_named() -> None:
    async with BusPool() as pool:
        with pytest.raises(NotConnected, match="none of 2 servos answers"):
            async with connected(pool, device(emulator={"ids": []}, retries=0, deadline=0.01)):
                pass


async def test_an_overload_is_named_and_a_reboot_recovers_without_motion() -> None:
    spec = device(2, emulator={"servo": {"reboot_time": 0.1}})
    async with BusPool() as pool, connected(pool, spec) as made:
        await made.activate()
        where = await settle(made, [0.3, 0.3])
        line(pool).servos[1].fail(Hardware.OVERLOAD)
        with pytest.raises(DeviceFault, match=r"overload in servo 1 \(j1\).*rtee recover") as told:
            await made.sense()
        assert told.value.code == Hardware.OVERLOAD
        await made.recover()
        await made.activate()
        assert (await made.sense()).position == pytest.approx(where, abs=2e-3)
        assert await settle(made, [0.1, 0.1]) == pytest.approx([0.1, 0.1], abs=2e-3)


async def test_lost_torque_and_a_tripped_watchdog_are_noticed() -> None:
    spec = device(1, health_every=1, watchdog=0.3)
    async with BusPool() as pool, connected(pool, spec) as made:
        await made.activate()
        assert made.capabilities.watchdog
        servo = line(pool).servos[0]
        assert servo.get(table.BUS_WATCHDOG) == 15
        await made.sense()
        await anyio.sleep(0.5)
        with pytest.raises(DeviceFault, match="watchdog tripped: servo 0"):
            await made.sense()
        await made.recover()
        await made.activate()
        await made.sense()
        servo.set(table.TORQUE, 0)
        with pytest.raises(DeviceFault, match="torque lost: servo 0"):
            await made.sense()


async def test_servos_that_a_watchdog_has_stopped_are_powered_after_they_were_limp() -> None:
    async with BusPool() as pool, connected(pool, device(watchdog=0.1)) as made:
        await made.activate()
        await anyio.sleep(0.3)
        await made.disable()
        assert [each.get(table.BUS_WATCHDOG) for each in line(pool).servos.values()] == [-1] * 2
        for each in line(pool).ordered:
            each.axis.position += 200.0  # away from the goal, which a tripped watchdog locks
        await made.activate()
        assert await settle(made, [0.3, 0.3]) == pytest.approx([0.3, 0.3], abs=2e-3)


def spinning(servo: Any) -> None:
    """Leave a servo as another program may: powered, and turning without a goal."""
    servo.set(table.OPERATING_MODE, Mode.VELOCITY)
    servo.set(table.TORQUE, 1)
    servo.set(table.GOAL_VELOCITY, 20)
    servo._act()


async def test_a_servo_that_another_program_has_powered_in_another_mode_is_named() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        second = line(pool).servos[1]
        spinning(second)
        await made.configure()
        sentence = r"powered in operating mode 1, not 5: servo 1 \(j1\)"
        for ask in (made.examine, made.activate):
            with pytest.raises(DeviceFault, match=sentence) as found:
                await ask()
        assert (found.value.code, "rtee recover" in found.value.hint) == (0x102, True)
        assert not made.active
        await made.recover()
        assert second.get(table.TORQUE) == 0
        at = second.position
        await made.activate()
        assert second.get(table.OPERATING_MODE) == Mode.CURRENT_BASED_POSITION
        assert second.get(table.GOAL_POSITION) == pytest.approx(at, abs=2)
        assert await settle(made, [0.3, 0.3]) == pytest.approx([0.3, 0.3], abs=2e-3)


async def test_a_stop_ends_the_motion_of_a_servo_in_another_mode() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        first, second = line(pool).ordered
        first.set(table.OPERATING_MODE, Mode.CURRENT_BASED_POSITION)
        first.set(table.TORQUE, 1)
        first._act()
        spinning(second)
        await made.configure()
        await anyio.sleep(0.1)
        assert (await made.sense()).velocity[1] > 0.1
        await made.stop()
        await anyio.sleep(0.1)
        assert (await made.sense()).velocity.tolist() == pytest.approx([0.0, 0.0], abs=0.03)
        # One that follows goals keeps its power.
        assert [first.get(table.TORQUE), second.get(table.TORQUE)] == [1, 0]


def gripping(servo: Any, mode: Mode) -> None:
    """Leave a servo as another program may: on its slow way to a goal, in a position mode."""
    servo.set(table.OPERATING_MODE, mode)
    servo.set(table.TORQUE, 1)
    servo.set(table.PROFILE_VELOCITY, 10)
    servo.set(table.GOAL_POSITION, 3000)
    servo._act()


@pytest.mark.parametrize("mode", [Mode.POSITION, Mode.EXTENDED_POSITION])
async def test_servos_in_another_position_mode_keep_their_torque(mode: Mode) -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        for each in line(pool).ordered:
            gripping(each, mode)
        await made.configure()
        await made.stop()
        for each in line(pool).ordered:
            assert each.get(table.TORQUE) == 1
            assert each.get(table.GOAL_POSITION) == pytest.approx(each.position, abs=20)
        await made.recover()
        assert [each.get(table.TORQUE) for each in line(pool).ordered] == [1, 1]
        with pytest.raises(DeviceFault, match=f"operating mode {mode:d}, not 5.*hold what they"):
            await made.activate()
        for each in line(pool).ordered:
            each.set(table.TORQUE, 0)
        await made.activate()


async def test_a_servo_beyond_its_limits_is_stopped_at_the_nearest_in_another_mode() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        for each in line(pool).ordered:
            gripping(each, Mode.POSITION)
            each.set(table.MAX_POSITION, each.position - 10)
        await made.configure()
        await made.stop()
        for each in line(pool).ordered:
            assert each.get(table.GOAL_POSITION) == each.get(table.MAX_POSITION)


@pytest.mark.parametrize("mode", [Mode.EXTENDED_POSITION, Mode.CURRENT_BASED_POSITION])
async def test_a_stop_does_not_move_servos_beyond_limits_that_their_mode_ignores(
    mode: Mode,
) -> None:
    async with BusPool() as pool, connected(pool, device(mode="position")) as made:
        for each in line(pool).ordered:
            gripping(each, mode)
            each.set(table.MAX_POSITION, each.position - 300)
        await made.configure()
        await made.stop()
        for each in line(pool).ordered:
            assert each.get(table.GOAL_POSITION) == pytest.approx(each.position, abs=20)


@pytest.mark.parametrize("fast", ["auto", "never"])
@pytest.mark.parametrize("n", [4, 16])
async def test_a_stop_at_a_low_baud_rate_needs_no_retries(n: int, fast: str) -> None:
    spec = device(n, baudrate=57600, health_every=10_000, fast=fast)
    async with BusPool() as pool, connected(pool, spec) as made:
        await made.activate()
        await made.stop()
        retries, begun = made.counters()["retries"], monotonic.now()
        await made.stop()
        assert made.counters()["retries"] == retries
        assert monotonic.now() - begun < 0.15


async def test_a_servo_that_keeps_its_torque_does_not_prevent_the_stop_of_the_others() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        first, second = line(pool).ordered
        gripping(first, Mode.CURRENT_BASED_POSITION)
        spinning(second)
        await made.configure()
        write = second.write
        second.write = lambda at, data: 0 if at == table.TORQUE.address else write(at, data)
        await made.stop()
        assert first.get(table.GOAL_POSITION) == pytest.approx(first.position, abs=20)


async def test_servos_that_answer_nothing_but_reads_are_set_up() -> None:
    """As the program of an ORCA hand leaves them: status return level 1."""
    async with BusPool() as pool, connected(pool, device()) as made:
        for each in line(pool).ordered:
            each.set(table.STATUS_RETURN_LEVEL, 1)
        await made.activate()
        for each in line(pool).ordered:
            assert each.get(table.OPERATING_MODE) == Mode.CURRENT_BASED_POSITION
            assert each.get(table.RETURN_DELAY) == 0
        assert made.counters()["timeouts"] == 0


async def test_servos_that_answer_nothing_but_pings_are_named() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        line(pool).ordered[1].set(table.STATUS_RETURN_LEVEL, 0)
        with pytest.raises(NotConnected, match=r"servo 1 answers pings, but no reads.*address 68"):
            await made.configure()
        line(pool).power_cycle(monotonic.now())
        await anyio.sleep(0.5)
        await made.configure()


async def test_a_read_lost_to_a_short_disturbance_does_not_blame_the_return_level() -> None:
    async with BusPool() as pool, connected(pool, device(retries=0)) as made:
        emulator, answers = line(pool), DynamixelEmulator.answers
        lost: list[Any] = []

        def lossy(frame: Any, now: float) -> list[bytes]:
            came = answers(emulator, frame, now)
            if frame.instruction == Instruction.FAST_SYNC_READ and not lost:
                lost.append(frame)
                return []
            return came

        emulator.answers = lossy  # type: ignore[method-assign]
        assert await made.link.data(0, 0, 2) == (1200).to_bytes(2, "little")
        assert lost


async def test_what_another_program_left_does_not_slow_or_weaken_the_motors() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        for each in line(pool).ordered:
            each.set(table.GOAL_PWM, 20)
            each.set(table.PROFILE_ACCELERATION, 1)
            each.set(table.PROFILE_VELOCITY, 1)
        lent = made._hold

        async def hold(*args: Any, **kwargs: Any) -> None:
            # Before the first goal, whose limits set the profile velocity, too.
            assert [s.get(table.PROFILE_VELOCITY) for s in line(pool).ordered] == [0, 0]
            await lent(*args, **kwargs)

        made._hold = hold  # type: ignore[method-assign]
        await made.activate()
        for each in line(pool).ordered:
            assert each.get(table.GOAL_PWM) == 885
            assert each.get(table.PROFILE_ACCELERATION) == 0
        assert await settle(made, [0.5, 0.5]) == pytest.approx([0.5, 0.5], abs=2e-3)


@pytest.mark.parametrize("register", [table.GOAL_PWM, table.PROFILE_VELOCITY])
async def test_a_servo_that_keeps_another_power_or_profile_is_activated(
    register: table.Register,
) -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        first = line(pool).ordered[0]
        first.set(register, 7)
        write = first.write
        first.write = lambda at, data: 0 if at == register.address else write(at, data)
        await made.activate()
        assert first.get(table.TORQUE) == 1


@pytest.mark.parametrize("fast", ["auto", "never"])
@pytest.mark.parametrize(
    "timing",
    [{"retries": 1}, {"retries": 2, "deadline": 0.03}],
    ids=["patient", "default"],
)
async def test_the_one_servo_that_falls_silent_is_named(fast: str, timing: dict[str, Any]) -> None:
    async with BusPool() as pool, connected(pool, device(3, fast=fast, **timing)) as made:
        await made.activate()
        line(pool).ordered[1].silent_until = math.inf
        for _ in range(3):
            with pytest.raises(BusTimeout, match=r"no answer from servo 1$"):
                await made.sense()
        line(pool).ordered[0].silent_until = math.inf
        await anyio.sleep(0.5)  # after which it is found out again
        with pytest.raises(BusTimeout, match=r"no answer$"):
            await made.sense()


async def test_finding_out_who_is_silent_takes_the_place_of_a_retry_and_is_rare() -> None:
    spec = device(3, retries=2, deadline=0.03, health_every=10_000)
    async with BusPool() as pool, connected(pool, spec) as made:
        await made.activate()
        await made.sense()
        before = dict(line(pool).counts)
        line(pool).ordered[1].silent_until = math.inf
        for _ in range(4):
            with pytest.raises(BusTimeout):
                await made.sense()
        kinds = (Instruction.FAST_SYNC_READ, Instruction.SYNC_READ)
        spent = [line(pool).counts[kind] - before.get(kind, 0) for kind in kinds]
        assert spent == [4 * 3 - 1, 1]


async def test_on_a_slow_line_one_lost_answer_fails_one_exchange() -> None:
    spec = device(16, baudrate=57600, retries=2, deadline=0.03, health_every=10_000)
    async with BusPool() as pool, connected(pool, spec) as made:
        await made.activate()
        await made.sense()
        emulator, answers = line(pool), DynamixelEmulator.answers
        lost: list[Any] = []

        def lossy(frame: Any, now: float) -> list[bytes]:
            came = answers(emulator, frame, now)
            if not lost:
                lost.append(frame)
                return [came[0][: len(came[0]) // 2]]
            return came

        emulator.answers = lossy  # type: ignore[method-assign]
        with pytest.raises(BusError):
            await made.sense()
        await made.sense()


async def test_an_answer_to_an_earlier_request_is_not_taken_for_this_one() -> None:
    spec = device(fast="never", deadline=0.5)
    async with BusPool() as pool, connected(pool, spec) as made:
        await made.activate()
        emulator, answers = line(pool), DynamixelEmulator.answers
        late: list[bytes] = []

        def behind(frame: Any, now: float) -> list[bytes]:
            came = answers(emulator, frame, now)
            before = [late.pop()] if late else []
            return [*before, *came]

        emulator.answers = behind  # type: ignore[method-assign]
        retries = made.counters()["retries"]
        # The state of servo 0, ten bytes whose first one is not its torque.
        late.append(StatusPacket(0, 0, bytes(range(10))).to_bytes())
        assert await made.link.values(table.TORQUE, [0]) == {0: 1}
        late.append(StatusPacket(0, 0, bytes(range(10))).to_bytes())
        assert await made.link.model(0) == 1200
        assert made.counters()["retries"] == retries, "the answer behind it was waited for"


async def test_stop_holds_and_release_lets_go() -> None:
    async with BusPool() as pool, connected(pool, device(1)) as made:
        await made.activate()
        slow = {"max_velocity": np.array([0.5])}
        await made.move(Reference.at([1.5], **slow))
        await anyio.sleep(0.1)
        await made.stop()
        where = (await made.sense()).position[0]
        await anyio.sleep(0.1)
        assert 0.0 < where < 0.5
        assert (await made.sense()).position[0] == pytest.approx(where, abs=0.03)
        await made.disable()
        await made.sense()
        assert line(pool).servos[0].get(table.TORQUE) == 0


async def test_gains_reach_the_servos() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        await made.set_gains({"p": 321.4})
        await made.sense()
        assert line(pool).servos[1].get(table.POSITION_P) == 321


async def test_lost_and_damaged_packets_are_retried() -> None:
    async with BusPool() as pool, connected(pool, device(retries=5)) as made:
        await made.activate()
        simulation = pool.simulation("leap_hand/line")
        simulation.faults = Faults(drop=0.1, corrupt=0.1, noise=0.1, split=0.1, seed=3)
        failed = 0
        for _ in range(60):
            try:
                await made.sense()
                await made.move(Reference.at([0.2, 0.2]))
            except BusError:
                failed += 1
        assert failed < 20
        assert made.counters()["retries"] > 0
        simulation.faults = Faults()
        assert np.isfinite((await made.sense()).position).all()


class AnswersForAnother(Faults):
    """Has the second servo give the first one's id in its answers, which are valid otherwise."""

    def apply(self, data: bytes) -> list[tuple[float, bytes]]:
        changed = bytearray(data)
        if len(data) > 8 and data[7] == STATUS:
            if data[4] == BROADCAST:  # the one answer to a fast read: a part for each servo
                changed[8 + (len(data) - 8) // 2 + 1] = 0
            elif data[4] == 1:
                changed[4] = 0
            changed[-2:] = crc16(changed[:-2]).to_bytes(2, "little")
        return [(0.0, bytes(changed))]


@pytest.mark.parametrize("fast", ["auto", "never"])
async def test_a_group_in_which_a_servo_answers_for_another_is_refused(fast: str) -> None:
    spec = device(fast=fast, retries=1, deadline=0.1)
    async with BusPool() as pool, connected(pool, spec) as made:
        await made.activate()
        before = await made.sense()
        simulation = pool.simulation("leap_hand/line")
        simulation.faults = AnswersForAnother()
        with pytest.raises(BusError, match=r"damaged|no answer"):
            await made.sense()
        simulation.faults = Faults()
        assert (await made.sense()).position == pytest.approx(before.position, abs=2e-3)


class DamagesRequests(Faults):
    """Flips a bit in every second request to a single servo, none in answers."""

    def apply(self, data: bytes) -> list[tuple[float, bytes]]:
        asks = len(data) > 7 and data[4] != BROADCAST and data[7] != STATUS
        self.injected["corrupt"] += asks
        if asks and self.injected["corrupt"] % 2:
            return [(0.0, data[:-1] + bytes([data[-1] ^ 1]))]
        return [(0.0, data)]


async def test_what_a_servo_heard_damaged_is_said_again() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        simulation = pool.simulation("leap_hand/line")
        simulation.faults = damages = DamagesRequests()
        await made.close()
        await made.configure()
        await made.activate()
        assert damages.injected["corrupt"] > 2
        assert made.counters()["checksum_errors"] > 0, "the servos told of it"
        assert made.counters()["timeouts"] == 0


async def test_an_adapter_that_keeps_bytes_back_is_waited_for() -> None:
    async with BusPool() as pool, connected(pool, device(turnaround=0.016, deadline=0.2)) as made:
        await made.activate()
        before = made.counters()["timeouts"]
        for _ in range(5):
            state = await made.sense()
            await made.move(Reference.at(state.position))
        assert made.counters()["timeouts"] == before


async def test_calibration_is_taken_stored_and_compared(tmp_path: Path) -> None:
    path = tmp_path / "calibration" / "leap.json"
    plain = device(emulator={"servo": {"start": 1111.0}}, outside=10.0)
    async with BusPool() as pool:
        async with connected(pool, plain) as made:
            prompts: list[str] = []

            async def ready(text: str) -> None:
                prompts.append(text)

            found = await made.calibrate(path, np.array([0.0, 0.5]), ready)
            assert len(prompts) == 1
            assert found[0].zero == pytest.approx(1111)
        stored = device(emulator={"servo": {"start": 1111.0}}, calibration=str(path))
        async with connected(pool, stored) as made:
            assert (await made.sense()).position == pytest.approx([0.0, 0.5], abs=1e-3)
        line(pool).servos[1].set(table.HOMING_OFFSET, 7)
        with pytest.raises(CalibrationError, match=r"'j1' has changed since.*homing offset is 7"):
            async with connected(pool, stored):
                pass


def test_a_missing_calibration_is_told(tmp_path: Path) -> None:
    from rtee.drivers.servo_lines import read_calibration

    with pytest.raises(CalibrationError, match="rtee calibrate"):
        read_calibration(tmp_path / "none.json", "line")
    (tmp_path / "bad.json").write_text('{"servos": [{"id": 1}]}')
    with pytest.raises(CalibrationError, match="not a calibration"):
        read_calibration(tmp_path / "bad.json", "line")


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"servos": {"j0": {"id": 1}}}, "these do not match: j1"),
        ({"servos": {"j0": {"id": 1}, "j1": {"id": 1}}}, "same id"),
        ({"baudrate": 1234}, "baudrate must be one of"),
        ({"mode": "velocity"}, "mode"),
    ],
)
def test_mistakes_in_options_are_told(options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        DynamixelDriver(device(**options), BusPool())


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("gear", [1.0, 2.5])
def test_units_have_inverses(direction: int, gear: float) -> None:
    effort = 0.001 * 0.35 * gear
    scale = ServoScale(
        table.RAD_PER_PULSE,
        1000.0,
        direction,
        gear,
        table.VELOCITY_UNIT,
        effort_unit=effort,
        limit_unit=effort,
    )
    for angle in np.linspace(-0.6, 0.6, 25):
        pulses = scale.to_counts(float(angle))
        assert scale.to_rad(pulses) == pytest.approx(angle, abs=table.RAD_PER_PULSE / gear * 0.51)
        for lost in (-2, -1, 0, 1, 3):
            other = ServoScale(table.RAD_PER_PULSE, 1000.0, direction, gear)
            other.unwrap(pulses + lost * table.PULSES, -0.6, 0.6)
            assert other.to_rad(pulses + lost * table.PULSES) == pytest.approx(scale.to_rad(pulses))
    counts = scale.to_speed(1.0)
    assert counts * table.VELOCITY_UNIT / gear == pytest.approx(1.0, rel=0.02)
    assert scale.to_limit(0.2) * scale.effort_unit == pytest.approx(0.2, rel=0.01)
    column = np.array([[1000.0], [0.0], [400.0], [400.0], [25.0], [50.0]])
    assert ServoScales([scale]).measured(column).torque == pytest.approx([400 * effort * direction])
    assert np.isnan(ServoScales([ServoScale(1.0, 0.0)]).measured(column).torque).all()


def _group_write(address: int) -> Callable[[bytes], bool]:
    """Return what finds a sync write to an address."""
    return lambda data: (
        len(data) > 10
        and data[7] == Instruction.SYNC_WRITE
        and int.from_bytes(data[8:10], "little") == address
    )


def _length(data: bytes) -> int:
    return 7 + int.from_bytes(data[5:7], "little")


async def test_torque_is_taken_away_though_a_frame_is_lost() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        await made.activate()
        lost = lose(
            pool.simulation("leap_hand/line").wire, _group_write(table.TORQUE.address), _length
        )
        await made.disable()
        assert lost
        assert [each.get(table.TORQUE) for each in line(pool).servos.values()] == [0, 0]


async def test_a_stop_reaches_the_servos_though_a_frame_is_lost() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        await made.activate()
        await made.sense()
        await made.move(Reference.at([0.9, 0.9], max_velocity=[0.3, 0.3]))
        await anyio.sleep(0.1)
        lost = lose(
            pool.simulation("leap_hand/line").wire,
            _group_write(table.GOAL_POSITION.address),
            _length,
        )
        await made.stop()
        assert lost
        state = await made.sense()
        goals = [
            made.scales[i].to_rad(each.get(table.GOAL_POSITION))
            for i, each in enumerate(line(pool).servos.values())
        ]
        assert goals == pytest.approx(list(state.position), abs=0.02)


@pytest.mark.parametrize(("register", "wanted"), [(table.BUS_WATCHDOG, 5), (table.POSITION_P, 444)])
async def test_what_is_set_up_arrives_though_a_frame_is_lost(
    register: table.Register, wanted: int
) -> None:
    async with BusPool() as pool, connected(pool, device(watchdog=0.1, p=444)) as made:
        seen = _group_write(register.address)
        # The watchdog is cleared first, by a frame that looks the same but for its values.
        lost = lose(
            pool.simulation("leap_hand/line").wire,
            lambda data: seen(data) and wanted % 256 in data[13 : _length(data) - 2],
            _length,
        )
        await made.activate()
        assert lost
        assert [each.get(register) for each in line(pool).servos.values()] == [wanted] * 2


async def test_a_servo_outside_its_own_limits_is_powered_at_the_nearest() -> None:
    async with BusPool() as pool, connected(pool, device(mode="position")) as made:
        for each in line(pool).servos.values():
            each.set(table.MAX_POSITION, each.position - 10)
        await made.find()
        await made.activate()
        await made.stop()
        for each in line(pool).servos.values():
            assert each.get(table.TORQUE) == 1
            assert each.get(table.GOAL_POSITION) == each.get(table.MAX_POSITION)


async def test_a_limit_that_is_lost_is_written_again() -> None:
    async with BusPool() as pool, connected(pool, device(health_every=5)) as made:
        await made.activate()
        await made.sense()
        await made.move(Reference.at([0.6, 0.6]))
        lost = lose(
            pool.simulation("leap_hand/line").wire,
            _group_write(table.GOAL_CURRENT.address),
            _length,
        )
        weak = Reference.at([0.6, 0.6], max_effort=[0.03, 0.03])
        for _ in range(12):
            await made.sense()
            await made.move(weak)
        assert lost
        assert all(each.get(table.GOAL_CURRENT) < 200 for each in line(pool).servos.values())


async def test_what_is_left_alone_keeps_its_limits() -> None:
    def limits(pool: BusPool) -> list[tuple[int, int]]:
        servos = line(pool).servos.values()
        return [(s.get(table.GOAL_CURRENT), s.get(table.PROFILE_VELOCITY)) for s in servos]

    async with BusPool() as pool:
        async with connected(pool, device()) as first:
            await first.activate()
            weak = {"max_effort": [0.03, 0.03], "max_velocity": [1.0, 1.0]}
            await settle(first, [0.5, 0.5], **weak)
            before = limits(pool)
        async with connected(pool, device()) as second:
            await second.activate()
            state = await second.sense()
            await second.move(Reference.at(list(state.position)))
            await second.sense()  # nothing answers to a write; what is read comes behind it
            assert limits(pool) == before, "its grip"
            await second.move(Reference.at([0.7, 0.7]))
            await second.sense()
            assert limits(pool) != before
