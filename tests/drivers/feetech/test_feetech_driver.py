"""The driver of Feetech servos against emulated ones: what it writes, reads, refuses, stores."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest

from rtee.buses.faults import Faults
from rtee.drivers.feetech import table
from rtee.drivers.feetech.codec import Frame, Instruction, RequestParser
from rtee.errors import (
    BusError,
    BusTimeout,
    CalibrationError,
    ConfigError,
    DeviceFault,
    DriverError,
    FrameError,
    HandshakeError,
    NotConnected,
)
from rtee.sample import ActuatorState
from rtee.testing import DeviceCase, Session, actuator
from rtee.types import Reference
from tests.drivers.feetech.test_feetech_contract import CASE, DIFFERENTIAL, NAMES, PAIRED, TORQUE
from tests.drivers.objects import obstruct
from tests.drivers.use import lose

pytestmark = pytest.mark.anyio


def case(*, emulator: Mapping[str, Any] | None = None, **options: Any) -> DeviceCase:
    servo = {"reboot_time": 0.05, **((emulator or {}).get("servo") or {})}
    made = {**CASE.options, **options, "emulator": {**(emulator or {}), "servo": servo}}
    return replace(CASE, options=made, tolerance=0.003)


def paired(**options: Any) -> DeviceCase:
    servos = {
        f"{f}_{k}": {"id": 2 * i + k} for i, f in enumerate(("index", "middle")) for k in (1, 2)
    }
    made = {
        "family": "scs",
        "servos": servos,
        "differential": DIFFERENTIAL,
        "deadline": 0.2,
        **options,
    }
    return replace(CASE, actuators=PAIRED, options=made, tolerance=0.01)


class Wire(list[Frame]):
    """What goes out on a wire."""

    def trace(self, bus: str, direction: str, data: bytes, stamp: float) -> None:
        if direction == "tx":
            self.extend(RequestParser().feed(data))

    def written(self, address: int) -> list[bytes]:
        """Return what was written to several servos from an address on."""
        return [
            f.params for f in self if f.code == Instruction.SYNC_WRITE and f.params[0] == address
        ]


async def fault_of(session: Session, goal: Reference | None = None) -> DeviceFault:
    """Return the fault that comes while a reference is sent, or none."""
    with anyio.fail_after(15.0):
        while True:
            try:
                await session.driver.sense()
            except DeviceFault as fault:
                return fault
            if goal is not None:
                await session.driver.move(goal)
            await anyio.sleep(0.005)


async def settled(session: Session, goal: list[float]) -> ActuatorState:
    """Return the state at a posture once nothing moves any more."""
    state = await session.reach(goal)
    with anyio.fail_after(10.0):
        while np.any(state.velocity):
            await anyio.sleep(0.01)
            state = await session.sense()
    return state


# --- connecting ------------------------------------------------------------------------------


async def test_connecting_writes_nothing_and_tells_what_is_there() -> None:
    wire = Wire()
    async with Session(case()) as session:
        session.pool.trace = wire.trace
        await session.connect()
        assert {frame.code for frame in wire} == {Instruction.READ}
        made = session.driver.capabilities
        assert made.identity == {
            "model": "3 x STS3215", "firmware": "3.10", "read": "all at once",
        }  # fmt: skip
        assert made.measures == {"position", "velocity", "effort", "current", "temperature"}
        assert made.accepts == {"position", "max_effort", "max_velocity"}
        assert made.gains == ("p", "i", "d")


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"family": "scs"}, "'torque' in the options"),
        ({"family": "sts", "stall_torque": None}, "'stall_torque' in its options"),
        ({"family": "hls"}, "'torque_per_ampere' in its options"),
    ],
)
async def test_efforts_are_limited_only_where_torque_is_known(
    options: dict[str, Any], why: str
) -> None:
    async with Session(case(**options)) as session:
        await session.connect()
        assert "max_effort" not in session.driver.capabilities.accepts
        assert why in session.driver.capabilities.refuses["max_effort"]


def reading_rate(together: bool, n: int, size: int) -> float:
    """Return the rate of cycles at 1 Mbaud with 1 ms of the adapter's latency [Hz]."""
    if together:
        once = (8 + n + n * (6 + size)) * 1e-5 + 1e-3
    else:
        once = n * ((8 + 6 + size) * 1e-5 + 1e-3)
    written = 6 if size == 11 else 8
    return 1.0 / (once + (8 + n * (1 + written)) * 1e-5)


