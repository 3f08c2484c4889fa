"""Start Python processes that use the same rtee and import nothing from the working folder.

Python puts the working folder first on its path; with ``-m``, this is the folder in which it was
started. A ``typer.py`` in a downloads folder would then run instead of the library.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Final

_ROOT: Final = str(Path(__file__).parents[1])
"""The folder of the package, from which a child runs the same rtee, installed or not."""

_SAFE: Final = "PYTHONSAFEPATH"
"""Environment variable with the effect of ``-P``, which the children of a child inherit."""


def processors() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # a container or taskset may leave fewer than there are
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def python(*words: str) -> list[str]:
    """Return the command line of a Python process; start it with `environment`."""
    return [sys.executable, "-P", *words]


def environment() -> dict[str, str]:
    """Return the environment of a Python process that imports rtee."""
    # An empty or relative entry of PYTHONPATH is resolved in the working folder.
    given = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    paths = [_ROOT, *(path for path in given if os.path.isabs(path))]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths), _SAFE: "1"}


@contextlib.contextmanager
def spawning() -> Iterator[None]:
    """Let processes started by `multiprocessing` import neither the program nor its folder.

    They would run the program once more, which fails without ``if __name__ == "__main__"``, and if
    it comes from the standard input.
    """
    before, main = os.environ.get(_SAFE), sys.modules["__main__"]
    os.environ[_SAFE] = "1"
    # Multiprocessing looks here for the program.
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main
        if before is None:
            del os.environ[_SAFE]
        else:
            os.environ[_SAFE] = before
