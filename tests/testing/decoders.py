"""All decoders of rtee, for the fuzz test and the benchmark."""

from __future__ import annotations

import struct
from collections.abc import Callable

from pymodbus.framer import FramerBase, FramerRTU, FramerSocket
from pymodbus.pdu import DecodePDU, ReadHoldingRegistersRequest

from rtee.buses.modbus_frames import AnswerParser, RtuRequests, TcpRequests, rtu_frame
from rtee.buses.parser import CodecError
from rtee.drivers.ability_hand import codec as ability
from rtee.drivers.allegro import codec as allegro
from rtee.drivers.cia402 import cia301
from rtee.drivers.cia402 import codec as cia402
from rtee.drivers.dynamixel.codec import InstructionParser
from rtee.drivers.feetech import codec as feetech
from rtee.drivers.feetech.table import FAMILIES
from rtee.drivers.heri_ethercat import codec as heri
from rtee.drivers.inspire_rh56 import codec as rh56
from rtee.drivers.inspire_rh56.memory import Rh56Memory, Rh56Properties
from rtee.drivers.linkerhand import codec as linkerhand
from rtee.drivers.onrobot_3fg import codec as onrobot
from rtee.drivers.onrobot_rg import codec as rg
from rtee.drivers.orca_touch import codec as orca
from rtee.drivers.qb_softhand import codec as qb
from rtee.drivers.qb_softhand.codec import SLOT, ListParser, Parameter
from rtee.drivers.qb_softhand.emulator import QbSoftHandEmulator
from rtee.drivers.robotiq_2f import codec as two
from rtee.drivers.robotiq_3f import codec as three
from rtee.drivers.schunk_egu import codec as egu
from rtee.drivers.schunk_svh import codec as svh
from rtee.drivers.wsg50 import codec as wsg
from rtee.drivers.xbot2 import codec as xbot2
from rtee.errors import FrameError
from tests.testing.fuzz import Decoder


def frames(*texts: str) -> list[bytes]:
    """Return bytes from their hexadecimal digits."""
    return [bytes.fromhex(text) for text in texts]


def registers(count: int, decode: Callable[[tuple[int, ...]], object]) -> Callable[[bytes], object]:
    """Return a decoder of bytes from one of registers; what is missing is 0."""

    def decoded(data: bytes) -> object:
        padded = data[: 2 * count].ljust(2 * count, b"\0")
        return decode(struct.unpack(f">{count}H", padded))

    return decoded


def answered(
    framer: type[FramerBase], unit: int, counts: tuple[int, ...]
) -> Callable[[bytes], object]:
    """Return a decoder of the answers to requests for so many registers."""

    def decoded(data: bytes) -> object:
        for count in counts:
            request = ReadHoldingRegistersRequest(dev_id=unit, count=count)
            parser = AnswerParser(framer(DecodePDU(False)), request, bytes([2 * count]))
            parser.request(2)
            if found := parser.feed(data):
                return found
        raise FrameError("", "no answer")

    return decoded


def state_of(data: bytes) -> object:
    return cia402.Status.from_bytes(data).state


ROBOTIQ = frames(
    "09 10 03 E8 00 03 06 09 00 00 FF FF FF 42 29",
    "09 04 07 D0 00 03 B1 CE",
    "09 17 07 D0 00 03 03 E8 00 03 06 09 00 00 80 FF 40 96 56",
)
NETWORK = frames(
    "33 9A 00 00 00 0D 02 10 00 00 00 03 06 01 00 00 00 00 00",
    "00 02 00 00 00 06 41 03 01 00 00 04",
)
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