@pytest.mark.parametrize(
    ("options", "rate"),
    [
        ({}, reading_rate(True, 3, 15)),
        ({"read": "single"}, reading_rate(False, 3, 15)),
        ({"family": "scs"}, reading_rate(False, 3, 11)),
    ],
)
async def test_the_best_rate_follows_from_the_bytes(options: dict[str, Any], rate: float) -> None:
    async with Session(case(**options)) as session:
        await session.connect()
        assert session.driver.capabilities.best_rate == pytest.approx(rate)


async def test_missing_and_wrong_servos_are_named() -> None:
    async with Session(case(emulator={"ids": [1, 3]})) as session:
        with pytest.raises(HandshakeError, match="servos 1 to 3, found no 2"):
            await session.driver.configure()
    async with Session(case(emulator={"ids": [9]})) as session:
        with pytest.raises(NotConnected, match="none of 3 servos answers"):
            await session.driver.configure()
    servos = {**CASE.options["servos"], "j1": {"id": 2, "model": 2825}}
    async with Session(case(servos=servos)) as session:
        with pytest.raises(HandshakeError, match=r"2 \(j1\) is STS3215, not STS3250"):
            await session.driver.configure()


async def test_another_family_is_found_out_by_its_order_of_bytes() -> None:
    async with Session(case(emulator={"family": "scs"})) as session:
        with pytest.raises(HandshakeError, match=r"an STS servo as 1.*SCS0009, of family scs"):
            await session.driver.configure()
    async with Session(case(emulator={"servo": {"model": 4660}})) as session:
        with pytest.raises(HandshakeError, match="model 34 12"):
            await session.driver.configure()
    servos = {name: {**servo, "model": 4660} for name, servo in CASE.options["servos"].items()}
    async with Session(case(emulator={"servo": {"model": 4660}}, servos=servos)) as session:
        await session.connect()
        assert session.driver.capabilities.identity["model"] == "3 x model 4660"


async def test_a_servo_that_turns_without_end_is_refused() -> None:
    endless = {"servo": {"limits": [0, 0]}}
    async with Session(case(family="scs", emulator=endless)) as session:
        with pytest.raises(HandshakeError, match="limits of 0 and 0"):
            await session.driver.configure()
    async with Session(case(emulator=endless)) as session:
        # One of another family counts turns, and goes anywhere.
        await session.start()


async def test_limits_of_a_servo_that_are_too_tight_are_told() -> None:
    async with Session(case(emulator={"servo": {"limits": [1500, 2600]}})) as session:
        await session.connect()
        with pytest.raises(ConfigError, match="from 1396 to 2961, but accepts 1500 to 2600"):
            await session.driver.activate()


async def test_a_joint_that_cannot_be_where_it_is_is_told() -> None:
    async with Session(case(emulator={"special": {2: {"start": 3800}}})) as session:
        await session.connect()
        with pytest.raises(CalibrationError, match=r"'j1' is at 2\.69 rad, 1\.29 rad outside"):
            await session.driver.activate()
        with pytest.raises(CalibrationError):
            await session.driver.examine()


# --- powering --------------------------------------------------------------------------------


async def test_powering_sets_up_what_differs_and_stores_nothing() -> None:
    wire = Wire()
    special = {1: {"return_delay": 250}}
    made = case(emulator={"special": special}, p=20, d=32, acceleration=50)
    async with Session(made) as session:
        session.pool.trace = wire.trace
        await session.start()
        registers = [frame.params[0] for frame in wire if frame.code == Instruction.SYNC_WRITE]
        # Lock, P, acceleration, return delay, mark, goal, torque: D and mode were right.
        assert registers == [55, 21, 41, 7, 20, 42, 40]
        assert wire.written(7) == [bytes([7, 1, 1, 0])]
        for servo in session.emulator.ordered:
            assert servo.get(table.GOAL_POSITION) == servo.position
            assert servo.get(table.TORQUE_LIMIT) == 1000
        session.wire.power_cycle()
        first = session.emulator.ordered[0]
        assert (first.get(table.P), first.get(table.RETURN_DELAY)) == (32, 250)
        assert first.get(table.ALARM) == 47


