"""The page on LeRobot is run as it is written, by LeRobot itself where that is installed."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shlex
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("av", reason="the extra lerobot is not installed")

import av
from mcap.writer import Writer
from pyarrow import parquet

import rtee
from rtee.log import read
from rtee.messages.schema import parse

ROOT = Path(__file__).parents[2]
LEROBOT = ROOT / ".lerobot" / "bin"
PEERS = Path(__file__).with_name("lerobot_peers")

pytestmark = [
    pytest.mark.heavy,
    pytest.mark.timeout(3600),
    pytest.mark.skipif(
        not (LEROBOT.parent / ".ready").exists(),
        reason="LeRobot is not installed (several gigabytes): make lerobot",
    ),
]

SMALL = (
    # Weights that the internet has, and a size that takes hours without a GPU.
    "--policy.pretrained_backbone_weights=null --policy.dim_model=64 --policy.n_heads=4 "
    "--policy.dim_feedforward=128 --policy.n_encoder_layers=2 --policy.chunk_size=20 "
    "--policy.n_action_steps=10 --policy.latent_dim=8 --num_workers=0 "
    "--batch_size=4 --log_freq=20"
)


def blocks() -> dict[str, list[str]]:
    page = (ROOT / "docs" / "how-to" / "lerobot.md").read_text()
    found: dict[str, list[str]] = {}
    for section in page.split("\n## ")[1:]:
        title, _, text = section.partition("\n")
        found[title] = re.findall(r"^```\w*\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    return found


@contextlib.contextmanager
def filming(path: Path) -> Iterator[None]:
    """Record what a camera sees of the running hand, 25 times a second."""
    sys.path.append(str(PEERS))
    from drawn import HEIGHT, WIDTH, picture

    kind = parse(
        "sensor_msgs/msg/CompressedImage", "std_msgs/Header header\nstring format\nuint8[] data\n"
    )
    ended = threading.Event()
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}

    def film() -> None:
        encoder: Any = av.CodecContext.create("png", "w")
        encoder.width, encoder.height, encoder.pix_fmt = WIDTH, HEIGHT, "rgb24"
        encoder.framerate = 25
        with path.open("wb") as stream, rtee.connect_blocking(wait=60.0) as hand:
            writer = Writer(stream)
            writer.start("ros2")
            schema = writer.register_schema(kind.name, "ros2msg", b"")
            channel = writer.register_channel("/wrist/compressed", "cdr", schema)
            while not ended.wait(0.04):
                state = hand.state()
                image = picture(state.position)
                packets = encoder.encode(av.VideoFrame.from_ndarray(image, format="rgb24"))
                fields = {"header": header, "format": "png", "data": b"".join(map(bytes, packets))}
                writer.add_message(channel, state.wall_ns, kind.encode(fields), state.wall_ns)
            writer.finish()

    thread = threading.Thread(target=film)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@pytest.fixture(scope="module")
def shell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A folder in which the page's commands work."""
    folder = tmp_path_factory.mktemp("lerobot")
    camera = folder / "camera" / "lerobot_camera_drawn-1.0.dist-info"
    camera.mkdir(parents=True)
    (camera / "METADATA").write_text("Metadata-Version: 2.1\nName: lerobot_camera_drawn\n")
    home = folder / "home"
    home.mkdir(mode=0o700)
    path = os.pathsep.join([str(Path(sys.executable).parent), str(LEROBOT), os.environ["PATH"]])
    variables = {
        "PATH": path,
        "PYTHONPATH": os.pathsep.join([str(PEERS), str(camera.parent)]),
        "XDG_RUNTIME_DIR": str(home),
        "HF_HOME": str(home),
        "HF_HUB_OFFLINE": "1",
        "OMP_NUM_THREADS": "1",  # threads that wait for each other take the loop's processor
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in variables.items():
            patch.setenv(name, value)
        patch.delenv("RTEE_RUNTIME_DIR", raising=False)
        patch.chdir(folder)
        yield


def run(command: str) -> str:
    done = subprocess.run(shlex.split(command), capture_output=True, text=True)
    assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
    return done.stdout + done.stderr


@contextlib.contextmanager
def running(command: str) -> Iterator[None]:
    with subprocess.Popen(shlex.split(command)) as hand:
        try:
            yield
        finally:
            hand.terminate()


@pytest.fixture(scope="module")
def dataset(shell: None) -> dict[str, Any]:
    page = blocks()
    start, table, demonstrate = page["1. Demonstrate"]
    Path("close.csv").write_text(table)
    with running(start), filming(Path("cameras.mcap")):
        with rtee.connect_blocking(wait=60.0) as hand:
            hand.ready()
        for _ in range(3):
            for command in demonstrate.splitlines():
                run(command)
            run("rtee open")
    (make,) = page["3. Make the dataset"]
    print(run(make))
    info: dict[str, Any] = json.loads(Path("datasets/close/meta/info.json").read_text())
    return info


@pytest.fixture(scope="module")
def losses(dataset: dict[str, Any]) -> list[float]:
    (train,) = blocks()["4. Train"]
    said = run(f"{train.strip()} {SMALL}")
    return [float(each) for each in re.findall(r"loss:([\d.]+)", said)]


def test_demonstrations_become_a_dataset(dataset: dict[str, Any]) -> None:
    assert dataset["total_episodes"] > 0
    assert dataset["features"]["observation.images.wrist"]["shape"] == [48, 64, 3]


def test_a_policy_is_trained_on_it(losses: list[float]) -> None:
    print(f"loss {losses[0]} to {losses[-1]} in 200 steps")
    assert losses[-1] < 0.5 * losses[0]


def test_the_policy_moves_the_hand_smoothly(losses: list[float]) -> None:
    page = blocks()
    _, evaluate = page["5. Run the policy"]
    evaluate = evaluate.strip().replace("type: opencv, index_or_path: 0", "type: drawn")
    for recording in Path("logs").glob("*.mcap"):
        recording.unlink()
    with running(page["1. Demonstrate"][0]), rtee.connect_blocking(wait=60.0) as hand:
        hand.ready()
        run(f"{evaluate} --play_sounds=false")
        assert not hand.status().holder
    table = parquet.read_table("datasets/eval_close/data/chunk-000/file-000.parquet")
    assert np.isfinite(np.array(table["action"].to_pylist())).all()
    recorded = read("logs")
    sent, taken = recorded.reference, recorded.stream_samples
    moved, step = np.ptp(sent.position, axis=0), np.abs(np.diff(sent.position, axis=0))
    print(f"{len(taken)} actions, moved by up to {moved.max():.2f} rad, a tick's step {step.max()}")
    assert len(taken) > 10
    assert moved.max() > 0.1
    # An action's step does not reach the motors, but the hand's own speed.
    limits = {each.name: each.velocity for each in rtee.load_hand("leap_hand").actuators}
    speed = step / np.diff(recorded.actuator_states.time)[:, np.newaxis]
    assert (speed <= 1.001 * np.array([limits[name] for name in sent.names])).all()
