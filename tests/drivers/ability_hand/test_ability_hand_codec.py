"""The Ability Hand's bytes, from the example frames of its fact sheet."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.buses.parser import CodecError
from rtee.drivers.ability_hand import codec
from rtee.drivers.ability_hand.codec import (
    Command,
    CommandParser,
    Header,
    Reply,
    ReplyParser,
)

COMMANDS = [
    ("7E 50 A0 10 7E", Command(0x50, Header.READ)),
    ("7E 50 A1 0F 7E", Command(0x50, Header.READ + 1)),
    ("7E 50 A2 0E 7E", Command(0x50, Header.READ + 2)),
    ("7E 50 10" + " 00" * 12 + " A0 7E", Command(0x50, Header.POSITION, (0,) * 6)),
    (
        "7E 50 10" + " 99 19" * 5 + " 67 E6 D9 7E",
        Command(0x50, Header.POSITION, (6553,) * 5 + (-6553,)),
    ),
    (
        "7E 50 12" + " 54 55" * 5 + " AC AA FB 7E",
        Command(0x50, Header.POSITION + 2, (21844,) * 5 + (-21844,)),
    ),
    ("7E 50 20 8F 02" + " 00" * 10 + " FF 7E", Command(0x50, Header.VELOCITY, (655, *[0] * 5))),
    ("7E 50 30 36 01" + " 00" * 10 + " 49 7E", Command(0x50, Header.CURRENT, (310, *[0] * 5))),
    ("7E 50 40 62 01" + " 00" * 10 + " 0D 7E", Command(0x50, Header.DUTY, (354, *[0] * 5))),
    ("7E 50 7C 34 7E", Command(0x50, Header.LEAVE)),
    (
        "7E 50 10 7D 5E 7D 5D" + " 00" * 10 + " A5 7E",
        Command(0x50, Header.POSITION, (0x7D7E, *[0] * 5)),
    ),
]
"""The escaped word is given low byte first: 7E, then 7D."""

FIRST = Reply(
    1,
    (6553,) * 5 + (-6553,),
    (0,) * 6,
    touch=(0x123, 0x456, *[0] * 28),
    limited=(True, *[False] * 5),
)
THIRD = Reply(3, (6553,) * 5 + (-6553,), (310,) * 6, (40,) * 6)
REPLIES = [
    ("10" + " 99 19 00 00" * 5 + " 67 E6 00 00 23 61 45" + " 00" * 42 + " 01 5F", FIRST),
    ("10" + " 00" * 70 + " F0", Reply(1, (0,) * 6, (0,) * 6, touch=(0,) * 30)),
    ("12" + " 99 19 36 01" * 5 + " 67 E6 36 01" + " 28 00" * 6 + " 00 ED", THIRD),
]
GOOD = FIRST.to_bytes()


@pytest.mark.parametrize(("sheet", "command"), COMMANDS)
def test_commands_are_the_bytes_of_the_sheet(sheet: str, command: Command) -> None:
    raw = bytes.fromhex(sheet)
    assert command.to_bytes() == raw
    assert CommandParser().feed(raw) == [command]


@pytest.mark.parametrize(("sheet", "reply"), REPLIES)
def test_replies_are_the_bytes_of_the_sheet(sheet: str, reply: Reply) -> None:
    raw = bytes.fromhex(sheet)
    assert len(raw) == {1: 72, 2: 72, 3: 39}[reply.variant]
    assert reply.to_frame() == raw[:-1]
    assert codec.checksum(raw[:-1]) == raw[-1]
    assert ReplyParser().feed(codec.stuffed(raw)) == [reply]
    assert ReplyParser().feed(reply.to_bytes()) == [reply]


def test_the_second_reply_tells_velocities_and_touch() -> None:
    second = Reply(2, (1, 2, 3, 4, 5, 6), velocities=(-1,) * 6, touch=tuple(range(4066, 4096)))
    raw = second.to_frame()
    assert (raw[0], len(raw) + 1) == (0x11, 72)
    assert Reply.from_frame(raw) == second


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda f: b"", "not the header of a reply"),
        (lambda f: b"\x13" + f[1:], "not the header of a reply: 13"),
        (lambda f: b"\x50" + f[1:], "not the header of a reply: 50"),
        (lambda f: f[:-1], "a reply of variant 1 cannot have 70 bytes"),
        (lambda f: b"\x12" + f[1:], "a reply of variant 3 cannot have 71 bytes"),
        (lambda f: f[:-1] + b"\x40", "not the status of six motors: 0x40"),
    ],
)
def test_what_no_hand_can_reply_is_refused(change: object, text: str) -> None:
    frame = change(FIRST.to_frame())  # type: ignore[operator]
    with pytest.raises(CodecError, match=text):
        Reply.from_frame(frame)


def test_incomplete_commands_and_escapes_are_refused() -> None:
    with pytest.raises(CodecError, match="a command cannot have 1 bytes"):
        Command.from_frame(b"\x50")
    with pytest.raises(CodecError, match="of set-points cannot have 3 bytes"):
        Command.from_frame(b"\x50\x10\x00")
    with pytest.raises(CodecError, match="ends with an escape"):
        codec.unstuffed(b"\x01\x7d")


def test_the_parser_counts_what_is_damaged_and_drops_what_is_too_long() -> None:
    parser = ReplyParser()
    # Its checksum, its escape, and its length.
    damaged = (b"\x7e" + GOOD[1:5] + b"\xff" + GOOD[6:], b"\x7e\x10\x7d\x7e", bytes([1] * 200))
    for count, raw in enumerate(damaged, 1):
        assert parser.feed(raw + b"\x7e") == []
        assert parser.errors == count
    assert parser.pending == 0
    parser.feed(bytes([1] * 10_000))
    assert parser.pending <= ReplyParser.LIMIT + 1
    assert parser.feed(GOOD) == [FIRST]


def test_stray_zero_bytes_between_frames_are_no_damage() -> None:
    parser = ReplyParser()
    assert parser.feed(b"\0\0" + GOOD + b"\0" + GOOD) == [FIRST, FIRST]
    assert parser.errors == 0


@given(noise=st.binary(max_size=300), at=st.integers(0, 72), value=st.integers(0, 255))
def test_noise_and_damage_cost_no_frame_that_follows(noise: bytes, at: int, value: int) -> None:
    parser = ReplyParser()
    damaged = bytearray(GOOD)
    damaged[at] = value
    parser.feed(noise + bytes(damaged))
    assert parser.pending <= ReplyParser.LIMIT + 1
    # The first of two may end what the noise began.
    assert parser.feed(GOOD + GOOD)[-1] == FIRST


@given(
    cuts=st.lists(st.integers(1, 40), min_size=1),
    words=st.lists(st.integers(-32768, 32767), min_size=6, max_size=6),
)
def test_frames_are_found_however_the_stream_is_cut(cuts: list[int], words: list[int]) -> None:
    sent = [Command(0x7D, Header.DUTY + n, tuple(words)) for n in range(3)]
    stream, parser, found, at = b"".join(c.to_bytes() for c in sent), CommandParser(), [], 0
    while at < len(stream):
        step = cuts[at % len(cuts)]
        found += parser.feed(stream[at : at + step])
        at += step
    assert found == sent
    assert parser.errors == 0


@given(
    positions=st.lists(st.integers(-32768, 32767), min_size=6, max_size=6),
    touch=st.lists(st.integers(0, 4095), min_size=30, max_size=30),
    limited=st.lists(st.booleans(), min_size=6, max_size=6),
)
def test_replies_survive_the_wire(
    positions: list[int], touch: list[int], limited: list[bool]
) -> None:
    reply = replace(FIRST, positions=tuple(positions), touch=tuple(touch), limited=tuple(limited))
    assert ReplyParser().feed(reply.to_bytes()) == [reply]


# --- units ---------------------------------------------------------------------------------------


def test_full_scales_are_those_of_the_sheet() -> None:
    assert codec.angle(32767) == pytest.approx(math.radians(150.0))
    assert codec.angle_counts(math.radians(30.0)) == 6553
    assert codec.angle_counts(math.inf) == 32767
    assert codec.rate_counts(math.radians(60.0)) == 655
    assert codec.rate(-32767) == pytest.approx(-math.radians(3000.0))
    # 10 rad/s of the rotor are 40 counts; 649 turns of it are one of a finger's joint.
    assert codec.velocity(40, 0) == pytest.approx(10.0 / 649.0)
    assert codec.velocity_counts(10.0 / 162.45, 5) == 40
    # 0.5 A are 310 counts; a rotor turns with 1.49 mN·m per ampere.
    assert codec.effort(310, 0) == pytest.approx(0.5 * 1.49e-3 * 649.0, rel=2e-3)
    assert codec.effort_counts(0.5 * 1.49e-3 * 162.45, 5) == 310


@given(st.integers(0, 4095))
def test_touch_words_and_forces_belong_to_each_other(word: int) -> None:
    assert codec.touch_word(codec.touch_force(word)) == word


def test_touch_forces_follow_the_clients_line() -> None:
    assert codec.touch_force(0) == pytest.approx(0.878894)
    # V = 1.65, R = 33000 / 1.65 + 10000, N = 121591 / R + 0.878894.
    assert codec.touch_force(2048) == pytest.approx(121591 / 30000 + 0.878894)
    assert codec.touch_word(1e9) == 4095
    assert codec.touch_word(-1.0) == 0
    rising = [codec.touch_force(word) for word in range(4096)]
    assert rising == sorted(rising)
