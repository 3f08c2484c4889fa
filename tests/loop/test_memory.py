"""Memory that only the start needed is given back: in a process of its own, that uses it again."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

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


_WRITTEN = r"""
import ctypes
import mmap
from pathlib import Path
from rtee.loop.memory import give_memory_back

file = Path({file!r})
file.write_bytes(b"file" * mmap.PAGESIZE)
with file.open("rb") as opened:
    areas = [mmap.mmap(opened.fileno(), 0, mmap.MAP_PRIVATE, 3) for _ in range(2)]
areas[0][:4] = b"mine"  # as a library's table of addresses, which is then protected
print(areas[1][:4].decode())
for area in areas:
    address = ctypes.addressof(ctypes.c_char.from_buffer(area))
    assert ctypes.CDLL(None).mprotect(ctypes.c_void_p(address), ctypes.c_size_t(len(area)), 1) == 0
give_memory_back()
print(*(area[:4].decode() for area in areas))
"""


def test_what_was_written_into_a_mapped_file_stays(tmp_path: Path) -> None:
    code = _WRITTEN.format(file=str(tmp_path / "mapped"))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["file", "mine", "file"]
