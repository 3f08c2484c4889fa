"""The RH56's driver against its emulator: what it reads, what it writes, faults and calibration."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import anyio
import pytest

from rtee.buses.modbus import ModbusRefusal
from rtee.drivers.inspire_rh56 import driver as calibration
from rtee.drivers.inspire_rh56.codec import Register, table, words
from rtee.drivers.inspire_rh56.driver import InspireRh56Driver
from rtee.drivers.inspire_rh56.link import ModbusLink
from rtee.drivers.inspire_rh56.options import InspireRh56Options, motors_of
from rtee.errors import (
    CalibrationError,
    CommandRejected,
    ConfigError,
    DeviceFault,
    HandshakeError,
    NotConnected,
)
from rtee.testing import DeviceCase, Session, actuator
from rtee.types import Reference
from tests.drivers.inspire_rh56.test_inspire_rh56_contract import ACTUATORS, CASE, held

pytestmark = pytest.mark.anyio


def case(*, emulator: Mapping[str, Any] | None = None, **options: Any) -> DeviceCase:
    properties = {"haste": 4.0, **(emulator or {})}
    return replace(CASE, options={**options, "emulator": properties}, deadline=0.5)


class Wire(list[bytes]):
    """What goes out on a wire."""

    def trace(self, bus: str, direction: str, data: bytes, stamp: float) -> None:
        if direction == "tx":
            self.append(bytes(data))

    def written(self, register: Register) -> list[tuple[int, ...]]:
        """Return the tables written to a register by the hand's own frames."""
        head = register.to_bytes(2, "little")
        return [words(d[7:-1]) for d in self if d[4] == 0x12 and d[5:7] == head]


# --- which motor drives what -----------------------------------------------------------------


def test_motors_are_found_by_their_names_or_as_told() -> None:
    spec = CASE.spec()
    assert motors_of(spec, InspireRh56Options()) == (5, 4, 3, 2, 1, 0)
    other = replace(CASE, actuators=(actuator("a", 0.0, 1.0), actuator("b", 0.0, 1.0))).spec()
    told = InspireRh56Options(fingers={"a": "index", "b": "thumb_bend"})
    assert motors_of(other, told) == (3, 4)
    with pytest.raises(ConfigError, match="its own motor; missing: a, b"):
        motors_of(other, InspireRh56Options())
    with pytest.raises(ConfigError, match="must name the device's actuators"):
        motors_of(other, InspireRh56Options(fingers={"a": "index"}))
    same = InspireRh56Options(fingers={"a": "index", "b": "index"})
    with pytest.raises(ConfigError, match="two have the same"):
        motors_of(other, same)


def test_an_actuator_without_limits_is_refused() -> None:
    endless = replace(CASE, actuators=(actuator("index", -math.inf, math.inf, rest=0.0),))
    with pytest.raises(ConfigError, match="actuator 'index' has no limits"):
        Session(endless)


# --- every cycle -----------------------------------------------------------------------------


@pytest.mark.parametrize(("unknown", "reads"), [("zeros", 1), ("refused", 2)])
@pytest.mark.parametrize("protocol", ["frames", "modbus"])
async def test_one_exchange_reads_everything_where_the_hand_gives_it(
    unknown: str, reads: int, protocol: str
) -> None:
    async with Session(case(emulator={"unknown": unknown}, protocol=protocol)) as session:
        await session.start()
        before = session.driver.counters()["transactions"]
        state = await session.sense()
        assert session.driver.counters()["transactions"] - before == reads
        assert state.position.tolist() == pytest.approx([0.0] * 6)
        assert state.temperature.tolist() == [25.0] * 6
        assert state.current.tolist() == [0.0] * 6
        # Nobody has commanded it since its power-up.
        assert state.grasped == (None,) * 6


