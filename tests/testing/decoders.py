"""All decoders of rtee, for the fuzz test and the benchmark."""

from __future__ import annotations

import struct
from collections.abc import Callable

from rtee.buses.modbus_frames import RtuRequests, TcpRequests, find_answer, rtu_frame
from rtee.drivers.dynamixel.codec import InstructionParser, StatusParser
from rtee.drivers.onrobot_3fg import codec as onrobot
from rtee.drivers.qb_softhand import codec as qb
from rtee.drivers.robotiq_2f import codec as two
from rtee.drivers.robotiq_3f import codec as three
from rtee.drivers.schunk_svh import codec as svh
from rtee.errors import FrameError
from rtee.testing.fuzz import Decoder


def registers(count: int, decode: Callable[[tuple[int, ...]], object]) -> Callable[[bytes], object]:
    """Return a decoder of bytes from one of registers; what is missing is 0."""

    def decoded(data: bytes) -> object:
        padded = data[: 2 * count].ljust(2 * count, b"\0")
        return decode(struct.unpack(f">{count}H", padded))

    return decoded


def answered(data: bytes) -> object:
    start, end = find_answer(data, 9, 3)
    if start < 0:
        raise FrameError("", "no answer")
    return data[start:end]


ROBOTIQ = [
    bytes.fromhex(text)
    for text in (
        "09 10 03 E8 00 03 06 09 00 00 FF FF FF 42 29",
        "09 04 07 D0 00 03 B1 CE",
        "09 17 07 D0 00 03 03 E8 00 03 06 09 00 00 80 FF 40 96 56",
    )
]
NETWORK = [
    bytes.fromhex(text)
    for text in (
        "33 9A 00 00 00 0D 02 10 00 00 00 03 06 01 00 00 00 00 00",
        "00 02 00 00 00 06 41 03 01 00 00 04",
    )
]
ANSWERS = [
    bytes.fromhex("09 03 06 39 00 00 FF 0E 0A F7 8B"),
    rtu_frame(9, b"\x83\x02"),
    bytes.fromhex("09 03 10 F9 FF 00 00 07 00 00 06 00 00 06 00 00 89 00 00 34 8D"),
]
SVH = [
    svh.Packet(svh.Command.GET_FIRMWARE_INFO).to_bytes(),
    svh.Packet(svh.Command.GET_CONTROL_FEEDBACK, 3, b"\1\2\3\4\5\6", 7).to_bytes(pad=False),
]
QB = [qb.Frame(1, 0).to_bytes(), qb.Frame(1, 132, bytes(range(6))).to_bytes()]
DYNAMIXEL_REQUESTS = [
    bytes.fromhex("FF FF FD 00 01 03 00 01 19 4E"),
    bytes.fromhex("FF FF FD 00 01 07 00 02 84 00 04 00 1D 15"),
]
DYNAMIXEL_ANSWERS = [
    bytes.fromhex("FF FF FD 00 01 07 00 55 00 06 04 26 65 5D"),
    bytes.fromhex("FF FF FD 00 01 08 00 55 00 A6 00 00 00 8C C0"),
]

DECODERS = [
    Decoder("Modbus RTU requests", ROBOTIQ, parser=lambda: RtuRequests(9), prefix=b"\x09"),
    # A length in the garbage may span good frames; a connection begins with none.
    Decoder("Modbus TCP requests", NETWORK, parser=TcpRequests, limit=260, lost=8),
    Decoder(
        "Modbus RTU answers", ANSWERS, decode=answered, errors=(FrameError,), prefix=b"\x09\x03"
    ),
    Decoder(
        "Robotiq 2F status",
        [frame[3:-2] for frame in ANSWERS[::2]],
        decode=registers(3, two.Status.from_registers),
        errors=(FrameError,),
    ),
    Decoder(
        "Robotiq 3F status",
        [frame[3:-2] for frame in ANSWERS[::2]],
        decode=registers(8, three.Status.from_registers),
        errors=(FrameError,),
    ),
    Decoder("Robotiq 3F command", ROBOTIQ, decode=registers(8, three.Command.from_registers)),
    Decoder(
        "OnRobot 3FG status",
        [bytes.fromhex("00 0E 02 EE 02 70 01 F4")],
        decode=registers(4, onrobot.Status.from_registers),
        errors=(FrameError,),
    ),
    Decoder(
        "OnRobot 3FG command",
        [bytes.fromhex("01 F4 02 EE 00 00 00 01")],
        decode=registers(4, onrobot.Command.from_registers),
        errors=(FrameError,),
    ),
    Decoder("SCHUNK SVH packets", SVH, parser=svh.Parser, prefix=svh.SYNC, limit=svh.Parser.LIMIT),
    Decoder("qb SoftHand frames", QB, parser=qb.Parser, prefix=qb.HEADER, limit=qb.Parser.LIMIT),
    Decoder(
        "Dynamixel instructions",
        DYNAMIXEL_REQUESTS,
        parser=InstructionParser,
        prefix=b"\xff\xff\xfd\x00",
        limit=InstructionParser.LIMIT,
    ),
    Decoder(
        "Dynamixel answers",
        DYNAMIXEL_ANSWERS,
        parser=StatusParser,
        prefix=b"\xff\xff\xfd\x00",
        limit=StatusParser.LIMIT,
    ),
]
