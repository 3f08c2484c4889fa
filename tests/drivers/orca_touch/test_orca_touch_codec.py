"""The frames of the ORCA hand's touch board, by examples that its own rule of checks gives."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest

from rtee.buses.parser import CodecError
from rtee.drivers.orca_touch import codec
from rtee.drivers.orca_touch.codec import (
    AnswerParser,
    Content,
    Encoders,
    Forces,
    Function,
    Register,
    Reply,
    Request,
    RequestParser,
    Stream,
)

FULL = {"thumb": 51, "index": 87, "middle": 87, "ring": 87, "pinky": 51}
COUNTS = tuple(FULL.values())


@pytest.mark.parametrize(
    ("request_", "raw"),
    [
        (Request(Function.READ, Register.CONNECTED, 4), "55aa000310000400ea"),
        (Request(Function.READ, Register.COUNTS, 56), "55aa00033000380096"),
        (Request(Function.READ, Register.CONTENT, 1), "55aa000316000100e7"),
        (Request(Function.WRITE, Register.CONTENT, 1, b"\x01"), "55aa00101600010001d9"),
        (Request(Function.WRITE, Register.CONTENT, 1, b"\x03"), "55aa00101600010003d7"),
        (Request(Function.WRITE, Register.STREAM, 1, b"\x01"), "55aa00101700010001d8"),
        (Request(Function.READ, Register.RESULTANTS, 168), "55aa00030005a80051"),
    ],
)
def test_requests(request_: Request, raw: str) -> None:
    data = bytes.fromhex(raw.replace(" ", ""))
    assert request_.to_bytes() == data
    assert RequestParser().feed(data) == [request_]


def test_replies() -> None:
    parser = AnswerParser()
    [reply] = parser.feed(bytes.fromhex("aa5500031000040044440400 5e".replace(" ", "")))
    assert isinstance(reply, Reply)
    assert codec.connected(reply.data) == codec.FINGERS
    assert codec.connected_bytes(codec.FINGERS) == reply.data
    done, refused = parser.feed(
        bytes.fromhex("aa55001016000100 00daaa5500101600010001d9".replace(" ", ""))
    )
    assert (done.data, refused.data) == (b"\x00", b"\x01")
    table = bytearray(56)
    for offset, count in ((4, 0x33), (12, 0x57), (20, 0x57), (28, 0x57), (36, 0x33)):
        table[offset] = count
    raw = bytes.fromhex("aa55000330003800") + bytes(table) + b"\x2b"
    [reply] = AnswerParser().feed(raw)
    assert codec.tip_counts(reply.data) == FULL
    assert codec.counts_bytes(FULL) == reply.data


def test_a_frame_with_resultants() -> None:
    raw = bytes.fromhex(
        "aa561f".replace("561f", "56001f00000500fdff1400") + "00" * 18 + "0000000096ff37"
    )
    [frame] = AnswerParser().feed(raw)
    assert frame == Stream(0, raw[6:-1])
    forces = Forces.from_bytes(frame.data, Content.RESULTANTS, COUNTS)
    assert forces.resultants[0] == pytest.approx([0.5, -0.3, 2.0])
    # The high byte of z may be FF from 128 counts on.
    assert forces.resultants[4] == pytest.approx([0.0, 0.0, 15.0])
    assert forces.taxels.shape == (0, 3)
    assert AnswerParser().feed(bytes.fromhex("aa56000700 00000000000000f9".replace(" ", "")))


@pytest.mark.parametrize(("content", "size"), [(1, 31), (2, 1090), (3, 1120)])
def test_sizes_of_a_whole_hand(content: int, size: int) -> None:
    assert codec.data_size(Content(content), COUNTS) + 1 == size


def test_encoders() -> None:
    raw = bytes.fromhex("aaa900230000" + "00" * 10 + "0090" + "00" * 22 + "fa")
    [frame] = AnswerParser().feed(raw)
    assert isinstance(frame, Encoders)
    angles = frame.angles()
    assert angles.shape == (17,)
    assert angles[5] == pytest.approx(math.pi / 2)
    # A wrong parity, and the bit of an error.
    words = np.zeros(17, dtype="<u2")
    words[0], words[1] = 0x0001, 0xC000
    found = Encoders(0, words.tobytes()).angles()
    assert np.isnan(found[:2]).all()
    assert not np.isnan(found[2:]).any()


@pytest.mark.parametrize("content", [*Content, Content.TAXELS | Content.RESULTANTS])
def test_forces_come_back(content: Content) -> None:
    random_ = np.random.default_rng(3)
    taxels = [
        np.stack(
            [
                random_.integers(-128, 128, n),
                random_.integers(-128, 128, n),
                random_.integers(0, 256, n),
            ],
            axis=1,
        )
        * 0.1
        for n in COUNTS
    ]
    resultants = np.array(
        [[-12.8, 12.7, 25.5], [0.0, 0.1, 0.2], [1, 2, 3], [0, 0, 0], [-0.1, 0, 9]]
    )
    data = codec.forces_bytes(resultants, taxels, content)
    found = Forces.from_bytes(data, content, COUNTS)
    if content & Content.TAXELS:
        assert found.taxels == pytest.approx(np.concatenate(taxels))
    if content & Content.RESULTANTS:
        assert found.resultants == pytest.approx(resultants)
    with pytest.raises(CodecError):
        Forces.from_bytes(data[:-1], content, COUNTS)


def test_other_boards_are_told_apart() -> None:
    for wrong in (b"\xff" * 4, b"\x44\x44\x04\x01", b"\x44"):
        with pytest.raises(CodecError):
            codec.connected(wrong)


def test_the_parser_finds_frames_in_pieces_and_among_garbage() -> None:
    frames = [
        Stream(0, bytes(range(31)) * 3),
        Encoders(0, bytes(34)),
        Reply(Function.WRITE, Register.STREAM, 1, b"\x00"),
        Stream(2, b"\xaa\x56\x00" * 30),
    ]
    random_ = random.Random(5)
    for _ in range(200):
        noise = [bytes(random_.randrange(256) for _ in range(random_.randrange(6))) for _ in frames]
        data = b"".join(n + f.to_bytes() for n, f in zip(noise, frames, strict=True)) + bytes(40)
        parser, found = AnswerParser(), []
        while data:
            cut = random_.randrange(1, 40)
            found += parser.feed(data[:cut])
            data = data[cut:]
        assert [frame for frame in found if frame in frames] == frames
        assert parser.pending <= AnswerParser.LIMIT
