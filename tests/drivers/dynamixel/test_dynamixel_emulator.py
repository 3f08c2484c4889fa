"""The emulated servos, asked by a master that knows only the sheet's bytes."""

from __future__ import annotations

import struct
from typing import Any

import pytest

from rtee.buses.link import Line
from rtee.buses.simulated import SimulatedLine
from rtee.drivers.dynamixel import table
from rtee.drivers.dynamixel.codec import ALERT, Error, Hardware
from rtee.drivers.dynamixel.emulator import DynamixelEmulator, DynamixelProperties
from rtee.drivers.dynamixel.servo import DynamixelServoProperties
from rtee.drivers.dynamixel.table import Mode
from tests.drivers.objects import obstruct


def crc(data: bytes) -> int:
    """CRC-16 bit by bit, on its own feet."""
    value = 0
    for byte in data:
        for bit in range(8):
            top = (value >> 15) ^ (byte >> (7 - bit) & 1)
            value = (value << 1 & 0xFFFF) ^ (0x8005 if top else 0)
    return value


class Master:
    """Packs and unpacks by hand; keeps its own time."""

    def __init__(self, emulator: DynamixelEmulator) -> None:
        self.emulator = emulator
        self.now = 0.0

    def ask(
        self, number: int, instruction: int, params: bytes = b"", *, wait: float = 0.001
    ) -> Any:
        self.now += wait
        raw = b"\xff\xff\xfd\x00" + struct.pack("<BHB", number, len(params) + 3, instruction)
        raw += params
        raw += struct.pack("<H", crc(raw))
        return self.emulator.feed(raw, self.now)

    def one(self, *args: Any, **kwargs: Any) -> tuple[int, int, bytes]:
        (raw,) = self.ask(*args, **kwargs)
        assert raw[:4] == b"\xff\xff\xfd\x00"
        assert struct.unpack_from("<H", raw, 5)[0] == len(raw) - 7
        assert raw[7] == 0x55
        assert crc(raw[:-2]) == struct.unpack("<H", raw[-2:])[0]
        return raw[4], raw[8], raw[9:-2]

    def write(self, number: int, register: table.Register, value: int) -> int:
        params = struct.pack("<H", register.address) + register.pack(value)
        return self.one(number, 0x03, params)[1]

    def read(self, number: int, register: table.Register) -> int:
        params = struct.pack("<HH", register.address, register.size)
        _, _, data = self.one(number, 0x02, params)
        return register.unpack(data)

    def wait(self, seconds: float) -> None:
        self.now += seconds
        self.emulator.step(self.now)


def line(*ids: int, **properties: Any) -> Master:
    return Master(
        DynamixelEmulator(
            DynamixelProperties(ids=ids or (1,), servo=DynamixelServoProperties(**properties))
        )
    )


def test_ping_tells_model_and_firmware_and_broadcast_reaches_all() -> None:
    master = line(1, 2, 5)
    assert master.one(2, 0x01) == (2, 0, bytes([0xB0, 0x04, 48]))
    assert [raw[4] for raw in master.ask(0xFE, 0x01)] == [1, 2, 5]
    assert master.ask(9, 0x01) == []


def test_unknown_instructions_and_bad_ranges_are_answered_with_their_error() -> None:
    master = line()
    assert master.one(1, 0x77)[1] == Error.INSTRUCTION
    assert master.one(1, 0x02, struct.pack("<HH", 220, 20))[1] == Error.DATA_RANGE
    assert master.write(1, table.PRESENT_POSITION, 1) == Error.ACCESS
    assert master.write(1, table.GOAL_CURRENT, 1800) == Error.DATA_LIMIT
    assert master.write(1, table.GOAL_POSITION, 5000) == Error.DATA_LIMIT
    assert master.write(1, table.BAUD_RATE, 9) == Error.DATA_RANGE


def test_eeprom_is_closed_while_torque_is_on() -> None:
    master = line()
    assert master.write(1, table.OPERATING_MODE, 5) == 0
    assert master.write(1, table.TORQUE, 1) == 0
    assert master.write(1, table.OPERATING_MODE, 3) == Error.ACCESS
    assert master.read(1, table.OPERATING_MODE) == 5


