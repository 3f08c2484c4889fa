"""Lines of text are found in any pieces, and what is no line costs only itself."""

from __future__ import annotations

import pytest

from rtee.buses.parser import LineParser


@pytest.mark.parametrize("size", [1, 2, 7, 1000])
@pytest.mark.parametrize("end", [b"\r", b"\r\n"])
def test_lines_are_found_in_any_pieces(size: int, end: bytes) -> None:
    parser, lines = LineParser(end, most=8), []
    raw = end.join([b"OK", b"W12 3", b"123456789", b"caf\xe9", b"a\tb", b"12345678", b"half"])
    for start in range(0, len(raw), size):
        lines += parser.feed(raw[start : start + size])
    assert lines == ["OK", "W12 3", "12345678"]
    assert parser.errors == 3  # too long, not ASCII, not printable
    parser.reset()
    assert parser.feed(b"OK" + end) == ["OK"]


def test_a_flood_without_an_end_is_not_kept() -> None:
    parser = LineParser(b"\r", most=8)
    for _ in range(100):
        assert parser.feed(b"x" * 1000) == []
    assert len(parser._buffer) <= 9
    assert parser.feed(b"\rOK\r") == ["OK"]
    assert parser.errors == 1
