"""Devices are found by what they answer, wherever they are."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from rtee.buses.emulator import Emulator
from rtee.buses.modbus_slave import ModbusEmulator, Refused
from rtee.buses.pool import BusPool
from rtee.buses.simulated import SimulatedLine
from rtee.buses.simulated_time import SimulatedTimeLoop
from rtee.drivers.diagnosis import probes
from rtee.drivers.diagnosis.can_probe import can as can_probe
from rtee.drivers.diagnosis.scan import Address, ScanPlan, network_probes, scan, serial_probes
from rtee.drivers.diagnosis.slaves import ANSWER
from rtee.drivers.emulators import make_emulator
from rtee.drivers.orca_touch import codec
from tests.buses.devices import in_real_time

pytestmark = pytest.mark.anyio


async def scanned(line: SimulatedLine, *, units: Sequence[int] | None = None) -> Address:
    probes_ = serial_probes(units)
    if line.address.startswith("tcp"):
        probes_ = network_probes(units)
    real = not isinstance(asyncio.get_running_loop(), SimulatedTimeLoop)
    # Each question is asked once, and a busy computer answers later than a device.
    usual = ANSWER.set(0.4 if real else ANSWER.get())
    try:
        async with BusPool() as pool:
            [found] = await scan([ScanPlan(line.address, probes=probes_)], pool)
    finally:
        ANSWER.reset(usual)
    return found


def device(name: str, **properties: object) -> Emulator:
    return make_emulator(name, {"emulator": properties, "port": "/dev/emulated"})


@pytest.mark.parametrize(
    ("name", "properties", "what"),
    [
        ("robotiq_2f", {"unit": 12}, "Robotiq 2-finger gripper, unit 12, 115200 baud 8N1"),
        ("robotiq_3f", {}, "Robotiq 3-Finger, unit 9, 115200 baud 8N1"),
        ("onrobot_3fg", {"unit": 66, "framing": "rtu"}, "OnRobot 3FG, unit 66, 1000000 baud 8E1"),
        ("onrobot_rg", {"unit": 67, "framing": "rtu"}, "OnRobot RG2, unit 67, 1000000 baud 8E1"),
        ("schunk_egu", {}, "SCHUNK EGK 40 M-B, unit 12"),
        ("qb_softhand", {"device": 3}, "qb SoftHand, device 3"),
        ("schunk_svh", {}, "SCHUNK SVH, firmware"),
        ("inspire_rh56", {"unit": 3}, "Inspire RH56, unit 3"),
        ("linkerhand", {}, "LinkerHand O6, unit 39"),
        ("linkerhand", {"model": "l10", "unit": 40}, "LinkerHand L10, unit 40"),
        ("ability_hand", {}, "PSYONIC Ability Hand, address 80"),
        (
            "orca_touch",
            {},
            "ORCA touch board, fingertips thumb, index, middle",
        ),
    ],
)
async def test_a_device_on_a_line_is_found_with_its_options(
    name: str, properties: dict[str, object], what: str
) -> None:
    with SimulatedLine([device(name, **properties)], wire_time=False) as line:
        found = await scanned(line, units=None if name.startswith("onrobot") else [9, 12])
    assert [one.driver for one in found.found] == [name]
    assert found.found[0].what.startswith(what)
    assert found.found[0].options["port"]


@pytest.mark.parametrize(
    "name",
    [
        "robotiq_2f", "onrobot_rg", "schunk_egu", "qb_softhand", "schunk_svh", "inspire_rh56",
        "linkerhand", "ability_hand", "orca_touch", "dynamixel", "feetech",
    ],
)  # fmt: skip
async def test_a_slow_and_noisy_adapter_hides_no_device(name: str) -> None:
    """Its first answer is late and damaged, each time that its port is opened."""
    given: dict[str, Any] = {"onrobot_rg": {"framing": "rtu"}, "feetech": {"family": "scs"}}
    properties = {"wear": "worn", **given.get(name, {})}
    if name in ("dynamixel", "feetech"):
        properties["ids"] = [1, 2, 3]
    with SimulatedLine([device(name, **properties)], strict=True) as line:
        found = await scanned(line)
    assert {one.driver for one in found.found} == {name}
    if "ids" in properties:
        assert [one.options["id"] for one in found.found] == [1, 2, 3]


async def test_servos_at_the_slowest_rate_are_found() -> None:
    servos = make_emulator(
        "dynamixel",
        {"emulator": {"ids": [1, 2]}, "baudrate": 9600, "port": "/dev/emulated"},
    )
    with SimulatedLine([servos], strict=True) as line:
        async with BusPool() as pool:
            found = await probes.dynamixel(9600).ask(pool, line.address)
    assert [one.options["id"] for one in found] == [1, 2]


async def test_a_touch_board_that_sends_is_found_at_its_rate() -> None:
    board = make_emulator("orca_touch", {"port": "/dev/emulated", "baudrate": 2_000_000})
    with SimulatedLine([board], wire_time=False, strict=True) as line:
        async with BusPool() as pool:
            bus = await pool.serial(line.address, owner="earlier", baudrate=2_000_000)
            for register, value in ((codec.Register.CONTENT, 3), (codec.Register.STREAM, 1)):
                start = codec.Request(codec.Function.WRITE, register, 1, bytes([value]))
                await bus.transact(start.to_bytes(), codec.AnswerParser(), 0.5, 1)
            await bus.detach("earlier")
            [found] = await scan([ScanPlan(line.address, probes=serial_probes([9])[:4])], pool)
        options = {"port": line.address, "baudrate": 2_000_000}
        assert [one.options for one in found.found] == [options]


class Bank(ModbusEmulator):
    """Registers of another maker: 0 wherever it is asked."""

    def read(self, function: int, address: int, count: int, now: float) -> list[int]:
        return [0] * count

    def write(self, address: int, values: Sequence[int], now: float) -> None:
        pass

    def advance(self, now: float) -> None:
        pass

    def power_cycle(self, now: float) -> None:
        pass


async def test_a_bank_of_zeros_is_no_gripper() -> None:
    with SimulatedLine([Bank(12)], wire_time=False) as line:
        found = await scanned(line, units=[12])
    assert [(one.driver, one.what) for one in found.found] == [
        ("", "a Modbus slave, unit 12, 115200 baud 8N1")
    ]


async def test_an_rg_that_has_registers_of_zeros_is_an_rg() -> None:
    gripper = make_emulator("onrobot_rg", {"port": "/dev/emulated", "emulator": {"unit": 65}})
    read = gripper.read

    def lenient(function: int, address: int, count: int, now: float) -> Sequence[int]:
        try:
            return read(function, address, count, now)  # type: ignore[no-any-return]
        except Refused:
            return [0] * count

    gripper.read = lenient
    with SimulatedLine([gripper], wire_time=False) as line:
        found = await scanned(line, units=[65])
    assert [one.driver for one in found.found] == ["onrobot_rg"]


async def test_a_gripper_that_knows_one_function_for_reading_is_found() -> None:
    gripper = device("robotiq_2f", functions=[4, 16])
    with SimulatedLine([gripper], wire_time=False) as line:
        found = await scanned(line, units=[9])
    assert [one.driver for one in found.found] == ["robotiq_2f"]


async def test_two_slaves_on_a_line_are_both_found() -> None:
    both = [device("robotiq_2f", unit=9), device("robotiq_2f", unit=10)]
    with SimulatedLine(both, wire_time=False) as line:
        found = await scanned(line, units=[9, 10])
    assert [one.options["unit"] for one in found.found] == [9, 10]


async def test_two_softhands_that_answer_at_once_are_both_found() -> None:
    both = [device("qb_softhand", device=1), device("qb_softhand", device=2)]
    with SimulatedLine(both, wire_time=False) as line:
        async with BusPool() as pool:
            [found] = await scan(
                [ScanPlan(line.address, probes=[probes.softhand([1, 2, 3])])], pool
            )
    assert [one.options["device"] for one in found.found] == [1, 2]


@in_real_time
async def test_a_compute_box_on_the_network_is_found() -> None:
    gripper = make_emulator("onrobot_3fg", {"host": "x"})
    with SimulatedLine([gripper], tcp=True, scheme="tcp") as line:
        found = await scanned(line)
    assert [one.what for one in found.found] == ["OnRobot 3FG, unit 65"]


@pytest.mark.parametrize("model", ["rg2", "rg6"])
@in_real_time
async def test_another_tool_behind_a_compute_box_is_found_with_its_model(model: str) -> None:
    gripper = make_emulator("onrobot_rg", {"host": "x", "model": model})
    with SimulatedLine([gripper], tcp=True, scheme="tcp") as line:
        found = await scanned(line)
        assert [one.what for one in found.found] == [f"OnRobot {model.upper()}, unit 65"]
        assert found.found[0].options == {"port": line.address, "unit": 65, "model": model}
        gripper.inject("wrong_device")
        found = await scanned(line)
    assert [(one.driver, one.what) for one in found.found] == [("", "OnRobot 2FG7, unit 65")]


@in_real_time
async def test_a_wsg_is_found_at_its_socket_and_nowhere_else() -> None:
    with SimulatedLine([make_emulator("wsg50", {})], tcp=True, scheme="socket") as line:
        async with BusPool() as pool:
            [found] = await scan([ScanPlan(line.address, probes=serial_probes([9])[:1])], pool)
    assert [one.what for one in found.found] == ["WSG 50, serial 1234, firmware 4.0.0"]
    assert found.found[0].options == {"port": line.address}
    async with BusPool() as pool:
        for address in ("tcp://127.0.0.1:1", "/dev/null"):
            assert await probes.wsg50().ask(pool, address) == []


@in_real_time
async def test_a_hand_on_modbus_is_told_from_grippers() -> None:
    """On a line and on the network, also where it tells zeros instead of refusing."""
    line = {"protocol": "modbus", "unit": 2, "emulator": {"unknown": "refused"}}
    with SimulatedLine([make_emulator("inspire_rh56", line)], wire_time=False) as wire:
        found = await scanned(wire, units=[1, 2])
        assert [one.what for one in found.found] == ["Inspire RH56, unit 2, 115200 baud 8N1"]
        assert found.found[0].options == {
            "port": wire.address, "unit": 2, "protocol": "modbus", "baudrate": 115200,
        }  # fmt: skip
    hand = make_emulator("inspire_rh56", {"port": "tcp://x", "emulator": {"unknown": "zeros"}})
    with SimulatedLine([hand], tcp=True, scheme="tcp") as wire:
        found = await scanned(wire)
        assert [one.what for one in found.found] == ["Inspire RH56, any unit"]
        assert found.found[0].options == {"port": wire.address, "unit": 1}


async def test_three_servos_at_two_rates_are_found_at_their_own() -> None:
    lines = [
        make_emulator(
            "dynamixel",
            {"baudrate": rate, "servos": {str(number): {"id": number} for number in numbers}},
        )
        for rate, numbers in ((1_000_000, (11, 12)), (57_600, (7,)))
    ]
    with SimulatedLine(lines, wire_time=False, strict=True) as line:
        rates = tuple(probes.dynamixel(rate) for rate in (57_600, 4_000_000, 1_000_000))
        async with BusPool() as pool:
            [found] = await scan([ScanPlan(line.address, probes=rates)], pool)
    assert {(one.options["id"], one.options["baudrate"]) for one in found.found} == {
        (7, 57_600),
        (11, 1_000_000),
        (12, 1_000_000),
    }
    assert len(found.found) == 3


@pytest.mark.parametrize("echo", [False, True])
async def test_servos_of_two_families_on_a_line_are_found_with_theirs(echo: bool) -> None:
    lines = [
        make_emulator("feetech", {"family": "scs", "emulator": {"ids": [1, 2], "echo": echo}}),
        make_emulator("feetech", {"family": "sts", "emulator": {"ids": [11]}}),
    ]
    with SimulatedLine(lines, wire_time=False) as line:
        async with BusPool() as pool:
            [found] = await scan([ScanPlan(line.address, probes=(probes.feetech(500_000),))], pool)
    assert [(one.driver, one.what) for one in found.found] == [
        ("feetech", "SCS0009, id 1, firmware 3.10, 1000000 baud"),
        ("feetech", "SCS0009, id 2, firmware 3.10, 1000000 baud"),
        ("feetech", "STS3215, id 11, firmware 3.10, 1000000 baud"),
    ]
    assert found.found[2].options == {
        "port": found.address, "baudrate": 1_000_000, "family": "sts", "id": 11,
    }  # fmt: skip


async def test_a_servo_of_a_model_that_is_not_known_is_told() -> None:
    servos = make_emulator("feetech", {"emulator": {"ids": [5], "servo": {"model": 0x1234}}})
    with SimulatedLine([servos], wire_time=False) as line:
        found = await scanned(line, units=[])
    assert [(one.driver, one.what) for one in found.found] == [
        ("", "servo with model bytes 34 12, id 5, firmware 3.10, 1000000 baud")
    ]


@pytest.mark.parametrize(
    ("name", "what"),
    [
        ("robotiq_3f", "Robotiq 3-Finger, any unit"),
        ("robotiq_2f", "Robotiq 2-finger gripper, any unit"),
    ],
)
@in_real_time
async def test_a_device_that_answers_to_every_unit_is_listed_once(name: str, what: str) -> None:
    emulator = make_emulator(name, {"port": "tcp://", "emulator": {"activated": True}})
    with SimulatedLine([emulator], tcp=True, scheme="tcp") as line:
        found = await scanned(line)
    assert [(one.driver, one.what, one.options["unit"]) for one in found.found] == [(name, what, 9)]


@pytest.mark.parametrize("rate", [57_600, 4_000_000])
async def test_a_servo_on_a_line_that_carries_every_rate_is_listed_once(rate: int) -> None:
    servos = make_emulator("dynamixel", {"baudrate": rate, "servos": {"a": {"id": 3}}})
    with SimulatedLine([servos], wire_time=False) as line:
        asked = tuple(probes.dynamixel(rate) for rate in (57_600, 1_000_000, 4_000_000))
        async with BusPool() as pool:
            [found] = await scan([ScanPlan(line.address, probes=asked)], pool)
    assert [(one.options["id"], one.options["baudrate"]) for one in found.found] == [(3, rate)]


async def test_nobody_is_nobody() -> None:
    with SimulatedLine([], wire_time=False) as line:
        asked = (probes.modbus(115200, "N", [9]), probes.svh(), probes.softhand([1]))
        async with BusPool() as pool:
            [found] = await scan([ScanPlan(line.address, probes=asked)], pool)
    assert (found.found, found.problem) == ((), "")


async def test_a_missing_or_busy_port_says_so() -> None:
    async with BusPool() as pool:
        [found] = await scan([ScanPlan("/dev/there-is-none", probes=serial_probes([9]))], pool)
    assert "there is no such port" in found.problem
    with SimulatedLine([]) as line:
        async with BusPool() as other, BusPool() as pool:
            await other.serial(line.address, owner="x")
            [found] = await scan([ScanPlan(line.address, probes=serial_probes([9]))], pool)
    assert "another program" in found.problem


@in_real_time
async def test_what_is_no_port_and_no_name_says_so(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    plans = [
        ScanPlan(str(tmp_path / "file"), probes=serial_probes([9])),
        ScanPlan("tcp://no-such-host.invalid", probes=network_probes([9])),
        ScanPlan("can9", probes=(can_probe("socketcan", 1_000_000),)),
        ScanPlan("can9", probes=(can_probe("no_such_interface", 1_000_000),)),
    ]
    async with BusPool() as pool:
        file, name, channel, interface = [one.problem for one in await scan(plans, pool)]
    assert file.startswith("is not a serial port")
    assert name == "the host name is unknown; use the IP address"
    assert "SocketCAN" in channel or "no such CAN interface" in channel
    assert "no_such_interface" in interface


async def test_what_a_can_interface_hands_back_is_no_device() -> None:
    async with BusPool() as pool:
        plan = ScanPlan("239.74.163.93", probes=(can_probe("udp_multicast", 1_000_000),))
        [found] = await scan([plan], pool)
    assert (found.found, found.problem) == ((), "")


@pytest.mark.parametrize(
    ("driver", "options"),
    [
        ("allegro", {}),
        ("linkerhand", {"model": "o6"}),
        ("linkerhand", {"model": "l10", "unit": 40}),
    ],
)
@in_real_time
async def test_nodes_on_a_can_bus_are_found(driver: str, options: dict[str, Any]) -> None:
    async with BusPool() as pool:
        await pool.can("can0", owner="x", emulator=lambda: make_emulator(driver, options))
        [channel] = pool.simulations
        plan = ScanPlan(channel, probes=(can_probe("virtual", 1_000_000),))
        async with BusPool() as asking:
            [found] = await scan([plan], asking)
    assert [one.driver for one in found.found] == [driver]
    assert found.found[0].options.items() >= options.items()
