"""Declare how bytes hold values, once for a driver, its emulator and the tests."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import MISSING, dataclass, field, fields
from enum import EnumType
from functools import cache, lru_cache
from operator import attrgetter, itemgetter
from typing import Any, ClassVar, NamedTuple, Self, dataclass_transform

from rtee.buses.parser import CodecError


def text(raw: bytes) -> str:
    """Return ASCII text that ends at the first zero byte."""
    return raw.split(b"\0")[0].decode("ascii", "replace").strip()


class PackedPart(NamedTuple):
    """The format of a value, which follows those declared before it.

    Attributes:
        code: Its format in `struct`.
        many: Number of values in a tuple; 0 for a single value.
        kind: Makes the value from the number or bytes.
        per: Counts per unit of the value; ``None``: the value is the number itself.
        skip: Unused bytes before it.
    """

    code: str
    many: int = 0
    kind: Callable[[Any], Any] | None = None
    per: float | None = None
    skip: int = 0

    def getter(self, at: int) -> Callable[[tuple[Any, ...]], Any]:
        """Return a function that makes the value from a block's numbers, starting at an index.

        The function raises `ValueError` for a number that does not encode a value.
        """
        kind, per, many = self.kind, self.per, self.many
        if per is not None:
            kind = lambda number: number / per  # noqa: E731
        if isinstance(kind, EnumType):
            kind = lru_cache(maxsize=256)(kind)  # flags are slow to make
        cut = itemgetter(slice(at, at + many) if many else at)
        if kind is None:
            return cut
        if many:
            return lambda values: tuple([kind(value) for value in cut(values)])
        return lambda values: kind(cut(values))

    def putter(self) -> Callable[[Any], Sequence[Any]]:
        """Return a function that converts the value to its numbers or bytes."""
        per = self.per
        if per is not None and self.many:
            return lambda value: [round(one * per) for one in value]
        if per is not None:
            return lambda value: (round(value * per),)
        if self.kind is text:
            return lambda value: (value.encode("ascii", "replace"),)
        return tuple if self.many else lambda value: (value,)


def part(
    code: str,
    many: int = 0,
    *,
    kind: Callable[[Any], Any] | None = None,
    per: float | None = None,
    skip: int = 0,
    default: Any = MISSING,
) -> Any:
    """Declare a value of `Packed`. Arguments as for `PackedPart`."""
    return field(default=default, metadata={"at": PackedPart(code, many, kind, per, skip)})


@dataclass_transform(frozen_default=True)
class Packed:
    """Little-endian bytes: a class derived from it declares its fields by `part`.

    Such a class is a frozen dataclass.

    Attributes:
        WHAT: Its name in messages, with its article, such as ``a report of an RH56``.
        LONGER: Whether further bytes may follow, which are ignored.
    """

    WHAT: ClassVar[str]
    LONGER: ClassVar[bool] = False

    def __init_subclass__(cls) -> None:
        """Make it a dataclass."""
        dataclass(frozen=True)(cls)

    def to_bytes(self) -> bytes:
        """Return the bytes; a number out of range becomes the nearest one that fits."""
        layout = _layout(type(self))
        form, found = layout.form, layout.values(self)
        if layout.putters is not None:
            values, found = found, []
            for put, value in zip(layout.putters, values, strict=True):
                found += put(value)
        # Clamped only if packing fails, since almost all values fit and this runs in every cycle.
        try:
            return form.pack(*found)
        except struct.error:
            return form.pack(*map(_clamped, layout.codes, found))

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """Read the fields; raises `CodecError` for invalid values."""
        layout = _layout(cls)
        form, getters = layout.form, layout.getters
        if len(data) != form.size and (len(data) < form.size or not cls.LONGER):
            raise CodecError(f"{len(data)} bytes are not {cls.WHAT}")
        values = form.unpack_from(data)
        if getters is None:
            return cls(*values)
        try:
            return cls(*[get(values) for get in getters])
        except ValueError as error:
            raise CodecError(f"not {cls.WHAT}: {data.hex(' ')} ({error})") from None


class _Layout(NamedTuple):
    """Layout of a block; without ``getters`` and ``putters``, each value is a single number."""

    form: struct.Struct
    codes: str
    values: Callable[[Any], Any]
    getters: Sequence[Callable[[tuple[Any, ...]], Any]] | None
    putters: Sequence[Callable[[Any], Sequence[Any]]] | None


def _laid_out(block: Any) -> _Layout:
    form, codes, getters = "<", "", []
    parts: list[PackedPart] = [one.metadata["at"] for one in fields(block)]
    for at in parts:
        form += f"{at.skip}x{at.many or ''}{at.code}"
        getters.append(at.getter(len(codes)))
        codes += at.code[-1] * (at.many or 1)
    names = [one.name for one in fields(block)]
    values = attrgetter(*names) if len(names) > 1 else lambda value: (getattr(value, names[0]),)
    if all(at.kind is None and at.per is None and not at.many for at in parts):
        return _Layout(struct.Struct(form), codes, values, None, None)
    return _Layout(struct.Struct(form), codes, values, getters, [at.putter() for at in parts])


_layout: Callable[[Any], _Layout] = cache(_laid_out)


def _clamped(code: str, value: Any) -> Any:
    if code in "fs":
        return value
    bits = 8 * struct.calcsize(f"<{code}")
    low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if code.islower() else (0, (1 << bits) - 1)
    return min(max(round(value), low), high)