MESSAGES: list[tuple[str, bytes, Callable[[bytes], object], tuple[type[Exception], ...]]] = [
    ("Allegro positions", bytes(8), allegro.read_counts, (CodecError,)),
    (
        "Allegro information",
        bytes.fromhex("00040102002801"),
        allegro.HandInfo.from_bytes,
        (CodecError,),
    ),
    (
        "CANopen SDO",
        bytes.fromhex("4B41600040000000"),
        cia301.Sdo.from_bytes,
        (CodecError,),
    ),
    (
        "CANopen emergency",
        bytes.fromhex("3081110000000000"),
        cia301.Emergency.from_bytes,
        (CodecError,),
    ),
    (
        "CiA 402 status",
        bytes.fromhex("3712DA03000008"),
        state_of,
        (CodecError,),
    ),
    (
        "XBot2 state",
        xbot2.State(1, ("a", "b"), (0.5, 1.0), (0.0, 0.0), (0.0, 0.0), ()).to_bytes((0.0, 0.0), 1),
        xbot2.State.from_bytes,
        (CodecError,),
    ),
    (
        "XBot2 command",
        xbot2.Command(("a",), (0.5,), (), (xbot2.Control.POSITION,)).to_bytes(),
        xbot2.Command.from_bytes,
        (CodecError,),
    ),
    ("XBot2 service", xbot2.answer(True, "ok", ["a", "b"]), xbot2.read_yaml, (CodecError,)),
    ("XBot2 joint names", xbot2.answer(True, "", ["a"]), xbot2.joint_names, (CodecError,)),
    (
        "Allegro periods",
        bytes.fromhex("030000000000"),
        allegro.Periods.from_bytes,
        (CodecError,),
    ),
    ("CANopen heartbeat", b"\x05", cia301.read_heartbeat, (CodecError,)),
    ("CiA 402 command", bytes(7), cia402.Command.from_bytes, (CodecError,)),
    ("CiA 402 limits", bytes(6), cia402.Limits.from_bytes, (CodecError,)),
    ("CiA 402 motion", bytes(8), cia402.Motion.from_bytes, (CodecError,)),
    (
        "SVH feedback",
        bytes(54),
        svh.FeedbackAll.from_bytes,
        (CodecError,),
    ),
    (
        "SVH position settings",
        bytes(40),
        svh.PositionSettings.from_bytes,
        (CodecError,),
    ),
    (
        "SVH state",
        bytes(12),
        svh.ControllerState.from_bytes,
        (CodecError,),
    ),
    (
        "SVH firmware",
        b"SVH\0" + bytes(52),
        svh.FirmwareInfo.from_bytes,
        (CodecError,),
    ),
    ("qb currents", bytes(10), qb.read_int16, (CodecError,)),
    (
        "qb parameter",
        Parameter(2, (1, 2)).to_bytes().ljust(SLOT, b"\0"),
        Parameter.from_bytes,
        (CodecError,),
    ),
    ("HERI II command", bytes(32), heri.Command.from_bytes, (CodecError,)),
    ("HERI II reply", bytes(38), heri.Reply.from_bytes, (CodecError,)),
]

RH56_REQUESTS = frames(
    "EB 90 01 04 11 0A 06 4E 74",
    "EB 90 01 0F 12 CE 05 FF FF FF FF FF FF F4 01 FF FF FF FF E0",
    "EB 90 01 04 12 EC 03 01 07",
)
RH56_REPLIES = frames(
    "90 EB 01 0F 11 2E 06 00 00 F4 FF 05 00 5E 01 00 00 00 00 AC",
    "90 EB 01 04 12 CE 05 01 EB",
    "90 EB 01 09 11 4C 06 02 02 02 03 02 02 7A",
)

FEETECH_REQUESTS = frames(
    "FF FF 01 02 01 FB",
    "FF FF 01 09 03 2A 01 FF 00 00 03 E8 DD",
    "FF FF FE 06 82 38 0F 01 02 2F",
)
FEETECH_REPLIES = frames(
    "FF FF 01 04 20 01 FF DA",
    "FF FF 01 0D 00 01 FF 00 00 00 00 32 1E 00 00 00 A1",
)

