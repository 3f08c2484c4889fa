"""Lock the memory of the process, or return to the system what only the start needed."""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path

_MAPS = Path("/proc/self/maps")
_DETAILS = Path("/proc/self/smaps")
_AREA = re.compile(
    r"^([0-9a-f]+)-([0-9a-f]+) r-[x-]p \S+ \S+ \d+ +/.*\n((?:[A-Z].*\n)+)", re.MULTILINE
)
_WRITTEN = re.compile(r"^(?:Anonymous|Swap): +(\d+) kB", re.MULTILINE)
_MCL_CURRENT = 1  # mlockall: pages that are mapped now (sys/mman.h)
_MCL_FUTURE = 2  # mlockall: pages that will be mapped
_MCL_ONFAULT = 4  # mlockall: each of them once it is used (Linux 4.4)
_M_TRIM_THRESHOLD = -1  # mallopt: more free memory than this is given back (malloc.h)
_M_MMAP_THRESHOLD = -3  # mallopt: larger blocks are mapped each for itself
_FREE = 128 * 1024  # of the first of these [byte]: what glibc begins with
_LARGE = 32 * 1024  # of the second [byte]: half of what Zenoh receives at once, which a flood keeps
_MADV_DONTNEED = 4  # madvise: the pages are not needed now (sys/mman.h)


def lock_memory() -> list[str]:
    """Keep the process's memory from being swapped out, now and later.

    Returns:
        A sentence if that was not permitted, with what to configure.
    """
    library = ctypes.CDLL(None, use_errno=True)
    everything = _MCL_CURRENT | _MCL_FUTURE
    # Memory that is reserved and never used, such as most of each stack, is twice the used memory.
    if library.mlockall(everything | _MCL_ONFAULT) == 0:
        _lock_programs(library)
        return []
    if library.mlockall(everything) == 0:
        return []
    reason = os.strerror(ctypes.get_errno())
    return [
        f"the memory could not be locked ({reason}); allow it by a line '<user> - memlock"
        " unlimited' in /etc/security/limits.d/rtee.conf and a new login, or"
        " 'LimitMEMLOCK=infinity' in the systemd unit"
    ]


def _lock_programs(library: ctypes.CDLL) -> None:
    """Load and lock all program files in memory: their first use must not wait for a disk."""
    library.mlock.argtypes = (ctypes.c_void_p, ctypes.c_size_t)
    for access, first, size in _files():
        # Neither shared memory, which is not a program, nor writable memory, which would be copied.
        if access.startswith("r-") and access.endswith("p"):
            # One that cannot be locked now, such as a device's, is locked where it is used.
            library.mlock(first, size)


def give_memory_back() -> None:
    """Return memory to the system that only the start needed, and from now on all freed memory.

    A process that locks its memory must not do this. Linux maps 64 kB of a library around each
    instruction that runs for the first time, so that a start maps three times the code that runs
    afterwards. The unmapped pages stay in the system's cache of files; those that are used again
    are mapped again within microseconds.
    """
    if not sys.platform.startswith("linux"):
        return
    library = ctypes.CDLL(None, use_errno=True)
    if hasattr(library, "malloc_trim"):  # glibc's; other libraries give back by themselves
        library.malloc_trim(ctypes.c_size_t(0))
        # By default, glibc raises both thresholds when the first large block is freed, and then
        # keeps up to twice its size.
        library.mallopt(_M_MMAP_THRESHOLD, _LARGE)
        library.mallopt(_M_TRIM_THRESHOLD, _FREE)
    library.madvise.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int)
    for first, size in _unchanged_files():
        library.madvise(first, size, _MADV_DONTNEED)


def _unchanged_files() -> Iterator[tuple[int, int]]:
    """Yield address and size [byte] of each read-only mapping of a file: code and constants.

    Mappings that were written to are left out, since unmapping them would lose what was written:
    the loader fills addresses into libraries before it protects them.
    """
    with contextlib.suppress(OSError):  # a kernel without these details
        for first, behind, details in _AREA.findall(_DETAILS.read_text()):
            written = _WRITTEN.findall(details)
            if written and not any(map(int, written)):
                yield int(first, 16), int(behind, 16) - int(first, 16)


def _files() -> Iterator[tuple[str, int, int]]:
    """Yield access rights, address and size [byte] of each mapping of a file."""
    for line in _MAPS.read_text().splitlines():
        where, access, _, _, _, *rest = line.split(maxsplit=5)
        if "".join(rest).startswith("/"):  # nothing where no file is mapped
            first, behind = (int(end, 16) for end in where.split("-"))
            yield access, first, behind - first
