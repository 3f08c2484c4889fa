"""The Ability Hand's driver against its emulator: what it reads, what it sends, and API mode."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import anyio
import pytest

from rtee.drivers.ability_hand import codec
from rtee.drivers.ability_hand.codec import Command, CommandParser, Header
from rtee.drivers.ability_hand.driver import AbilityHandOptions, motors_of
from rtee.errors import ConfigError, DeviceFault, FrameError, NotConnected
from rtee.testing import DeviceCase, Session, actuator
from rtee.types import Reference
from tests.drivers.ability_hand.test_ability_hand_contract import CASE

pytestmark = pytest.mark.anyio


def case(*, emulator: Mapping[str, Any] | None = None, **options: Any) -> DeviceCase:
    properties = {"haste": 2.0, **(emulator or {})}
    return replace(CASE, options={**options, "emulator": properties}, deadline=0.5)


class Wire(list[Command]):
    """The commands that go out on a wire."""

    def trace(self, bus: str, direction: str, data: bytes, stamp: float) -> None:
        if direction == "tx":
            self.extend(CommandParser().feed(bytes(data)))

    def sent(self, header: Header) -> list[tuple[int, ...]]:
        """Return the words of commands of a kind."""
        return [one.words for one in self if one.header & 0xF0 == header]


# --- which motor drives what ---------------------------------------------------------------------


def test_motors_are_found_by_their_names_or_as_told() -> None:
    assert motors_of(CASE.spec(), AbilityHandOptions()) == (0, 1, 2, 3, 4, 5)
    other = replace(CASE, actuators=(actuator("a", 0.0, 1.0), actuator("little", 0.0, 1.0))).spec()
    told = AbilityHandOptions(motors={"a": "thumb_flexor", "little": "index"})
    assert motors_of(other, told) == (4, 0)
    with pytest.raises(ConfigError, match="its own motor; missing: a"):
        motors_of(other, AbilityHandOptions())
    with pytest.raises(ConfigError, match="must name the device's actuators"):
        motors_of(other, AbilityHandOptions(motors={"a": "index"}))
    same = AbilityHandOptions(motors={"a": "index", "little": "index"})
    with pytest.raises(ConfigError, match="two have the same"):
        motors_of(other, same)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"mode": "current", "reply": 1}, "reply 1 has no velocities"),
        ({"address": 0}, "'address': input should be greater than or equal to 1"),
        ({"baudrate": 9600}, "'baudrate'"),
        ({"reply": 4}, "'reply'"),
        ({"speed": 1}, "unknown option 'speed'"),
    ],
)
def test_options_that_no_hand_has_are_refused(options: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        Session(case(**options))


# --- connecting ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("reply", "told"), [(1, "effort"), (2, "velocity"), (3, "effort")])
async def test_each_reply_tells_its_quantities(reply: int, told: str) -> None:
    async with Session(case(reply=reply)) as session:
        state = await session.start()
        assert session.driver.capabilities.identity["reply"] == f"variant {reply}"
        assert told in session.driver.capabilities.measures
        assert not math.isnan(getattr(state, told)[0])
        assert math.isnan(state.velocity[0]) == (reply == 1)
        assert math.isnan(state.current[0]) == (reply == 2)


async def test_in_fast_mode_replies_have_the_form_asked_for_from_the_second_on() -> None:
    async with Session(case(reply=3, emulator={"fast": True})) as session:
        state = await session.start()
        assert session.driver.capabilities.identity["reply"] == "variant 3"
        assert state.velocity.tolist() == [0.0] * 6


async def test_a_hand_at_another_address_is_not_found() -> None:
    async with Session(case(address=0x51, emulator={"address": 0x50})) as session:
        with pytest.raises(NotConnected, match="no Ability Hand answers at address 81") as caught:
            await session.driver.configure()
        assert "from the factory it is set to I2C" in str(caught.value)


# --- every cycle ---------------------------------------------------------------------------------


async def test_a_cycle_is_one_exchange_and_signs_are_those_of_the_wire() -> None:
    wire = Wire()
    async with Session(case()) as session:
        session.pool.trace = wire.trace
        await session.start()
        goal = Reference.at([math.radians(30.0)] * 6)
        await session.cycle(goal)
        wire.clear()
        before = session.driver.counters()["transactions"]
        await session.cycle(goal)
        assert session.driver.counters()["transactions"] - before == 1
        # The thumb's rotation flexes with negative angles.
        assert list(wire) == [Command(0x50, Header.POSITION, (6553,) * 5 + (-6553,))]


async def test_only_actuators_that_are_asked_move() -> None:
    wire = Wire()
    async with Session(case(emulator={"start": 0.5})) as session:
        session.pool.trace = wire.trace
        await session.start()
        only = [True, *[False] * 5]
        await session.cycle(Reference.at([0.0] * 6, mask=only))
        half = codec.angle_counts(0.87)
        assert wire.sent(Header.POSITION) == [(0, half, half, half, half, -half)]


async def test_velocity_limits_are_kept() -> None:
    wire = Wire()
    async with Session(case(mode="velocity")) as session:
        session.pool.trace = wire.trace
        await session.start()
        await session.reach([1.0] * 6, max_velocity=[1.5] * 6)
        sent = wire.sent(Header.VELOCITY)
        assert sent[0] == (*[codec.rate_counts(1.5)] * 5, codec.rate_counts(-1.5))
        assert max(abs(word) for words in sent for word in words) == codec.rate_counts(1.5)


async def test_effort_limits_are_kept() -> None:
    wire = Wire()
    async with Session(case(mode="current", emulator={"object": "0.5"})) as session:
        session.pool.trace = wire.trace
        await session.start()
        goal = Reference.at([1.5] * 6, max_effort=[0.4] * 5 + [0.1])
        with anyio.fail_after(20.0):
            while session.emulator.axes[0].position < 0.86:
                await session.cycle(goal)
                await anyio.sleep(0.002)
        sent = wire.sent(Header.CURRENT)
        finger, rotator = codec.effort_counts(0.4, 0), codec.effort_counts(0.1, 5)
        assert sent[0] == (*[finger] * 5, -rotator)
        assert max(abs(word) for words in sent for word in words[:5]) == finger
        assert max(abs(words[5]) for words in sent) == rotator


async def test_gains_can_be_changed_while_it_runs() -> None:
    async with Session(case(mode="current")) as session:
        await session.start()
        assert dict(session.driver.gains()) == {"stiffness": 8.0, "damping": 0.05}
        await session.driver.set_gains({"stiffness": 4.0})
        assert session.driver.gains()["stiffness"] == 4.0


async def test_a_limited_motor_is_a_warning_and_its_finger_still_holds() -> None:
    async with Session(case(emulator={"object": "0.5", "after_contact": 0.5})) as session:
        await session.start()
        state = None
        with anyio.fail_after(20.0):
            while state is None or not state.warnings:
                state = await session.cycle(Reference.at([1.5] * 6))
                await anyio.sleep(0.002)
        assert "index" in state.warnings[0]
        assert "thumb_rotator" not in state.warnings[0]
        state = await session.cycle(Reference.at([1.5] * 6))
        assert state is not None
        assert state.effort[0] == pytest.approx(3.0, rel=0.01)
        await session.reach([0.5] * 6)
        assert not (await session.sense()).warnings


async def test_a_position_that_no_finger_can_have_reached_is_not_believed_at_once() -> None:
    async with Session(case()) as session:
        await session.start()

        def jump() -> None:
            axis = session.emulator.axes[0]
            axis.position = axis.target = 1.0

        session.wire.call(jump)
        with pytest.raises(FrameError, match="position of a finger jumps"):
            await session.driver.sense()
        state = await session.driver.sense()
        assert state.position[0] == pytest.approx(1.0, abs=1e-3), "told twice, it is true"


# --- API mode ------------------------------------------------------------------------------------


async def test_reading_does_not_enter_api_mode_and_leaving_it_is_told() -> None:
    async with Session(case()) as session:
        await session.start()
        for _ in range(3):
            await session.cycle(Reference.at([0.0] * 6))
        assert not session.emulator.api
        await session.reach([0.5] * 6)
        assert session.emulator.api
        await session.driver.disable()
        await session.driver.sense()
        assert not session.emulator.api


async def test_a_hand_that_moved_by_itself_is_a_fault_and_does_not_jump_back() -> None:
    async with Session(case(emulator={"alone": "open"})) as session:
        await session.start()
        await session.reach([1.0] * 6)
        await anyio.sleep(0.8)
        moves = session.emulator.moves
        for _ in range(3):
            with pytest.raises(DeviceFault, match="left API mode") as caught:
                await session.driver.sense()
            with pytest.raises(DeviceFault):
                await session.driver.move(Reference.at([1.0] * 6))
        assert "rtee recover" in caught.value.hint
        await session.driver.recover()
        state = await session.driver.sense()
        assert state.position.tolist() == pytest.approx([0.0] * 6, abs=0.05)
        assert session.emulator.moves == moves


async def test_a_hand_that_stayed_where_it_was_goes_on() -> None:
    async with Session(case()) as session:
        await session.start()
        await session.reach([1.0] * 6)
        await anyio.sleep(0.4)
        state = await session.driver.sense()
        assert state.position.tolist() == pytest.approx([1.0] * 6, abs=0.02)
        await session.reach([0.5] * 6)


@pytest.mark.parametrize("mode", ["position", "velocity", "current"])
async def test_a_stopped_hand_holds_by_positions_and_a_disabled_one_has_no_voltage(
    mode: str,
) -> None:
    wire = Wire()
    async with Session(case(mode=mode)) as session:
        session.pool.trace = wire.trace
        await session.start()
        await session.reach([0.7] * 6)
        wire.clear()
        await session.driver.stop()
        [held] = wire.sent(Header.POSITION)
        assert held[0] == pytest.approx(codec.angle_counts(0.7), abs=codec.angle_counts(0.02))
        await session.driver.disable()
        assert wire.sent(Header.DUTY) == [(0,) * 6]
        assert not any(axis.enabled for axis in session.emulator.axes)


# --- touch ---------------------------------------------------------------------------------------


async def test_what_the_fingertips_feel_is_told_in_newtons() -> None:
    async with Session(case(emulator={"object": "0.5:0.2"})) as session:
        state = await session.start()
        assert [(s.name, s.taxels, s.unit) for s in session.driver.capabilities.touch] == [
            (finger, 6, "N") for finger in ("index", "middle", "ring", "pinky", "thumb")
        ]
        assert state.touch is not None
        assert state.touch.values.tolist() == [0.0] * 30
        await session.reach([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        touch = (await session.sense()).touch
        assert touch is not None
        words = session.emulator.reply(1).touch
        forces = [codec.touch_force(word) - codec.touch_force(0) for word in words]
        # What rose slowly, below the threshold, counts a little as drift: a force not far above the
        # threshold may be under it without.
        for felt, force in zip(touch.values, forces, strict=True):
            assert felt == pytest.approx(force, abs=0.05) or (felt == 0.0 and force < 0.2)
        assert touch.values[1] > 0.1
        assert touch.values[6:].tolist() == [0.0] * 24


# Words of the sensors of the first finger in a real hand's frame, while nothing touches it.
REST = (138, 149, 188, 811, 102, 218)


async def test_sensors_that_are_not_zero_at_rest_feel_nothing_until_something_touches() -> None:
    emulator = {"touch_rest": list(REST), "object": "0.5:0.2"}
    async with Session(case(emulator=emulator)) as session:
        state = await session.start()
        assert session.emulator.reply(1).touch[:6] == REST
        assert state.touch is not None
        assert state.touch.values.tolist() == [0.0] * 30
        await session.reach([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        touch = (await session.sense()).touch
        assert touch is not None
        felt = [codec.touch_force(word) for word in session.emulator.reply(1).touch[:6]]
        above = [now - codec.touch_force(rest) for now, rest in zip(felt, REST, strict=True)]
        # What rose slowly, below the threshold, counts a little as drift.
        assert touch.values[:6].tolist() == pytest.approx(above, abs=0.2)
        assert touch.values[:6].sum() > 0.3
        assert touch.values[6:].tolist() == [0.0] * 24


@pytest.mark.parametrize("options", [{"reply": 3}, {"touch": False}])
async def test_a_hand_without_touch_tells_none(options: dict[str, Any]) -> None:
    async with Session(case(**options)) as session:
        state = await session.start()
        assert session.driver.capabilities.touch == ()
        assert state.touch is None