ABILITY_COMMANDS = frames(
    "7E 50 A0 10 7E",
    "7E 50 10 99 19 99 19 99 19 99 19 99 19 67 E6 D9 7E",
    "7E 50 10 7D 5E 7D 5D" + " 00" * 10 + " A5 7E",
)
ABILITY_REPLIES = [
    bytes.fromhex(
        "7E 10" + " 99 19 00 00" * 5 + " 67 E6 00 00 23 61 45" + " 00" * 42 + " 01 5F 7E"
    ),
    bytes.fromhex("7E 12" + " 99 19 36 01" * 5 + " 67 E6 36 01" + " 28 00" * 6 + " 00 ED 7E"),
]

BLOCKS: list[tuple[str, list[bytes], int, Callable[[tuple[int, ...]], object], type[Exception]]] = [
    (
        "Robotiq 2F status",
        [frame[3:-2] for frame in ANSWERS[::2]],
        3,
        two.Status.from_registers,
        FrameError,
    ),
    (
        "Robotiq 3F status",
        [frame[3:-2] for frame in ANSWERS[::2]],
        8,
        three.Status.from_registers,
        FrameError,
    ),
    (
        "OnRobot 3FG status",
        frames("00 0E 02 EE 02 70 01 F4"),
        4,
        onrobot.Status.from_registers,
        FrameError,
    ),
    (
        "OnRobot 3FG command",
        frames("01 F4 02 EE 00 00 00 01"),
        4,
        onrobot.Command.from_registers,
        FrameError,
    ),
    (
        "LinkerHand version",
        frames("00 06 00 01 00 01 00 52 00 10 00 10"),
        6,
        linkerhand.Version.from_registers,
        FrameError,
    ),
    (
        "OnRobot RG state",
        frames("01 F4 00 00", "01 40 00 02"),
        2,
        rg.Status.from_registers,
        FrameError,
    ),
    ("OnRobot RG command", frames("01 90 04 4C 00 10"), 3, rg.Command.from_registers, FrameError),
    (
        "SCHUNK EGU input",
        frames("80 00 00 80 FB 00 00 00 00 00 00 00 D9 00 00 00"),
        8,
        egu.Input.from_registers,
        FrameError,
    ),
    (
        "SCHUNK EGU output",
        frames("01 20 00 00 10 27 00 00 20 4E 00 00 00 00 00 00"),
        8,
        egu.Output.from_registers,
        FrameError,
    ),
]
"""Decoders of registers: name, samples, number of registers, what decodes them, its error."""

