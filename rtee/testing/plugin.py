"""The pytest plugin of rtee: makes the contract suite's assertions speak, and offers a leak check.

It is loaded through the entry point ``pytest11`` in every project that has rtee installed, so it
imports nothing of rtee by itself and changes nothing that is not asked for.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator

import pytest

pytest.register_assert_rewrite("rtee.testing.contract")


@pytest.fixture
def no_leaks() -> Iterator[None]:
    """Fail a test that leaves file descriptors or threads behind."""
    files, threads = _files(), threading.active_count()
    yield
    end = time.monotonic() + 2.0
    while (_files() > files or threading.active_count() > threads) and time.monotonic() < end:
        time.sleep(0.01)
    if _files() > files or threading.active_count() > threads:
        pytest.fail(
            f"left behind: {_files() - files} files, {threading.active_count() - threads} threads"
        )


def _files() -> int:
    folder = "/proc/self/fd"
    return len(os.listdir(folder)) if os.path.isdir(folder) else 0
