"""What real devices sent is read as what it means; the decoders are those of the drivers."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from typing import Any

import pytest

from rtee.buses.modbus_frames import rtu_frame
from rtee.drivers.ability_hand import codec as ability
from rtee.drivers.cia402 import cia301
from rtee.drivers.cia402.codec import State as DriveState
from rtee.drivers.dynamixel.codec import StatusPacket
from rtee.drivers.feetech import table as servos
from rtee.drivers.feetech.codec import Frame as ServoFrame
from rtee.drivers.inspire_rh56 import codec as rh56
from rtee.drivers.robotiq_2f.codec import Status as Status2F
from rtee.drivers.robotiq_3f.codec import Status as Status3F
from rtee.drivers.schunk_egu import codec as egu
from rtee.drivers.schunk_egu.codec import registers
from tests.drivers.recorded.table import recorded

RECORDED = recorded()
FRAMES = [
    pytest.param(family, text, means, id=f"{family} {text}")
    for family, one in RECORDED.items()
    for text, means in one.frames
]


def modbus(text: str) -> tuple[int, ...]:
    """Return the registers in the answer of a Modbus slave, whose checksum is checked."""
    raw = bytes.fromhex(text)
    assert rtu_frame(raw[0], raw[1:-2]) == raw
    return struct.unpack(f">{raw[2] // 2}H", raw[3:-2])


def robotiq_2f(text: str) -> Mapping[str, Any]:
    words = modbus(text)
    # An answer with the first register alone says nothing of the others.
    status = Status2F.from_registers((*words, 0, 0)[:3])
    return {name: _plain(getattr(status, name)) for name in status.__dataclass_fields__}


def robotiq_3f(text: str) -> Mapping[str, Any]:
    status = Status3F.from_registers(modbus(text))
    return {"motion": status.motion.name, "positions": [one.position for one in status.axes]}


def schunk_egu(text: str) -> Mapping[str, Any]:
    image = egu.Input.from_registers(registers(bytes.fromhex(text)))
    names = sorted(str(one.name) for one in image.status)
    return {"status": names, "position": image.position, "error": image.error}


def inspire_rh56(text: str) -> Mapping[str, Any]:
    raw = bytes.fromhex(text)
    if len(raw) == rh56.COUNT:
        report = rh56.table([0] * 6) * 2 + bytes(6) + raw + bytes([30] * 6)
        states = rh56.Report.from_bytes(rh56.table([0] * 6) + rh56.GAP + report).states
        return {"states": [state.name for state in states]}
    if len(raw) == rh56.WORDS:
        return {"set_points": list(rh56.words(raw))}
    frame = rh56.Frame.from_bytes(raw)
    assert frame.to_bytes(rh56.REQUEST if raw[0] == 0xEB else rh56.REPLY) == raw
    found: dict[str, Any] = {
        "hand": frame.hand,
        "command": rh56.Command(frame.command).name,
        "address": frame.address,
        "data": frame.data.hex(),
    }
    if len(frame.data) == rh56.WORDS:
        found["words"] = list(rh56.words(frame.data))
    return found


def ability_hand(text: str) -> Mapping[str, Any]:
    frame = bytes([0x10]) + bytes(24) + bytes.fromhex(text).ljust(45, b"\0") + b"\0"
    touch = ability.Reply.from_frame(frame).touch[: ability.SITES]
    least = min(ability.touch_force(word) for word in touch)
    return {"touch": list(touch), "forces_at_least": 1.0 if least >= 1.0 else least}


def feetech(text: str) -> Mapping[str, Any]:
    raw = bytes.fromhex(text)
    frame = ServoFrame.from_bytes(raw)
    assert frame.to_bytes() == raw
    found: dict[str, Any] = {
        "device": frame.device, "code": int(frame.code), "params": frame.params.hex()
    }  # fmt: skip
    if len(frame.params) == 2:
        found["position"] = servos.FAMILIES["sts"].unpack(
            servos.PRESENT_POSITION, frame.params, servos.PRESENT_POSITION.address
        )
    return found


def dynamixel(text: str) -> Mapping[str, Any]:
    raw = bytes.fromhex(text)
    packet = StatusPacket(raw[4], raw[8], raw[9:-2])  # the SDK reads them in the driver
    assert packet.to_bytes() == raw
    return {"device": packet.device, "error": packet.error, "params": packet.params.hex()}


def cia402(text: str) -> Mapping[str, Any]:
    number, data = int(text[:3], 16), bytes.fromhex(text[4:])
    kind = number & 0x780
    if kind == 0x700:
        return {"heartbeat": cia301.read_heartbeat(data).name}
    if kind == 0x180:
        return {"state": DriveState.of(int.from_bytes(data, "little")).name}
    if kind == 0x080:
        emergency = cia301.Emergency.from_bytes(data)
        assert emergency.to_frame(number & 0x7F).data == data
        return {"emergency": emergency.code, "register": emergency.register}
    sdo = cia301.Sdo.from_bytes(data)
    assert sdo.to_bytes() == data
    value = sdo.data[: sdo.size]
    found = {"index": sdo.index, "value": value.hex()}
    if sdo.index == 0x6041:
        found["state"] = DriveState.of(int.from_bytes(value, "little")).name
    return found


DECODERS: Mapping[str, Callable[[str], Mapping[str, Any]]] = {
    "robotiq_2f": robotiq_2f,
    "robotiq_3f": robotiq_3f,
    "schunk_egu": schunk_egu,
    "inspire_rh56": inspire_rh56,
    "ability_hand": ability_hand,
    "feetech": feetech,
    "dynamixel": dynamixel,
    "cia402": cia402,
}


def _plain(value: Any) -> Any:
    return getattr(value, "name", value)


@pytest.mark.parametrize(("family", "text", "means"), FRAMES)
def test_what_a_device_sent_is_read(family: str, text: str, means: Mapping[str, Any]) -> None:
    found = DECODERS[family](text)
    assert {name: found[name] for name in means} == means


def test_every_family_of_the_table_is_read_and_has_a_source() -> None:
    assert set(RECORDED) == set(DECODERS)
    for family, one in RECORDED.items():
        assert one.source, family
        assert one.kind in ("manual", "capture", "issue", "report"), family
