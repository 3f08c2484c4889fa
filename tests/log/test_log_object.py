"""A recording says what was grasped: in each of its files, and to those who play it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import anyio
import numpy as np
import pytest
from PIL import Image

pytest.importorskip("mujoco")

from rtee.buses.pool import BusPool
from rtee.drivers.replay.driver import ReplayDriver
from rtee.gui.playback import Playback
from rtee.hand.frames import pose_in_hand
from rtee.log import read
from rtee.trials.bench import bench, recorder_for
from rtee.trials.recorded_pictures import moments, write_pictures
from rtee.trials.result import Trial
from rtee.trials.trial import run_trial
from rtee.types import DeviceSpec

HAND = "robotiq_2f_85"


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording of a trial: the object is grasped and lifted."""
    folder = tmp_path_factory.mktemp("trial")
    ready = bench(HAND)
    with recorder_for(ready, folder) as recorder:
        trial = Trial("Grasp", (), "box:0.04x0.04x0.1")
        result = run_trial(ready, trial, observers=[recorder])
    assert result.held
    (path,) = folder.glob("*.mcap")
    return path


@pytest.mark.heavy
def test_the_object_is_recorded_and_stays_in_the_hand_that_lifts_it(file: Path) -> None:
    recording = read(file)
    obj = recording.object_description
    assert obj is not None
    assert (obj.name, obj.parts[0].kind) == ("box:0.04x0.04x0.1", "box")
    playback = Playback(recording, bench(HAND).hand)
    assert playback.object_description is obj
    places = []
    for share in (0.5, 0.95):
        playback.time = share * playback.duration
        channels = {k.rpartition("/")[2]: v for k, v in playback.state().channels.items()}
        pose = pose_in_hand(channels)
        assert pose is not None
        places.append(pose[:3])
        assert len(channels["contacts"]) % 7 == 0
    assert places[1] == pytest.approx(places[0], abs=0.01)
    base = recording.channels["simulation/base_pose"].values
    assert np.ptp([pose[2] for pose in base]) > 0.1


def test_contacts_are_recorded_when_they_change(file: Path) -> None:
    channels = read(file).channels
    contacts, poses = channels["simulation/contacts"], channels["simulation/object_pose"]
    assert len(contacts.t) < len(poses.t) / 4
    assert np.diff(contacts.t).min() > 0.03


@pytest.mark.anyio
async def test_who_plays_it_gets_the_object_and_all_channels(file: Path) -> None:
    hand = bench(HAND).hand
    spec = DeviceSpec("played", HAND, "replay", hand.actuators, {"file": str(file)}, 100.0)
    driver = ReplayDriver(spec, BusPool())
    await driver.configure()
    try:
        await driver.activate()
        # The first state was recorded before the channels beside it.
        wanted = {"object_pose", "base_pose", "contacts", "contact_force"}
        while not wanted <= set((await driver.sense()).extras):  # noqa: ASYNC110
            await anyio.sleep(0.01)
        assert driver.object_description is not None
        assert driver.object_description.name == "box:0.04x0.04x0.1"
    finally:
        await driver.close()


@pytest.mark.heavy
def test_pictures_are_made_before_the_grasp_and_after_it(file: Path, tmp_path: Path) -> None:
    pytest.importorskip("coal")
    recording = read(file)
    captions = [caption for caption, _ in moments(recording)]
    assert captions == ["before", "Grasp: held", "at the end"]
    assert write_pictures(recording, tmp_path / "strip.png")
    with Image.open(tmp_path / "strip.png") as strip:
        width = strip.width // 3
        colours = strip.convert("RGB").crop((width, 0, 2 * width, strip.height - 30))
        pixels = np.asarray(colours, dtype=int)
    red, green, blue = pixels[..., 0], pixels[..., 1], pixels[..., 2]
    assert ((red > 150) & (red - blue > 40) & (green > blue)).mean() > 0.02, "the object"
    assert ((red > 1.5 * blue) & (blue > 1.5 * green)).any(), "the forces"
    assert not write_pictures(replace(recording, object_description=None), tmp_path / "none.png")
