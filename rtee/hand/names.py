"""Names that may become file names or keys on the network."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Final

from rtee.errors import ConfigError

MAX_LENGTH: Final = 100
"""Longest name [characters]: with an ending it fits into a file name of any file system."""

_WORTH: Final = 5
"""A beginning with fewer characters than this is not worth leaving out."""

_ALLOWED = re.compile(r"[A-Za-z0-9_\-.]+\Z")
_FORBIDDEN = re.compile(r"[^A-Za-z0-9_\-.]+")


def check_name(
    name: str, what: str, path: Path | str | None = None, line: int | None = None
) -> str:
    """Return ``name`` if it is safe as a file name and as a key.

    Args:
        name: The name to check.
        what: What it names, for the message, such as ``"action"``.
        path: The file it is in.
        line: Its line there.

    Raises:
        ConfigError: It is empty, longer than 100 characters, starts with a dot, holds ``..`` or
            anything but letters, digits, ``_``, ``-`` and ``.``.
    """
    wrong = _why_not(name)
    if wrong:
        raise ConfigError(
            f"{what} name {name[:MAX_LENGTH]!r} {wrong}; use letters, digits, '_', '-' and '.'",
            path=path,
            line=line,
        )
    return name


def safe_name(text: str, default: str = "hand") -> str:
    """Return ``text`` made into a valid name, or ``default`` when nothing of it is left."""
    name = _FORBIDDEN.sub("_", text).strip("_.")[:MAX_LENGTH]
    # Repeatedly: three dots become two, which are refused as well.
    while ".." in name:
        name = name.replace("..", ".")
    return name or default


def _why_not(name: str) -> str | None:
    # Nearly all names: the other checks are for the rest.
    if name.isalnum() and name.isascii() and len(name) <= MAX_LENGTH:
        return None
    if not name:
        return "is empty"
    if len(name) > MAX_LENGTH:
        return f"is longer than {MAX_LENGTH} characters"
    if name.startswith("."):
        return "starts with a dot"
    if ".." in name:
        return "holds '..'"
    if not _ALLOWED.match(name):
        return "holds a character that is not allowed"
    return None


def shared_length(parts: Sequence[Sequence[str]]) -> int:
    """Return how many items all of several sequences begin with; 0 for a single one."""
    columns = zip(*parts, strict=False) if len(parts) > 1 else ()
    return sum(1 for _ in takewhile(lambda column: len(set(column)) == 1, columns))


def common_prefix(names: Collection[str]) -> str:
    """Return the words that all names begin with, to be left out where room is scarce.

    Words end in ``_``, ``-``, ``.``, ``/`` or a blank. Empty for a single name, and where little
    would be gained or nothing be left of a name.
    """
    same = next(iter(names), "")[: shared_length(list(names))]
    end = 1 + max(same.rfind(mark) for mark in "_-./ ")
    return same[:end] if end >= _WORTH and all(len(name) > end for name in names) else ""
