"""A recording plays back as it was, at any speed."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from rtee.buses.pool import BusPool
from rtee.drivers.replay.driver import ReplayDriver
from rtee.drivers.replay.states import Block, RecordedStates
from rtee.errors import ConfigError, LogError, NotConnected
from rtee.messages.codec import header
from rtee.messages.schema import message_type
from rtee.messages.state import actuator_state_fields
from rtee.messages.topics import log_topic
from rtee.messages.touch import TOUCH_SENSORS, TouchEncoder, sensors_fields
from rtee.sample import ActuatorState
from rtee.touch import TouchSensor, TouchState
from rtee.types import ActuatorSpec, DeviceSpec, JointKind, Reference

pytestmark = pytest.mark.anyio
KIND = message_type("rtee_msgs/msg/ActuatorState")
TOUCH_TYPE = message_type("rtee_msgs/msg/Touch")
FURTHER = message_type("rtee_msgs/msg/Channels")
RECORDED = ("thumb", "index")
STATES = 1234
PERIOD = 0.002


def actuator(name: str) -> ActuatorSpec:
    return ActuatorSpec(name, JointKind.REVOLUTE, -9, 9, 1.0, 1.0, 1.0, 1.0, 0.0)


def write(
    path: Path,
    hand: str = "claw",
    count: int = STATES,
    finish: bool = True,
    further: Sequence[str] = (),
) -> Path:
    """Write states whose values tell their number, with the `mcap` package's own writer."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=20_000)
        writer.start("ros2")
        schema = writer.register_schema(KIND.name, "ros2msg", KIND.schema.encode())
        topic = log_topic(hand, "actuator_states")
        channel = writer.register_channel(topic, "cdr", schema)
        schema = writer.register_schema(FURTHER.name, "ros2msg", FURTHER.schema.encode())
        more = writer.register_channel(log_topic(hand, "channels"), "cdr", schema)
        for k in range(count):
            if further and k % 10 == 5:
                fields = {
                    "header": header(1_000_000 + k),
                    "tick": k,
                    "name": list(further),
                    "length": [2] * len(further),
                    "value": np.arange(2.0 * len(further)) + k,
                }
                writer.add_message(more, 1_000_000 + k, FURTHER.encode(fields), 1_000_000 + k)
            fields = actuator_state_fields(RECORDED) | {
                "tick": k,
                "time": 70.0 + k * PERIOD,
                "position": np.array([k, -k], dtype=float),
                "velocity": np.array([1.0, 2.0]),
                "effort": np.array([3.0, 4.0]),
                "current": np.array([np.nan, np.nan]),
                "temperature": np.array([30.0, 31.0]),
                "grasped": np.array([1, -1], dtype=np.int8),
            }
            writer.add_message(channel, 1_000_000 + k, KIND.encode(fields), 1_000_000 + k)
        if finish:
            writer.finish()
    return path


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("replay") / "a.mcap")


class Player:
    def __init__(
        self, path: Path, actuators: Sequence[str] = ("index", "thumb"), **options: object
    ) -> None:
        self.seconds = 5.0
        specs = tuple(actuator(name) for name in actuators)
        given = {"file": str(path), **options}
        spec = DeviceSpec("tape", "claw", "replay", specs, options=given, source="hand.yaml:3")
        self.driver = ReplayDriver(spec, BusPool())
        self.driver.now = lambda: self.seconds

    async def __aenter__(self) -> Player:
        await self.driver.configure()
        await self.driver.activate()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.driver.close()

    async def sense(self) -> ActuatorState:
        """Return what is to be shown now, once it has been read."""
        state = await self.driver.sense()
        fresh = state.fresh  # a block's last state is shown while the next block is still read
        while self.driver.behind:
            state = await self.driver.sense()
            fresh = fresh or state.fresh
        return replace(state, fresh=fresh)


async def test_states_come_by_name_at_their_time(recording: Path) -> None:
    async with Player(recording) as player:
        for k in (0, 1, 2, 700, 1100, STATES - 1):
            player.seconds = 5.0 + k * PERIOD + 1e-9
            state = await player.sense()
            assert state.position.tolist() == [-k, k]
            assert state.velocity.tolist() == [2.0, 1.0]
            assert state.effort.tolist() == [4.0, 3.0]
            assert np.isnan(state.current).all()
            assert state.temperature.tolist() == [31.0, 30.0]
            assert state.grasped == (None, True)
            assert state.fresh
            assert state.stamp == player.seconds
            assert not (await player.sense()).fresh