def test_moves_with_its_profile_velocity_and_torque_takes_the_pose_for_goal() -> None:
    master = line(start=1000.0)
    assert master.write(1, table.GOAL_POSITION, 3000) == 0
    assert master.write(1, table.TORQUE, 1) == 0
    master.wait(0.5)
    assert master.read(1, table.PRESENT_POSITION) == 1000
    assert master.write(1, table.PROFILE_VELOCITY, 64) == 0
    assert master.write(1, table.GOAL_POSITION, 3000) == 0
    master.wait(0.5)
    # 64 counts are 14.7 rpm, 1000 pulses in a second.
    assert master.read(1, table.PRESENT_POSITION) == pytest.approx(1500, abs=30)
    assert master.read(1, table.PRESENT_VELOCITY) == pytest.approx(64, abs=1)
    master.wait(3.0)
    assert master.read(1, table.PRESENT_POSITION) == 3000


def test_an_object_is_squeezed_with_no_more_than_the_goal_current() -> None:
    master = line()
    obstruct(master.emulator.servos[1].axis, 2500.0, 2.0)
    for register, value in ((table.OPERATING_MODE, 5), (table.TORQUE, 1)):
        assert master.write(1, register, value) == 0
    assert master.write(1, table.GOAL_CURRENT, 200) == 0
    assert master.write(1, table.GOAL_POSITION, 3500) == 0
    master.wait(3.0)
    assert master.read(1, table.PRESENT_POSITION) == pytest.approx(2600, abs=1)
    assert master.read(1, table.PRESENT_CURRENT) == 200


def test_sync_write_and_both_sync_reads() -> None:
    master = line(0, 1, return_delay=0)
    goals = struct.pack("<HHBiBi", 116, 4, 0, 2100, 1, 1990)
    for number in (0, 1):
        assert master.write(number, table.TORQUE, 1) == 0
    assert master.ask(0xFE, 0x83, goals) == []
    master.wait(2.0)
    first, second = master.ask(0xFE, 0x82, struct.pack("<HHBB", 132, 4, 0, 1))
    assert struct.unpack("<i", first[9:-2]) == (2100,)
    assert struct.unpack("<i", second[9:-2]) == (1990,)
    (fast,) = master.ask(0xFE, 0x8A, struct.pack("<HHBB", 132, 4, 0, 1))
    assert fast[4] == 0xFE
    assert fast[8:10] == b"\x00\x00"
    assert struct.unpack_from("<i", fast, 10) == (2100,)
    assert struct.unpack_from("<H", fast, 14)[0] == crc(fast[:14])
    assert fast[16:18] == b"\x00\x01"
    assert struct.unpack_from("<H", fast, 22)[0] == crc(fast[:22])


def test_a_missing_servo_silences_those_after_it() -> None:
    master = line(0, 1, 2)
    master.emulator.servos[1].silent_until = 1e9
    request = struct.pack("<HHBBB", 132, 4, 0, 1, 2)
    assert len(master.ask(0xFE, 0x82, request)) == 1
    (cut,) = master.ask(0xFE, 0x8A, request)
    assert len(cut) == 16
    assert struct.unpack_from("<H", cut, 5)[0] == 1 + 3 * 8


def test_bulk_read_write_and_registered_write() -> None:
    master = line(1, 2)
    bulk = struct.pack("<BHHBBHHh", 1, 65, 1, 1, 2, 102, 2, 99)
    assert master.ask(0xFE, 0x93, bulk) == []
    first, second = master.ask(0xFE, 0x92, struct.pack("<BHHBHH", 1, 65, 1, 2, 102, 2))
    assert first[9:-2] == b"\x01"
    assert second[9:-2] == struct.pack("<h", 99)
    assert master.one(1, 0x04, b"\x41\x00\x00")[1] == 0
    assert master.read(1, table.LED) == 1
    assert master.read(1, table.REGISTERED) == 1
    assert master.ask(0xFE, 0x05) == []
    assert master.read(1, table.LED) == 0


