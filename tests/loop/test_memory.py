"""Memory that only the start needed is given back: in a process of its own, that uses it again."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux only")

_CODE = r"""
import re
from pathlib import Path
import numpy as np
from rtee.loop.memory import give_memory_back

def resident():
    "Code of files that is in memory, and what was written anywhere [kB]."
    found = {"r-xp": 0, "own": 0}
    text = Path("/proc/self/smaps").read_text()
    for area in re.findall(r"^[0-9a-f]+-[0-9a-f]+ .*\n(?:[A-Z].*\n)+", text, re.M):
        head, *rest = area.splitlines()
        values = {line.split(":")[0]: line.split()[1] for line in rest}
        if head.split()[1] == "r-xp" and "/" in head:
            found["r-xp"] += int(values["Rss"])
        found["own"] += int(values["Anonymous"])
    return found["r-xp"], found["own"]

kept = np.arange(10000.0)
solved = np.linalg.solve(np.eye(50) * 2, np.ones(50))
freed = [bytes(5000) for _ in range(4000)]  # below the size for which malloc asks the system
top = bytes(5000)  # what lies above is not given back by free itself
before = resident()
del freed
give_memory_back()
after = resident()
again = np.linalg.solve(np.eye(50) * 2, np.ones(50))
print(*before, *after, kept.sum() == 49995000.0, np.array_equal(solved, again))
"""


def test_what_only_the_start_needed_is_given_back_and_comes_again_when_used() -> None:
    done = subprocess.run([sys.executable, "-c", _CODE], capture_output=True, text=True, check=True)
    *sizes, kept, same = done.stdout.split()
    code, own, less_code, less_own = map(int, sizes)
    assert less_code < code / 2
    assert less_own < own - 15_000, "20 MB were freed"
    assert (kept, same) == ("True", "True")
