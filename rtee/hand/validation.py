"""Check plain data, as YAML and JSON hold it, against types.

msgspec does the check: `Section` is the base of what people write, and dataclasses hold what
programs write; bounds are `msgspec.Meta`. Values are converted only where YAML and JSON lack the
type: a mapping becomes a section or a dataclass, a list a tuple or a set, a string a path or a
member of an enumeration, an integer a ``float``. msgspec stops at the first mistake and does not
say the key of a mapping, so wrong data is examined once more, to locate every mistake.
"""

from __future__ import annotations

import dataclasses
import math
import os
import re
import types
import typing
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple, TypeVar

from msgspec import NODEFAULT, Meta, Struct, ValidationError, convert, structs

from rtee.errors import ConfigError, UserError, suggestion
from rtee.hand.yamlfile import Location, YamlDocument

T = TypeVar("T")

_NONE: Final = (NODEFAULT, dataclasses.MISSING)
"""Marks of fields without a default."""

_LARGEST: Final = 1.7976931348623157e308

Finite = Annotated[float, Meta(ge=-_LARGEST, le=_LARGEST)]
"""A finite number of a file that may hold NaN and infinity; with other bounds, ``le`` is enough."""
Amount = Annotated[float, Meta(ge=0, le=_LARGEST)]
"""One that is at least 0."""


class Section(Struct, frozen=True, forbid_unknown_fields=True):
    """A section of a file written by users: unknown keys are refused.

    Conditions on several values are checked in ``__post_init__``, which raises a
    ``ValueError`` with the reason, or `Misfit`.
    """


class Misfit(ValueError):
    """A value inside a section is invalid.

    Attributes:
        at: Its location in the section.
    """

    def __init__(self, reason: str, *at: str | int) -> None:
        super().__init__(reason)
        self.at = at


@contextmanager
def fitting(*at: str | int) -> Iterator[None]:
    """Raise a ``ValueError`` inside the context as a `Misfit` at a location of the section."""
    try:
        yield
    except ValueError as error:
        raise Misfit(str(error), *at) from None


class MistakeKind(Enum):
    """A mistake in a value."""

    UNKNOWN = "its key is unknown"
    MISSING = "it is missing"
    UNFIT = "it is of another type or out of bounds"
    CONTRARY = "a condition of its section does not hold"


class Mistake(NamedTuple):
    """A mistake in plain data.

    Attributes:
        fault: What kind of mistake it is.
        at: Its location: keys and positions from the root.
        words: The expected value, the mistake, or for an unknown key a hint.
        value: The value that is wrong.
    """

    fault: MistakeKind
    at: Location
    words: str
    value: Any = None


class Invalid(ValueError):
    """Data does not fit the type it was checked against.

    Attributes:
        mistakes: All mistakes, in the order of the fields.
    """

    def __init__(self, mistakes: list[Mistake]) -> None:
        self.mistakes = mistakes
        place = ".".join(map(str, self.first.at))
        super().__init__(f"{place}: {self.sentence}" if place else self.sentence)

    @property
    def first(self) -> Mistake:
        """The first mistake."""
        return self.mistakes[0]

    @property
    def sentence(self) -> str:
        """The problems at the place of the first mistake; a union may have several."""
        words = " or ".join(each.words for each in self.mistakes if each.at == self.first.at)
        unfit = self.first.fault is MistakeKind.UNFIT
        return f"{words}, not {self.first.value!r:.80}" if unfit else words


def validated(kind: type[T], data: Any) -> T:
    """Return plain data from YAML or JSON as a value of a type.

    Raises:
        Invalid: if it does not fit; the error names all mistakes.
    """
    try:
        return convert(data, kind, dec_hook=_converted)
    except ValidationError:
        raise Invalid([*_mistakes(kind, data, ())]) from None


def checked(
    kind: type[T],
    document: YamlDocument,
    raised: type[UserError] = ConfigError,
    at: Location = (),
    data: Any = None,
) -> T:
    """Return a document, or the part of it at a location, as a value of a type.

    Args:
        kind: The type of valid data.
        document: The document.
        raised: The error to raise.
        at: Location of the data in the document.
        data: The data, if not the whole document.

    Raises:
        UserError: if it does not fit; the message names file, line and key of the first mistake.
    """
    try:
        return validated(kind, document.data if data is None else data)
    except Invalid as error:
        found = [each._replace(at=(*at, *each.at)) for each in error.mistakes]
    # Keys that are missing come last: one of them may only be misspelled.
    found.sort(key=lambda each: (each.fault is MistakeKind.MISSING, document.line(each.at) or 0))
    wrong = Invalid(found)
    unknown = "unknown key; " if wrong.first.fault is MistakeKind.UNKNOWN else ""
    raise document.error(wrong.first.at, unknown + wrong.sentence, raised)


@cache
def field_names(kind: Any) -> Collection[str]:
    """Return the names of the fields of a section or a dataclass."""
    if issubclass(kind, Struct):
        return tuple(field.name for field in structs.fields(kind))
    return tuple(field.name for field in dataclasses.fields(kind))


def defaults(kind: Any) -> dict[str, Any]:
    """Return the default of each field of a section or a dataclass that has one.

    Args:
        kind: The class; ``None`` for one without fields.
    """
    if kind is None:
        return {}
    found = {}
    for field in structs.fields(kind) if issubclass(kind, Struct) else dataclasses.fields(kind):
        if field.default_factory not in _NONE:
            found[field.name] = field.default_factory()
        elif field.default is not NODEFAULT and field.default is not dataclasses.MISSING:
            found[field.name] = field.default
    return found


