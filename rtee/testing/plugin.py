"""The pytest plugin of rtee: fixtures for the tests of applications and of drivers.

``rtee_hand`` starts a hand whose devices are emulated; ``no_leaks`` detects leaked files and
threads. Failing assertions of the contract suite show their values.

Pytest loads the plugin through the entry point ``pytest11`` in every project that has rtee
installed, so it imports nothing of rtee before a fixture is used.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from rtee import monotonic

if TYPE_CHECKING:
    from rtee.testing.running import HandUnderTest, StartHand
    from rtee.testing.simulated import SimulatedHand, StartSimulatedHand

# Must precede the import: pytest then rewrites its assertions like those of a test file.
pytest.register_assert_rewrite("rtee.testing.contract")


@pytest.fixture
def no_leaks() -> Iterator[None]:
    """Fail a test that leaves file descriptors or threads behind."""
    files, threads = _files(), threading.active_count()
    yield
    end = monotonic.now() + 2.0
    # Threads and transports may end a moment after the test, so they get two seconds.
    while (_files() > files or threading.active_count() > threads) and monotonic.now() < end:
        time.sleep(0.01)
    if _files() > files or threading.active_count() > threads:
        pytest.fail(
            f"left behind: {_files() - files} files, {threading.active_count() - threads} threads"
        )


@pytest.fixture
def rtee_hand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[StartHand]:
    """Start hands whose devices are emulated; they run until the test ends.

    ``rtee_hand("robotiq_2f_85", object="50mm")`` returns the hand as `rtee.connect_blocking` does,
    ready to move; everything in the test that connects to a hand finds only this one. Recordings
    are in the test's ``tmp_path``, under ``rtee``. For the other arguments, see
    `rtee.testing.running.running_hand`.
    """
    from rtee.testing.running import running_hand

    folder = tmp_path / "rtee"
    folder.mkdir()
    monkeypatch.setenv("RTEE_RUNTIME_DIR", str(folder / "run"))
    for name in ("RTEE_CONNECT", "RTEE_HAND"):
        # The test must not connect to a hand that the developer runs at the same time.
        monkeypatch.delenv(name, raising=False)
    with contextlib.ExitStack() as stack:

        def start(hand: str | Path, **options: Any) -> HandUnderTest:
            return stack.enter_context(running_hand(hand, folder=folder, **options))

        yield start


@pytest.fixture
def rtee_simulated_hand() -> Iterator[StartSimulatedHand]:
    """Start hands on simulated time, in this process; they run until the test ends.

    ``rtee_simulated_hand("robotiq_2f_85", object="50mm")`` returns a
    `rtee.testing.simulated.SimulatedHand`, ready to move. Nothing listens: pass it to the code
    under test instead of connecting.
    """
    from rtee.testing.simulated import simulated

    with contextlib.ExitStack() as stack:

        def start(hand: str | Path, **options: Any) -> SimulatedHand:
            return stack.enter_context(simulated(hand, **options))

        yield start


def _files() -> int:
    folder = "/proc/self/fd"
    # Without /proc, as on macOS, only threads are compared.
    return len(os.listdir(folder)) if os.path.isdir(folder) else 0