async def test_powering_again_after_the_supply_was_cut_sets_up_again() -> None:
    async with Session(case(p=20)) as session:
        await session.start()
        session.wire.power_cycle()
        found = await fault_of(session)
        assert (found.code, found.name[:19]) == (256, "torque lost: servo ")
        await session.driver.recover()
        await session.driver.activate()
        assert [servo.get(table.P) for servo in session.emulator.ordered] == [20] * 3


async def _sensed(session: Session, times: int) -> None:
    for _ in range(times):
        await session.sense()


@pytest.mark.parametrize("family", ["scs", "sts", "sms", "hls"])
async def test_a_restart_is_noticed_while_set_points_power_the_servo_again(family: str) -> None:
    async with Session(case(family=family, p=20, check_every=1)) as session:
        await session.start()
        await session.reach([0.5] * 3)
        second = session.emulator.ordered[1]

        def restart() -> None:
            second.memory.power_cycle()
            second._start()

        session.wire.call(restart)
        goal = Reference.at([0.5] * 3)
        await session.driver.move(goal)
        # The set-point has powered it, without its settings: only the mark is missing.
        while second.get(table.TORQUE) != 1:
            await session.driver.move(goal)
            await asyncio.sleep(0.001)
        with pytest.raises(DeviceFault, match=r"restarted: servo 2 \(j1\)") as found:
            await _sensed(session, 3)
        assert found.value.code == 512
        kept = session.emulator.ordered[0]
        await session.driver.recover()
        assert (kept.get(table.TORQUE), second.get(table.TORQUE)) == (1, 0)
        # Bent meanwhile, it stays where it stands until a reference asks for more.
        bent = second.axis.position + 40.0
        session.wire.call(lambda: setattr(second.axis, "position", bent))
        await session.driver.activate()
        assert second.get(table.GOAL_POSITION) == round(bent)
        assert [servo.get(table.P) for servo in session.emulator.ordered] == [20] * 3
        assert session.near(await session.reach([0.5] * 3), [0.5] * 3)


def spinning(servo: Any) -> None:
    """Leave a servo as another program may: powered, and turning without a goal."""
    servo.set(table.MODE, 1)
    servo.set(table.GOAL_SPEED, 300)
    servo.set(table.TORQUE, 1)
    servo._act()


async def test_a_servo_that_another_program_lets_turn_is_named_and_set_up() -> None:
    async with Session(case()) as session:
        await session.connect()
        second = session.emulator.ordered[1]
        session.wire.call(lambda: spinning(second))
        await session.driver.close()
        await session.connect()
        with pytest.raises(
            DeviceFault, match=r"powered in operating mode 1, not 0: servo 2 \(j1\)"
        ):
            await session.driver.examine()
        with pytest.raises(DeviceFault, match="operating mode 1") as found:
            await session.driver.activate()
        assert (found.value.code, "rtee recover" in found.value.hint) == (0x102, True)
        await session.driver.recover()
        assert second.get(table.TORQUE) == 0
        await session.driver.activate()
        assert second.get(table.MODE) == 0
        assert session.near(await session.reach([0.5] * 3), [0.5] * 3)


async def test_a_stop_ends_the_turning_of_a_servo_in_another_mode() -> None:
    """A goal would give it the largest speed instead."""
    async with Session(case()) as session:
        await session.connect()
        second = session.emulator.ordered[1]
        session.wire.call(lambda: spinning(second))
        await session.driver.close()
        await session.connect()
        await asyncio.sleep(0.05)
        assert (await session.sense()).velocity[1] > 0.1
        await session.driver.stop()
        await asyncio.sleep(0.05)
        assert (await session.sense()).velocity[1] == 0.0


@pytest.mark.parametrize("read", ["sync", "single"])
async def test_the_one_servo_that_falls_silent_is_named(read: str) -> None:
    async with Session(case(read=read, check_every=10_000)) as session:
        await session.start()
        second = session.emulator.ordered[1]
        session.wire.call(lambda: setattr(second, "silent_until", math.inf))
        with pytest.raises(BusTimeout, match=r"servo 2\b"):
            await session.driver.sense()
        # It may have restarted meanwhile, so it is checked as soon as it answers.
        session.wire.call(lambda: second.reboot(0.0))
        with pytest.raises(DeviceFault, match=r"(restarted|torque lost): servo 2"):
            await session.sense()