def test_status_return_level_is_obeyed() -> None:
    master = line()
    assert master.write(1, table.STATUS_RETURN_LEVEL, 1) == 0
    assert master.ask(1, 0x03, b"\x41\x00\x01") == []
    assert master.read(1, table.LED) == 1


def test_return_delay_and_latency_make_the_turnaround() -> None:
    emulator = DynamixelEmulator(DynamixelProperties(ids=(1, 2), latency=0.001))
    master = Master(emulator)
    master.ask(0xFE, 0x82, struct.pack("<HHBB", 132, 4, 1, 2))
    assert emulator.turnaround == pytest.approx(2 * 500e-6 + 0.001)
    assert master.write(1, table.RETURN_DELAY, 0) == 0
    master.ask(1, 0x01)
    assert emulator.turnaround == pytest.approx(0.001)


def test_overload_takes_the_torque_and_only_a_reboot_clears_it() -> None:
    master = line(overload_time=0.5, reboot_time=0.4)
    obstruct(master.emulator.servos[1].axis, 2100.0, 50.0)
    assert master.write(1, table.TORQUE, 1) == 0
    assert master.write(1, table.GOAL_POSITION, 4000) == 0
    for _ in range(20):
        master.wait(0.1)
    assert master.one(1, 0x01)[1] == ALERT
    assert master.read(1, table.HARDWARE_ERROR) == Hardware.OVERLOAD
    assert master.read(1, table.TORQUE) == 0
    assert master.one(1, 0x08)[1] == ALERT
    assert master.ask(1, 0x01) == []
    master.wait(0.5)
    assert master.one(1, 0x01)[1] == 0
    assert master.read(1, table.HARDWARE_ERROR) == 0


def test_the_bus_watchdog_stops_it_until_it_is_cleared() -> None:
    master = line()
    for register, value in (
        (table.TORQUE, 1), (table.PROFILE_VELOCITY, 10), (table.BUS_WATCHDOG, 5),
        (table.GOAL_POSITION, 4000),
    ):  # fmt: skip
        assert master.write(1, register, value) == 0
    for _ in range(4):
        master.wait(0.05)
    assert master.read(1, table.BUS_WATCHDOG) == -1
    stopped = master.read(1, table.PRESENT_POSITION)
    assert master.write(1, table.GOAL_POSITION, 3000) == Error.DATA_RANGE
    master.wait(0.5)
    assert master.read(1, table.PRESENT_POSITION) == stopped
    assert master.write(1, table.BUS_WATCHDOG, 0) == 0
    assert master.write(1, table.GOAL_POSITION, 3000) == 0


def test_turns_are_lost_with_the_supply() -> None:
    master = line(start=-30.0)
    assert master.write(1, table.OPERATING_MODE, Mode.EXTENDED_POSITION) == 0
    assert master.read(1, table.PRESENT_POSITION) == 4066
    assert master.write(1, table.TORQUE, 1) == 0
    assert master.write(1, table.GOAL_POSITION, 4200) == 0
    master.wait(2.0)
    assert master.read(1, table.PRESENT_POSITION) == 4200
    master.emulator.power_cycle(master.now)
    master.wait(1.0)
    assert master.read(1, table.PRESENT_POSITION) == 104


def test_reverse_mode_and_homing_offset_change_what_is_read() -> None:
    master = line(start=1000.0, drive_mode=1, homing_offset=100)
    assert master.read(1, table.PRESENT_POSITION) == 4096 - 1000 + 100
    assert master.write(1, table.TORQUE, 1) == 0
    assert master.write(1, table.GOAL_POSITION, 3296) == 0
    master.wait(2.0)
    assert master.read(1, table.PRESENT_POSITION) == 3296
    assert master.emulator.servos[1].axis.position == pytest.approx(900, abs=1)


def test_indirect_data_show_what_they_point_to() -> None:
    master = line()
    assert master.one(1, 0x03, struct.pack("<HHH", 168, 146, 65))[1] == 0
    assert master.one(1, 0x03, struct.pack("<HB", 209, 1))[1] == 0
    assert master.one(1, 0x02, struct.pack("<HH", 208, 2))[2] == b"\x19\x01"


