"""Check plain data, as YAML and JSON hold it, against dataclasses.

The types of a dataclass define valid data: ``float``, ``int``, ``bool``, ``str``, ``Path``,
literals, enumerations, tuples, lists, mappings, other dataclasses, unions of these, and bounds of
annotated-types. Values are converted only where YAML and JSON lack the type: a mapping becomes a
dataclass, a list a tuple, a text a path or a member of an enumeration, an integer a ``float``.
Unknown keys, and numbers that are NaN or infinite, are refused.

The mistakes have the form of those of pydantic, which checks the options of drivers. Files are not
checked with it, since its import takes 9 MB and a tenth of a second; `checked` reads them.
"""

from __future__ import annotations

import dataclasses
import math
import operator
import os
import types
import typing
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple, TypedDict, TypeVar

from annotated_types import BaseMetadata, Ge, GroupedMetadata, Gt, Le, Lt, MaxLen, MinLen

from rtee.errors import ConfigError, UserError, suggestion
from rtee.hand.yamlfile import Location, YamlDocument

T = TypeVar("T")

OTHERS: Final = "others"
"""Marks, in its metadata, the field of a dataclass that takes all keys without a field."""


@dataclass(frozen=True, slots=True)
class Check:
    """A further condition for a value of the right type, in `Annotated`.

    Attributes:
        function: Takes the value; raises a ``ValueError`` with the reason if it is wrong.
    """

    function: Callable[[Any], object]


class Mistake(TypedDict):
    """A mistake, as in ``ValidationError.errors()`` of pydantic.

    Attributes:
        type: Its kind, such as ``missing``.
        loc: Its location: keys and positions from the root.
        msg: What the value should be, or what is wrong.
        input: The value that is wrong.
    """

    type: str
    loc: Location
    msg: str
    input: Any


class Invalid(ValueError):
    """Data does not fit the dataclass it was checked against."""

    def __init__(self, mistakes: list[Mistake]) -> None:
        super().__init__(mistakes[0]["msg"])
        self._mistakes = mistakes

    def errors(self) -> list[Mistake]:
        """Return all mistakes, in the order of the fields."""
        return self._mistakes


def validated(kind: type[T], data: Any) -> T:
    """Return plain data from YAML or JSON as a dataclass.

    Raises:
        Invalid: It does not fit; the error names all mistakes.
    """
    mistakes: list[Mistake] = []
    made = _checker(typing.cast("Any", kind))(data, (), mistakes)
    if mistakes:
        raise Invalid(mistakes)
    return typing.cast("T", made)


def checked(
    kind: type[T],
    document: YamlDocument,
    raised: type[UserError] = ConfigError,
    at: Location = (),
    data: Any = None,
) -> T:
    """Return a document, or what is at a location in it, as a dataclass.

    Args:
        kind: The dataclass, or another type of valid data.
        document: The document.
        raised: The error to raise.
        at: Location of the data in the document.
        data: The data, if not the whole document.

    Raises:
        UserError: It does not fit; the message names file, line and key of the first mistake.
    """
    try:
        return validated(kind, document.data if data is None else data)
    except Invalid as error:
        found = document.located([{**each, "loc": (*at, *each["loc"])} for each in error.errors()])
    location, first = found[0]
    # One location has several for a union.
    reasons = " or ".join(mistake["msg"] for place, mistake in found if place == location)
    match first["type"]:
        case "extra_forbidden":
            known = known_keys(kind, location[len(at) : -1])
            reasons = f"unknown key; {suggestion(str(location[-1]), known)}"
        case "missing" | "value_error":
            pass
        case _:
            reasons = f"{reasons}, not {first['input']!r:.80}"
    raise document.error(location, reasons, raised)


def known_keys(kind: Any, location: Location) -> list[str]:
    """Return the keys that a dataclass allows at a location inside it."""
    for part in location:
        kind = _inside(kind, part)
    return list(field_types(next(_dataclasses(kind))))


def _inside(kind: Any, part: str | int) -> Any:
    """Return the type of the value at a key or position of a value of some type."""
    if _is_dataclass(kind):
        others = _others(kind)
        if part in field_types(kind) and part != others:
            return field_types(kind)[str(part)]
        return kind if others is None else _inside(field_types(kind)[others], part)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (dict, Mapping):
        return arguments[1]
    if origin in (list, tuple):
        return arguments[0]
    # An annotated or optional type contains the type that leads further.
    return _inside(arguments[0], part)


def _dataclasses(annotation: Any) -> Iterator[Any]:
    """Yield the dataclasses in a type."""
    if _is_dataclass(annotation):
        yield annotation
    for inner in typing.get_args(annotation):
        yield from _dataclasses(inner)


@cache
def field_types(kind: Any) -> Mapping[str, Any]:
    """Return the fields of a dataclass with their types, bounds included."""
    hints = typing.get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind)}


def _is_dataclass(kind: Any) -> bool:
    return dataclasses.is_dataclass(kind)


