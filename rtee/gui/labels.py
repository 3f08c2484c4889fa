"""Short names, for where there is little room."""

from __future__ import annotations

from collections.abc import Sequence


def short_names(names: Sequence[str]) -> tuple[str, ...]:
    """Return names without the words that all of them begin with: ``left_hand_Pinky`` is ``Pinky``.

    Names that would become empty, or the only one, stay whole.
    """
    if len(names) < 2:
        return tuple(names)
    first, last = min(names), max(names)
    same = next(
        (i for i, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), len(first)
    )
    length = max(first.rfind(mark, 0, same) for mark in "_-. ") + 1
    short = tuple(name[length:] for name in names)
    return short if all(short) else tuple(names)
