"""Common parts of the benchmarks: the parser of command lines, and the printer of tables."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

HELP = {
    "chromium": "measure Chromium's window, too",
    "connections": "connections that are made, one after the other",
    "cycles": "exchanges with each fault",
    "flight": "what the flight recorder keeps [s]",
    "frames": "frames for each decoder",
    "goals": "goals that are sent",
    "hand": "name of the hand",
    "hands": "names of hands, or their URDFs",
    "hogs": "programs that keep CPUs busy",
    "jobs": "processes at a time",
    "live": "also over the network",
    "kills": "recordings that are killed",
    "minutes": "length of the recording that is read [min]",
    "nice": "priority of Chromium, 0 (as all others) to 19 (lowest)",
    "no_matrix": "leave the faults out",
    "no_throughput": "leave the throughput out",
    "only": "what has this in its name, and nothing else",
    "pairs": "runs with each driver, by turns",
    "places": "places of the object that rtee try tries",
    "rate": "ticks per second [Hz]",
    "realtime": "with real-time scheduling, as on a robot PC",
    "record": "also record every tick",
    "reference": "length of cyclictest, at most [s]",
    "runs": "runs of each hand",
    "no_sampling": "leave random sampling out",
    "starts": "compare depths with those of a search from this many starts",
    "times": "how often each hand is extracted",
    "every": "print every pinch, not only those that differ",
    "rounds": "how often everything is measured, by turns",
    "seconds": "length of each measurement [s]",
    "slow": "how much longer a flush to the disk takes in an overload [s]",
    "still": "motion is more than this [rad | m]",
    "tries": "how often each command is given",
    "warm": "time before anything is measured [s]",
    "witness": "cyclictest beside the loop",
}
"""The help texts of the benchmarks' options."""


def command_line(doc: str | None, **options: object) -> argparse.ArgumentParser:
    """Return the parser of a benchmark's command line.

    Args:
        doc: The benchmark's docstring, printed by ``--help``.
        **options: Options (see `HELP`) and their defaults, whose types they take; ``False`` makes a
            flag, a type an option that is ``None`` unless it is given.
    """
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, value in options.items():
        flag, said = f"--{name.replace('_', '-')}", HELP[name]
        # Before `isinstance(value, type)` and numbers: a bool is an int in Python.
        if value is False:
            parser.add_argument(flag, action="store_true", help=said)
        elif isinstance(value, type):
            parser.add_argument(flag, type=value, help=said)
        else:
            said = f"{said} (default: %(default)s)"
            parser.add_argument(flag, type=type(value), default=value, help=said)
    return parser


def own(pid: int) -> float:
    """Return the memory that is a process' own [byte]."""
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
        if line.startswith("Pss_Anon:"):
            return float(line.split()[1]) * 1024
    raise SystemExit("this kernel does not tell whose memory is whose")


def interval_of_median(values: Sequence[float]) -> tuple[float, float]:
    """Return between which values the true median lies with at least 95 % certainty.

    The number of values below it has a binomial distribution, whatever theirs is. With fewer than
    six values no interval is certain enough: it is infinite.
    """
    ordered, n = sorted(values), len(values)
    outside, k = 0.0, 0
    while (outside := outside + math.comb(n, k) / 2**n) <= 0.025:
        k += 1
    return (ordered[k - 1], ordered[n - k]) if k else (-math.inf, math.inf)


class Table:
    """A Markdown table that is printed row by row, as the results come in."""

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
        """Print a row, at once."""
        texts = [str(cell).ljust(w) for cell, w in zip(cells, self._widths, strict=True)]
        print(f"| {' | '.join(texts)} |", flush=True)
