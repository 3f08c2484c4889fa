from __future__ import annotations

import contextlib
import random
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtee.errors import MessageError, MissingExtra, foreign
from rtee.messages.cdr import DTYPES, HEADER
from rtee.messages.schema import DEFINITIONS, Field, MessageType, message_type, parse
from rtee.messages.typestore import typestore

STORE = typestore()
NAMES = sorted(DEFINITIONS)

_TEXT = st.text(st.characters(blacklist_categories=["Cs"], blacklist_characters="\0"), max_size=9)
_RANGES = {
    "uint8": (0, 2**8 - 1),
    "int8": (-(2**7), 2**7 - 1),
    "int32": (-(2**31), 2**31 - 1),
    "uint32": (0, 2**32 - 1),
    "int64": (-(2**63), 2**63 - 1),
    "uint64": (0, 2**64 - 1),
}


def _scalar(kind: str) -> st.SearchStrategy[Any]:
    if kind == "bool":
        return st.booleans()
    if kind in ("float32", "float64"):
        return st.floats(allow_nan=False, width=int(kind[5:]))
    if kind == "string":
        return _TEXT
    low, high = _RANGES[kind]
    return st.integers(low, high)


def _field(field: Field) -> st.SearchStrategy[Any]:
    one = fields(message_type(field.kind)) if field.nested else _scalar(field.kind)
    if not field.sequence:
        return one
    many = st.lists(one, max_size=field.capacity or 4)
    if field.nested or field.kind == "string":
        return many
    return many.map(lambda values: np.array(values, dtype=DTYPES[field.kind]))


def fields(kind: MessageType) -> st.SearchStrategy[dict[str, Any]]:
    """Return a strategy for the fields of a message."""
    return st.fixed_dictionaries({field.name: _field(field) for field in kind.fields})


def plain(values: Any) -> Any:
    """Return fields with arrays as lists, and names as they are read, to compare them."""
    if isinstance(values, dict):
        return {name: plain(value) for name, value in values.items()}
    if isinstance(values, (np.ndarray, bytes)):
        return list(values)
    if isinstance(values, list):
        # Strings in sequences are names, whose control characters are escaped.
        return [foreign(value) if isinstance(value, str) else plain(value) for value in values]
    return values


def rosbags_message(kind: MessageType, values: dict[str, Any]) -> Any:
    made = {}
    for field in kind.fields:
        value = values[field.name]
        if field.nested:
            inner = message_type(field.kind)
            made[field.name] = (
                [rosbags_message(inner, item) for item in value]
                if field.sequence
                else rosbags_message(inner, value)
            )
        elif field.sequence and field.kind != "string":
            made[field.name] = np.array(value, dtype=DTYPES[field.kind])
        else:
            made[field.name] = value
    return STORE.types[kind.name](**made)


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=5, deadline=None)
@given(data=st.data())
def test_bytes_are_those_of_rosbags(name: str, data: st.DataObject) -> None:
    kind = message_type(name)
    values = data.draw(fields(kind))
    encoded = kind.encode(values)
    assert encoded == bytes(STORE.serialize_cdr(rosbags_message(kind, values), name))
    assert plain(kind.decode(encoded)) == plain(values)


@pytest.mark.parametrize("name", NAMES)
def test_schema_is_what_rosbags_and_others_parse(name: str) -> None:
    from rosbags.typesys import get_types_from_msg

    found = get_types_from_msg(message_type(name).schema, name)
    assert [field for field, _ in found[name][1]] == [f.name for f in message_type(name).fields]


@pytest.mark.parametrize("name", NAMES)
def test_every_field_of_ours_says_what_it_is(name: str) -> None:
    kind = message_type(name)
    assert kind.summary
    assert kind.summary.endswith(".")


@given(name=st.sampled_from(NAMES), junk=st.binary(max_size=300), header=st.booleans())
def test_junk_raises_nothing_but_message_error(name: str, junk: bytes, header: bool) -> None:
    try:
        values = message_type(name).decode(HEADER + junk if header else junk)
    except MessageError:
        return
    assert set(values) == {field.name for field in message_type(name).fields}


