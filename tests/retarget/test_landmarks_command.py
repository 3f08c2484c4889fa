"""`rtee retarget`, and `rtee teleop --landmarks`."""

from __future__ import annotations

import json
import shutil
import struct
import zipfile
from collections.abc import AsyncIterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from remote.served_leap import served
from remote.serving import Served
from typer.testing import CliRunner

from rtee.cli._common import app_of
from rtee.cli.retarget import retarget
from rtee.cli.teleop import teleop
from rtee.errors import GoalRejected, LogError, UserError
from rtee.hand.catalog import find_hand
from rtee.retarget import LAYOUTS, Retargeter, Side
from rtee.retarget import frames as of_files
from rtee.retarget.frames import TrackerFrame, follow, read_frames
from rtee.testing.human_hand import HumanHand

__all__ = ["served"]

HUMAN = HumanHand()


def run(command: object, *words: str, given: str | None = None) -> str:
    result = CliRunner().invoke(app_of(command), words, input=given, catch_exceptions=False)  # type: ignore[arg-type]
    assert result.exit_code == 0, result.output
    return result.output


def lines(frames: Sequence[np.ndarray[Any, Any]], rate: float = 30.0) -> str:
    found = ({"t": k / rate, "points": points.tolist()} for k, points in enumerate(frames))
    return "".join(json.dumps(frame) + "\n" for frame in found)


@pytest.mark.parametrize("live", [False, True])
def test_a_hand_follows_a_persons(served: Served, tmp_path: Path, live: bool) -> None:
    text = lines([HUMAN.points((c / 12,) * 5) for c in range(12)])
    file = tmp_path / "hand.jsonl"
    file.write_text(text)
    said = run(teleop, "--landmarks", "-" if live else str(file), given=text if live else None)
    assert "12 frames followed, 0 dropped" in said
    middle = served.loop.hand.actuator_index("middle_mcp_forward")
    # How far it gets in 0.4 s is up to a busy computer.
    moved = abs(served.loop.controller.reference_position[middle])
    assert live or moved > 0.01  # all lines come at once, and the stream ends


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("[1, 2]", "an object such as"),
        ('{"points": []}', "no time"),
        ('{"t": 1}', "neither 'points'"),
        ('{"t": 1, "points": [[0, 0, 0]]}', "21 points"),
        (json.dumps({"t": 1, "points": [[0, 0, float("nan")]] * 21}), "finite"),
        ('{"t": -1, "points": null}', "not later"),
        ('{"t": 1, "hand_world_landmarks": [[{"x": 1}]]}', "MediaPipe"),
        ('{"layout": {"order": [1]}}', "a layout must be"),
        ('{"layout": "octopus"}', "unknown layout"),
        ("not json", "is not valid: it is not JSON from character 1 on"),
    ],
)
def test_a_line_without_sense_moves_nothing(tmp_path: Path, line: str, said: str) -> None:
    file = tmp_path / "hand.jsonl"
    file.write_text(lines([HUMAN.points()]) + line + "\n")
    with pytest.raises(LogError, match=said) as caught:
        run(teleop, "--landmarks", str(file))
    assert caught.value.line == 2


BAD = {"t": 0.1, "points": [[0, 0, float("nan")]] * 21}


def test_single_frames_without_sense_are_left_out_of_a_live_tracker(served: Served) -> None:
    good = lines([HUMAN.points((c / 12,) * 5) for c in range(12)]).splitlines()
    far = json.dumps({"t": 0.101, "points": (1e3 * HUMAN.points()).tolist()})
    text = "\n".join([*good[:4], json.dumps(BAD), good[2], "junk", far, *good[4:]])
    assert "12 frames followed" in run(teleop, "--landmarks", "-", given=text)


@pytest.mark.parametrize("first", [[], lines([HUMAN.points()]).splitlines()])
def test_a_tracker_without_sense_ends(served: Served, first: list[str]) -> None:
    bad = [json.dumps(BAD)] * (1 if not first else 31)
    with pytest.raises(LogError, match=r"the standard input:.*: is not valid: .* finite") as caught:
        run(teleop, "--landmarks", "-", given="\n".join([*first, *bad]))
    assert caught.value.line == len(first) + len(bad)


@pytest.mark.anyio
async def test_a_jump_of_the_clock_is_outlasted() -> None:
    """The hand refuses a few samples, until it believes the new time."""
    refused, sent = [5, 6, 7], list[float]()

    async def send(targets: Mapping[str, float], stamp: float) -> None:
        sent.append(stamp)
        if len(sent) in refused:
            raise GoalRejected("the stamp is 100 s ahead of those before")

    async def frames() -> AsyncIterator[TrackerFrame]:
        for k in range(10):
            yield TrackerFrame(k / 30 + 100.0 * (k > 3), HUMAN.points())

    assert await follow(frames(), Retargeter.of("leap_hand"), send) == 7
    assert len(sent) == 10


