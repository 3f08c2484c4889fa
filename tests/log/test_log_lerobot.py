"""Recordings as LeRobot datasets: what a frame holds was known at its time."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("av", reason="the extra lerobot is not installed")
pytest.importorskip("pyarrow", reason="the extra lerobot is not installed")

import av
from mcap.writer import Writer
from pyarrow import parquet
from typer.testing import CliRunner

from log.samples import BEGIN, RATE, RESULT, WALL, Log, recorded, settings, tick
from rtee.cli.log import app
from rtee.commands import CommandRecord, EndStream, StreamSample
from rtee.errors import LogError
from rtee.hand.model import Hand
from rtee.log.dataset.cameras import cameras_in
from rtee.log.dataset.convert import Choice, EpisodeBoundary, write_dataset
from rtee.log.recover import recover
from rtee.messages.features import ObservedQuantity
from rtee.messages.schema import parse
from rtee.types import Event, Goal, Intensity, Named

MARKS = {
    50: "episode: turn it",
    150: "episode: end",
    200: "episode: fumble",
    250: "Episode: discard",
    270: "the light went out",
    300: "episode: turn it again",
    370: "episode: end",
}
SAMPLED = range(40, 180, 4)
GONE = 330
"""The tick from which on the camera is gone."""

EVERY = 3
"""A frame of the camera in so many ticks."""


def asked_at(number: int) -> float:
    return 0.2 + 0.001 * number


@pytest.fixture(scope="module")
def demonstrations(claw: Hand, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four seconds with a stream, marks and a goal; not to be changed."""
    folder = tmp_path_factory.mktemp("demonstrations")
    log = Log(claw, settings(folder))
    for number in log.ticks(0, 400):
        now = log.time.now
        if number in MARKS:
            log.writer.item(Event("mark", "user", MARKS[number], now), now)
        if number in SAMPLED:
            targets = {"Trig one": asked_at(number)}
            positions = {"first": asked_at(number)}
            sample = StreamSample("s", now, now, targets, {}, positions, {"first": np.nan})
            log.writer.item(CommandRecord(number, now, sample), now)
        if number == 310:
            goal = Goal(Named("Trig", ("one",)), Intensity(0.5), goal_id="g1", client="tests")
            log.writer.item(goal, now)
        if number == 360:
            log.writer.item(RESULT, now)
    log.writer.close()
    (path,) = recorded(folder)
    return path


def test_a_recording_that_is_being_written_is_told_from_a_damaged_one(
    claw: Hand, tmp_path: Path
) -> None:
    """`rtee log recover` would refuse it."""
    log = Log(claw, settings(tmp_path))
    for _ in log.ticks(0, 10):
        pass
    with pytest.raises(LogError, match="is still being written; end its run"):
        cameras_in(tmp_path.iterdir())
    log.writer.close()
    assert cameras_in(recorded(tmp_path)) == []


