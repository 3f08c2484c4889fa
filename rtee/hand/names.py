"""Names that may become file names or keys on the network."""

from __future__ import annotations

import re
from collections.abc import Collection, Container, Iterable, Sequence
from itertools import chain, count, takewhile
from pathlib import Path
from typing import Final
from unicodedata import combining, normalize

from rtee.errors import ConfigError, UserError

MAX_LENGTH: Final = 100
"""Longest name [characters]: together with a suffix, it is a valid file name on any file system."""

_WORTH: Final = 5
"""Length of the shortest prefix that is worth leaving out [characters]."""

_ALLOWED = re.compile(r"[A-Za-z0-9_\-.]+\Z")
_FORBIDDEN = re.compile(r"[^A-Za-z0-9_\-.]+")


def check_name(
    name: str, what: str, path: Path | str | None = None, line: int | None = None
) -> str:
    """Return ``name`` if it is safe as a file name and as a key.

    Args:
        name: The name to check.
        what: Noun for the message, such as ``"action"``.
        path: The file that contains the name.
        line: Its line in that file.

    Raises:
        ConfigError: if the name is empty, longer than 100 characters, starts with a dot, contains
            ``..`` or characters other than letters, digits, ``_``, ``-`` and ``.``.
    """
    if not isinstance(name, str):
        raise ConfigError(f"{what} name {name!r:.100} is not a text", path=path, line=line)
    wrong = _why_not(name)
    if wrong:
        raise ConfigError(
            f"{what} name {name[:MAX_LENGTH]!r} {wrong}; use letters, digits, '_', '-' and '.'",
            path=path,
            line=line,
        )
    return name


def listed(names: object, what: str, raised: type[UserError]) -> tuple[str, ...]:
    """Return names as a tuple; raise an error for anything but strings in a list.

    Args:
        names: The names; an iterator is read once.
        what: Noun for the message, such as ``"elements"``.
        raised: The error.
    """
    # A string is a list of letters.
    given = names if isinstance(names, Iterable) and not isinstance(names, str) else (None,)
    found = tuple(given)
    if not all(isinstance(name, str) for name in found):
        raise raised(f"the {what} must be a list of names, such as ['index'], not {names!r:.100}")
    return found


def safe_name(text: str, default: str = "hand") -> str:
    """Return a valid name made from ``text``, or ``default`` if nothing remains."""
    plain = "".join(each for each in normalize("NFKD", text) if not combining(each))
    name = _FORBIDDEN.sub("_", plain).strip("_.")[:MAX_LENGTH]
    # Repeatedly, since three dots become two.
    while ".." in name:
        name = name.replace("..", ".")
    return name or default


def free_name(stem: str, taken: Container[str], suffix: str = "") -> str:
    """Return ``stem`` with a suffix, and with a number from 2 on if that is taken already."""
    numbered = (f"{stem}_{number}{suffix}" for number in count(2))
    return next(name for name in chain([stem + suffix], numbered) if name not in taken)


def unique_names(names: Iterable[str]) -> list[str]:
    """Return the names made unique: a repeated name gets a number from 2 on."""
    unique: list[str] = []
    for name in names:
        unique.append(free_name(name, unique))
    return unique


def _why_not(name: str) -> str | None:
    # A fast check, which nearly all names pass.
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
    """Return the length of the common prefix of several sequences; 0 for a single one."""
    columns = zip(*parts, strict=False) if len(parts) > 1 else ()
    return sum(1 for _ in takewhile(lambda column: len(set(column)) == 1, columns))


def common_prefix(names: Collection[str]) -> str:
    """Return the words with which all names begin, to leave them out where space is scarce.

    Words end in ``_``, ``-``, ``.``, ``/`` or a space. The prefix is empty for a single name, if it
    would be short, or if nothing of a name would be left.
    """
    same = next(iter(names), "")[: shared_length(list(names))]
    end = 1 + max(same.rfind(mark) for mark in "_-./ ")
    return same[:end] if end >= _WORTH and all(len(name) > end for name in names) else ""