def test_points_need_no_actions_and_no_gamepad() -> None:
    for words in (["fist"], ["--keyboard"], ["--side", "middle"], ["--layout", "octopus"]):
        with pytest.raises(UserError):
            run(teleop, "--landmarks", "-", *words)


def test_results_of_mediapipe_and_arrays_are_read(tmp_path: Path) -> None:
    points = HUMAN.points()
    marks = [dict(zip("xyz", point, strict=True)) for point in points.tolist()]
    result = {
        "timestamp_ms": 40,
        "handedness": [[{"category_name": "Left"}], [{"category_name": "Right"}]],
        "hand_world_landmarks": [marks[:1], marks],
    }
    file = tmp_path / "hand.jsonl"
    file.write_text(json.dumps(result) + '\n{"timestamp_ms": 80, "hand_world_landmarks": []}\n')
    seen, lost = read_frames(file, LAYOUTS["mediapipe"], Side.RIGHT)
    assert seen.stamp == pytest.approx(0.04)
    assert seen.points == pytest.approx(points)
    assert lost.points is None
    np.savez(tmp_path / "hand.npz", joints=np.array([points, points * np.nan]))
    first, second = read_frames(tmp_path / "hand.npz", LAYOUTS["mediapipe"], Side.RIGHT)
    assert (first.stamp, second.points) == (0.0, None)
    assert first.points == pytest.approx(points)


def _npz(path: Path, header: str, data: bytes) -> Path:
    """Write an array 'points' whose header may not fit its data."""
    head = f"{header}\n".encode()
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("points.npy", b"\x93NUMPY\x01\0" + struct.pack("<H", len(head)) + head + data)
    return path


def test_arrays_that_cannot_be_read_are_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def header(shape: str, kind: str = "<f8") -> str:
        return f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}}}"

    random = np.random.default_rng(0).bytes(10 * 21 * 3 * 8)
    good = _npz(tmp_path / "good.npz", header("(10, 21, 3)"), random).read_bytes()
    entry = good.index(b"PK\x01\x02")
    path = tmp_path / "bad.npz"

    def refused(said: str) -> None:
        with pytest.raises(LogError, match=f"bad.npz: {said}") as caught:
            read_frames(path, LAYOUTS["mediapipe"], Side.RIGHT)
        assert "\n" not in str(caught.value)

    for place in range(45, entry - 30, 97):
        path.write_bytes(good[:place] + bytes([good[place] ^ 0xFF]) + good[place + 1 :])
        refused("cannot be read: ")
    for place, value in ((8, 1), (10, 99)):  # encrypted; packed in an unknown way
        path.write_bytes(good[: entry + place] + bytes([value]) + good[entry + place + 1 :])
        refused("cannot be read: ")
    for shape in ("(10**15, 21, 3)", "(1000000000000000, 21, 3)", "(-1, 21, 3)", "(" * 5000):
        _npz(path, header(shape), bytes(100))
        refused("cannot be read: ")
    for kind in ("<c16", "<U2", "|O"):
        _npz(path, header("(1, 21, 3)", kind), bytes(21 * 3 * 16))
        refused("cannot be read: ")
    # Far smaller than what it holds.
    monkeypatch.setattr(of_files, "_LARGEST", 1_000_000)
    _npz(path, header("(10000, 21, 3)"), bytes(10000 * 21 * 3 * 8))
    assert path.stat().st_size < 100_000
    refused("is larger than 1 MB unpacked")


def test_what_a_hand_follows_is_a_file_to_change(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "config" / "leap_hand"
    shutil.copytree(find_hand("leap_hand"), folder)
    monkeypatch.chdir(tmp_path)
    file = folder / "retarget.yaml"
    file.unlink(missing_ok=True)
    assert "thumb" in run(retarget, "leap_hand", "--save")
    kept = file.read_text()
    file.write_text(kept.replace("human: ring", "human: little"))
    assert Retargeter.of(folder).correspondence.fingers["ring"].human == "little"
    for wrong, said in (
        (kept.replace("human: ring", "human: toe"), "retarget.yaml:"),
        (kept.replace("model: ", "model: x"), "another model"),
        (kept.replace("  ring:", "  nose:"), "'nose' has no tip"),
    ):
        file.write_text(wrong)
        with pytest.raises(UserError, match=said):
            Retargeter.of(folder)
