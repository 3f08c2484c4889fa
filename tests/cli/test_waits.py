"""No command waits in silence for what is not there."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import anyio
import pytest
from rtee_process import RTEE

from rtee.cli import _common
from rtee.cli.main import main
from rtee.errors import NoHand
from rtee.remote.directory import about_to_run, starting


def test_the_gui_of_a_hand_that_does_not_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("viser")
    monkeypatch.setenv("RTEE_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("RTEE_CONNECT", raising=False)
    monkeypatch.setattr(sys, "argv", ["rtee", "gui", "schunk_svh"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err.count("\n") == 1
    assert "the hand 'schunk_svh' is not running on this computer" in output.err
    assert "'rtee run schunk_svh'" in output.err


def test_clients_wait_for_a_hand_while_its_run_is_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[list[str]] = []

    async def run_hands(*_: object, **__: object) -> int:
        told.append(starting())
        return 0

    monkeypatch.setenv("RTEE_RUNTIME_DIR", str(tmp_path / "run"))
    monkeypatch.setattr("rtee.running.run.run_hands", run_hands)
    monkeypatch.setattr(sys, "argv", ["rtee", "run", "config/schunk_svh/", "robotiq_2f_85"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
    assert told == [["schunk_svh", "robotiq_2f_85"]]
    assert starting() == []


def test_the_first_word_may_be_a_hand_that_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("RTEE_RUNTIME_DIR", str(tmp_path / "run"))
    monkeypatch.delenv("RTEE_CONNECT", raising=False)
    monkeypatch.setattr("rtee.remote.find._STARTING", 0.0)
    monkeypatch.setattr(sys, "argv", ["rtee", "do", "schunk_svh", "fist"])
    with about_to_run(["schunk_svh"]), pytest.raises(SystemExit):
        main()
    assert "the hand 'schunk_svh' is not running on this computer" in capsys.readouterr().err


def test_the_gui_of_any_hand_says_that_it_waits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("viser")
    monkeypatch.setenv("RTEE_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("RTEE_CONNECT", raising=False)
    words = [*RTEE, "gui", "--port", "0"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as page:
        assert page.stdout is not None
        said = page.stdout.readline()
        page.terminate()
    assert said == "rtee: no hand runs here yet; the page will show the first one that does\n"


def test_the_first_word_is_the_hand_that_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("RTEE_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("RTEE_CONNECT", raising=False)
    monkeypatch.setattr(sys, "argv", ["rtee", "do", "schunk_svh", "fist", "--wait", "0"])
    with pytest.raises(SystemExit):
        main()
    assert "the hand 'schunk_svh' is not running on this computer" in capsys.readouterr().err


def test_the_first_word_is_the_hand_elsewhere(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Commands of two words took it for the action, and asked which hand was meant."""
    monkeypatch.setenv("RTEE_CONNECT", "robot")
    for words in ("do schunk_svh fist", "recover schunk_svh hand", "log mark schunk_svh x"):
        monkeypatch.setattr(sys, "argv", ["rtee", *words.split()])
        with pytest.raises(SystemExit):
            main()
        # All words were taken: the next mistake is the endpoint.
        assert "'robot' is not an endpoint" in capsys.readouterr().err


def test_a_hand_that_does_not_answer_is_waited_for_in_words(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told: list[str] = []
    heard = anyio.Event()

    class Silent:
        async def __aenter__(self) -> None:
            await heard.wait()
            raise NoHand("it does not answer")

        async def __aexit__(self, *_: object) -> None: ...

    def hear(text: str) -> None:
        told.append(text)
        heard.set()

    async def nothing(_: object) -> None: ...

    monkeypatch.setattr("rtee.remote.client.connect", lambda *_, **__: Silent())
    monkeypatch.setattr(_common, "_SILENCE", 0.0)
    monkeypatch.setattr(_common, "waiting", hear)
    with pytest.raises(NoHand):
        _common.with_hand(None, None, "do", nothing)
    assert told == ["the hand has not answered for 0 s"]


def test_a_watch_of_no_hand_says_that_it_waits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RTEE_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("RTEE_CONNECT", raising=False)
    words = [*RTEE, "status", "--watch"]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as watching:
        assert watching.stderr is not None
        told = watching.stderr.readline()
        watching.kill()
    assert told.startswith("rtee: waiting: no hand is running on this computer; start one with")