def test_factory_reset_keeps_the_id_when_asked() -> None:
    master = line(7)
    assert master.write(7, table.RETURN_DELAY, 0) == 0
    assert master.one(7, 0x06, b"\x01")[1] == 0
    master.wait(1.0)
    assert master.read(7, table.RETURN_DELAY) == 250


def test_a_part_of_a_register_is_refused_by_its_length() -> None:
    master = line()
    assert master.one(1, 0x03, struct.pack("<HB", 116, 200))[1] == Error.DATA_LENGTH
    assert master.one(1, 0x03, struct.pack("<HH", 118, 200))[1] == Error.DATA_LENGTH
    assert master.one(1, 0x03, struct.pack("<HB", 168, 200))[1] == Error.DATA_LENGTH
    assert master.one(1, 0x03, struct.pack("<H", 116))[1] == Error.DATA_LENGTH
    assert master.one(1, 0x02, b"\x84\x00")[1] == Error.DATA_LENGTH
    assert master.one(1, 0x03, struct.pack("<HB", 132, 1))[1] == Error.ACCESS
    assert master.read(1, table.GOAL_POSITION) == table.CENTER


def test_indirect_addresses_point_to_their_own_data_at_first() -> None:
    master = line()
    told = struct.unpack("<20H", master.one(1, 0x02, struct.pack("<HH", 168, 40))[2])
    assert told == tuple(range(208, 228))
    assert master.one(1, 0x03, struct.pack("<HH", 168, 132))[1] == 0
    assert master.one(1, 0x03, struct.pack("<HH", 170, 63))[1] == Error.DATA_RANGE
    assert master.one(1, 0x03, struct.pack("<HH", 170, 228))[1] == Error.DATA_RANGE
    assert master.one(1, 0x08)[1] == 0
    master.wait(1.0)
    assert master.one(1, 0x02, struct.pack("<HH", 168, 2))[2] == struct.pack("<H", 208)


def test_a_damaged_instruction_is_answered_with_the_crc_error() -> None:
    emulator = DynamixelEmulator(DynamixelProperties(ids=(1, 2)))
    # "write goal 512" of the e-manual, a bit of its data flipped; the answer's bytes are the SDK's.
    damaged = bytes.fromhex("FF FF FD 00 01 09 00 03 74 00 01 02 00 00 CA 89")
    answer = bytes.fromhex("FF FF FD 00 01 04 00 55 03")
    answer += struct.pack("<H", crc(answer))
    assert emulator.feed(damaged, 0.0) == [answer]
    assert emulator.servos[1].get(table.GOAL_POSITION) == table.CENTER
    everybody = damaged[:4] + b"\xfe" + damaged[5:]
    assert emulator.feed(everybody, 0.1) == []
    absent = damaged[:4] + b"\x07" + damaged[5:]
    assert emulator.feed(absent, 0.2) == []
    emulator.servos[1].set(table.STATUS_RETURN_LEVEL, 1)
    assert emulator.feed(damaged, 0.3) == []


def test_the_makers_sdk_hears_the_same_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    sdk = pytest.importorskip("dynamixel_sdk")
    # Half of the time [ms] that it waits for an answer, in real time.
    monkeypatch.setattr("dynamixel_sdk.port_handler.LATENCY_TIMER", 10_000.0)
    with SimulatedLine([DynamixelEmulator()], line=Line(57_600)) as played:
        port, packets = sdk.PortHandler(played.address), sdk.PacketHandler(2.0)
        assert port.setBaudRate(57_600)
        assert packets.write1ByteTxRx(port, 1, 116, 5) == (sdk.COMM_SUCCESS, Error.DATA_LENGTH)
        assert packets.write4ByteTxRx(port, 1, 116, 2100) == (sdk.COMM_SUCCESS, 0)
        assert packets.read2ByteTxRx(port, 1, 168) == (208, sdk.COMM_SUCCESS, 0)
        port.closePort()


@pytest.mark.parametrize("mode", [2, 6, 15])
def test_a_number_that_is_no_operating_mode_is_refused(mode: int) -> None:
    master = line()
    assert master.write(1, table.OPERATING_MODE, mode) == Error.DATA_RANGE
    assert master.read(1, table.OPERATING_MODE) == Mode.POSITION
