"""Names of actions: regardless of case, underscores, hyphens and spaces, two spellings are one."""

from __future__ import annotations

import re

_HUMP = re.compile(r"(?<=[a-z0-9])(?=[A-Z])")


def normalise(name: str) -> str:
    """Return the spelling under which names are compared.

    ``pinchTight``, ``PinchTight``, ``pinch_tight`` and ``pinch tight`` all become ``pinchtight``.
    """
    return "".join(name.split()).replace("_", "").replace("-", "").lower()


def snake_case(name: str) -> str:
    """Return a name in small letters: ``PinchTight`` as ``pinch_tight``."""
    return _HUMP.sub("_", name).lower()


def label(name: str, elements: tuple[str, ...] = ()) -> str:
    """Return how an action is called in a sentence: ``PinchTight (index, thumb)``."""
    return f"{name} ({', '.join(elements)})" if elements else name