async def test_only_what_changes_is_written_and_limits_go_first() -> None:
    wire = Wire()
    async with Session(case()) as session:
        session.pool.trace = wire.trace
        await session.start()
        limited = {"max_effort": [0.3] * 6, "max_velocity": [1.0] * 6}
        index = Reference.at([0.5] * 6, mask=[False, False, True, False, False, False], **limited)
        wire.clear()
        for _ in range(5):
            await session.cycle(index)
        # -1 keeps the other motors' set-points.
        assert wire.written(Register.ANGLE_SET) == [(-1, -1, -1, 660, -1, -1)]
        [force], [speed] = wire.written(Register.FORCE_SET), wire.written(Register.SPEED_SET)
        assert force == (1000, 1000, 1000, 457, 1000, 1000)
        assert speed == (1000, 1000, 1000, 204, 1000, 1000)
        order = [d[5] for d in wire if d[4] == 0x12]
        assert order == [Register.FORCE_SET & 0xFF, Register.SPEED_SET & 0xFF, 0xCE]


async def test_a_hand_is_driven_that_reports_no_state_until_it_is_commanded() -> None:
    """As in a public report of a real hand at power-up: STATUS FF and ANGLE_SET FFFF, six times."""
    async with Session(case()) as session:
        await session.before(lambda emulator: None)
        memory = session.emulator.memory
        assert memory.read(Register.STATUS, 6) == bytes.fromhex("FF FF FF FF FF FF")
        assert memory.read(Register.ANGLE_SET, 12) == bytes.fromhex("FF FF" * 6)
        state = await session.start()
        assert state.grasped == (None,) * 6
        index = Reference.at([0.5] * 6, mask=[False, False, True, False, False, False])
        for _ in range(60):
            state = await session.cycle(index) or state
        # The one that was commanded has a state now, the others have none yet.
        assert state.grasped == (None, None, False, None, None, None)
        assert session.near(await session.reach([0.5] * 6), [0.5] * 6)


