"""Hands and GUIs in processes of their own, apart from all others on this computer."""

from __future__ import annotations

import contextlib
import os
import queue
import re
import shutil
import signal
import socket
import subprocess
import threading
from pathlib import Path

from rtee_process import RTEE

PATIENCE = 60.0
"""Longest wait, in a page or for a line [s]: for a hang, not for a slow computer."""

GRIPPER, SQUEEZER, MANY = "robotiq_2f_85", "squeezer", "many"
"""The hands of the tests in a browser: kinematic, simulated with a ball, and with 24 actuators."""


class Program:
    """A command of rtee that runs until it is ended."""

    def __init__(
        self, folder: Path, *arguments: str, command: tuple[str, ...] = RTEE, **more: str
    ) -> None:
        runtime = folder / "run"
        runtime.mkdir(mode=0o700, exist_ok=True)
        environment = {k: v for k, v in os.environ.items() if not k.startswith("RTEE_")}
        environment |= {"XDG_RUNTIME_DIR": str(runtime), "PYTHONUNBUFFERED": "1", **more}
        environment["PYTHONPATH"] = str(Path(__file__).with_name("gate"))
        self.process = subprocess.Popen(
            [*command, *arguments],
            cwd=folder,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        self._lines: queue.Queue[str] = queue.Queue()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._lines.put(line)
        self._lines.put("")  # there will be no more

    def line(self, pattern: str) -> re.Match[str]:
        """Wait for a line of its output."""
        said: list[str] = []
        with contextlib.suppress(queue.Empty):
            while line := self._lines.get(timeout=PATIENCE):
                said.append(line)
                if found := re.search(pattern, line):
                    return found
        raise AssertionError(f"it ended or waits without '{pattern}': {''.join(said)}")

    def rest(self) -> str:
        """Return what it has said since the last line that was waited for."""
        lines = []
        while not self._lines.empty():
            lines.append(self._lines.get())
        return "".join(lines)

    def kill(self) -> None:
        """Kill it as a crash would."""
        self.process.kill()
        self.process.wait()

    def end(self) -> None:
        """End it in good order."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            self.process.wait()
        self._thread.join()
        if self.process.stdout is not None:
            self.process.stdout.close()


def free_port() -> int:
    """Return a port of this computer that is free."""
    with socket.socket() as trial:
        trial.bind(("127.0.0.1", 0))
        return int(trial.getsockname()[1])


def copy_of(repository: Path, folder: Path, hand: str, name: str | None = None) -> Path:
    """Copy a hand, so that actions made in a test are stored in the copy."""
    target = folder / "config" / (name or hand)
    shutil.copytree(repository / "config" / hand, target)
    if name is not None:
        file = target / "hand.yaml"
        file.write_text(re.sub(r"(?m)^name: .*$", f"name: {name}", file.read_text()))
    return target