async def test_after_a_silence_every_servo_is_checked() -> None:
    servo = {"reboot_time": 0.0}
    async with Session(case(check_every=10_000, emulator={"servo": servo})) as session:
        await session.start()
        await session.reach([0.5] * 3)
        session.emulator.inject("silent")
        with pytest.raises(BusTimeout):
            await session.driver.sense()
        session.wire.power_cycle()
        session.emulator.clear("silent")
        await session.driver.move(Reference.at([0.5] * 3))
        with pytest.raises(DeviceFault, match="restarted: servo 1"):
            await session.sense()


@pytest.mark.parametrize("disturbance", ["echo", "noise"])
async def test_a_supply_cut_is_noticed_though_bytes_arrive_meanwhile(disturbance: str) -> None:
    emulator = {"echo": disturbance == "echo", "servo": {"reboot_time": 0.0}}
    async with Session(case(check_every=10_000, emulator=emulator)) as session:
        await session.start()
        await session.reach([0.5] * 3)
        session.wire.power_cycle()
        if disturbance == "echo":
            session.emulator.inject("silent")
        else:
            session.wire.faults = Faults(corrupt=1.0, requests=False)
        with pytest.raises(BusTimeout if disturbance == "echo" else FrameError):
            await session.driver.sense()
        session.emulator.clear("silent")
        session.wire.faults = Faults()
        with pytest.raises(DeviceFault, match=r"(restarted|torque lost): servo 1"):
            await session.sense()


async def test_a_stop_does_not_power_a_servo_that_has_restarted() -> None:
    """Its goal would do that, in the mode that it stores, which may be that of a wheel."""
    async with Session(case(check_every=10_000)) as session:
        await session.start()
        first, second, third = session.emulator.ordered
        session.wire.call(lambda: second.reboot(0.0))
        await asyncio.sleep(0.2)
        session.wire.call(lambda: second.set(table.MODE, 1))
        await session.driver.stop()
        await session.sense()
        assert [s.get(table.TORQUE) for s in (first, second, third)] == [1, 0, 1]
        assert second.axis.velocity == 0.0


async def test_a_servo_that_takes_no_mark_is_driven_all_the_same() -> None:
    async with Session(case(check_every=1)) as session:
        await session.connect()
        third = session.emulator.ordered[2]
        act = third._act
        session.wire.call(
            lambda: setattr(third, "_act", lambda: (third.set(table.ALARM, 47), act()))
        )
        await session.driver.activate()
        for _ in range(6):
            await session.driver.sense()
        assert session.near(await session.reach([0.5] * 3), [0.5] * 3)


async def test_a_largest_torque_keeps_scs_servos_from_switching_off() -> None:
    async with Session(case(family="scs", torque=0.75)) as session:
        await session.start()
        assert [s.get(table.MAX_TORQUE) for s in session.emulator.ordered] == [750] * 3
        assert session.emulator.ordered[0].memory._stored[16:18] == b"\x03\xe8"
    async with Session(case(torque=0.75)) as session:
        await session.start()
        await session.reach([0.5] * 3)
        assert [s.get(table.TORQUE_LIMIT) for s in session.emulator.ordered] == [750] * 3


async def test_a_setting_that_a_servo_does_not_take_is_told() -> None:
    async with Session(case(p=20, return_delay=5)) as session:
        await session.connect()
        third = session.emulator.ordered[2]
        kept = [(register, third.get(register)) for register in (table.P, table.RETURN_DELAY)]
        session.wire.call(lambda: setattr(third, "_act", lambda: [third.set(*one) for one in kept]))
        with pytest.raises(
            DriverError, match="servo 3 does not accept 20 at address 21; it has 32"
        ):
            await session.driver.activate()
    async with Session(case(return_delay=5)) as session:
        await session.connect()
        third = session.emulator.ordered[2]
        act = third._act
        session.wire.call(
            lambda: setattr(third, "_act", lambda: (third.set(table.RETURN_DELAY, 0), act()))
        )
        # It is slower so, and no worse.
        await session.driver.activate()


async def test_a_servo_that_takes_no_torque_is_a_fault() -> None:
    async with Session(case()) as session:
        await session.connect()
        second = session.emulator.ordered[1]
        session.wire.call(lambda: setattr(second, "_act", lambda: second.set(table.TORQUE, 0)))
        with pytest.raises(DeviceFault, match=r"torque lost: servo 2 \(j1\)"):
            await session.driver.activate()