async def test_motors_without_a_reference_get_no_more_than_the_largest_speed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where the hand does not return its set-points, and takes larger forces than speeds."""
    read = ModbusLink.read

    async def refusing(link: ModbusLink, address: int, size: int) -> bytes:
        if address == Register.ANGLE_SET:
            raise ModbusRefusal("hand", 3, 2)
        return await read(link, address, size)

    monkeypatch.setattr(ModbusLink, "read", refusing)
    async with Session(case(protocol="modbus", model="dftp")) as session:
        await session.start()
        one = [False, False, True, False, False, False]
        await session.cycle(Reference.at([0.5] * 6, mask=one, max_velocity=[1.0] * 6))
        memory = session.emulator.memory
        assert words(memory.read(Register.SPEED_SET, 12)) == (1000, 1000, 1000, 204, 1000, 1000)
        assert max(words(memory.read(Register.FORCE_SET, 12))) == 3000


async def test_a_hand_that_was_started_anew_gets_its_set_points_again() -> None:
    async with Session(case(check_every=5)) as session:
        await session.start()
        goal = [0.3] * 6
        await session.reach(goal)
        session.wire.call(lambda: session.emulator.memory.power_cycle())
        for _ in range(10):
            await session.cycle(Reference.at(goal))
        sent = words(session.emulator.memory.read(Register.ANGLE_SET, 12))
        assert -1 not in sent


async def test_set_points_that_the_hand_has_lost_are_sent_again() -> None:
    async with Session(case(check_every=5)) as session:
        await session.start()
        goal = [0.3] * 6
        await session.reach(goal, max_effort=[0.3] * 6)
        limited = session.emulator.memory.begun
        # Its supply is cut for a moment: limits return to those of its start.
        session.wire.call(lambda: session.emulator.memory.power_cycle())
        for _ in range(10):
            await session.cycle(Reference.at(goal, max_effort=[0.3] * 6))
        memory = session.emulator.memory
        assert words(memory.read(Register.FORCE_SET, 12)) == tuple(limited)


async def test_what_is_held_is_told_with_its_force() -> None:
    async with Session(case(emulator={"object": "0.5"})) as session:
        await session.start()
        # The thumb's rotation closes on nothing.
        efforts = [0.3, 1.0, 0.3325, 0.3, 0.3, 0.3]
        goal = Reference.at([1.3, 0.6, 1.4, 1.4, 1.4, 1.4], max_effort=efforts)
        state = None
        with anyio.fail_after(20.0):
            while state is None or state.grasped != (False, True, True, True, True, True):
                state = await session.cycle(goal)
                await anyio.sleep(0.002)
        assert state.effort.tolist()[1:] == pytest.approx(efforts[1:], rel=0.01)
        # 500 g are 3.3 N at the tip of the index finger.
        assert session.emulator.memory.report().forces[3] == 500


async def test_a_refused_write_is_a_rejected_command() -> None:
    async with Session(case()) as session:
        await session.start()
        session.wire.call(lambda: setattr(session.emulator.memory, "write", lambda *_: False))
        with pytest.raises(CommandRejected, match="refused a write to register 1486"):
            await session.driver.move(Reference.at([0.5] * 6))


# --- faults ----------------------------------------------------------------------------------


@pytest.mark.parametrize("port", ["/dev/ttyUSB0", "tcp://192.0.2.1:6000"])
async def test_errors_are_named_by_finger_and_cleared(port: str) -> None:
    async with Session(case(port=port)) as session:
        await session.start()
        await session.reach([0.5, 0.3, 0.7, 0.7, 0.7, 0.7])
        session.wire.call(lambda: session.emulator.inject("locked_rotor"))
        with pytest.raises(DeviceFault, match="index: rotor locked") as caught:
            await session.driver.sense()
        assert (caught.value.code, caught.value.recoverable) == (1, True)
        with pytest.raises(DeviceFault, match="rotor locked"):
            await session.driver.examine()
        session.wire.call(session.emulator.clear)
        with pytest.raises(DeviceFault):  # it stays until it is cleared
            await session.driver.sense()
        before = session.emulator.memory.report().angles[3]
        await session.driver.recover()
        await session.driver.activate()
        assert session.emulator.memory.report().angles[3] == before
        assert await session.driver.examine() == ""


async def test_heat_is_waited_for_not_cleared() -> None:
    async with Session(case()) as session:
        await session.start()
        session.wire.call(lambda: session.emulator.inject("too_hot"))
        with pytest.raises(DeviceFault, match="index: too hot") as caught:
            await session.driver.recover()
        assert "cool down" in caught.value.hint
        session.wire.call(session.emulator.clear)
        await session.driver.recover()


async def test_a_grip_survives_another_fingers_fault() -> None:
    async with Session(case()) as session:
        await session.before(held)
        await session.start()
        session.wire.call(lambda: session.emulator.inject("over_current"))
        with pytest.raises(DeviceFault, match="index: over-current"):
            await session.sense()
        session.wire.call(session.emulator.clear)
        await session.driver.recover()
        efforts = [abs(axis.effort) for axis in session.emulator.axes]
        assert efforts[:3] == [400.0] * 3
        assert efforts[4] == 400.0


# --- connecting ------------------------------------------------------------------------------


async def test_what_is_no_hand_is_named() -> None:
    async with Session(case(unit=7, emulator={"unit": 1})) as session:
        with pytest.raises(NotConnected, match="no RH56 answers as unit 7"):
            await session.driver.configure()
    async with Session(case(protocol="modbus")) as session:
        await session.before(lambda emulator: emulator.inject("wrong_device"))
        with pytest.raises(HandshakeError, match="another device"):
            await session.driver.configure()


async def test_a_read_in_one_exchange_that_is_asked_for_has_to_work() -> None:
    async with Session(case(reading="block", emulator={"unknown": "refused"})) as session:
        with pytest.raises(NotConnected):
            await session.driver.configure()
    async with Session(case(reading="separate")) as session:
        await session.connect()
        assert session.driver.capabilities.identity["reading"] == "two exchanges"


def rates(port: str, **options: Any) -> DeviceCase:
    return replace(CASE, options={"port": port, **options})


@pytest.mark.parametrize(
    ("made", "rate"),
    [
        # 124 bytes at 115,200 baud are 10.8 ms, and two answers of the hand 5 ms.
        (rates("/dev/ttyUSB0"), 63.4),
        (rates("/dev/ttyUSB0", reading="separate"), 56.6),
        (rates("/dev/ttyUSB0", baudrate=921_600, turnaround=0.001), 298.8),
        (rates("tcp://192.0.2.1:6000"), 200.0),
    ],
)
async def test_the_best_rate_is_that_of_the_wire_and_the_hand(
    made: DeviceCase, rate: float
) -> None:
    async with Session(made) as session:
        await session.connect()
        assert session.driver.capabilities.best_rate == pytest.approx(rate, rel=0.01)


# --- calibration -----------------------------------------------------------------------------


async def ready(text: str) -> None:
    assert "do not touch it" in text


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration, "_LASTS", 0.3)


def biased(**options: Any) -> DeviceCase:
    properties = {"force_bias": [5, -20, 0, 60, 0, 0], "calibration_time": 0.2}
    return case(emulator=properties, **options)


@pytest.mark.usefixtures("quick")
async def test_the_force_sensors_are_calibrated_and_what_is_left_is_taken_off(
    tmp_path: Path,
) -> None:
    path = tmp_path / "zeros" / "hand.json"
    async with Session(biased()) as session:
        await session.start()
        await session.reach([0.5] * 6)
        driver = session.driver
        assert isinstance(driver, InspireRh56Driver)
        rest = Reference.at([a.rest for a in ACTUATORS]).position
        found = await driver.calibrate(path, rest, ready)
        assert "index reads 0 g" in str(found)
        assert json.loads(path.read_text()) == {"unit": 1, "grams": [0] * 6}
        memory = session.emulator.memory
        assert words(memory.read(Register.SPEED_SET, 12)) == (1000,) * 6, "as it was"
        assert memory.report().angles == (1000,) * 6
    path.write_text(json.dumps({"unit": 1, "grams": [5, -20, 0, 60, 0, 0]}))
    async with Session(biased(calibration=str(path))) as session:
        state = await session.start()
        assert state.effort.tolist() == [0.0] * 6


@pytest.mark.usefixtures("quick")
async def test_a_hand_that_feels_something_when_idle_is_not_calibrated(tmp_path: Path) -> None:
    path = tmp_path / "hand.json"
    async with Session(biased()) as session:
        await session.start()
        opened = table([1000] * 6)
        session.wire.call(lambda: session.emulator.memory.write(Register.ANGLE_SET, opened))
        session.wire.call(lambda: setattr(session.emulator.memory, "_bias", [0, 0, 0, 150, 0, 0]))
        session.wire.call(lambda: setattr(session.emulator.memory, "write", lambda *_: True))
        driver = session.driver
        assert isinstance(driver, InspireRh56Driver)
        with pytest.raises(
            CalibrationError, match="index measures 150 g although the hand is idle"
        ):
            await driver.calibrate(path, Reference.at([0.0] * 6).position, ready)
    assert not path.exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "there is no calibration at"),
        ("{}", "is not a calibration"),
        ('{"unit": 2, "grams": [0, 0, 0, 0, 0, 0]}', "was made with unit 2, not 1"),
        ('{"unit": 1, "grams": [0]}', "is not a calibration"),
    ],
)
async def test_a_file_that_is_no_calibration_is_refused(
    tmp_path: Path, text: str | None, message: str
) -> None:
    path = tmp_path / "hand.json"
    if text is not None:
        path.write_text(text)
    async with Session(case(calibration=str(path))) as session:
        with pytest.raises(CalibrationError, match=message):
            await session.driver.configure()
