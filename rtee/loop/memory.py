"""Lock the memory of the process, or release its start-up memory to the system."""

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
_MCL_ONFAULT = 4  # mlockall: lock each page when it is first used (Linux 4.4)
_M_TRIM_THRESHOLD = -1  # mallopt: free memory above this is released (malloc.h)
_M_MMAP_THRESHOLD = -3  # mallopt: larger blocks each get a mapping of their own
_FREE = 128 * 1024  # for M_TRIM_THRESHOLD [byte]: glibc's initial value
_LARGE = 32 * 1024  # for M_MMAP_THRESHOLD [byte]: half of Zenoh's receive buffer, kept in a flood
_MADV_DONTNEED = 4  # madvise: the pages are not needed now (sys/mman.h)


def lock_memory() -> list[str]:
    """Keep the process's memory from being swapped out, now and later.

    Returns:
        Empty, or one sentence: why this was not permitted, and what to configure.
    """
    library = ctypes.CDLL(None, use_errno=True)
    everything = _MCL_CURRENT | _MCL_FUTURE
    # On fault, since unused memory, such as most of each stack, is twice the memory in use.
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
    """Lock all program files in memory, so that no first use waits for a disk."""
    library.mlock.argtypes = (ctypes.c_void_p, ctypes.c_size_t)
    for access, first, size in _files():
        # Shared memory holds no program, and locking writable memory would copy it.
        if access.startswith("r-") and access.endswith("p"):
            # Failures are ignored: mappings such as a device's are locked when first used.
            library.mlock(first, size)


def give_memory_back() -> None:
    """Release start-up memory to the system, and from now on all memory that is freed.

    Not for a process that locks its memory. When an instruction first runs, Linux maps 64 kB of its
    library around it, so that start-up maps three times as much code as runs later. The unmapped
    pages stay in the system's page cache, and are mapped again within microseconds when needed.
    """
    if not sys.platform.startswith("linux"):
        return
    library = ctypes.CDLL(None, use_errno=True)
    if hasattr(library, "malloc_trim"):  # glibc only; other libraries release memory by themselves
        library.malloc_trim(ctypes.c_size_t(0))
        # By default, glibc raises both thresholds when the first large block is freed, and then
        # keeps up to twice its size.
        library.mallopt(_M_MMAP_THRESHOLD, _LARGE)
        library.mallopt(_M_TRIM_THRESHOLD, _FREE)
    library.madvise.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int)
    for first, size in _unchanged_files():
        library.madvise(first, size, _MADV_DONTNEED)


def _unchanged_files() -> Iterator[tuple[int, int]]:
    """Yield the address and size [byte] of each read-only mapping of a file: code and constants.

    Mappings that were modified are left out, since unmapping would lose the changes: the loader
    writes addresses into libraries before it makes them read-only.
    """
    with contextlib.suppress(OSError):  # a kernel without these details
        for first, behind, details in _AREA.findall(_DETAILS.read_text()):
            written = _WRITTEN.findall(details)
            if written and not any(map(int, written)):
                yield int(first, 16), int(behind, 16) - int(first, 16)


def _files() -> Iterator[tuple[str, int, int]]:
    """Yield the access rights, address and size [byte] of each mapping of a file."""
    for line in _MAPS.read_text().splitlines():
        where, access, _, _, _, *rest = line.split(maxsplit=5)
        if "".join(rest).startswith("/"):  # nothing where no file is mapped
            first, behind = (int(end, 16) for end in where.split("-"))
            yield access, first, behind - first
