"""Run commands of `rtee` as if some packages were not installed.

    python hidden.py NAME,NAME,… COMMAND…    one command, like `rtee COMMAND…`
    python hidden.py NAME,NAME,…             commands as JSON lists, a line each; answers likewise

In the second form each runs in a fork of one process, which saves most of the time of starting.
"""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import json
import os
import sys
import tempfile
from collections.abc import Sequence
from types import ModuleType


class Hider(importlib.abc.MetaPathFinder):
    """Finds nothing of some packages."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = frozenset(names)

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname.partition(".")[0] in self._names:
            raise ModuleNotFoundError(f"No module named '{fullname}'", name=fullname)
        return None


def run(words: Sequence[str]) -> int:
    """Run one command in this process and return its exit status."""
    from rtee.cli import main

    sys.argv = ["rtee", *words]
    try:
        main()
    except SystemExit as ended:
        return ended.code if isinstance(ended.code, int) else 1
    return 0


def forked(words: Sequence[str]) -> tuple[int, str]:
    """Run one command in a fork of this process; return its exit status and what it said."""
    with tempfile.TemporaryFile() as said:
        child = os.fork()
        if not child:
            os.dup2(said.fileno(), 1)
            os.dup2(said.fileno(), 2)
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            status = 70
            try:
                status = run(words)
            except BaseException:
                sys.excepthook(*sys.exc_info())
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(status)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        said.seek(0)
        return status, said.read().decode("utf-8", "replace")


def main() -> None:
    names = sys.argv[1].split(",")
    sys.meta_path.insert(0, Hider(names))
    if len(sys.argv) > 2:
        sys.exit(run(sys.argv[2:]))
    # What nearly every command needs; nothing here starts a thread.
    import rtee.actions.library
    import rtee.cli.main
    import rtee.hand.load  # noqa: F401

    for line in sys.stdin:
        print(json.dumps(forked(json.loads(line))), flush=True)


if __name__ == "__main__":
    main()
