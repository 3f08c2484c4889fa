"""Extraction, simulation and replay without what only Linux has, and what Windows is told."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

HIDDEN = Path(__file__).parent / "without_linux"


@pytest.mark.heavy
def test_a_mac_would_find_actions_run_a_hand_and_replay(tmp_path: Path, repository: Path) -> None:
    more = {"PYTHONPATH": str(HIDDEN), "RTEE_RUNTIME_DIR": str(tmp_path / "run")}
    environment = {**os.environ, **more}

    def python(*words: str) -> str:
        done = subprocess.run(
            [sys.executable, *words],
            env=environment,
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    look = "import select, sys; print(sys.platform, hasattr(select, 'epoll'))"
    assert python("-c", look) == "darwin False\n"
    hand = str(repository / "config" / "robotiq_2f_85")
    assert "PinchTight" in python("-m", "rtee", "extract", hand)
    with subprocess.Popen(
        [sys.executable, "-m", "rtee", "run", hand],
        env=environment,
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        text=True,
    ) as run:
        assert run.stdout is not None
        assert "1 actuator" in run.stdout.readline()
        assert "reached" in python("-m", "rtee", "do", "Grasp")
        assert "active" in python("-m", "rtee", "status")
        with subprocess.Popen(
            [sys.executable, "-m", "rtee", "gui", "--port", "0"],
            env=environment,
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            text=True,
        ) as gui:
            assert gui.stdout is not None
            address = next(word for word in gui.stdout.readline().split() if "http://" in word)
            browser = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
            try:
                with browser.open(address) as page:
                    assert b"<html" in page.read()
            finally:
                gui.send_signal(signal.SIGINT)
        run.send_signal(signal.SIGINT)
    assert run.returncode == 0
    assert "the same" in python("-m", "rtee", "log", "replay", "--check", "logs")


WINDOWS = """
import sys
for name in ("fcntl", "termios", "resource", "pwd", "grp"):
    sys.modules[name] = None
from rtee.cli import main
sys.platform = "win32"
main()
"""


def test_windows_is_told_in_a_sentence() -> None:
    done = subprocess.run(
        [sys.executable, "-c", WINDOWS], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("rtee: rtee runs on Linux, ")
    assert done.stderr.endswith("not on Windows; use WSL 2\n")