# --- every cycle -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "frame"),
    [
        # Position, time 0, speed; with STS the torque limit, with HLS the current instead of time.
        (
            {},
            "2A 08 01 8C 0A 00 00 8C 02 E8 03 02 8C 0A 00 00 8C 02 E8 03 "
            "03 8C 0A 00 00 8C 02 E8 03",
        ),
        ({"family": "scs"}, "2A 06 01 02 C3 00 00 00 C4 02 02 C3 00 00 00 C4 03 02 C3 00 00 00 C4"),
        ({"family": "hls"}, "2A 06 01 8C 0A F4 01 0D 00 02 8C 0A F4 01 0D 00 03 8C 0A F4 01 0D 00"),
    ],
)
async def test_a_reference_is_one_frame(options: dict[str, Any], frame: str) -> None:
    wire = Wire()
    async with Session(case(**options)) as session:
        session.pool.trace = wire.trace
        await session.start()
        wire.clear()
        await session.driver.move(Reference.at([1.0] * 3, max_velocity=[1.0] * 3))
        assert wire.written(42) == [bytes.fromhex(frame)]


async def test_only_what_a_reference_is_for_is_sent() -> None:
    wire = Wire()
    async with Session(case()) as session:
        session.pool.trace = wire.trace
        await session.start()
        wire.clear()
        await session.driver.move(Reference.at([1.0] * 3, mask=[False, True, False]))
        [params] = wire.written(42)
        assert params[2::9] == b"\x02"
        await session.driver.move(Reference.at([1.0] * 3, mask=[False] * 3))
        assert len(wire.written(42)) == 1


async def test_direction_gear_and_zero_are_those_of_the_servo() -> None:
    servos = {
        "j0": {"id": 1, "zero": 1000, "direction": -1},
        "j1": {"id": 2, "gear": 2.0, "zero": 2000},
        "j2": {"id": 3},
    }
    actuators = (*(replace(a, lower=-0.5, upper=0.6) for a in CASE.actuators),)
    made = replace(case(servos=servos), actuators=actuators)
    async with Session(made) as session:
        await session.start()
        state = await settled(session, [0.5, 0.5, 0.5])
        assert state.position.tolist() == pytest.approx([0.5] * 3, abs=2e-3)
        positions = [servo.position for servo in session.emulator.ordered]
        assert positions == [1000 - 326, 2000 + 652, 2048 + 326]


async def test_what_the_servos_measure_is_told_in_si_units() -> None:
    async with Session(case(emulator={"servo": {"voltage": 7.4}})) as session:
        await session.start()
        session.wire.call(
            lambda: [obstruct(session.emulator.servos[n].axis, 2100.0, 50.0) for n in (1, 2, 3)]
        )
        goal = Reference.at([1.0] * 3, max_effort=[0.5] * 3)
        with anyio.fail_after(10.0):
            state = await session.cycle(goal)
            while state is None or not np.allclose(state.velocity, 0.0) or state.effort[0] < 0.4:
                state = await session.cycle(goal)
                await anyio.sleep(0.01)
        assert state.effort.tolist() == pytest.approx([0.5] * 3, rel=0.01)
        # A quarter of the torque, of the current of 500 counts.
        assert state.current.tolist() == pytest.approx([125 * 6.5e-3] * 3, rel=0.01)
        assert state.extras["voltage"].tolist() == pytest.approx([7.4] * 3)
        assert state.temperature.tolist() == pytest.approx([25.0] * 3, abs=3.0)


async def test_a_velocity_is_measured_on_the_way() -> None:
    async with Session(case()) as session:
        await session.start()
        goal = Reference.at([1.2] * 3, max_velocity=[0.5] * 3)
        await session.cycle(goal)
        await anyio.sleep(0.1)
        state = await session.sense()
        assert state.velocity.tolist() == pytest.approx([0.5] * 3, rel=0.01)


async def test_a_position_that_cannot_be_is_believed_only_when_told_twice() -> None:
    async with Session(case()) as session:
        state = await session.start()
        second = session.emulator.ordered[1]
        session.wire.call(lambda: setattr(second.axis, "position", 2048.0 + 500))
        with pytest.raises(FrameError, match="servo 2 cannot have reached the position it reports"):
            await session.driver.sense()
        session.wire.call(lambda: setattr(second.axis, "position", 2048.0))
        assert (await session.driver.sense()).position.tolist() == state.position.tolist()
        # A hand that somebody has bent while nobody looked is where it is.
        session.wire.call(lambda: setattr(second.axis, "target", 2048.0 + 500))
        session.wire.call(lambda: setattr(second.axis, "position", 2048.0 + 500))
        with pytest.raises(FrameError):
            await session.driver.sense()
        there = await session.driver.sense()
        assert there.position[1] == pytest.approx(500 * math.tau / 4096)


