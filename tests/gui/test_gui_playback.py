from __future__ import annotations

from pathlib import Path

import anyio
import numpy as np
import pytest

import rtee
from rtee.errors import LogError
from rtee.gui.playback import Playback, timeline
from rtee.hand.load import load_hand
from rtee.hand.model import Hand
from rtee.log import read
from rtee.running.run import RunOptions, run_hands

HAND = "robotiq_2f_85"


@pytest.fixture(scope="module")
def hand() -> Hand:
    return load_hand(HAND)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a pinch, with a mark."""
    folder = tmp_path_factory.mktemp("logs")

    async def run() -> None:
        end = anyio.Event()
        options = RunOptions(driver="kinematic", rate=200.0, log=folder)
        async with anyio.create_task_group() as group:
            group.start_soon(lambda: run_hands([HAND], options, say=lambda _: None, until=end))
            async with rtee.connect(HAND, wait=300.0) as remote:
                assert (await remote.status()).recording.startswith(str(folder))
                assert (await remote.do("PinchTight", "finger_1", "finger_2")).succeeded
                await remote.record("mark", "closed <now>")
                await anyio.sleep(0.2)
            end.set()

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("run")))
        patch.delenv("RTEE_RUNTIME_DIR", raising=False)
        anyio.run(run)
    return next(folder.glob("*.mcap"))


@pytest.fixture
def playback(file: Path, hand: Hand) -> Playback:
    return Playback(read(file), hand)


def test_the_state_is_that_of_the_time(playback: Playback, hand: Hand) -> None:
    states = playback.recording.actuator_states
    first = playback.state()
    assert first.position[0] == states.position[0, 0]
    playback.time = playback.duration
    last = playback.state()
    assert last.position[0] == states.position[-1, 0] != first.position[0]
    assert np.allclose(last.joint_position, hand.transmission.joints(last.position), atol=1e-6)
    assert last.joint_names == hand.joint_names
    assert last.reference_position[0] == pytest.approx(last.position[0], abs=0.02)


def test_lines_are_those_around_the_time_shown(playback: Playback, hand: Hand) -> None:
    playback.time = playback.duration
    part = playback.duration / 2.0
    assert playback.window("position", (0,), part)[0][0] >= part
    playback.time = 0.5 * part
    time, position = playback.window("position", (0,), 10.0)
    assert time[0] == 0.0 <= playback.pose <= time[-1]
    assert playback.measured("position").all()
    assert not playback.measured("temperature").any()
    states = playback.recording.actuator_states
    assert set(position.tolist()) <= set(states.position[:, 0].tolist())
    for name in ("reference", "joint_position", "joint_velocity", "effort"):
        assert len(playback.window(name, (0,), 10.0)[1]) == len(time)
    _, velocity = playback.window("velocity", (0,), 10.0)
    assert np.abs(velocity).max() > 0.0
    for joint, slope in enumerate(hand.transmission.jacobian(hand.rest)[:, 0]):
        _, along = playback.window("joint_velocity", (joint,), 10.0)
        assert np.allclose(along, slope * velocity)


def test_actions_and_marks_are_on_the_line(playback: Playback) -> None:
    (span,) = playback.recording.spans
    assert span.name.startswith("PinchTight")
    assert [text for _, text in playback.marks] == ["closed <now>"]
    picture = timeline(playback)
    assert f"{span.name}: " in picture
    assert "closed &lt;now&gt;" in picture


def test_a_recording_of_another_hand_is_refused(file: Path) -> None:
    with pytest.raises(LogError, match="not of 'schunk_svh'"):
        Playback(read(file), load_hand("schunk_svh"))
