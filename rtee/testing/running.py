"""Run a hand beside the tests of an application, with emulated devices.

Its process ends with the test, and also when the process of the tests is killed.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol

import rtee
from rtee.drivers.plain_options import default_options
from rtee.drivers.registry import find_driver
from rtee.errors import ConfigError, NoHand, RteeError
from rtee.hand.load import load_configured

if TYPE_CHECKING:
    from rtee.hand.config import HandConfig
    from rtee.remote.blocking import BlockingHand

_READY_WITHIN: Final = 60.0
"""Time for starting, connecting and homing [s]; an SVH homes for half of it."""

_LOOK_EVERY: Final = 0.2
"""Time between two looks whether the process that starts is still there [s]."""

_END_WITHIN: Final = 10.0
"""Time for coming to rest and writing the rest of the recording [s]."""

# `rtee` that ends with its input: when that is closed, it is interrupted as by Ctrl-C.
_PROGRAM: Final = """
import os, runpy, signal, sys, threading

def watch():
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGINT)

signal.signal(signal.SIGINT, signal.default_int_handler)
threading.Thread(target=watch, daemon=True).start()
runpy.run_module("rtee", run_name="__main__", alter_sys=True)
"""


class StartHand(Protocol):
    """What the fixture ``rtee_hand`` is: it starts a hand that runs until the test ends."""

    def __call__(
        self,
        hand: str | Path,
        *,
        object: str | None = None,  # noqa: A002 - as on the command line
        driver: str | None = None,
        timeout: float = _READY_WITHIN,
    ) -> BlockingHand:
        """Start a hand; see `running_hand`."""


@contextlib.contextmanager
def running_hand(
    hand: str | Path,
    *,
    folder: Path,
    object: str | None = None,  # noqa: A002 - as on the command line
    driver: str | None = None,
    timeout: float = _READY_WITHIN,
) -> Iterator[BlockingHand]:
    """Run a hand in a process of its own for as long as the context lasts.

    It can be found on this computer by all that share the environment variable
    ``RTEE_RUNTIME_DIR`` with this process.

    Args:
        hand: Its name, or its folder.
        folder: Where its recordings go, and what the process says.
        object: What is between the fingers, as ``rtee run --object`` takes it.
        driver: As ``rtee run --driver`` takes it; ``None``: the hand's devices, emulated; the
            kinematic driver for a hand without devices.
        timeout: Time until all devices are active, homing included [s].

    Yields:
        The hand, ready.

    Raises:
        UserError: for every mistake in the hand's files or the options.
        NotReady: if a device is not active in time.
        RteeError: if the hand does not start, or failed; with what it said.
    """
    config = load_configured(hand)[1]
    said = folder / f"{config.name}.txt"
    words = [str(hand), "--log", str(folder / "logs"), *_driven(config, driver)]
    words += [] if object is None else ["--object", object]
    command = [sys.executable, "-c", _PROGRAM, "run", *words]
    with said.open("wb") as output:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=output, stderr=output)
    try:
        with _connected(config.name, process, said, timeout) as remote:
            yield remote
    except BaseException:
        _end(process)
        raise
    # A loop that failed at its end must fail the test, too, even if all goals were reached.
    if _end(process) != 0:
        raise RteeError(f"the hand '{config.name}' failed: {_last(said)}")


def _driven(config: HandConfig, driver: str | None) -> list[str]:
    """Return the options that say what is driven: emulated devices, which may home, if any."""
    if driver is not None:
        return ["--driver", driver]
    if not config.devices:
        return ["--driver", "kinematic"]
    drivers = [find_driver(device.driver) for device in config.devices.values()]
    homes = any("home" in default_options(driver.Options) for driver in drivers)
    return ["--driver", "devices", "--emulated", *(["--home"] if homes else [])]


@contextlib.contextmanager
def _connected(
    name: str, process: subprocess.Popen[bytes], said: Path, timeout: float
) -> Iterator[BlockingHand]:
    until = time.monotonic() + timeout
    while True:
        try:
            remote = rtee.connect_blocking(name, client="test", wait=_LOOK_EVERY)
            break
        except NoHand:
            if process.poll() is not None:
                raise _failure(name, process.returncode, said) from None
            if time.monotonic() >= until:
                raise
    with remote:
        remote.ready(max(0.0, until - time.monotonic()))
        yield remote


def _failure(name: str, status: int, said: Path) -> RteeError:
    text = _last(said)
    if status == ConfigError.exit_status:
        return ConfigError(text.removeprefix("rtee: "))
    return RteeError(f"the hand '{name}' ended with status {status}: {text}")


def _end(process: subprocess.Popen[bytes]) -> int:
    """Have the hand come to rest and end; return its exit status."""
    if process.stdin is not None:
        process.stdin.close()
    try:
        return process.wait(_END_WITHIN)
    except subprocess.TimeoutExpired:
        # It does not come to rest: a test must not wait for ever.
        process.kill()
        return process.wait()


def _last(said: Path) -> str:
    lines = said.read_text("utf-8", errors="replace").strip().splitlines()
    return lines[-1] if lines else "it said nothing"
