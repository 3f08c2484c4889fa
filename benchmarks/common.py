"""Common parts of the benchmarks: the parser of command lines, statistics, and Markdown tables."""

from __future__ import annotations

import argparse
import atexit
import math
import os
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

HELP = {
    "chromium": "measure Chromium's window, too",
    "connections": "number of connections, made one after the other",
    "before": "folder of hands whose stored actions are compared",
    "cycles": "exchanges with each fault",
    "generations": "most generations of an evolution",
    "flight": "length of the flight recorder's history [s]",
    "frames": "frames for each decoder",
    "fresh": "send each goal only once",
    "goals": "number of goals to send",
    "hand": "name of the hand",
    "hands": "names of hands, or their URDFs",
    "hogs": "number of programs that keep CPUs busy",
    "jobs": "processes at a time",
    "live": "measure over the network, too",
    "kills": "number of times that a recording process is killed",
    "minutes": "length of the measurement or recording [min]",
    "nice": "priority of Chromium, 0 (as all others) to 19 (lowest)",
    "no_matrix": "leave the faults out",
    "no_throughput": "leave the throughput out",
    "processor": "measure processor time of exchanges in simulated time",
    "only": "measure only what has this in its name",
    "pairs": "runs with each driver, by turns",
    "places": "number of places of the object for rtee try",
    "rate": "ticks per second [Hz]",
    "realtime": "with real-time scheduling, as on a robot PC",
    "record": "record every tick, too",
    "reference": "longest run of cyclictest [s]",
    "runs": "runs of each hand",
    "no_sampling": "leave random sampling out",
    "starts": "compare depths with those of a search from this many starts",
    "tls": "send the stops through TLS",
    "times": "number of extractions of each hand",
    "every": "print every pinch, not only those that differ",
    "rounds": "number of rounds, in which all cases are measured by turns",
    "sample": "take every n-th pinch only",
    "seconds": "length of each measurement [s]",
    "seed": "seed of the variations",
    "slow": "additional time of a flush to the disk in an overload [s]",
    "still": "least motion that counts [rad | m]",
    "tries": "number of times each thing is done",
    "varied": "variations of each grasp",
    "warm": "time before the measurement [s]",
    "witness": "cyclictest beside the loop",
}
"""The help texts of the benchmarks' options."""


_OWN = "RTEE_BENCHMARK"
"""Variable of the environment that says that a benchmark has its own runtime folder."""


def own_runtime() -> None:
    """Give this process and its children a runtime folder of their own.

    A benchmark must neither find nor move the hands that already run on this computer.
    """
    if _OWN in os.environ:  # a child of the benchmark that made the folder
        return
    for name in ("RTEE_CONNECT", "RTEE_HAND"):
        os.environ.pop(name, None)
    os.environ[_OWN] = os.environ["RTEE_RUNTIME_DIR"] = tempfile.mkdtemp(prefix="rtee-")
    atexit.register(shutil.rmtree, os.environ[_OWN], ignore_errors=True)


def command_line(doc: str | None, **options: object) -> argparse.ArgumentParser:
    """Return the parser of a benchmark's command line; calls `own_runtime`.

    Args:
        doc: The benchmark's docstring, printed by ``--help``.
        **options: Options (see `HELP`) and their defaults, whose types they take; ``False`` makes a
            flag, a type an option that is ``None`` unless it is given.
    """
    own_runtime()
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, value in options.items():
        flag, text = f"--{name.replace('_', '-')}", HELP[name]
        # Before `isinstance(value, type)` and numbers: a bool is an int in Python.
        if value is False:
            parser.add_argument(flag, action="store_true", help=text)
        elif isinstance(value, type):
            parser.add_argument(flag, type=value, help=text)
        else:
            text = f"{text} (default: %(default)s)"
            parser.add_argument(flag, type=type(value), default=value, help=text)
    return parser


def own(pid: int) -> float:
    """Return a process's own memory, without pages of files [byte]."""
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
        # "Proportional": memory shared with a fork counts for each process in part.
        if line.startswith("Pss_Anon:"):
            return float(line.split()[1]) * 1024
    raise SystemExit("this kernel does not report the memory of single processes")


def interval_of_median(values: Sequence[float]) -> tuple[float, float]:
    """Return the interval that contains the true median with at least 95 % certainty.

    The number of values below the median has a binomial distribution, whatever the values'
    distribution is. With fewer than six values the interval is infinite.
    """
    ordered, n = sorted(values), len(values)
    outside, k = 0.0, 0
    while (outside := outside + math.comb(n, k) / 2**n) <= 0.025:
        k += 1
    return (ordered[k - 1], ordered[n - k]) if k else (-math.inf, math.inf)


class Table:
    """A Markdown table that is printed row by row, as results arrive."""

    def __init__(self, *head: str, widths: Sequence[int] = ()) -> None:
        """Print the head.

        Args:
            head: The columns' titles.
            widths: Least widths of the first columns [characters], so that columns are aligned on a
                terminal, too.
        """
        self._widths = [*widths, *(0 for _ in head[len(widths) :])]
        self.row(*head)
        self.row(*("---" for _ in head))

    def row(self, *cells: object) -> None:
        """Print a row at once, not buffered."""
        texts = [str(cell).ljust(w) for cell, w in zip(cells, self._widths, strict=True)]
        print(f"| {' | '.join(texts)} |", flush=True)