async def test_a_torque_that_nobody_sets_is_set_right() -> None:
    async with Session(case(check_every=1)) as session:
        await session.start()
        second = session.emulator.ordered[1]
        session.wire.call(lambda: second.write(table.TORQUE.address, b"\x03"))
        for _ in range(3):
            await session.driver.sense()
        assert second.get(table.TORQUE) == 1


async def test_servos_that_are_read_one_by_one_are_checked_one_by_one() -> None:
    wire = Wire()
    async with Session(case(family="scs", check_every=2)) as session:
        session.pool.trace = wire.trace
        await session.start()
        wire.clear()
        for _ in range(6):
            await session.sense()
        asked = [frame.device for frame in wire if frame.params == b"\x14\x15"]
        assert sorted(asked) == [1, 2, 3]
        assert len(wire) == 6 * 3 + 3


async def test_an_adapter_that_hands_back_what_it_sends_is_understood() -> None:
    async with Session(case(emulator={"echo": True})) as session:
        await session.start()
        state = await session.reach([0.7] * 3)
        assert state.position.tolist() == pytest.approx([0.7] * 3, abs=0.01)


@pytest.mark.parametrize("level", [0, 1])
async def test_servos_that_answer_to_reading_alone_are_driven_as_well(level: int) -> None:
    async with Session(case(emulator={"servo": {"level": level}})) as session:
        await session.start()
        await session.reach([0.7] * 3)
        await session.driver.disable()
        assert [servo.get(table.TORQUE) for servo in session.emulator.ordered] == [0] * 3


async def test_gains_are_written_and_not_stored() -> None:
    async with Session(case()) as session:
        await session.start()
        await session.driver.set_gains({"p": 12.4, "i": 3.0, "d": 999.0})
        await session.sense()
        for servo in session.emulator.ordered:
            gains = [servo.get(register) for register in (table.P, table.I, table.D)]
            assert gains == [12, 3, 254]
            assert servo.memory._stored[21:24] == bytes([32, 32, 0])


# --- pairs -----------------------------------------------------------------------------------


async def test_two_servos_bend_and_tilt_a_finger() -> None:
    async with Session(paired()) as session:
        await session.start()
        state = await settled(session, [0.8, 0.1, 0.3, -0.2])
        assert state.position.tolist() == pytest.approx([0.8, 0.1, 0.3, -0.2], abs=0.02)
        one, two, *_ = (servo.axis.position for servo in session.emulator.ordered)
        per_rad = 1024 / math.radians(300)
        # Their difference bends, their sum tilts: flexion 0.8 is met at 0.44 rad of the servos.
        assert (one - two) / 2 / per_rad == pytest.approx(0.4408, abs=0.01)
        assert (one + two) / 2 - 511 == pytest.approx(0.1 / 0.57 / 0.859 * per_rad, abs=1.5)


async def test_velocities_and_efforts_go_through_the_differential() -> None:
    wire = Wire()
    made = paired(family="sts", stall_torque=TORQUE, differential={"pairs": DIFFERENTIAL["pairs"]})
    actuators = tuple(replace(a, lower=-0.6, upper=0.6, rest=0.0) for a in PAIRED)
    async with Session(replace(made, actuators=actuators)) as session:
        session.pool.trace = wire.trace
        await session.start()
        wire.clear()
        asked = Reference.at(
            [0.5, 0.0, 0.0, 0.0], max_velocity=[1.0, 0.5, 1.0, 0.5], max_effort=[1.0, 3.0, 1.0, 3.0]
        )
        await session.driver.move(asked)
        [params] = wire.written(42)
        family = session.driver.family
        speeds = [family.unpack(table.GOAL_SPEED, params[i + 1 : i + 9], 42) for i in (2, 11)]
        torques = [family.unpack(table.TORQUE_LIMIT, params[i + 1 : i + 9], 42) for i in (2, 11)]
        # 1.5 rad/s each; both servos together give the flexion twice their torque of 0.5 N·m.
        assert speeds == [978, 978]
        assert torques == [250, 250]
        # Pushing only with the first servo: half a bend, half a tilt.
        session.wire.call(lambda: obstruct(session.emulator.servos[1].axis, 2100.0, 50.0))
        with anyio.fail_after(10.0):
            state = await session.cycle(asked)
            while state is None or state.effort[0] < 0.4 or abs(state.velocity[0]) > 1e-6:
                state = await session.cycle(asked)
                await anyio.sleep(0.01)
        assert state.effort[:2].tolist() == pytest.approx([0.5, 0.5], rel=0.02)
        assert state.position[0] == pytest.approx((0.08 + 0.5) / 2, abs=0.02)
        assert state.position[1] == pytest.approx((0.08 - 0.5) / 2, abs=0.02)


