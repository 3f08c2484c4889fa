"""The LinkerHands' driver against its emulator: what it reads, what it writes, and faults."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import anyio
import pytest

from rtee.buses.modbus import ModbusRefusal
from rtee.drivers.linkerhand.codec import L10, Table
from rtee.drivers.linkerhand.driver import LinkerHandOptions, motors_of
from rtee.errors import (
    CommandRejected,
    ConfigError,
    DeviceFault,
    FrameError,
    HandshakeError,
    NotConnected,
)
from rtee.testing import DeviceCase, Session, actuator
from rtee.types import Reference
from tests.drivers.linkerhand.test_linkerhand_contract import CASE, actuators_of

pytestmark = pytest.mark.anyio

NAMES = (
    "thumb_cmc_pitch", "thumb_cmc_yaw", "index_mcp_pitch", "middle_mcp_pitch", "ring_mcp_pitch",
    "pinky_mcp_pitch", "index_mcp_roll", "ring_mcp_roll", "pinky_mcp_roll", "thumb_cmc_roll",
)  # fmt: skip


def case(*, emulator: Mapping[str, Any] | None = None, **options: Any) -> DeviceCase:
    properties = {"haste": 4.0, **(emulator or {})}
    actuators = actuators_of(L10) if options.get("model") == "l10" else CASE.actuators
    options = {"health_every": 5, **options, "emulator": properties}
    return replace(CASE, actuators=actuators, options=options, deadline=0.5)


class Wire(list[bytes]):
    """What goes out on a wire."""

    def trace(self, bus: str, direction: str, data: bytes, stamp: float) -> None:
        if direction == "tx":
            self.append(bytes(data))

    def written(self) -> list[tuple[int, list[int]]]:
        """Return the first register and the values of each write."""
        return [
            (int.from_bytes(d[2:4], "big"), [int(v) for v in d[8:-2:2]]) for d in self if d[1] == 16
        ]

    def read(self) -> list[int]:
        """Return the first register of each read."""
        return [int.from_bytes(d[2:4], "big") for d in self if d[1] == 4]


# --- options -------------------------------------------------------------------------------------


def test_motors_are_found_by_their_names_or_as_told() -> None:
    spec = replace(CASE, actuators=tuple(actuator(n, 0.0, 0.3) for n in NAMES)).spec()
    assert motors_of(spec, LinkerHandOptions(model="l10")) == tuple(range(10))
    other = replace(CASE, actuators=(actuator("a", 0.0, 1.0),)).spec()
    assert motors_of(other, LinkerHandOptions(motors={"a": "ring"})) == (4,)
    with pytest.raises(ConfigError, match="its own motor; missing: a"):
        motors_of(other, LinkerHandOptions())
    with pytest.raises(ConfigError, match="must name the device's actuators"):
        motors_of(other, LinkerHandOptions(motors={"b": "ring"}))


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"model": "l20"}, "'model'"),
        ({"unit": 0}, "'unit': input should be greater than or equal to 1"),
        ({"motors": {"thumb_bend": "index_roll"}}, "an O6 has no motor 'index_roll'"),
        ({"ranges": {"thumb_roll": [0, 1]}}, "an O6 has no motor 'thumb_roll'"),
        ({"ranges": {"index": [0, 0]}}, "motor 'index' reaches 0 to 0 rad"),
        ({"ranges": {"index": [-2, -1]}}, "set 'ranges'"),
        ({"health_every": 0}, "'health_every'"),
    ],
)
def test_options_that_no_hand_has_are_refused(options: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        Session(case(**options))


# --- connecting ----------------------------------------------------------------------------------


async def test_a_hand_says_what_it_is() -> None:
    async with Session(case(unit=40)) as session:
        await session.start()
        assert session.driver.capabilities.identity == {
            "model": "LinkerHand O6",
            "address": "unit 40",
            "side": "left",
            "firmware": "1.0",
            "hardware": "1.0",
        }


async def test_a_hand_of_the_other_kind_is_refused_unless_told_otherwise() -> None:
    other = {"model": "l10"}
    async with Session(case(emulator=other)) as session:
        with pytest.raises((HandshakeError, NotConnected), match="LinkerHand O6"):
            await session.driver.configure()
    async with Session(case(emulator={"software": 0x21}, check_model=False)) as session:
        await session.before(lambda emulator: emulator.inject("wrong_device"))
        await session.driver.configure()
        assert session.driver.capabilities.identity["firmware"] == "2.1"


async def test_a_hand_with_another_number_is_not_found() -> None:
    async with Session(case(unit=40, emulator={"unit": 39})) as session:
        with pytest.raises(NotConnected, match="no LinkerHand O6 answers as unit 40") as caught:
            await session.driver.configure()
        assert "39 is a right hand, 40 a left one" in str(caught.value)


# --- every cycle ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("model", "joint", "reads"),
    [
        ("o6", True, [0, 18, 0, 0, 0, 0]),
        ("o6", False, [0, 18, 24, 0, 0, 0, 0]),
        ("l10", True, [0, 40, 0, 0, 0, 0]),
        ("l10", False, [0, 40, 50, 0, 0, 0, 0]),
    ],
)
async def test_temperatures_and_faults_are_read_now_and_then_at_once_where_that_is_possible(
    model: str, joint: bool, reads: list[int]
) -> None:
    wire = Wire()
    async with Session(case(model=model, emulator={"joint_reads": joint})) as session:
        session.pool.trace = wire.trace
        await session.start()
        for _ in range(2):
            await session.driver.sense()
        wire.clear()
        for _ in range(5):
            state = await session.driver.sense()
        assert wire.read() == reads
        assert set(state.temperature.tolist()) == {25.0}


async def test_values_that_are_no_fault_codes_are_no_answer() -> None:
    """As when the late answer to another question is taken for that about faults."""
    async with Session(case(emulator={"joint_reads": False})) as session:
        await session.start()
        emulator = session.emulator
        told = emulator.table
        session.wire.call(
            lambda: setattr(
                emulator, "table", lambda t: told(t if t < Table.FAULT else Table.POSITION)
            )
        )
        with pytest.raises(FrameError, match="not 6 values of a LinkerHand"):
            await session.driver.examine()


async def test_only_what_changes_is_written_and_limits_go_with_it() -> None:
    wire = Wire()
    async with Session(case()) as session:
        session.pool.trace = wire.trace
        await session.start()
        only = [False, False, True, False, False, False]
        index = Reference.at([0.8] * 6, mask=only, max_effort=[1.0] * 6, max_velocity=[0.4] * 6)
        for _ in range(3):
            await session.cycle(index)
        torques, speeds = [255, 255, 128, 255, 255, 255], [255, 255, 64, 255, 255, 255]
        targets = [255, 255, 128, 255, 255, 255]
        assert wire.written() == [(0, targets + torques + speeds)]
        wire.clear()
        await session.cycle(replace(index, position=index.position * 0.5))
        assert wire.written() == [(0, [255, 255, 191, 255, 255, 255])]


async def test_an_l10_gets_its_limits_before_its_positions() -> None:
    wire = Wire()
    async with Session(case(model="l10")) as session:
        session.pool.trace = wire.trace
        await session.start()
        goal = [0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0.1, 0.1, 0.1, 0.2]
        await session.cycle(Reference.at(goal, max_effort=[1.0] * 10))
        assert [address for address, _ in wire.written()] == [20, 10, 0]
        # Fingers that swing sideways have 255 at their upper end.
        assert wire.written()[-1][1][6:9] == [195, 121, 75]


async def test_limits_have_a_least_count() -> None:
    wire = Wire()
    async with Session(case()) as session:
        session.pool.trace = wire.trace
        await session.start()
        await session.cycle(Reference.at([0.3] * 6, max_effort=[0.0] * 6, max_velocity=[0.0] * 6))
        assert wire.written()[0][1][6:] == [1] * 12


async def test_a_motor_that_rests_short_of_its_set_point_holds_something() -> None:
    async with Session(case(emulator={"object": "0.5"})) as session:
        state = await session.start()
        assert state.grasped == (None,) * 6
        state = await session.cycle(Reference.at([0.5, 1.3, 1.5, 1.5, 1.5, 0.2]))
        assert state is not None
        wanted = (True, False, True, True, True, False)
        with anyio.fail_after(20.0):
            while state is None or state.grasped != wanted:
                state = await session.cycle(Reference.at([0.5, 1.3, 1.5, 1.5, 1.5, 0.2]))
                await anyio.sleep(0.01)
        await session.reach([0.0] * 6)
        await anyio.sleep(0.3)
        assert (await session.sense()).grasped == (False,) * 6


async def test_a_hand_that_was_busy_is_still_read_with_one_request() -> None:
    wire = Wire()
    async with Session(case()) as session:
        session.pool.trace = wire.trace
        await session.start()
        session.emulator.inject("failing")
        with pytest.raises(ModbusRefusal):
            await session.driver.link.health()
        session.emulator.clear("failing")
        wire.clear()
        await session.driver.link.health()
        assert len(wire.read()) == 1


async def test_a_refused_write_is_a_rejected_command() -> None:
    async with Session(case()) as session:
        await session.start()
        functions = frozenset({4})
        session.wire.call(lambda: setattr(session.emulator, "functions", functions))
        with pytest.raises(CommandRejected, match="illegal function"):
            await session.driver.move(Reference.at([0.3] * 6))


# --- faults --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fault", "code", "text"),
    [
        ("over_current", 1, "index: over-current"),
        ("over_temperature", 2, "index: over-temperature"),
        ("encoder", 3, "index: encoder error"),
        ("supply", 4, "index: supply too high or too low"),
    ],
)
@pytest.mark.parametrize("channel", [None, "can0"])
async def test_faults_have_names(fault: str, code: int, text: str, channel: str | None) -> None:
    async with Session(case(channel=channel)) as session:
        await session.start()
        session.emulator.inject(fault)
        # One exchange was at the start, and the fifth asks for faults.
        for _ in range(3):
            await session.driver.sense()
        with pytest.raises(DeviceFault, match=text) as caught:
            await session.driver.sense()
        assert caught.value.code == code
        with pytest.raises(DeviceFault, match=text):
            await session.driver.examine()


@pytest.mark.parametrize("channel", [None, "can0"])
async def test_a_fault_code_that_is_not_published_is_a_fault_too(channel: str | None) -> None:
    async with Session(case(channel=channel)) as session:
        await session.start()
        emulator, told = session.emulator, session.emulator.table

        def table(asked: Table) -> list[int]:
            return [0, 0, 9, 0, 0, 0] if asked is Table.FAULT else told(asked)

        session.wire.call(lambda: setattr(emulator, "table", table))
        with pytest.raises(DeviceFault, match="index: unknown fault 9") as caught:
            await session.driver.examine()
        assert (caught.value.code, "rtee recover" in caught.value.hint) == (9, True)


async def test_recovering_keeps_what_is_held_and_what_had_the_fault_where_it_is() -> None:
    async with Session(case()) as session:
        await session.start()
        await session.reach([0.3] * 6)
        await session.cycle(Reference.at([0.5] * 6))
        session.emulator.inject("over_current")
        with pytest.raises(DeviceFault):
            await session.driver.recover()
        axes = session.emulator.axes
        assert axes[2].target == round(axes[2].position)
        assert axes[3].target == round(255 * (1.0 - 0.5 / 1.6))
        session.emulator.clear()
        await session.driver.recover()


async def test_on_can_an_l10_is_set_and_read_in_parts() -> None:
    async with Session(case(model="l10", channel="can0", spacing=0.0)) as session:
        await session.start()
        goal = [0.3, 0.6, 0.5, 0.6, 0.7, 0.8, 0.1, 0.1, 0.2, 0.5]
        state = await session.reach(goal, max_effort=[1.0] * 10)
        assert state.position.tolist() == pytest.approx(goal, abs=0.02)
        assert session.emulator.table(Table.TORQUE) == [128] * 10


async def test_a_model_without_effort_limits_gets_all_torque() -> None:
    boundless = tuple(replace(one, effort=math.inf) for one in CASE.actuators)
    async with Session(replace(case(), actuators=boundless)) as session:
        await session.start()
        goal = [0.3] * len(boundless)
        await session.driver.move(Reference.at(goal))
        await session.driver.move(Reference.at(goal, max_effort=[5.0] * len(boundless)))
        assert set(session.driver._sent[Table.TORQUE]) == {255}


@pytest.mark.parametrize("blocked", [True, False])
async def test_a_set_point_that_creeps_on_hides_no_object(blocked: bool) -> None:
    """A slow motor, which takes each count in a reading of its own, holds nothing."""
    given = {"object": "0.5"} if blocked else {}
    async with Session(case(emulator=given)) as session:
        await session.start()
        index, said = 2, set[bool | None]()
        for number in range(200):
            there = [0.0, 0.0, 0.6 + 0.002 * number, 0.0, 0.0, 0.0]
            # So slow that it stays some counts behind.
            slow = Reference.at(there, max_velocity=[0.03 if number > 60 else 9.0] * 6)
            state = await session.cycle(slow)
            assert state is not None
            said.add(None if state.grasped is None else state.grasped[index])
            await anyio.sleep(0.02)
        assert (True in said) is blocked
