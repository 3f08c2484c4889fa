"""Attribute missed ticks to the computer or to the loop, by a witness of stalled CPUs.

A virtual machine is stopped by its host now and then, for milliseconds; whatever runs on it then is
late. `cyclictest` (Debian: rt-tests), the kernel's own C program, runs beside the loop as a
witness, with one thread per CPU, above the loop's priority, and notes when it was woken late
itself. A tick that the loop missed while a witness was late, too, is the computer's; the others are
the loop's own.
"""

from __future__ import annotations

import bisect
import ctypes
import itertools
import re
import shutil
import signal
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

PERIOD_US = 500
"""The witness wakes up this often: half a period of the loop [µs]."""

LATE_US = 300
"""Lateness of a witness from which on its CPU counts as stalled [µs]: an idle CPU wakes it
sooner."""

PRIORITY = 90  # above the loop's 80: the witness is late only if the CPU stood still

_SPIKE = re.compile(r"(?m)^T:\s*\d+ Spike:\s*(\d+): TS:\s*(\d+)")
_PR_SET_PDEATHSIG = 1
# Loaded before the fork: little is safe between fork and exec.
_C = ctypes.CDLL(None)


def child(words: Sequence[str], **options: Any) -> subprocess.Popen[str]:
    """Start a program that is killed when this one ends, for whatever reason."""

    def die_with_parent() -> None:
        _C.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)

    return subprocess.Popen(words, text=True, preexec_fn=die_with_parent, **options)


@dataclass(frozen=True)
class Missed:
    """Ticks that the loop missed in a row.

    Attributes:
        woken: When it woke up at last, CLOCK_MONOTONIC [s].
        since: When the last tick before was due [s].
        count: How many.
        busy: Processor time that its thread had used in the tick before [s].
        switches: How often its thread was taken off its CPU meanwhile.
        faults: Pages that were missing meanwhile.
        computer: A witness was late, too; ``None``: there was none.
    """

    woken: float
    since: float
    count: int
    busy: float
    switches: int
    faults: int
    computer: bool | None = None


class Witness:
    """Notes stalls of CPUs until `stop`; without cyclictest it notes nothing."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        if shutil.which("cyclictest") is None:
            return
        words = ["cyclictest", "-q", "-m", f"-p{PRIORITY}", "-S", f"-i{PERIOD_US}", "-d0"]
        # Its usual set-up of the whole computer would make the loop look better than it is alone.
        words += ["--default-system", f"--spike={LATE_US}", "--spike-nodes=1000000"]
        self._process = child(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)

    def stop(self) -> list[tuple[float, float]] | None:
        """Return the stalls of CPUs, from and to [s]; ``None`` without a measurement."""
        if self._process is None or self._process.poll() is not None:
            return None
        self._process.send_signal(signal.SIGINT)
        said = self._process.communicate(timeout=10)[0]
        late = [(int(found[1]), int(found[2])) for found in _SPIKE.finditer(said)]
        return [((stamp - lateness) * 1e-6, stamp * 1e-6) for lateness, stamp in late]


class StoodStill:
    """The stalls of CPUs, sorted for many look-ups.

    Args:
        spans: From and to [s]; ``None`` without a measurement.
    """

    def __init__(self, spans: Sequence[tuple[float, float]] | None) -> None:
        self.measured = spans is not None
        ordered = sorted(spans or ())
        self._begins = [begin for begin, _ in ordered]
        # The latest end of a span and of all before it.
        self._ends = list(itertools.accumulate((end for _, end in ordered), max))

    def between(self, begin: float, end: float) -> bool:
        """Return whether a CPU was stalled at any moment of a span."""
        before = bisect.bisect_right(self._begins, end)
        return before > 0 and self._ends[before - 1] >= begin


def judged(missed: Missed, stood_still: StoodStill) -> Missed:
    """Return missed ticks, each attributed to the computer or to the loop."""
    if not stood_still.measured:
        return missed
    found = stood_still.between(missed.since, missed.woken)
    return Missed(**{**vars(missed), "computer": found})