DECODERS = [
    Decoder("Modbus RTU requests", ROBOTIQ, parser=lambda: RtuRequests(9), prefix=b"\x09"),
    Decoder("Modbus TCP requests", NETWORK, parser=TcpRequests, limit=260, lost=0),
    Decoder(
        "Modbus TCP answers",
        [
            bytes.fromhex("00 02 00 00 00 0B 41 03 08 00 0E 02 EE 02 70 01 F4"),
            bytes.fromhex("00 02 00 00 00 03 41 83 02"),
        ],
        decode=answered(FramerSocket, 65, (4,)),
        errors=(FrameError,),
        prefix=bytes.fromhex("00 02 00 00 00"),
    ),
    Decoder("Robotiq 2F command", ROBOTIQ, decode=registers(3, two.Command.from_registers)),
    Decoder(
        "Modbus RTU answers",
        ANSWERS,
        decode=answered(FramerRTU, 9, (3, 8)),
        errors=(FrameError,),
        prefix=b"\x09\x03",
    ),
    Decoder("Robotiq 3F command", ROBOTIQ, decode=registers(8, three.Command.from_registers)),
    Decoder(
        "WSG 50 frames",
        [
            wsg.move(30.0, 100.0, stop_on_block=True).to_bytes(),
            wsg.answer(0x53, wsg.Status.OK, wsg.Limits().to_bytes()).to_bytes(),
            wsg.answer(0x40, wsg.Status.OK, b"\xc1\0\0\0").to_bytes(),
        ],
        parser=wsg.FrameParser,
        prefix=wsg.PREAMBLE,
        limit=wsg.FrameParser.LIMIT,
    ),
    Decoder("SCHUNK SVH packets", SVH, parser=svh.Parser, prefix=svh.SYNC, limit=svh.Parser.LIMIT),
    Decoder(
        "RH56 requests",
        RH56_REQUESTS,
        parser=rh56.RequestParser,
        prefix=rh56.RequestParser.HEADER,
        limit=rh56.RequestParser.LIMIT,
    ),
    Decoder(
        "RH56 replies",
        RH56_REPLIES,
        parser=rh56.ReplyParser,
        prefix=rh56.ReplyParser.HEADER,
        limit=rh56.ReplyParser.LIMIT,
    ),
    Decoder(
        "RH56 report",
        [Rh56Memory(Rh56Properties()).report().to_bytes()],
        decode=rh56.Report.from_bytes,
        errors=(CodecError,),
    ),
    Decoder(
        "Ability Hand commands",
        ABILITY_COMMANDS,
        parser=ability.CommandParser,
        prefix=b"\x7e",
        limit=ability.CommandParser.LIMIT + 1,
    ),
    Decoder(
        "Ability Hand replies",
        ABILITY_REPLIES,
        parser=ability.ReplyParser,
        prefix=b"\x7e",
        limit=ability.ReplyParser.LIMIT + 1,
    ),
    Decoder(
        "Ability Hand reply",
        [frame[1:-2] for frame in ABILITY_REPLIES],
        decode=ability.Reply.from_frame,
        errors=(CodecError,),
    ),
    Decoder(
        "ORCA touch requests",
        [bytes.fromhex("55aa000310000400ea"), bytes.fromhex("55aa00101600010001d9")],
        parser=orca.RequestParser,
        prefix=orca.RequestParser.HEADER,
        limit=orca.RequestParser.LIMIT,
    ),
    Decoder(
        "ORCA touch answers",
        [
            bytes.fromhex("aa55000310000400444404005e"),
            orca.Stream(0, bytes(30)).to_bytes(),
            orca.Encoders(0, bytes(34)).to_bytes(),
        ],
        parser=orca.AnswerParser,
        prefix=orca.AnswerParser.HEADER,
        limit=orca.AnswerParser.LIMIT,
    ),
    Decoder(
        "ORCA touch forces",
        [bytes(6 + 3 * 4)],
        decode=lambda data: orca.Forces.from_bytes(data, orca.Content(3), (4,)),
        errors=(CodecError,),
    ),
    Decoder("qb SoftHand frames", QB, parser=qb.Parser, prefix=qb.HEADER, limit=qb.Parser.LIMIT),
    Decoder(
        "Dynamixel instructions",
        DYNAMIXEL_REQUESTS,
        parser=InstructionParser,
        prefix=b"\xff\xff\xfd\x00",
        limit=InstructionParser.LIMIT,
    ),
    Decoder(
        "Feetech requests",
        FEETECH_REQUESTS,
        parser=feetech.RequestParser,
        prefix=feetech.HEADER,
        limit=feetech.RequestParser.LIMIT,
    ),
    Decoder(
        "Feetech replies",
        FEETECH_REPLIES,
        parser=feetech.ReplyParser,
        prefix=feetech.HEADER,
        limit=feetech.ReplyParser.LIMIT,
    ),
    Decoder(
        "Feetech state",
        [bytes.fromhex("00 08 00 00 00 00 4A 1E 00 00 00 00 08 00 00")],
        decode=FAMILIES["sts"].measured,
    ),
    Decoder(
        "qb parameter list",
        [b"".join(QbSoftHandEmulator().feed(bytes.fromhex("3A3A01040C00000C"), 0.0))],
        parser=lambda: ListParser(1),
        prefix=b"::\1\x0c",
        limit=ListParser.LIMIT,
    ),
    *(
        Decoder(name, samples, decode=registers(count, decode), errors=(error,))
        for name, samples, count, decode, error in BLOCKS
    ),
    *(
        # Reading YAML takes half a millisecond.
        Decoder(name, [sample], decode=decode, errors=errors)
        for name, sample, decode, errors in MESSAGES
    ),
]
