"""Values of unordered pairs, found under either order."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Generic, TypeVar

Name = TypeVar("Name")
Value = TypeVar("Value")


class Pairs(dict[tuple[Name, Name], Value], Generic[Name, Value]):
    """A dictionary by pairs of names, in which either order of a pair finds its value.

    Iteration yields the pairs in the order in which they were added.
    """

    def __init__(
        self,
        items: Iterable[tuple[tuple[Name, Name], Value]] = (),
        *,
        turned: Callable[[Value], Value] = lambda value: value,
    ) -> None:
        """Add some pairs; ``turned`` gives the value of a pair in the reverse order."""
        super().__init__(items)
        self._turned = turned

    def __missing__(self, pair: tuple[Name, Name]) -> Value:
        """Return the value of a pair that was added in the reverse order."""
        if not super().__contains__(pair[::-1]):
            raise KeyError(pair)
        return self._turned(super().__getitem__(pair[::-1]))

    def __contains__(self, pair: object) -> bool:
        """Return whether a pair was added, in either order."""
        return isinstance(pair, tuple) and (
            super().__contains__(pair) or super().__contains__(pair[::-1])
        )

    def get(self, pair: tuple[Name, Name], default: Any = None) -> Any:
        """Return the value of a pair in this order, or a default."""
        try:
            return self[pair]
        except KeyError:
            return default