@given(name=st.sampled_from(NAMES), data=st.data(), seed=st.integers(0, 2**32))
def test_damaged_messages_raise_nothing_but_message_error(
    name: str, data: st.DataObject, seed: int
) -> None:
    kind = message_type(name)
    encoded = bytearray(kind.encode(data.draw(fields(kind))))
    source = random.Random(seed)
    for _ in range(source.randrange(1, 4)):
        encoded[source.randrange(len(encoded))] = source.randrange(256)
    damaged = bytes(encoded[: source.randrange(len(encoded) + 1)])
    with contextlib.suppress(MessageError):
        assert set(kind.decode(damaged)) == {field.name for field in kind.fields}


@pytest.mark.parametrize("name", NAMES)
def test_every_shorter_message_is_refused(name: str) -> None:
    kind = message_type(name)
    filled = {"string": "text", "bool": True}

    def sample(of: MessageType) -> dict[str, Any]:
        values: dict[str, Any] = {}
        for field in of.fields:
            one = sample(message_type(field.kind)) if field.nested else filled.get(field.kind, 1)
            values[field.name] = [one] if field.sequence else one
        return values

    encoded = kind.encode(sample(kind))
    for length in range(len(encoded)):
        with pytest.raises(MessageError):
            kind.decode(encoded[:length])


def test_a_huge_length_is_refused_before_anything_is_made_of_it() -> None:
    with pytest.raises(MessageError, match="sequence of 4294967295 elements"):
        message_type("rtee_msgs/msg/Names").decode(HEADER + b"\xff\xff\xff\xff")


def test_a_megabyte_of_junk_is_refused() -> None:
    with pytest.raises(MessageError):
        message_type("rtee_msgs/msg/Goal").decode(random.Random(1).randbytes(1_000_000))


def test_other_encodings_are_refused() -> None:
    with pytest.raises(MessageError, match="little-endian CDR header"):
        message_type("std_msgs/msg/String").decode(b"\x00\x00\x00\x00\x00\x00\x00\x01\x00")


def test_bytes_too_many_are_refused() -> None:
    encoded = message_type("std_msgs/msg/String").encode({"data": "hand"})
    assert message_type("std_msgs/msg/String").decode(encoded + bytes(3)) == {"data": "hand"}
    with pytest.raises(MessageError, match="too many"):
        message_type("std_msgs/msg/String").decode(encoded + bytes(8))


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({}, "missing or unknown fields \\['data'\\]"),
        ({"data": "a", "more": "b"}, "missing or unknown fields \\['more'\\]"),
        ({"text": "a"}, "std_msgs/msg/String.data"),
        ({"data": 3}, "std_msgs/msg/String.data"),
    ],
)
def test_wrong_fields_are_refused(values: dict[str, Any], text: str) -> None:
    with pytest.raises(MessageError, match=text):
        message_type("std_msgs/msg/String").encode(values)


def test_numbers_that_do_not_fit_are_refused() -> None:
    with pytest.raises(MessageError, match=r"Time\.nanosec"):
        message_type("builtin_interfaces/Time").encode({"sec": 0, "nanosec": -1})


def test_a_string_is_no_list_of_strings() -> None:
    with pytest.raises(MessageError, match="list of strings"):
        message_type("rtee_msgs/Names").encode({"names": "thumb"})


def test_unknown_type() -> None:
    with pytest.raises(MessageError, match="no message type 'rtee_msgs/Gaol'"):
        message_type("rtee_msgs/Gaol")


def test_definitions_outside_the_notation_are_refused() -> None:
    with pytest.raises(MessageError, match="no message type 'a/msg/float65'"):
        parse("a/msg/B", "float65 x\n")
    with pytest.raises(MessageError, match="not a field definition"):
        parse("a/msg/B", "int32\n")
    with pytest.raises(MessageError, match="not a value"):
        parse("a/msg/B", f"int32 x = {'-' * 5000}3\n")


def test_the_type_store_says_which_extra_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(MissingExtra, match=r'extra \'rosbags\': pip install .*\[rosbags\]"'):
        typestore()
