"""Declare the meaning of register bits once for a driver, its emulator and the tests."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields
from functools import cache, lru_cache
from typing import Any, ClassVar, NamedTuple, Self, cast, dataclass_transform

from rtee.errors import FrameError


class RegisterField(NamedTuple):
    """The place of a value in a block of registers.

    Attributes:
        word: Its register, counted from the first of the block.
        bit: Its lowest bit there.
        width: Its number of bits.
        kind: Makes the value from the number.
        signed: Whether the number is in two's complement.
    """

    word: int
    bit: int
    width: int
    kind: Callable[[int], Any]
    signed: bool = False

    @property
    def mask(self) -> int:
        """Mask of the value's bits in its register."""
        return ((1 << self.width) - 1) << self.bit

    def get(self, words: Sequence[int]) -> Any:
        """Return the value; raises `ValueError` for an invalid number."""
        number = words[self.word] >> self.bit & (1 << self.width) - 1
        if self.signed and number >> self.width - 1:
            number -= 1 << self.width
        return self.kind(number)

    def put(self, words: list[int], value: Any) -> None:
        """Set the value."""
        words[self.word] |= (int(value) & (1 << self.width) - 1) << self.bit


class Group(NamedTuple):
    """A tuple of values, or of objects with a place for each of their values.

    Attributes:
        kind: Makes an object from its values; ``None``: each value stands for itself.
        members: For each element of the tuple, the places of its values.
    """

    kind: Callable[..., Any] | None
    members: tuple[tuple[RegisterField, ...], ...]

    def get(self, words: Sequence[int]) -> tuple[Any, ...]:
        """Return the tuple; raises `ValueError` for an invalid number."""
        found = ([place.get(words) for place in member] for member in self.members)
        return tuple(each[0] if self.kind is None else self.kind(*each) for each in found)

    def put(self, words: list[int], values: Sequence[Any]) -> None:
        """Set the tuple."""
        for member, value in zip(self.members, values, strict=True):
            parts = (
                [value] if self.kind is None else [getattr(value, f.name) for f in fields(value)]
            )
            for place, part in zip(member, parts, strict=True):
                place.put(words, part)


def at(
    word: int,
    bit: int = 0,
    width: int = 16,
    kind: Callable[[int], Any] = int,
    *,
    signed: bool = False,
    default: int = 0,
) -> Any:
    """Declare a value of `Registers`, by default a whole register, as a `RegisterField`."""
    return field(
        default=kind(default), metadata={"at": RegisterField(word, bit, width, kind, signed)}
    )


def flag(word: int, bit: int) -> Any:
    """Declare a bit of `Registers`."""
    return at(word, bit, 1, bool)


def each(kind: Callable[..., Any] | None, *members: Sequence[RegisterField]) -> Any:
    """Declare a tuple of `Registers`; arguments as for `Group`."""
    group = Group(kind, tuple(map(tuple, members)))
    count = 1 + max(place.word for member in group.members for place in member)
    return field(default=group.get([0] * count), metadata={"at": group})


@dataclass_transform(frozen_default=True)
class Registers:
    """A block of registers: a class derived from it declares its fields by `at`, `flag`, `each`.

    Such a class is a frozen dataclass.

    Attributes:
        COUNT: Number of registers in the block: by default, up to the last one with a field.
        WHAT: Its name in messages, such as ``status of an RG``.
        STRICT: Whether bits outside all fields are always clear.
    """

    COUNT: ClassVar[int]
    WHAT: ClassVar[str] = ""
    STRICT: ClassVar[bool] = False

    def __init_subclass__(cls) -> None:
        """Make it a dataclass."""
        dataclass(frozen=True)(cls)
        if "COUNT" not in cls.__dict__:
            cls.COUNT = 1 + max(one.word for one in _places(cls))

    def to_registers(self) -> tuple[int, ...]:
        """Return the registers."""
        words, kind = [0] * self.COUNT, cast("Any", type(self))
        for name, place in _layout(kind):
            place.put(words, getattr(self, name))
        return tuple(words)

    @classmethod
    def from_registers(cls, registers: Sequence[int], bus: str = "") -> Self:
        """Read the block; raises `FrameError` for invalid values, with the name of the bus."""
        try:
            return cast("Self", _read(cast("Any", cls), tuple(registers)))
        except ValueError:
            raw = b"".join(register.to_bytes(2, "big") for register in registers)
            raise FrameError(bus, f"not a valid {cls.WHAT}: {raw.hex(' ')}", raw) from None


@lru_cache(maxsize=64)  # a device at rest repeats its answers
def _read(block: Any, registers: tuple[int, ...]) -> Any:
    known = _known(block) if block.STRICT else ()
    if len(registers) < block.COUNT or any(registers[i] & ~k for i, k in enumerate(known)):
        raise ValueError
    return block(**{name: place.get(registers) for name, place in _layout(block)})


@cache
def _layout(block: Any) -> tuple[tuple[str, RegisterField | Group], ...]:
    return tuple((one.name, one.metadata["at"]) for one in fields(block))


@cache
def _known(block: Any) -> tuple[int, ...]:
    """Return the bits of each register that belong to a field."""
    known = [0] * block.COUNT
    for one in _places(block):
        known[one.word] |= one.mask
    return tuple(known)


def _places(block: Any) -> Iterator[RegisterField]:
    for _, place in _layout(block):
        for member in place.members if isinstance(place, Group) else [[place]]:
            yield from member