def picture(number: int) -> np.ndarray[Any, Any]:
    """The camera's image of a tick: its number in eight stripes, black and white."""
    bits = np.unpackbits(np.array([number // EVERY], dtype=np.uint8))
    return np.broadcast_to(np.repeat(255 * bits, 8)[:, np.newaxis], (48, 64, 3))


def number_in(frame: av.VideoFrame) -> int:
    stripes = frame.to_ndarray(format="rgb24").reshape(48, 8, 8, 3).mean(axis=(0, 2, 3))
    return EVERY * int(np.packbits(stripes > 128)[0])


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of other software: a camera as JPEG, and one as H.264."""
    path = tmp_path_factory.mktemp("filmed") / "cameras.mcap"
    still = parse(
        "sensor_msgs/msg/CompressedImage",
        "std_msgs/Header header\nstring format\nuint8[] data\n",
    )
    moving = parse(
        "foxglove_msgs/msg/CompressedVideo",
        "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n",
    )
    encoders: dict[str, Any] = {}
    for codec, pixels in (("mjpeg", "yuvj420p"), ("libx264", "yuv420p")):
        encoder = encoders[codec] = av.CodecContext.create(codec, "w")
        encoder.width, encoder.height, encoder.pix_fmt = 64, 48, pixels
        encoder.framerate, encoder.time_base = 30, Fraction(1, 30)
    encoders["libx264"].options = {"tune": "zerolatency", "preset": "ultrafast"}
    time = {"sec": 0, "nanosec": 0}
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        channels = {}
        for topic, kind in (("/wrist/image/compressed", still), ("/video", moving)):
            schema = writer.register_schema(kind.name, "ros2msg", b"")
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        for number in range(0, GONE, EVERY):
            frame = av.VideoFrame.from_ndarray(picture(number).copy(), format="rgb24")
            frame.pts = number
            packets = {c: b"".join(map(bytes, e.encode(frame))) for c, e in encoders.items()}
            image = {
                "header": {"stamp": time, "frame_id": "wrist"},
                "format": "rgb8; jpeg compressed bgr8",
                "data": packets["mjpeg"],
            }
            shown = {"timestamp": time, "frame_id": "", "data": packets["libx264"]}
            contents = {
                "/wrist/image/compressed": still.encode(image),
                "/video": moving.encode(shown | {"format": "h264"}),
            }
            for topic, content in contents.items():
                at = WALL + round(number / RATE * 1e9)
                writer.add_message(channels[topic], at, content, at)
        writer.finish()
    return path


def frames_of(folder: Path) -> dict[str, np.ndarray[Any, Any]]:
    table = parquet.read_table(folder / "data/chunk-000/file-000.parquet")
    return {name: np.array(table[name].to_pylist()) for name in table.column_names}


def ticks_of(episode: range, fps: int) -> list[int]:
    """The newest tick at each frame."""
    count = int(len(episode) * fps // RATE) + 1
    return [int(episode.start + k * RATE / fps) for k in range(count)]


def test_a_frame_has_what_was_known_at_its_time(
    demonstrations: Path, filmed: Path, tmp_path: Path
) -> None:
    output = tmp_path / "made"
    made = write_dataset([demonstrations, filmed], output, Choice(fps=30))
    expected = ticks_of(range(50, 150), 30)
    assert (made.episodes, made.frames) == (1, len(expected))
    assert any("turn it again" in note and "the image of" in note for note in made.notes)
    assert any(note.startswith("second.effort") for note in made.notes)  # never measured
    frames = frames_of(output)
    names = ["first.pos", "second.pos", "first_far.pos", "second_far.pos", "first.effort"]
    info = json.loads((output / "meta/info.json").read_text())
    assert info["features"]["observation.state"]["names"] == names
    assert info["features"]["action"]["names"] == ["first.pos", "second.pos"]
    assert frames["timestamp"] == pytest.approx(np.arange(len(expected)) / 30)
    for number, state, action, sent in zip(
        expected, frames["observation.state"], frames["action"], frames["sent_action"], strict=True
    ):
        told = tick(number)
        assert state[:2] == pytest.approx(told.position)
        assert state[4] == pytest.approx(told.effort[0])
        assert sent == pytest.approx(told.reference_position)
        # The stream asks for the first one only; the second goes where the loop sends it.
        asked = asked_at(max(each for each in SAMPLED if each <= number))
        assert action == pytest.approx([asked, told.reference_position[1]])
    for camera in ("wrist_image", "video"):
        key = f"observation.images.{camera}"
        with av.open(str(output / f"videos/{key}/chunk-000/file-000.mp4")) as video:
            shown = list(video.decode(video=0))
        assert [float(frame.time) for frame in shown] == pytest.approx(frames["timestamp"])
        newest = [number // EVERY * EVERY for number in expected]
        assert [number_in(frame) for frame in shown] == newest
        stats = json.loads((output / "meta/stats.json").read_text())[key]
        mean = np.mean([picture(number) for number in newest]) / 255
        assert np.ravel(stats["mean"]) == pytest.approx([mean] * 3, abs=0.02)


def test_goals_are_episodes_and_intensities_actions(demonstrations: Path, tmp_path: Path) -> None:
    made = write_dataset(
        [demonstrations], tmp_path / "goals", Choice(25, EpisodeBoundary.GOALS, "close")
    )
    frames = frames_of(tmp_path / "goals")
    assert made.frames == len(ticks_of(range(310, 360), 25))
    # The way of a goal is the loop's own.
    assert np.array_equal(frames["action"], frames["sent_action"])
    choice = Choice(25, actions=("trig one",), observe=(ObservedQuantity.POSITION,))
    write_dataset([demonstrations], tmp_path / "actions", choice)
    expected = ticks_of(range(50, 150), 25)
    asked = [asked_at(max(each for each in SAMPLED if each <= n)) for n in expected]
    # In the other episode, the last sample holds until the goal asks for something else.
    asked += [asked_at(SAMPLED[-1]) if n < 310 else 0.5 for n in ticks_of(range(300, 370), 25)]
    assert frames_of(tmp_path / "actions")["action"] == pytest.approx(asked)
    tasks = parquet.read_table(tmp_path / "goals/meta/tasks.parquet")
    assert tasks.to_pylist() == [{"task_index": 0, "task": "close"}]


def test_an_episode_in_two_parts_is_one_however_they_are_given(claw: Hand, tmp_path: Path) -> None:
    log = Log(claw, settings(tmp_path, max_file_size=20_000))
    for number in log.ticks(0, 400):
        if number in (20, 380):
            log.writer.item(Event("mark", "user", "episode: close", log.time.now), log.time.now)
    log.writer.close()
    parts = recorded(tmp_path)
    assert len(parts) > 2
    frames = ticks_of(range(20, 380), 25)
    for number, given in enumerate(([tmp_path], parts, [*reversed(parts), parts[0]])):
        made = write_dataset(given, tmp_path / f"made{number}", Choice(25))
        assert made.frames == len(frames) + 5, "until the end of the recording, the second one"
        state = frames_of(tmp_path / f"made{number}")["observation.state"]
        assert state[: len(frames), :2] == pytest.approx(
            np.array([tick(number).position for number in frames])
        )


def test_an_episode_that_is_in_two_files_is_taken_once(
    demonstrations: Path, tmp_path: Path
) -> None:
    """As from a flight recorder, whose file has no session and ends earlier."""
    once = write_dataset([demonstrations], tmp_path / "once", Choice(25))
    again = write_dataset([demonstrations, demonstrations], tmp_path / "again", Choice(25))
    assert (again.episodes, again.frames, again.notes) == (once.episodes, once.frames, once.notes)
    flight = tmp_path / "claw_flight.mcap"
    data = demonstrations.read_bytes()
    flight.write_bytes(data[: int(0.95 * len(data))].replace(b"session", b"another"))
    recover(flight, in_place=True)
    both = write_dataset([flight, demonstrations], tmp_path / "both", Choice(25))
    assert (both.episodes, both.frames) == (once.episodes, once.frames)
    assert "2 episodes are in several files, and taken once" in both.notes


def test_an_episode_of_intensities_is_as_long_as_its_stream(claw: Hand, tmp_path: Path) -> None:
    log = Log(claw, settings(tmp_path))
    for number in log.ticks(0, 100):
        now = log.time.now
        if number in (10, 90):
            log.writer.item(Event("mark", "user", "episode: close", now), now)
        if number in range(40, 61, 4):
            sample = StreamSample("s", now, now, {"Trig one": 0.01 * number}, {}, {}, {})
            log.writer.item(CommandRecord(number, now, sample), now)
        if number == 70:
            log.writer.item(CommandRecord(99, now, EndStream("s")), now)
    log.writer.close()
    choice = Choice(25, actions=("Trig one",), observe=(ObservedQuantity.POSITION,))
    made = write_dataset(recorded(tmp_path), tmp_path / "made", choice)
    action = frames_of(tmp_path / "made")["action"].ravel()
    assert made.frames == len(action) == 7
    assert (action[0], action[-1]) == pytest.approx((0.4, 0.6))


def test_an_episode_with_a_short_gap_is_kept_and_the_reason_for_another_told(
    claw: Hand, tmp_path: Path
) -> None:
    log = Log(claw, settings(tmp_path))
    for first, last in ((0, 30), (37, 130), (143, 200)):  # 70 ms and 130 ms without states
        for number in log.ticks(first, last):
            if number in (10, 110):
                log.writer.item(Event("mark", "user", "episode: close", log.time.now), log.time.now)
    log.writer.close()
    # A frame each 33 ms may repeat what one or two before it have, but not three.
    made = write_dataset(recorded(tmp_path), tmp_path / "made", Choice(30))
    frames = ticks_of(range(10, 110), 30)
    assert (made.episodes, made.frames) == (1, len(frames))
    assert [note for note in made.notes if "is left out" in note] == [
        "episode 2, 'close', is left out: 0.30 s after its beginning, the position of the "
        "actuators is not known (for longer than 100 ms)"
    ]
    known = [number if number < 30 or number >= 37 else 29 for number in frames]
    assert 29 in known
    state = frames_of(tmp_path / "made")["observation.state"]
    assert state[:, :2] == pytest.approx(np.array([tick(number).position for number in known]))


@pytest.mark.parametrize(
    ("choice", "why"),
    [
        (Choice(fps=0), "1 to 100 frames a second, not 0"),
        (Choice(fps=101), "1 to 100 frames a second, not 101"),
        (Choice(actions=("Trig two",)), "has no stream with targets for Trig two; did you mean"),
        (Choice(actions=("Trig one", "Pinch")), "has no stream with targets for Pinch; valid: "),
        (
            Choice(observe=(ObservedQuantity.EFFORT,)),
            r"effort is not known throughout: second\.effort",
        ),
        (Choice(observe=(ObservedQuantity.TOUCH,)), "touch is not known throughout: not recorded"),
        (Choice(cameras=("top=/top",)), "no camera on '/top'"),
    ],
)
def test_what_makes_no_sense_is_refused_by_one_sentence(
    demonstrations: Path, tmp_path: Path, choice: Choice, why: str
) -> None:
    with pytest.raises(LogError, match=why):
        write_dataset([demonstrations], tmp_path / "made", choice)
    assert not list(tmp_path.iterdir())


def test_marks_another_hand_and_a_folder_that_is_there(
    demonstrations: Path, story: Path, filmed: Path, tmp_path: Path
) -> None:
    def said(*paths: Path, out: Path = tmp_path / "made") -> str:
        result = CliRunner().invoke(app, ["lerobot", *map(str, paths), "--out", str(out)])
        assert isinstance(result.exception, LogError)
        return str(result.exception)

    assert "no mark begins with 'episode:'" in said(story)
    assert "no recording of a hand" in said(filmed)
    assert "exists already" in said(demonstrations, out=tmp_path)


def _seen(path: Path) -> list[int]:
    """Read the times and the images of all cameras in a file."""
    at = np.arange(0, GONE, EVERY) * round(1e9 / RATE) + WALL
    numbers = []
    for camera in cameras_in([path]):
        camera.availability(30.0)
        numbers += [number_in(frame) for frame in camera.newest(at)]
    return numbers


@pytest.mark.samples("0")
@pytest.mark.parametrize("seed", range(4))
def test_damaged_files_of_cameras_are_one_sentence(filmed: Path, tmp_path: Path, seed: int) -> None:
    whole, path = filmed.read_bytes(), tmp_path / "damaged.mcap"
    source = np.random.default_rng(seed)
    refused = 0
    for number in range(25):
        data = bytearray(whole)
        if number % 5 == 0:
            del data[source.integers(len(data)) :]
        else:
            data[source.integers(len(data))] ^= 1 << source.integers(8)
        path.write_bytes(data)
        try:
            _seen(path)
        except LogError:
            refused += 1
    assert refused >= 10  # no other bit was needed


def _filmed(path: Path, *, schema: tuple[str, str, bytes], content: bytes, **options: Any) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start()
        channel = writer.register_channel("/camera", "cdr", writer.register_schema(*schema))
        writer.add_message(channel, WALL, content, WALL)
        writer.finish()
    return path


STILL = ("sensor_msgs/msg/CompressedImage", "ros2msg", b"")


def _png(width: int, height: int) -> bytes:
    encoder = av.CodecContext.create("png", "w")
    encoder.width, encoder.height, encoder.pix_fmt = width, height, "gray"
    encoder.time_base = Fraction(1, 30)
    frame = av.VideoFrame(width, height, "gray")
    data = b"".join(map(bytes, [*encoder.encode(frame), *encoder.encode(None)]))
    return parse(STILL[0], "std_msgs/Header header\nstring format\nuint8[] data\n").encode(
        {
            "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""},
            "format": "png",
            "data": data,
        }
    )


def test_messages_outside_of_chunks_are_images_too(tmp_path: Path) -> None:
    path = _filmed(tmp_path / "a.mcap", schema=STILL, content=_png(64, 48), use_chunking=False)
    assert len(_seen(path)) == len(range(0, GONE, EVERY))


def test_small_files_do_not_become_large_images_or_contradict_themselves(tmp_path: Path) -> None:
    kinds = ("foxglove.CompressedImage", "protobuf")
    for number, (schema, content) in enumerate(
        (
            (STILL, _png(51_000, 4_000)),
            ((*kinds, b"junk"), b"x"),
            ((*kinds, b""), b"x"),
        )
    ):
        path = _filmed(tmp_path / f"{number}.mcap", schema=schema, content=content)
        assert path.stat().st_size < 300_000
        with pytest.raises(LogError, match=r"an image (in it is damaged|cannot be decoded)"):
            _seen(path)


def test_a_camera_whose_video_begins_in_the_middle(filmed: Path) -> None:
    (camera,) = cameras_in([filmed], ["front=/video"])
    assert camera.name == "front"
    with pytest.raises(LogError, match="begins with a key frame"):
        next(camera.newest(np.array([WALL - 1], dtype=np.int64)))
    assert BEGIN > 0