def values_given(section: Section) -> dict[str, Any]:
    """Return the values of a section other than ``None``."""
    return {name: value for name, value in structs.asdict(section).items() if value is not None}


def _converted(kind: type, value: Any) -> Any:
    """Return a value as a type that msgspec does not know."""
    if issubclass(kind, Path) and isinstance(value, str | Path):
        return Path(os.path.expanduser(value))
    raise ValueError("should be a valid path")


def _mistakes(kind: Any, value: Any, at: Location) -> Iterator[Mistake]:
    """Yield the mistakes of a value."""
    try:
        convert(value, kind, dec_hook=_converted)
    except ValidationError as error:
        mistake = error
    else:
        return
    inner = [found for part in _parts(kind, value, at) for found in part]
    yield from inner or [_own(kind, value, at, mistake)]


def _parts(kind: Any, value: Any, at: Location) -> Iterator[Iterator[Mistake]]:
    """Yield the mistakes inside a value."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Annotated:
        yield _mistakes(arguments[0], value, at)
    elif origin in (typing.Union, types.UnionType):
        # A mistake need not say that None is possible.
        yield from (_mistakes(each, value, at) for each in arguments if each is not type(None))
    elif origin in (dict, Mapping) and isinstance(value, Mapping):
        for name, each in value.items():
            yield _mistakes(arguments[0], name, (*at, name))
            yield _mistakes(arguments[1], each, (*at, name))
    elif origin in (list, tuple, frozenset) and isinstance(value, list | tuple):
        fixed = origin is tuple and arguments[-1] is not Ellipsis
        kinds = arguments if fixed else arguments[:1] * len(value)
        for number, (inner, each) in enumerate(zip(kinds, value, strict=False)):
            yield _mistakes(inner, each, (*at, number))
    elif has_fields(kind) and isinstance(value, Mapping):
        yield from _fields(kind, value, at)


def has_fields(kind: Any) -> bool:
    """Return whether a type is a section or a dataclass."""
    return isinstance(kind, type) and (issubclass(kind, Struct) or dataclasses.is_dataclass(kind))


def _fields(kind: Any, value: Mapping[Any, Any], at: Location) -> Iterator[Iterator[Mistake]]:
    """Yield the mistakes of a section's or a dataclass's fields."""
    hints, names = typing.get_type_hints(kind, include_extras=True), field_names(kind)
    for name in names:
        if name in value:
            yield _mistakes(hints[name], value[name], (*at, name))
        elif name not in defaults(kind):
            yield iter([Mistake(MistakeKind.MISSING, (*at, name), "is missing", value)])
    for name in value:
        if name not in names and issubclass(kind, Section):
            hint = suggestion(str(name), names)
            yield iter([Mistake(MistakeKind.UNKNOWN, (*at, name), hint, value[name])])


_KINDS: Final[Mapping[Any, str]] = {
    float: "should be a valid number",
    int: "should be a valid integer",
    bool: "should be true or false",
    str: "should be a valid string",
    list: "should be a valid list, such as [1, 2, 3]",
    tuple: "should be a valid list, such as [1, 2, 3]",
    frozenset: "should be a valid list, such as [1, 2, 3]",
    dict: "should be a mapping, such as {name: value}",
    Mapping: "should be a mapping, such as {name: value}",
    Path: "should be a valid path",
}

_BOUNDS: Final[Mapping[str, str]] = {
    ">": "greater than",
    ">=": "greater than or equal to",
    "<": "less than",
    "<=": "less than or equal to",
}


def _own(kind: Any, value: Any, at: Location, error: ValidationError) -> Mistake:
    """Return the mistake of a value whose parts are valid."""
    cause = error.__cause__
    if cause is not None and kind is not Path:
        inner = cause.at if isinstance(cause, Misfit) else ()
        return Mistake(MistakeKind.CONTRARY, (*at, *inner), str(cause), value)
    return Mistake(MistakeKind.UNFIT, at, _words(kind, value, str(error)), value)


def _words(kind: Any, value: Any, error: str) -> str:
    """Return the expected kind of value, by its type and msgspec's message."""
    if isinstance(value, float) and not math.isfinite(value):
        return "should be a finite number"
    if bound := re.match(r"Expected `\w+` ([<>]=?) (\S+)", error):
        limit = float(bound[2])
        # A rate such as 12000000 as its user writes it, not 1.2e+07.
        words = f"{limit:.0f}" if limit.is_integer() and abs(limit) < 1e9 else f"{limit:g}"
        return f"should be {_BOUNDS[bound[1]]} {words}"
    if length := re.match(r"Expected `\w+` of length (?:([<>])= )?(\d+)", error):
        least = {"<": "at most ", ">": "at least "}.get(length[1], "")
        return f"should have {least}{length[2]} items"
    if pattern := re.search(r"matching regex (.+?)(?: - at|$)", error):
        return f"should match the pattern {pattern[1]}"
    while typing.get_origin(kind) is Annotated:
        kind = typing.get_args(kind)[0]
    if typing.get_origin(kind) is Literal:
        return _one_of(typing.get_args(kind))
    if isinstance(kind, type) and issubclass(kind, Enum):
        return _one_of([member.value for member in kind])
    return _KINDS[Mapping if has_fields(kind) else typing.get_origin(kind) or kind]


def _one_of(words: Collection[Any]) -> str:
    *names, last = map(repr, words)
    return f"should be {' or '.join(filter(None, (', '.join(names), last)))}"
