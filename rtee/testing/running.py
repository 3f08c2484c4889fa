"""Run a hand with emulated devices in a separate process, for the tests of an application.

The process ends with the test, and also when the process of the tests is killed.
"""

from __future__ import annotations

import contextlib
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final, Protocol

from anyio.from_thread import BlockingPortal

from rtee import child, monotonic
from rtee.errors import ConfigError, NoHand, RteeError
from rtee.hand.load import load_configured
from rtee.remote.blocking import BlockingHand, opened
from rtee.remote.client import RemoteHand
from rtee.remote.directory import VARIABLE, hands_running
from rtee.testing import bench
from rtee.testing.bench import Bench, EmulatedDevices

_READY_WITHIN: Final = 60.0
"""Time for starting, connecting and homing [s]; an SVH homes for half of it."""

_LOOK_EVERY: Final = 0.2
"""Interval at which a starting process is checked to be still running [s]."""

_END_WITHIN: Final = 10.0
"""Time for the hand to come to rest and to finish its recording [s]."""


class HandUnderTest(EmulatedDevices, BlockingHand):
    """A running hand whose emulated devices a test unplugs, fills and breaks.

    It has the methods of `rtee.connect_blocking`, and those of `EmulatedDevices`.
    """

    def __init__(
        self,
        portal: BlockingPortal,
        hand: RemoteHand,
        opened: contextlib.ExitStack,
        act: Callable[[str, str, str | None], None],
    ) -> None:
        super().__init__(portal, hand, opened)
        self._do = act

    def _act(self, what: str, detail: str, device: str | None) -> None:
        self._do(what, detail, device)


class StartHand(Protocol):
    """The type of the fixture ``rtee_hand``: starts a hand that runs until the test ends."""

    def __call__(
        self,
        hand: str | Path,
        *,
        object: str | None = None,  # noqa: A002 - as on the command line
        driver: str | None = None,
        timeout: float = _READY_WITHIN,
    ) -> HandUnderTest:
        """Start a hand; see `running_hand`."""


@contextlib.contextmanager
def running_hand(
    hand: str | Path,
    *,
    folder: Path,
    object: str | None = None,  # noqa: A002 - as on the command line
    driver: str | None = None,
    timeout: float = _READY_WITHIN,
) -> Iterator[HandUnderTest]:
    """Run a hand in a separate process for as long as the context lasts.

    All processes of this computer with the same environment variable ``RTEE_RUNTIME_DIR`` can find
    the hand. Only the hand of the started process is connected to, whatever else runs or
    ``RTEE_CONNECT`` says.

    Args:
        hand: Its name, or its folder.
        folder: Folder for the recordings and the output of the process.
        object: Object between the fingers, as for ``rtee run --object``.
        driver: Driver as for ``rtee run --driver``; ``None``: the hand's emulated devices, or the
            kinematic driver for a hand without devices.
        timeout: Longest time until all devices are active, including homing [s].

    Yields:
        The hand, ready to move.

    Raises:
        UserError: for every mistake in the hand's files or the options, and if a hand of this name
            runs already: it may be a real one.
        NotReady: if a device is not active in time.
        RteeError: if the hand does not start or fails; with the last line of its output.
    """
    config = load_configured(hand)[1]
    if (other := hands_running().get(config.name)) is not None:
        raise ConfigError(
            f"the hand '{config.name}' is already running, in process {other.pid}, and a test must "
            "not"
            f" move it: end it, or give the test a {VARIABLE} of its own, as the fixture rtee_hand"
            " does"
        )
    printed = folder / f"{config.name}.txt"
    chosen = driver or ("" if config.devices else "kinematic")
    ours, its = socket.socketpair()
    held = [] if object is None else [object]
    with printed.open("wb") as output, its:
        # The socket ends the hand when it is closed, which happens even if this process is killed.
        # The file may be closed: the hand has its own descriptor.
        process = subprocess.Popen(
            child.python(
                "-m",
                bench.__name__,
                str(its.fileno()),
                str(hand),
                str(folder / "logs"),
                chosen,
                *held,
            ),
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            pass_fds=[its.fileno()],
            # Its learned free motion must not reach the user's real hand, nor the next test.
            env={**child.environment(), "XDG_STATE_HOME": str(folder.resolve() / "state")},
        )
    line = bench.Bench(ours)
    try:
        with _connected(config.name, process, printed, timeout, line) as remote:
            yield remote
    except BaseException:
        # Whatever its exit status, the error of the test is the one to report.
        _end(process, line)
        raise
    # A loop that fails while it ends must fail the test, even if all goals were reached.
    if _end(process, line) != 0:
        raise RteeError(f"the hand '{config.name}' failed: {_last(printed)}")


@contextlib.contextmanager
def _connected(
    name: str, process: subprocess.Popen[bytes], printed: Path, timeout: float, line: Bench
) -> Iterator[HandUnderTest]:
    until = monotonic.now() + timeout
    while True:
        try:
            parts = opened(name, endpoint=_endpoint(name, process), client="test")
            remote = HandUnderTest(*parts, line.do)
            break
        except NoHand:
            if process.poll() is not None:
                raise _failure(name, process.returncode, printed) from None
            if monotonic.now() >= until:
                raise
            time.sleep(_LOOK_EVERY)
    with remote:
        remote.ready(max(0.0, until - monotonic.now()))
        yield remote


def _endpoint(name: str, process: subprocess.Popen[bytes]) -> str:
    """Return the endpoint of the hand that a process runs; raises `NoHand` until it does."""
    found = hands_running().get(name)
    # Compare the process: another hand of this name may have started at the same moment.
    if found is None or found.pid != process.pid or not found.endpoints:
        raise NoHand(f"the hand '{name}' is not running yet")
    return found.endpoints[0]


def _failure(name: str, status: int, printed: Path) -> RteeError:
    text = _last(printed)
    if status == ConfigError.exit_status:
        return ConfigError(text.removeprefix("rtee: "))
    return RteeError(f"the hand '{name}' ended with status {status}: {text}")


def _end(process: subprocess.Popen[bytes], line: Bench) -> int:
    """Let the hand come to rest and end; return its exit status."""
    line.close()
    try:
        return process.wait(_END_WITHIN)
    except subprocess.TimeoutExpired:
        # A test must not wait for ever for a hand that does not come to rest.
        process.kill()
        return process.wait()


def _last(printed: Path) -> str:
    lines = printed.read_text("utf-8", errors="replace").strip().splitlines()
    return lines[-1] if lines else "it printed nothing"