def _others(kind: Any) -> str | None:
    """Return the field of a dataclass that takes all keys without a field, if it has one."""
    return next(
        (field.name for field in dataclasses.fields(kind) if OTHERS in field.metadata), None
    )


_A_MAPPING: Final = "should be a mapping, such as {name: value}"

_Checker = Callable[[Any, Location, list[Mistake]], Any]
"""Takes a value, its location and the mistakes so far; returns the value converted to its type.

After a mistake, the returned value is meaningless."""


def _mistake(mistakes: list[Mistake], kind: str, at: Location, message: str, value: Any) -> None:
    mistakes.append(Mistake(type=kind, loc=at, msg=message, input=value))


# Cached, since a file of actions has thousands of values of a few types.
@cache
def _checker(kind: Any) -> _Checker:
    """Return the function that checks values of a type.

    Raises:
        TypeError: No value of that type can be in a file.
    """
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Annotated:
        return _bounded(_checker(arguments[0]), arguments[1:])
    if origin in (typing.Union, types.UnionType):
        return _union([_checker(each) for each in arguments])
    if origin is Literal:
        return _words({word: word for word in arguments})
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            return _sequence(_checker(arguments[0]), tuple, "tuple")
        return _fixed([_checker(each) for each in arguments])
    if origin is list:
        return _sequence(_checker(arguments[0]), list, "list")
    if origin in (dict, Mapping):
        return _mapping(_checker(arguments[0]), _checker(arguments[1]))
    if _is_dataclass(kind):
        return _dataclass(kind)
    if isinstance(kind, type) and issubclass(kind, Enum):
        return _words({member.value: member for member in kind})
    if kind is Any:
        return lambda value, at, mistakes: value
    if kind in _PLAIN:
        return _PLAIN[kind]
    raise TypeError(f"settings cannot be of the type {kind}")


def _float(value: Any, at: Location, mistakes: list[Mistake]) -> Any:
    if type(value) is float:
        if not math.isfinite(value):
            _mistake(mistakes, "finite_number", at, "should be a finite number", value)
        return value
    if type(value) is int:
        try:
            return float(value)
        # An integer of more than 308 digits.
        except OverflowError:
            pass
    _mistake(mistakes, "float_type", at, "should be a valid number", value)
    return None


def _of_type(kind: type, name: str, words: str) -> _Checker:
    def check(value: Any, at: Location, mistakes: list[Mistake]) -> Any:
        # Not isinstance: True is an int, too.
        if type(value) is not kind:
            _mistake(mistakes, f"{name}_type", at, f"should be a valid {words}", value)
        return value

    return check


def _none(value: Any, at: Location, mistakes: list[Mistake]) -> Any:
    if value is not None:
        _mistake(mistakes, "none_required", at, "should be None", value)


def _path(value: Any, at: Location, mistakes: list[Mistake]) -> Any:
    if isinstance(value, str | Path):
        return Path(os.path.expanduser(value))
    _mistake(mistakes, "path_type", at, "should be a valid path", value)
    return None


_PLAIN: Final[Mapping[Any, _Checker]] = {
    float: _float,
    int: _of_type(int, "int", "integer"),
    bool: _of_type(bool, "bool", "boolean"),
    str: _of_type(str, "string", "string"),
    Path: _path,
    type(None): _none,
}


def _words(members: Mapping[Any, Any]) -> _Checker:
    names = [repr(word) for word in members]
    expected = " or ".join(part for part in (", ".join(names[:-1]), names[-1]) if part)

    def check(value: Any, at: Location, mistakes: list[Mistake]) -> Any:
        # A text first: a list could not be looked up.
        if isinstance(value, str) and value in members:
            return members[value]
        message = f"should be {expected}"
        _mistake(mistakes, "literal_error", at, message, value)
        return None

    return check


def _union(checkers: list[_Checker]) -> _Checker:
    optional = _none in checkers
    members = [check for check in checkers if check is not _none]

    def check(value: Any, at: Location, mistakes: list[Mistake]) -> Any:
        # Not as one of the members: a mistake would then also say that None is possible.
        if value is None and optional:
            return None
        found: list[Mistake] = []
        for member in members:
            wrong: list[Mistake] = []
            made = member(value, at, wrong)
            if not wrong:
                return made
            found += wrong
        mistakes += found
        return None

    return check


def _sequence(item: _Checker, kind: type[list[Any]] | type[tuple[Any, ...]], name: str) -> _Checker:
    def check(value: Any, at: Location, mistakes: list[Mistake]) -> Any:
        if not isinstance(value, list | tuple):
            _mistake(mistakes, f"{name}_type", at, "should be a valid list", value)
            return None
        return kind(item(each, (*at, i), mistakes) for i, each in enumerate(value))

    return check


def _fixed(items: list[_Checker]) -> _Checker:
    def check(value: Any, at: Location, mistakes: list[Mistake]) -> Any:
        if not isinstance(value, list | tuple):
            _mistake(mistakes, "tuple_type", at, "should be a valid list", value)
            return None
        if len(value) > len(items):
            _exceeded(_TOO_LONG, len(items), value, at, mistakes)
            return None
        pairs = zip(items, value, strict=False)
        made = [item(each, (*at, i), mistakes) for i, (item, each) in enumerate(pairs)]
        for i in range(len(value), len(items)):
            _mistake(mistakes, "missing", (*at, i), "is missing", value)
        return tuple(made)

    return check


