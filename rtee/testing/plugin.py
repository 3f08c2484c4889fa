"""The pytest plugin of rtee: hands for the tests of applications, and help for drivers' authors.

``rtee_hand`` starts a hand whose devices are emulated. The assertions of the contract suite speak,
and ``no_leaks`` is a leak check.

It is loaded through the entry point ``pytest11`` in every project that has rtee installed, so it
imports nothing of rtee by itself and changes nothing that is not asked for.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from rtee.remote.blocking import BlockingHand
    from rtee.testing.running import StartHand

# Before it is imported: its assertions then show their values, as those of a test file do.
pytest.register_assert_rewrite("rtee.testing.contract")


@pytest.fixture
def no_leaks() -> Iterator[None]:
    """Fail a test that leaves file descriptors or threads behind."""
    files, threads = _files(), threading.active_count()
    yield
    end = time.monotonic() + 2.0
    # Threads and transports may end a moment after the test: they get two seconds.
    while (_files() > files or threading.active_count() > threads) and time.monotonic() < end:
        time.sleep(0.01)
    if _files() > files or threading.active_count() > threads:
        pytest.fail(
            f"left behind: {_files() - files} files, {threading.active_count() - threads} threads"
        )


@pytest.fixture
def rtee_hand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[StartHand]:
    """Start hands whose devices are emulated; they run until the test ends.

    ``rtee_hand("robotiq_2f_85", object="50mm")`` returns the hand as `rtee.connect_blocking` does,
    ready; everything in the test that connects to a hand finds this one and no other. Recordings
    are in the test's ``tmp_path``, under ``rtee``. See `rtee.testing.running.running_hand` for what
    else may be given.
    """
    from rtee.testing.running import running_hand

    folder = tmp_path / "rtee"
    folder.mkdir()
    monkeypatch.setenv("RTEE_RUNTIME_DIR", str(folder / "run"))
    for name in ("RTEE_CONNECT", "RTEE_HAND"):
        # A hand that the developer runs beside the tests must not be found instead.
        monkeypatch.delenv(name, raising=False)
    with contextlib.ExitStack() as stack:

        def start(
            hand: str | Path,
            *,
            object: str | None = None,  # noqa: A002 - as on the command line
            driver: str | None = None,
            timeout: float = 60.0,
        ) -> BlockingHand:
            return stack.enter_context(
                running_hand(hand, folder=folder, object=object, driver=driver, timeout=timeout)
            )

        yield start


def _files() -> int:
    folder = "/proc/self/fd"
    return len(os.listdir(folder)) if os.path.isdir(folder) else 0