async def test_a_tilt_that_gives_way_is_told() -> None:
    async with Session(paired()) as session:
        await session.start()
        goal = Reference.at([1.2, 0.3, 0.0, 0.0])
        with anyio.fail_after(10.0):
            state = await session.cycle(goal)
            while state is None or state.position[0] < 1.19:
                state = await session.cycle(goal)
                await anyio.sleep(0.005)
        assert state.warnings == (
            "index_tilt gives way to index_flexion: its servos are at their limit",
        )
        assert state.position[1] < 0.15
        assert abs(session.emulator.ordered[0].position - 511) <= 308


async def test_one_actuator_of_a_pair_moves_alone() -> None:
    async with Session(paired()) as session:
        await session.start()
        await session.reach([0.5, 0.1, 0.0, 0.0])
        goal = Reference.at([0.9, 0.0, 0.0, 0.0], mask=[True, False, False, False])
        with anyio.fail_after(10.0):
            state = await session.cycle(goal)
            while state is None or state.position[0] < 0.89:
                state = await session.cycle(goal)
                await anyio.sleep(0.005)
        assert state.position.tolist() == pytest.approx([0.9, 0.1, 0.0, 0.0], abs=0.02)


async def test_the_hotter_servo_of_a_pair_counts_for_both() -> None:
    async with Session(paired()) as session:
        await session.start()
        session.wire.call(lambda: setattr(session.emulator.ordered[1].axis, "temperature", 50.0))
        state = await session.sense()
        assert state.temperature.tolist() == pytest.approx([50.0, 50.0, 25.0, 25.0], abs=1.0)


# --- stopping and faults ---------------------------------------------------------------------


async def test_a_stop_leaves_servos_without_torque_without() -> None:
    async with Session(case()) as session:
        await session.connect()
        await session.driver.stop()
        assert [servo.get(table.TORQUE) for servo in session.emulator.ordered] == [0] * 3


@pytest.mark.parametrize(
    ("fault", "code", "words"),
    [
        ("voltage", 1, "voltage in servo 1"),
        ("angle", 2, "angle in servo 1"),
        ("overheating", 4, "overheating in servo 1"),
        ("overcurrent", 8, "overcurrent in servo 1"),
        ("overload", 32, r"overload in servo 1 \(j0\)"),
    ],
)
async def test_what_is_wrong_is_named(fault: str, code: int, words: str) -> None:
    async with Session(case()) as session:
        await session.start()
        session.wire.call(lambda: session.emulator.inject(fault))
        with pytest.raises(DeviceFault, match=words) as caught:
            await session.sense()
        assert caught.value.code == code


async def test_an_overload_by_pushing_on_is_recovered_from() -> None:
    async with Session(case(emulator={"servo": {"haste": 1.0}})) as session:
        await session.start()
        session.wire.call(lambda: obstruct(session.emulator.servos[2].axis, 2100.0, 50.0))
        goal = Reference.at([1.0] * 3)
        assert (await fault_of(session, goal)).name == "overload in servo 2 (j1)"
        assert session.emulator.ordered[1].get(table.TORQUE) == 0
        await session.driver.recover()
        await session.driver.activate()
        state = await session.sense()
        assert state.position[1] == pytest.approx(0.11, abs=0.02)
        assert session.emulator.ordered[1].get(table.TORQUE) == 1


# --- calibration -----------------------------------------------------------------------------


async def calibrated(session: Session, path: Path, rest: list[float]) -> Any:
    async def ready(text: str) -> None:
        assert "the torque of the servos is off" in text

    await session.connect()
    return await session.driver.calibrate(path, np.array(rest), ready)  # type: ignore[attr-defined]