def _mapping(key: _Checker, item: _Checker) -> _Checker:
    def check(value: Any, at: Location, mistakes: list[Mistake]) -> Any:
        if not isinstance(value, Mapping):
            _mistake(mistakes, "dict_type", at, _A_MAPPING, value)
            return None
        # "[key]" as in pydantic: without it, a wrong key would look like a wrong value.
        return {
            key(name, (*at, name, "[key]"), mistakes): item(each, (*at, name), mistakes)
            for name, each in value.items()
        }

    return check


def _dataclass(kind: Any) -> _Checker:
    fields = {field.name: field for field in dataclasses.fields(kind)}
    hints = field_types(kind)
    others = _others(kind)
    needed = {
        name
        for name, field in fields.items()
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
    }
    checkers = {name: _checker(hints[name]) for name in fields if name != others}
    rest = None if others is None else _checker(hints[others])

    def check(value: Any, at: Location, mistakes: list[Mistake]) -> Any:
        if not isinstance(value, Mapping):
            _mistake(mistakes, "dataclass_type", at, _A_MAPPING, value)
            return None
        before = len(mistakes)
        made: dict[str, Any] = {}
        for name, item in checkers.items():
            if name in value:
                made[name] = item(value[name], (*at, name), mistakes)
            elif name in needed:
                _mistake(mistakes, "missing", (*at, name), "is missing", value)
        unknown = {name: each for name, each in value.items() if name not in checkers}
        if rest is not None and others is not None:
            made[others] = rest(unknown, at, mistakes)
        else:
            for name, each in unknown.items():
                message = "unknown key"
                _mistake(mistakes, "extra_forbidden", (*at, name), message, each)
        # `__post_init__` relies on values of the right types.
        if len(mistakes) > before:
            return None
        try:
            return kind(**made)
        except ValueError as error:  # from __post_init__: values that do not fit each other
            _mistake(mistakes, "value_error", at, str(error), value)
            return None

    return check


class _Bound(NamedTuple):
    """A kind of bound on a value.

    Attributes:
        kind: The kind of its mistake.
        limit: Name of the limit, in annotated-types and in the mistake's context.
        holds: Function that returns whether a value is within a limit.
        words: The condition in words, with the limit in braces.
    """

    kind: str
    limit: str
    holds: Callable[[Any, Any], bool]
    words: str


_TOO_LONG: Final = _Bound(
    "too_long", "max_length", lambda value, most: len(value) <= most, "have at most {:g} items"
)
_BOUNDS: Final[Mapping[Any, _Bound]] = {
    Le: _Bound("less_than_equal", "le", operator.le, "be less than or equal to {:g}"),
    Lt: _Bound("less_than", "lt", operator.lt, "be less than {:g}"),
    Ge: _Bound("greater_than_equal", "ge", operator.ge, "be greater than or equal to {:g}"),
    Gt: _Bound("greater_than", "gt", operator.gt, "be greater than {:g}"),
    MinLen: _Bound(
        "too_short",
        "min_length",
        lambda value, least: len(value) >= least,
        "have at least {:g} items",
    ),
    MaxLen: _TOO_LONG,
}


def _bounded(inner: _Checker, metadata: tuple[Any, ...]) -> _Checker:
    """Return a function that checks values as `inner` does, and then their bounds."""
    bounds = [each for group in metadata for each in _single(group)]

    def check(value: Any, at: Location, mistakes: list[Mistake]) -> Any:
        before = len(mistakes)
        made = inner(value, at, mistakes)
        for bound in bounds:
            # A comparison with a value of the wrong type would raise an error.
            if made is None or len(mistakes) > before:
                break
            _check_bound(bound, made, value, at, mistakes)
        return made

    return check


def _single(metadata: Any) -> Iterator[Any]:
    """Yield the bounds in one annotation; annotations for other readers have none."""
    if isinstance(metadata, GroupedMetadata):
        yield from metadata
    elif isinstance(metadata, BaseMetadata | Check):
        yield metadata


def _check_bound(
    metadata: Any, value: Any, given: Any, at: Location, mistakes: list[Mistake]
) -> None:
    """Check a value of the right type, converted from `given`, against one bound."""
    if isinstance(metadata, Check):
        try:
            metadata.function(value)
        except ValueError as error:
            _mistake(mistakes, "value_error", at, str(error), given)
        return
    bound = _BOUNDS[type(metadata)]
    limit = getattr(metadata, bound.limit)
    if not bound.holds(value, limit):
        _exceeded(bound, limit, given, at, mistakes)


def _exceeded(bound: _Bound, limit: Any, value: Any, at: Location, mistakes: list[Mistake]) -> None:
    message = f"should {bound.words.format(limit)}"
    _mistake(mistakes, bound.kind, at, message, value)
