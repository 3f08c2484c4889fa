from __future__ import annotations

import math
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from msgspec import Meta, field

from rtee.hand.validation import Finite, Invalid, Misfit, MistakeKind, Section, validated


class Colour(StrEnum):
    RED = "red"
    BLUE = "blue"


class Part(Section, frozen=True):
    size: Annotated[float, Meta(gt=0)]
    name: str = "part"

    def __post_init__(self) -> None:
        if self.name == "large" and self.size < 10:
            raise ValueError("should be larger")


class Whole(Section, frozen=True, kw_only=True):
    part: Part
    ratio: Annotated[float, Meta(ge=0, lt=1)] = 0.0
    low: Annotated[float, Meta(le=3)] = 0.0
    high: Annotated[int, Meta(ge=3)] = 3
    below: Annotated[float, Meta(lt=2)] = 0.0
    even: int = 0
    colour: Colour = Colour.RED
    word: Literal["all"] | tuple[str, ...] = "all"
    pair: tuple[float, int] = (0.0, 0)
    some: Annotated[tuple[float, ...], Meta(min_length=1, max_length=3)] = (0.0,)
    rows: list[int] = field(default_factory=list)
    file: Path | None = None
    named: dict[str, Part] = field(default_factory=dict)
    marks: frozenset[Literal["a", "b"]] = frozenset()
    size: Annotated[str, Meta(pattern="^[0-9]+$")] = "1"
    number: Finite = 0.0
    switch: bool = False
    anything: Any = None

    def __post_init__(self) -> None:
        if self.even % 2:
            raise Misfit("should be even", "even")


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
            "named": {"x": {"size": 1.0}},
            "marks": ["b"],
            "anything": [{}],
        },
    )
    assert found.part == Part(3.0)
    assert type(found.part.size) is float
    assert found.colour is Colour.BLUE
    assert (found.word, found.pair, found.some) == (("a", "b"), (1.0, 2), (1.5,))
    assert found.file == Path("a/b")

    assert (found.named, found.marks) == ({"x": Part(1.0)}, {"b"})


def test_a_home_is_expanded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/ada")
    assert validated(Whole, {"part": {"size": 3}, "file": "~/x"}).file == Path("/home/ada/x")


@pytest.mark.parametrize(
    ("given", "place", "words"),
    [
        ({"ratio": 1}, "ratio", "should be less than 1, not 1"),
        ({"ratio": -0.1}, "ratio", "should be greater than or equal to 0, not -0.1"),
        ({"ratio": math.nan}, "ratio", "should be a finite number, not nan"),
        ({"number": math.inf}, "number", "should be a finite number, not inf"),
        ({"ratio": True}, "ratio", "should be a valid number, not True"),
        ({"ratio": 10**400}, "ratio", "should be a valid number, not 1000"),
        ({"low": 3.1}, "low", "should be less than or equal to 3, not 3.1"),
        ({"high": 2}, "high", "should be greater than or equal to 3, not 2"),
        ({"high": 3.0}, "high", "should be a valid integer, not 3.0"),
        ({"below": 2}, "below", "should be less than 2, not 2"),
        ({"even": 3}, "even", "should be even"),
        ({"colour": "green"}, "colour", "should be 'red' or 'blue', not 'green'"),
        ({"colour": 3}, "colour", "should be 'red' or 'blue', not 3"),
        (
            {"word": 3},
            "word",
            "should be 'all' or should be a valid list, such as [1, 2, 3], not 3",
        ),
        ({"switch": "yes"}, "switch", "should be true or false, not 'yes'"),
        ({"pair": [1]}, "pair", "should have 2 items, not [1]"),
        ({"some": []}, "some", "should have at least 1 items, not []"),
        ({"some": [1, 2, 3, 4]}, "some", "should have at most 3 items, not [1, 2, 3, 4]"),
        ({"rows": ["1"]}, "rows.0", "should be a valid integer, not '1'"),
        ({"file": 3}, "file", "should be a valid path, not 3"),
        ({"part": {}}, "part.size", "is missing"),
        ({"part": {"size": 1, "nam": ""}}, "part.nam", "did you mean 'name'?"),
        ({"part": {"size": 1, "name": "large"}}, "part", "should be larger"),
        ({"part": [1]}, "part", "should be a mapping, such as {name: value}, not [1]"),
        ({"named": {"x": {"size": 0}}}, "named.x.size", "should be greater than 0, not 0"),
        ({"named": {1: {"size": 1}}}, "named.1", "should be a valid string, not 1"),
        ({"marks": ["a", "c"]}, "marks.1", "should be 'a' or 'b', not 'c'"),
        ({"size": "x"}, "size", "should match the pattern '^[0-9]+$', not 'x'"),
    ],
)
def test_a_mistake_is_told_with_its_place(given: Any, place: str, words: str) -> None:
    with pytest.raises(Invalid) as told:
        validated(Whole, {"part": {"size": 1.0}} | given)
    assert ".".join(map(str, told.value.first.at)) == place
    assert told.value.sentence.startswith(words)


def test_all_mistakes_are_told_and_all_that_a_union_may_be() -> None:
    with pytest.raises(Invalid) as told:
        validated(Whole, {"part": {"size": -1}, "word": 3, "x": 1, 2: 1})
    assert [(mistake.fault, mistake.at) for mistake in told.value.mistakes] == [
        (MistakeKind.UNFIT, ("part", "size")),
        (MistakeKind.UNFIT, ("word",)),
        (MistakeKind.UNFIT, ("word",)),
        (MistakeKind.UNKNOWN, ("x",)),
        (MistakeKind.UNKNOWN, (2,)),
    ]