@pytest.mark.parametrize(
    ("recorded", "shown"),
    [
        (["hand/pressure", "hand/supply"], ["pressure", "supply"]),
        (["left/pressure", "right/pressure"], ["left/pressure", "right/pressure"]),
    ],
)
async def test_further_channels_come_as_they_were_last(
    tmp_path: Path, recorded: list[str], shown: list[str]
) -> None:
    path = write(tmp_path / "a.mcap", count=600, further=recorded)
    async with Player(path) as player:
        assert not (await player.sense()).extras
        for k, last in ((5, 5), (14, 5), (503, 495)):
            player.seconds = 5.0 + k * PERIOD + 1e-9
            extras = (await player.sense()).extras
            assert list(extras) == shown
            assert extras[shown[0]].tolist() == [last, last + 1]
            assert extras[shown[1]].tolist() == [last + 2, last + 3]


async def test_every_state_is_played_in_order(recording: Path) -> None:
    async with Player(recording) as player:
        seen = []
        for _ in range(STATES):
            seen.append((await player.sense()).position[1])
            player.seconds += PERIOD * (1 + 1e-9)
        assert seen == list(range(STATES))


async def test_what_takes_long_to_read_is_not_waited_for(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else the exchange would count as unanswered, and the replay as a lost device."""
    held = threading.Event()
    blocks = RecordedStates.blocks

    def slow(states: RecordedStates, size: int = 500) -> Iterator[Block]:
        for number, block in enumerate(blocks(states, size)):
            if number:
                held.wait()
            yield block

    monkeypatch.setattr(RecordedStates, "blocks", slow)
    async with Player(recording) as player:
        player.seconds += 700 * PERIOD + 1e-9
        state = await player.driver.sense()
        assert (state.position[1], player.driver.behind) == (499, True)
        assert not (await player.driver.sense()).fresh
        held.set()
        assert (await player.sense()).position[1] == 700
        assert not player.driver.behind


async def test_it_stays_at_the_end(recording: Path) -> None:
    async with Player(recording) as player:
        player.seconds += 1000.0
        state = await player.sense()
        assert state.position[1] == STATES - 1
        assert player.driver.ended
        assert not (await player.sense()).fresh


async def test_it_may_repeat(recording: Path) -> None:
    async with Player(recording, repeat=True) as player:
        player.seconds += STATES * PERIOD
        assert (await player.sense()).position[1] == 0
        player.seconds += 10 * PERIOD + 1e-9
        assert (await player.sense()).position[1] == 10


async def test_time_may_pass_faster(recording: Path) -> None:
    async with Player(recording, speed=10.0) as player:
        player.seconds += 20 * PERIOD + 1e-9
        assert (await player.sense()).position[1] == 200


async def test_references_change_nothing(recording: Path) -> None:
    async with Player(recording) as player:
        await player.driver.move(Reference.at([5.0, 5.0]))
        assert (await player.sense()).position.tolist() == [0.0, 0.0]


async def test_it_can_be_closed_and_opened_again(recording: Path) -> None:
    async with Player(recording) as player:
        player.seconds += 0.5
        await player.sense()
        await player.driver.close()
        await player.driver.close()
        with pytest.raises(NotConnected):
            await player.sense()
        await player.driver.configure()
        assert (await player.sense()).position[1] == 0


async def test_touch_sensors_that_were_known_later_are_played_too(tmp_path: Path) -> None:
    """The recorder tells the sensors anew when a further device has measured for the first time."""
    states = {
        name: TouchState(name, (TouchSensor(f"{name}_tip", 2),), np.array(values), 70.0)
        for name, values in (("palm", [1.0, 2.0]), ("tips", [3.0, 4.0]))
    }
    known: dict[str, TouchState] = {}
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        channel = {}
        for topic, kind in (
            ("actuator_states", KIND),
            ("touch_sensors", TOUCH_SENSORS),
            ("touch", TOUCH_TYPE),
        ):
            schema = writer.register_schema(kind.name, "ros2msg", kind.schema.encode())
            channel[topic] = writer.register_channel(log_topic("claw", topic), "cdr", schema)
        encoder = TouchEncoder()
        for k in range(30):
            if k in (10, 20):
                state = states["palm" if k == 10 else "tips"]
                known[state.device] = state
                sensors = TOUCH_SENSORS.encode(sensors_fields(known.values()))
                writer.add_message(channel["touch_sensors"], k, sensors, k)
                writer.add_message(channel["touch"], k, encoder.encode(state, k), k)
            fields = actuator_state_fields(RECORDED) | {"tick": k, "time": 70.0 + k * PERIOD}
            writer.add_message(channel["actuator_states"], k, KIND.encode(fields), k)
        writer.finish()
    async with Player(tmp_path / "a.mcap") as player:
        declared = [sensor.name for sensor in player.driver.capabilities.touch]
        assert sorted(declared) == ["palm_tip", "tips_tip"]
        felt = []
        for k in (5, 15, 25):
            player.seconds = 5.0 + k * PERIOD + 1e-9
            touch = (await player.sense()).touch
            felt.append(None if touch is None else sorted(touch.values.tolist()))
    assert felt[0] is None
    assert felt[1] is not None
    assert felt[1][:2] == [1.0, 2.0]
    assert np.isnan(felt[1][2:]).all()
    assert felt[2] == [1.0, 2.0, 3.0, 4.0]


async def test_it_goes_on_when_it_is_activated_again(recording: Path) -> None:
    async with Player(recording) as player:
        player.seconds += 1100 * PERIOD + 1e-9
        assert (await player.sense()).position[1] == 1100
        await player.driver.disable()
        await player.driver.activate()
        player.seconds += 7 * PERIOD
        assert (await player.sense()).position[1] == 1107


def test_a_recording_of_one_other_hand_will_do(tmp_path: Path) -> None:
    path = write(tmp_path / "other.mcap", hand="other", count=3)
    states = RecordedStates(path, "claw", ("thumb",))
    (block,) = states.blocks()
    assert block.values[:, 0, 0].tolist() == [0.0, 1.0, 2.0]
    states.close()


def test_files_that_cannot_be_played_are_refused(tmp_path: Path) -> None:
    junk = tmp_path / "junk.mcap"
    junk.write_bytes(b"no recording at all")
    nothing = tmp_path / "nothing.mcap"
    nothing.touch()
    cases = [
        (tmp_path / "missing.mcap", ("thumb",), "cannot be opened"),
        (junk, ("thumb",), "is not an MCAP file"),
        (nothing, ("thumb",), "is not an MCAP file"),
        (write(tmp_path / "empty.mcap", count=0), ("thumb",), "contains no states"),
        (write(tmp_path / "short.mcap", count=2), ("ring",), "no states of the actuator 'ring'"),
        (
            write(tmp_path / "cut.mcap", count=5, finish=False),
            ("thumb",),
            "was not closed; `rtee log recover` repairs it",
        ),
    ]
    for path, actuators, reason in cases:
        with pytest.raises(LogError, match=reason):
            RecordedStates(path, "claw", actuators)


async def test_a_damaged_recording_is_played_up_to_the_damage_and_then_refused(
    tmp_path: Path,
) -> None:
    """Damage that is decompressed to other numbers, too."""
    whole = write(tmp_path / "whole.mcap").read_bytes()
    with (tmp_path / "whole.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    place = summary.chunk_indexes[-1]
    for at in (place.chunk_length - place.compressed_size, place.chunk_length - 40):
        damaged = bytearray(whole)
        damaged[place.chunk_start_offset + at] ^= 0x10
        path = tmp_path / "damaged.mcap"
        path.write_bytes(damaged)
        async with Player(path) as player:
            player.seconds += 3 * PERIOD + 1e-9
            assert (await player.sense()).position[1] == 3
            player.seconds += STATES * PERIOD
            with pytest.raises(LogError, match=r"damaged\.mcap: is damaged"):
                await player.sense()


def test_wrong_options_are_named(recording: Path) -> None:
    with pytest.raises(ConfigError, match=r"hand\.yaml:3: .*speed"):
        Player(recording, speed=0.0)
