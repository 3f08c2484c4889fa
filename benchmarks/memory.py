"""Measure the memory of hands in an ordinary process without recordings; print Markdown.

    python benchmarks/memory.py [--seconds 75] [--hands robotiq_2f_85 schunk_svh]

`rtee run --no-log` runs the first hand, then all of them in one process. *Resident* is the figure
of `ps`; *own* is memory that no other process can share; the rest are pages of program files, such
as libraries, which the system keeps once for all processes and discards when memory is short.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from common import Table, command_line, own
from witness import child

EARLY = 12.0
"""Time of the first measurement [s]: everything has started by then."""


def resident(pid: int) -> float:
    """Return the resident memory of a process and the part of it in files [byte]."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return float(line.split()[1]) * 1024
    raise SystemExit("the run has ended")


def main() -> None:
    """Measure and print."""
    parser = command_line(__doc__, seconds=75.0)
    parser.add_argument("--hands", nargs="+", default=["robotiq_2f_85", "schunk_svh"])
    args = parser.parse_args()
    table = Table("hands", "after [s]", "resident [MB]", "own [MB]", widths=(26,))
    for hands in (args.hands[:1], args.hands):
        with tempfile.TemporaryDirectory() as folder:  # where a fault would be written
            words = [sys.executable, "-m", "rtee", "run", *hands, "--no-log"]
            with child(words, cwd=folder, stdout=subprocess.DEVNULL) as process:
                waited = 0.0
                for seconds in (EARLY, args.seconds):
                    time.sleep(seconds - waited)
                    waited = seconds
                    sizes = (resident(process.pid), own(process.pid))
                    table.row(", ".join(hands), seconds, *(f"{size / 1e6:.1f}" for size in sizes))
                process.terminate()


if __name__ == "__main__":
    main()
