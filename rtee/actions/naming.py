"""Names of actions, compared regardless of case, underscores, hyphens and spaces."""

from __future__ import annotations

import re

from rtee.errors import ActionError

# Where a capital follows a small letter or a digit, a new word begins.
_HUMP = re.compile(r"(?<=[a-z0-9])(?=[A-Z])")


def normalise(name: str) -> str:
    """Return the normal form of a name, by which names are compared.

    ``pinchTight``, ``PinchTight``, ``pinch_tight`` and ``pinch tight`` all become ``pinchtight``.
    Raises `ActionError` for anything but a string.
    """
    if not isinstance(name, str):
        raise ActionError(f"an action and its elements must be names, not {name!r:.100}")
    return "".join(name.split()).replace("_", "").replace("-", "").lower()


def snake_case(name: str) -> str:
    """Return a name in snake case: ``pinch_tight`` for ``PinchTight``."""
    return _HUMP.sub("_", name).lower()


def label(name: str, elements: tuple[str, ...] = ()) -> str:
    """Return the name of an action for a sentence: ``PinchTight (index, thumb)``."""
    return f"{name} ({', '.join(elements)})" if elements else name
