"""`rtee teleop` and `rtee stream play`."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import anyio.from_thread
import pytest
from remote.serving import Served, make_hand, make_library, serving
from rtee_process import RTEE
from typer.testing import CliRunner

from rtee.cli._common import app_of
from rtee.cli.status import _stream
from rtee.cli.teleop import play, teleop
from rtee.commands import StreamStatus
from rtee.errors import ConfigError, LogError, RequestRejected


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Served]:
    monkeypatch.setenv("RTEE_RUNTIME_DIR", str(tmp_path / "run"))
    monkeypatch.delenv("RTEE_CONNECT", raising=False)
    monkeypatch.delenv("RTEE_HAND", raising=False)
    hand = make_hand(tmp_path)
    with (
        anyio.from_thread.start_blocking_portal() as portal,
        portal.wrap_async_context_manager(serving(hand, make_library(hand))) as served,
    ):
        yield served


def run(command: object, *words: str) -> str:
    result = CliRunner().invoke(app_of(command), words, catch_exceptions=False)  # type: ignore[arg-type]
    assert result.exit_code == 0, result.output
    return result.output


def test_a_table_is_played(served: Served, tmp_path: Path) -> None:
    table = tmp_path / "wave.csv"
    rows = [f"{k / 50},{k / 50:.2f}" for k in range(40)]
    table.write_text("\n".join(["t,near", *rows]))
    assert "40 samples in 0.4 s" in run(play, str(table), "--speed", "2")
    # How far it gets in 0.4 s is up to a busy computer.
    assert served.loop.controller.reference_position[0] > 0.1


def test_what_cannot_be_played(served: Served, tmp_path: Path) -> None:
    table = tmp_path / "wave.csv"
    table.write_text("t,nose\n" + "\n".join(f"{k / 50},0.1" for k in range(40)))
    with pytest.raises(RequestRejected, match="neither an actuator"):
        run(play, str(table))
    with pytest.raises(LogError):
        run(play, str(tmp_path / "nothing.mcap"))
    with pytest.raises(LogError):
        run(play, str(tmp_path / "nothing.csv"))


@pytest.mark.parametrize("words", [("fist",), ("fist", "--gamepad", "--keyboard")])
def test_one_input_is_needed(words: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError, match="give one of --gamepad, --keyboard and --landmarks"):
        run(teleop, *words)


def test_without_a_gamepad_one_sentence_says_so() -> None:
    with pytest.raises(ConfigError, match=r"gamepad|teleop"):
        run(teleop, "fist", "--gamepad", "--device", "/dev/null")


def test_without_a_terminal_one_sentence_says_so() -> None:
    with pytest.raises(ConfigError, match="terminal"):
        run(teleop, "fist", "--keyboard")


def test_the_keyboard_of_a_terminal_moves_the_hand(served: Served) -> None:
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [*RTEE, "teleop", "--keyboard", "Trig index"],
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
    )
    os.close(theirs)
    controller = served.loop.controller
    try:
        while controller.stream is None:
            time.sleep(0.02)
        os.write(ours, b"qqqqqq")  # 30 % of 1.5 rad
        while abs(controller.reference_position[0] - 0.45) > 1e-3:
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        while controller.stream is not None:
            time.sleep(0.02)
        assert process.wait(300) in (0, 130)
    finally:
        process.kill()
        process.wait(300)
        os.close(ours)


def test_the_status_in_words() -> None:
    said = _stream(StreamStatus("s", 49.9, 0.0214, 0.0003, 412, outliers=2, thinned=7))
    assert said.startswith("49.9 Hz, lag 21.4 ms, jitter 0.3 ms; 412 samples, 0 late, 0 pauses")
    assert said.endswith("dropped: 2 outlying, 7 too many")
