from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from annotated_types import Ge, Gt, Interval, Le, Len, Lt

from rtee.hand.validation import OTHERS, Check, Invalid, known_keys, validated


class Colour(StrEnum):
    RED = "red"
    BLUE = "blue"


@dataclass(frozen=True)
class Part:
    size: Annotated[float, Gt(0)]
    name: str = "part"

    def __post_init__(self) -> None:
        if self.name == "large" and self.size < 10:
            raise ValueError("should be larger")


@dataclass(frozen=True)
class Named:
    first: Part | None = None
    others: Mapping[str, Part] = field(default_factory=dict, metadata={OTHERS: True})


def _even(number: int) -> None:
    if number % 2:
        raise ValueError("should be even")


@dataclass(frozen=True, kw_only=True)
class Whole:
    part: Part
    ratio: Annotated[float, Interval(ge=0, lt=1)] = 0.0
    low: Annotated[float, Le(3)] = 0.0
    high: Annotated[int, Ge(3)] = 3
    below: Annotated[float, Lt(2)] = 0.0
    even: Annotated[int, Check(_even)] = 0
    colour: Colour = Colour.RED
    word: Literal["all"] | tuple[str, ...] = "all"
    pair: tuple[float, int] = (0.0, 0)
    some: Annotated[tuple[float, ...], Len(1, 3)] = (0.0,)
    rows: list[int] = field(default_factory=list)
    file: Path | None = None
    named: Named = field(default_factory=Named)
    anything: Any = None


def test_what_yaml_cannot_express_is_converted() -> None:
    found = validated(
        Whole,
        {
            "part": {"size": 3},
            "colour": "blue",
            "word": ["a", "b"],
            "pair": [1, 2],
            "some": [1.5],
            "rows": [1],
            "file": "a/b",
            "named": {"first": None, "x": {"size": 1.0}},
            "anything": [{}],
        },
    )
    assert found.part == Part(3.0)
    assert type(found.part.size) is float
    assert found.colour is Colour.BLUE
    assert (found.word, found.pair, found.some) == (("a", "b"), (1.0, 2), (1.5,))
    assert found.file == Path("a/b")

    assert found.named == Named(None, {"x": Part(1.0)})


def test_a_home_is_expanded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/ada")
    assert validated(Whole, {"part": {"size": 3}, "file": "~/x"}).file == Path("/home/ada/x")


@pytest.mark.parametrize(
    ("given", "kind", "place"),
    [
        ({"ratio": 1}, "less_than", ("ratio",)),
        ({"ratio": -0.1}, "greater_than_equal", ("ratio",)),
        ({"ratio": math.nan}, "finite_number", ("ratio",)),
        ({"ratio": True}, "float_type", ("ratio",)),
        ({"ratio": 10**400}, "float_type", ("ratio",)),
        ({"low": 3.1}, "less_than_equal", ("low",)),
        ({"high": 2}, "greater_than_equal", ("high",)),
        ({"high": 3.0}, "int_type", ("high",)),
        ({"below": 2}, "less_than", ("below",)),
        ({"even": 3}, "value_error", ("even",)),
        ({"colour": "green"}, "literal_error", ("colour",)),
        ({"pair": [1]}, "missing", ("pair", 1)),
        ({"pair": [1, 2, 3]}, "too_long", ("pair",)),
        ({"some": []}, "too_short", ("some",)),
        ({"rows": ["1"]}, "int_type", ("rows", 0)),
        ({"file": 3}, "path_type", ("file",)),
        ({"part": {}}, "missing", ("part", "size")),
        ({"part": {"size": 1, "nam": ""}}, "extra_forbidden", ("part", "nam")),
        ({"part": {"size": 1, "name": "large"}}, "value_error", ("part",)),
        ({"part": [1]}, "dataclass_type", ("part",)),
        ({"named": {"x": {"size": 0}}}, "greater_than", ("named", "x", "size")),
        ({"named": {1: {"size": 1}}}, "string_type", ("named", 1, "[key]")),
    ],
)
def test_a_mistake_is_told_with_its_place(given: Any, kind: str, place: tuple[Any, ...]) -> None:
    with pytest.raises(Invalid) as told:
        validated(Whole, {"part": {"size": 1.0}} | given)
    (mistake,) = told.value.errors()
    assert (mistake["type"], mistake["loc"]) == (kind, place)


def test_all_mistakes_are_told_and_all_that_a_union_may_be() -> None:
    with pytest.raises(Invalid) as told:
        validated(Whole, {"part": {"size": -1}, "word": 3, "x": 1})
    found = [(mistake["type"], mistake["loc"]) for mistake in told.value.errors()]
    assert found == [
        ("greater_than", ("part", "size")),
        ("literal_error", ("word",)),
        ("tuple_type", ("word",)),
        ("extra_forbidden", ("x",)),
    ]


def test_the_keys_of_a_place_are_those_of_its_dataclass() -> None:
    assert known_keys(Whole, ("part",)) == ["size", "name"]
    assert known_keys(Whole, ("named", "first")) == ["size", "name"]
    assert known_keys(Whole, ("named", "anybody")) == ["size", "name"]