async def test_a_calibration_makes_the_rest_posture_the_present_one(tmp_path: Path) -> None:
    path = tmp_path / "hand" / "servos.json"
    places = {1: {"start": 1000}, 2: {"start": 3000}, 3: {"start": 2048}}
    async with Session(case(emulator={"special": places})) as session:
        found = await calibrated(session, path, [0.0, 0.5, 0.0])
        assert [one.zero for one in found] == pytest.approx([1000, 3000 - 326, 2048], abs=1)
        assert json.loads(path.read_text())["servos"][1]["actuator"] == "j1"
    made = case(emulator={"special": places}, calibration=str(path))
    made = replace(made, actuators=tuple(replace(a, lower=-0.5, upper=0.6) for a in CASE.actuators))
    async with Session(made) as session:
        state = await session.start()
        assert state.position.tolist() == pytest.approx([0.0, 0.5, 0.0], abs=2e-3)
    other = {**made.options, "emulator": {"special": {**places, 2: {"start": 3000, "offset": 9}}}}
    async with Session(replace(made, options=other)) as session:
        with pytest.raises(CalibrationError, match="homing offset is 9, was 0"):
            await session.driver.configure()


@pytest.mark.parametrize("zero", [None, "2048", float("nan"), True])
async def test_a_calibration_whose_zero_is_no_number_is_refused(
    tmp_path: Path, zero: object
) -> None:
    path = tmp_path / "servos.json"
    async with Session(case()) as session:
        await calibrated(session, path, [0.0, 0.0, 0.0])
    stored = json.loads(path.read_text())
    stored["servos"][1]["zero"] = zero
    path.write_text(json.dumps(stored))
    async with Session(case(calibration=str(path))) as session:
        with pytest.raises(CalibrationError, match=r"of servos: servos\.1\.zero: should be a"):
            await session.driver.configure()


async def test_a_pair_is_calibrated_by_its_servos(tmp_path: Path) -> None:
    path = tmp_path / "servos.json"
    places = {1: {"start": 400}, 2: {"start": 640}, 3: {"start": 391}, 4: {"start": 630}}
    async with Session(paired(emulator={"special": places})) as session:
        found = await calibrated(session, path, [0.0, 0.0, 0.0, 0.0])
        assert {one.actuator for one in found} == {"index_1", "index_2", "middle_1", "middle_2"}
    made = paired(emulator={"special": places}, calibration=str(path))
    async with Session(made) as session:
        state = await session.start()
        assert state.position.tolist() == pytest.approx([0.0] * 4, abs=2e-3)


async def test_two_families_share_a_line() -> None:
    made = case(port="/dev/both")
    fingers = replace(paired(port="/dev/both"), actuators=PAIRED)
    servos = {n: {**s, "id": s["id"] + 10} for n, s in CASE.options["servos"].items()}
    made = replace(made, options={**made.options, "servos": servos})
    async with Session(made) as one, Session(fingers, pool=one.pool, name="more") as other:
        await one.start()
        await other.start()
        await one.reach([0.4] * 3)
        state = await other.reach([0.6, 0.1, 0.2, 0.0])
        assert state.position.tolist() == pytest.approx([0.6, 0.1, 0.2, 0.0], abs=0.02)


def test_names_stay_those_of_the_actuators() -> None:
    driver = Session(
        replace(
            CASE,
            actuators=(actuator("z", 0.0, 1.0), actuator("a", 0.0, 1.0)),
            options={"family": "sts", "servos": {"a": {"id": 1}, "z": {"id": 2}}},
        )
    )
    joints = driver.driver._joints  # type: ignore[attr-defined]
    assert joints.names == ("z", "a")
    assert NAMES == ("j0", "j1", "j2")


async def test_servos_do_not_jump_to_a_goal_of_before_though_a_frame_is_lost() -> None:
    async with Session(case(family="sts")) as session:
        await session.start()
        await session.reach([0.9] * 3)
        await session.driver.disable()
        for servo in session.emulator.ordered:
            session.wire.call(
                lambda axis=servo.axis: setattr(axis, "position", axis.position - 1000)
            )
        for _ in range(3):  # a change that is too fast is doubted at first
            with contextlib.suppress(BusError):
                await session.sense()
        before = (await session.sense()).position
        lost = lose(
            session.wire.wire,
            lambda data: len(data) > 6 and data[4:6] == bytes([0x83, 42]),
            lambda data: data[3] + 4,
        )
        await session.driver.activate()
        assert lost
        await anyio.sleep(0.3)
        assert (await session.sense()).position == pytest.approx(before, abs=0.05)
