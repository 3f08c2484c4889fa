"""The doctor names the cause and the cure: one test for each."""

from __future__ import annotations

import asyncio
import os
import time
from contextvars import ContextVar
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rtee.buses.emulator import CanFrame, Emulator
from rtee.buses.link import Line
from rtee.buses.pool import BusPool
from rtee.buses.simulated import SimulatedLine
from rtee.buses.simulated_can import SimulatedCan
from rtee.drivers.cia402.emulated_drive import DriveProperties
from rtee.drivers.cia402.emulator import Cia402Emulator
from rtee.drivers.diagnosis import probes, slaves
from rtee.drivers.diagnosis.checks import Check, Verdict
from rtee.drivers.diagnosis.device import check_device
from rtee.drivers.diagnosis.machine import check_machine
from rtee.drivers.diagnosis.port import check_address, port_users
from rtee.drivers.emulators import make_emulator
from rtee.testing import actuator
from rtee.types import DeviceSpec

pytestmark = pytest.mark.anyio
in_real_time = pytest.mark.parametrize("anyio_backend", ["asyncio"])
"""As ports, sockets and CAN buses of this computer are."""


def gripper(**changes: Any) -> DeviceSpec:
    options = {"port": "/dev/there-is-none", **changes.pop("options", {})}
    return DeviceSpec(
        name="gripper",
        hand="hand",
        driver="robotiq_2f",
        actuators=(actuator("finger_joint", 0.0, 0.8),),
        options=options,
        **changes,
    )


def wrong(checks: list[Check]) -> Check:
    [found] = [check for check in checks if check.verdict is Verdict.WRONG]
    return found


def named(checks: list[Check], subject: str) -> Check:
    [found] = [check for check in checks if check.subject == subject]
    return found


def real(line: SimulatedLine) -> str:
    return os.path.realpath(line.address)


async def test_all_is_well() -> None:
    async with BusPool() as pool:
        checks = await check_device(gripper(emulated=True), pool)
    # A busy computer may cost a repetition on the wire, which is a warning.
    assert {check.verdict for check in checks if check.subject != "wire"} == {Verdict.OK}
    assert named(checks, "wire").verdict is not Verdict.WRONG
    assert "model 2F-85" in named(checks, "identity").text
    assert named(checks, "rate").text == "up to 164 Hz"
    assert named(checks, "watchdog").text.startswith("none armed")


async def test_an_armed_watchdog_is_told() -> None:
    options = {"watchdog": 0.5, "emulator": {"watchdog": True}}
    spec = replace(gripper(emulated=True), driver="qb_softhand", options=options)
    async with BusPool() as pool:
        checks = await check_device(spec, pool)
    assert named(checks, "watchdog").text.startswith("armed")


async def test_a_device_that_only_measures_tells_its_taxels() -> None:
    spec = DeviceSpec("skin", "h", "orca_touch", (), {}, emulated=True)
    async with BusPool(wire_time=False) as pool:
        checks = await check_device(spec, pool)
    assert named(checks, "touch").text.startswith("363 taxels")
    assert "position" not in [check.subject for check in checks]


async def test_a_port_that_is_not_there() -> None:
    async with BusPool() as pool:
        check = wrong(await check_device(gripper(), pool))
    assert check.text == "there is no /dev/there-is-none"
    assert "rtee scan" in check.remedy


async def test_a_file_that_is_no_port(tmp_path: Path) -> None:
    file = tmp_path / "port"
    file.write_text("")
    assert wrong(await check_address(str(file))).text == f"{file} is not a serial port"


@in_real_time
async def test_a_port_that_one_may_not_open(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with SimulatedLine([]) as line:
        check = wrong(await check_address(line.address))
    assert check.remedy.startswith("sudo usermod -aG ")


@in_real_time
async def test_a_port_in_use_names_the_program(tmp_path: Path) -> None:
    process = tmp_path / "proc" / "4242"
    (process / "fd").mkdir(parents=True)
    (process / "comm").write_text("minicom\n")
    with SimulatedLine([]) as line:
        (process / "fd" / "3").symlink_to(real(line))
        assert port_users(Path(line.address), tmp_path) == [(4242, "minicom")]
        check = wrong(await check_address(line.address, tmp_path))
    assert check.text == "it is in use by minicom (4242)"
    assert check.remedy == "end it: kill 4242"


@in_real_time
async def test_who_plays_a_port_does_not_use_it(tmp_path: Path) -> None:
    process = tmp_path / "proc" / "4242"
    (process / "fd").mkdir(parents=True)
    (process / "fd" / "3").symlink_to("/dev/ptmx")
    with SimulatedLine([]) as line:
        (process / "fd" / "4").symlink_to(real(line))
        assert port_users(Path(line.address), tmp_path) == []


@in_real_time
@pytest.mark.parametrize(("timer", "verdict"), [(16, Verdict.WARNING), (1, Verdict.OK)])
async def test_the_latency_timer(tmp_path: Path, timer: int, verdict: Verdict) -> None:
    with SimulatedLine([]) as line:
        name = os.path.basename(real(line))
        folder = tmp_path / "sys/bus/usb-serial/devices" / name
        folder.mkdir(parents=True)
        (folder / "latency_timer").write_text(f"{timer}\n")
        check = named(await check_address(line.address, tmp_path), "latency timer")
    assert check.verdict is verdict
    assert ("echo 1 | sudo tee" in check.remedy) is (timer == 16)


@pytest.mark.parametrize(
    ("properties", "options", "remedy"),
    [
        ({"unit": 12}, {}, "unit: 12"),
        ({}, {"model": "2f_140", "unit": 3}, "unit: 9"),
    ],
)
async def test_a_wrong_number_is_found_out(
    properties: dict[str, Any], options: dict[str, Any], remedy: str
) -> None:
    emulator = make_emulator("robotiq_2f", {"emulator": properties})
    with SimulatedLine([emulator], line=Line(115200)) as line:
        async with BusPool() as pool:
            spec = gripper(options={"port": line.address, **options})
            check = wrong(await check_device(spec, pool))
    assert "no answer from unit" in check.text
    assert remedy in check.remedy


async def test_a_wrong_rate_is_found_out() -> None:
    emulator = make_emulator("robotiq_2f", {})
    with SimulatedLine([emulator], line=Line(115200), strict=True) as line:
        async with BusPool() as pool:
            spec = gripper(options={"port": line.address, "baudrate": 9600})
            check = wrong(await check_device(spec, pool))
    assert "no answer from unit 9" in check.text
    assert "baudrate: 115200" in check.remedy


async def test_another_device_is_found_out() -> None:
    with SimulatedLine([make_emulator("schunk_svh", {})], wire_time=False) as line:
        async with BusPool() as pool:
            check = wrong(await check_device(gripper(options={"port": line.address}), pool))
    assert "SCHUNK SVH" in check.remedy
    assert "driver: schunk_svh" in check.remedy


@pytest.mark.parametrize(
    ("driver", "name", "options", "fault", "text"),
    [
        ("robotiq_2f", "finger_joint", {}, "overcurrent", "14: overcurrent"),
        ("schunk_svh", "hand_Pinky", {}, "driver_fault", "3: driver fault 0x01"),
        (
            "dynamixel",
            "jaw",
            {"servos": {"jaw": {"id": 1}}, "baudrate": 57600},
            "overload",
            "32: overload in servo 1 (jaw)",
        ),
        (
            "feetech",
            "jaw",
            {"family": "sts", "servos": {"jaw": {"id": 1}}},
            "overload",
            "32: overload in servo 1 (jaw)",
        ),
        (
            "onrobot_rg",
            "finger_joint",
            {"baudrate": 1_000_000},
            "safety_error",
            "6: a safety switch was pushed at power-up",
        ),
        ("schunk_egu", "left_finger_joint", {}, "overcurrent", "222: motor current too high"),
        ("inspire_rh56", "index_bend", {}, "over_current", "4: index: over-current"),
        ("linkerhand", "index_bend", {}, "encoder", "3: index: encoder error"),
        ("robotiq_2f", "finger_joint", {}, "", "none, but not activated"),
        ("schunk_svh", "hand_Pinky", {}, "", "none, but not homed"),
    ],
)
async def test_what_keeps_a_device_from_being_active_is_told(
    driver: str, name: str, options: dict[str, Any], fault: str, text: str
) -> None:
    emulator = make_emulator(driver, {"port": "/dev/emulated"})
    if fault:
        emulator.inject(fault)
    with SimulatedLine([emulator], wire_time=False) as line:
        spec = gripper(options={"port": line.address, **options})
        # A finger of the EGU has a way of 40 mm.
        upper = 0.04 if driver == "schunk_egu" else 0.8
        spec = replace(spec, driver=driver, actuators=(actuator(name, 0.0, upper),))
        async with BusPool() as pool:
            check = named(await check_device(spec, pool), "fault")
    assert check.verdict is (Verdict.WRONG if fault else Verdict.WARNING)
    assert check.text == text
    assert "recover" in check.remedy


async def test_a_zero_that_cannot_be_right_is_told_with_what_to_do() -> None:
    servo = {"id": 1, "zero": 4000}
    with SimulatedLine([make_emulator("feetech", {})], wire_time=False) as line:
        spec = gripper(options={"port": line.address, "family": "sts", "servos": {"jaw": servo}})
        spec = replace(spec, driver="feetech", actuators=(actuator("jaw", 0.0, 0.8),))
        async with BusPool() as pool:
            check = named(await check_device(spec, pool), "fault")
    assert "would have to move from 4000 to 4522, but accepts 0 to 4095" in check.text
    assert check.remedy == "correct its options in hand.yaml, or calibrate it"


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a busy computer answer in time, on a line of real time."""
    for module in (slaves, probes):
        monkeypatch.setattr(module, "ANSWER", ContextVar("ANSWER", default=0.3))


@pytest.mark.usefixtures("patient")
async def test_a_hand_that_speaks_modbus_alone_is_found_out() -> None:
    hand = make_emulator("inspire_rh56", {"protocol": "modbus"})
    with SimulatedLine([hand], wire_time=False) as line:
        spec = gripper(options={"port": line.address})
        spec = replace(spec, driver="inspire_rh56", actuators=(actuator("index", 0.0, 1.4),))
        async with BusPool() as pool:
            check = wrong(await check_device(spec, pool))
    assert check.text.startswith("no RH56 answers as unit 1")
    assert "set driver: inspire_rh56, unit: 1, protocol: modbus" in check.remedy


@in_real_time
@pytest.mark.usefixtures("patient")
async def test_a_hand_that_speaks_frames_is_told_with_its_protocol() -> None:
    """Advice that leaves a wrong setting out is followed in vain."""
    with SimulatedLine([make_emulator("inspire_rh56", {"port": "/dev/x"})]) as line:
        spec = replace(
            gripper(options={"port": real(line), "protocol": "modbus"}),
            driver="inspire_rh56",
            actuators=(actuator("index", 0.0, 1.47),),
        )
        async with BusPool() as pool:
            found = wrong(await check_device(spec, pool))
    assert "protocol: frames" in found.remedy


async def test_a_hand_on_a_can_channel_is_not_looked_for_on_a_tty() -> None:
    spec = replace(
        gripper(),
        driver="linkerhand",
        actuators=(actuator("index", 0.0, 1.6),),
        options={"channel": "rtee-nobody", "interface": "virtual"},
    )
    async with BusPool() as pool:
        found = wrong(await check_device(spec, pool))
    assert "/dev/" not in found.text
    assert "rtee-nobody" in found.text


@in_real_time
async def test_registers_of_zeros_raise_a_doubt() -> None:
    emulator = make_emulator("robotiq_2f", {"port": "/dev/x"})
    emulator._input_block = lambda: [0] * 8
    with SimulatedLine([emulator]) as line:
        async with BusPool() as pool:
            checks = await check_device(gripper(options={"port": real(line)}), pool)
    text = "all its registers are 0; is it a Robotiq 2-finger gripper?"
    assert named(checks, "warning").text == text


async def test_a_device_without_supply() -> None:
    with SimulatedLine([]) as line:
        async with BusPool() as pool:
            spec = gripper(options={"port": line.address})
            check = wrong(await check_device(spec, pool, search=False))
    assert "supply" in check.remedy


@pytest.mark.parametrize("activated", [True, False])
@pytest.mark.parametrize(
    ("there", "asked", "remedy"),
    [("robotiq_3f", "robotiq_2f", "3-Finger"), ("robotiq_2f", "robotiq_3f", "2-finger")],
)
async def test_a_gripper_with_other_fingers_is_refused(
    there: str, asked: str, remedy: str, activated: bool
) -> None:
    emulator = make_emulator(there, {"emulator": {"activated": activated}})
    with SimulatedLine([emulator], wire_time=False) as line:
        async with BusPool() as pool:
            spec = replace(gripper(options={"port": line.address}), driver=asked)
            check = wrong(await check_device(spec, pool))
    assert check.subject == "identity"
    assert remedy in check.remedy or activated


@pytest.mark.parametrize(
    ("there", "asked"), [("robotiq_3f", "robotiq_2f"), ("robotiq_2f", "robotiq_3f")]
)
async def test_the_check_of_an_inactive_gripper_s_fingers_can_be_left_out(
    there: str, asked: str
) -> None:
    emulator = make_emulator(there, {"emulator": {"activated": False}})
    with SimulatedLine([emulator], wire_time=False) as line:
        async with BusPool() as pool:
            spec = gripper(options={"port": line.address, "check_fingers": False})
            checks = await check_device(replace(spec, driver=asked), pool)
    assert named(checks, "identity").verdict is Verdict.OK


async def test_more_than_the_wire_gives_is_a_warning() -> None:
    async with BusPool() as pool:
        checks = await check_device(gripper(emulated=True, every=1), pool)
    check = named(checks, "rate")
    assert check.verdict is Verdict.WARNING
    assert check.remedy.startswith("set every: 7")


@pytest.mark.parametrize(
    ("address", "text"),
    [
        ("tcp://127.0.0.1:1", "127.0.0.1 refuses port 1"),
        ("tcp://no-such-host.invalid", "the name 'no-such-host.invalid' cannot be resolved"),
        ("tcp://192.168..5", "'192.168..5' is not a host name"),
    ],
)
async def test_network_addresses(address: str, text: str) -> None:
    assert wrong(await check_address(address)).text == text


@in_real_time
@pytest.mark.parametrize("driver", ["robotiq_2f", "onrobot_3fg", "onrobot_rg"])
async def test_a_device_that_takes_one_connection_is_asked_over_one(driver: str) -> None:
    emulator = make_emulator(driver, {"port": "tcp://", "emulator": {}})
    taken = 0

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal taken
        taken += 1
        while taken == 1 and (data := await reader.read(300)):
            writer.writelines(emulator.feed(data, time.monotonic()))
        writer.transport.abort()

    async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
        port = server.sockets[0].getsockname()[1]
        spec = gripper(options={"port": f"tcp://127.0.0.1:{port}"})
        if driver.startswith("onrobot"):
            spec = replace(spec, actuators=(actuator("f1_joint", 0.0, 3.0),))
        async with BusPool() as pool:
            checks = await check_device(replace(spec, driver=driver), pool)
    assert Verdict.WRONG not in {check.verdict for check in checks}, checks
    assert named(checks, "answer").verdict is Verdict.OK
    assert taken == 1


@in_real_time
async def test_a_played_network_device_is_well() -> None:
    with SimulatedLine(
        [make_emulator("robotiq_2f", {"port": "tcp://"})], tcp=True, scheme="tcp"
    ) as line:
        for _ in range(3):
            async with BusPool() as pool:
                checks = await check_device(gripper(options={"port": line.address}), pool)
            assert Verdict.WRONG not in {check.verdict for check in checks}, checks


@in_real_time
async def test_a_device_that_another_program_is_connected_to_is_named() -> None:
    gripped = make_emulator("robotiq_2f", {"port": "tcp://"})
    with SimulatedLine([gripped], tcp=True, scheme="tcp") as line:
        async with BusPool() as other, BusPool() as pool:
            await other.modbus(line.address, owner="other")
            checks = await check_device(gripper(options={"port": line.address}), pool)
    assert "accepts connections" in named(checks, "address").text
    assert "end the other program that is connected" in wrong(checks).remedy


@in_real_time
async def test_a_network_device_that_is_not_there_is_named() -> None:
    with SimulatedLine([], tcp=True, scheme="tcp") as line:
        address = line.address
    async with BusPool() as pool:
        check = wrong(await check_device(gripper(options={"port": address}), pool))
    assert "127.0.0.1 refuses port" in check.text
    assert "ping" in check.remedy


async def test_an_address_that_is_mistyped_is_named() -> None:
    spec = gripper(options={"port": "tcp://192.168..5"})
    async with BusPool() as pool:
        check = wrong(await check_device(spec, pool))
    assert check.text == "'192.168..5' is not a host name"


def drive(channel: str, **options: Any) -> DeviceSpec:
    given = {"channel": channel, "interface": "virtual", "nodes": {"jaw": {"id": 5}}}
    return DeviceSpec(
        name="drive",
        hand="hand",
        driver="cia402",
        actuators=(actuator("jaw", 0.0, 3.0),),
        options={**given, "deadline": 0.1, "enable_timeout": 0.3, "sdo_timeout": 0.1, **options},
    )


@in_real_time
async def test_drives_on_a_can_bus_are_asked_there() -> None:
    emulated = Cia402Emulator(DriveProperties(nodes=(5,)))
    with SimulatedCan([emulated], channel="doctor-drives"):
        async with BusPool() as pool:
            checks = await check_device(drive("doctor-drives"), pool)
    assert Verdict.WRONG not in {check.verdict for check in checks}, checks
    assert "emulated CiA 402 drive" in named(checks, "identity").text
    # Its option "host" is a node id, not a name on the network.
    assert "address" not in {check.subject for check in checks}


@in_real_time
@pytest.mark.parametrize(
    ("there", "options", "remedy"),
    [
        (
            "cia402",
            {"nodes": {"a": {"id": 7}}},
            "found CiA 402 drive 7 there; set driver: cia402, id: 7",
        ),
        ("allegro", {}, "found Allegro Hand 0 there; set driver: allegro, hand: 0"),
    ],
)
async def test_what_else_is_on_a_can_bus_is_named(
    there: str, options: dict[str, Any], remedy: str
) -> None:
    with SimulatedCan([make_emulator(there, options)], channel=f"doctor-{there}"):
        async with BusPool() as pool:
            check = wrong(await check_device(drive(f"doctor-{there}"), pool))
    assert "node 5 (jaw) does not answer" in check.text
    assert check.remedy == remedy


@in_real_time
async def test_a_drive_where_a_hand_was_expected_is_named() -> None:
    spec = DeviceSpec(
        name="hand",
        hand="hand",
        driver="allegro",
        actuators=tuple(actuator(f"joint_{i}_0", 0.0, 1.0) for i in range(16)),
        options={"channel": "doctor-kind", "interface": "virtual"},
    )
    emulated = Cia402Emulator(DriveProperties(nodes=(5,)))
    with SimulatedCan([emulated], channel="doctor-kind"):
        async with BusPool() as pool:
            check = wrong(await check_device(spec, pool))
    assert check.remedy.startswith("found CiA 402 drive 5")


class WithoutSync(Cia402Emulator):
    """Answers SDO, never process data."""

    def on_frame(self, frame: CanFrame, now: float) -> list[CanFrame]:
        return [] if frame.id == 0x080 else super().on_frame(frame, now)


@in_real_time
async def test_a_drive_that_answers_sdo_alone_is_not_said_to_be_unplugged() -> None:
    emulated: Emulator = WithoutSync(DriveProperties(nodes=(5,)))
    with SimulatedCan([emulated], channel="doctor-sync"):
        async with BusPool() as pool:
            check = wrong(await check_device(drive("doctor-sync"), pool))
    assert "no process data from node 5, although the drives answer SDO" in check.text
    assert "transmission type 1" in check.remedy


def test_the_machine_is_looked_at(tmp_path: Path) -> None:
    governor = tmp_path / "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor"
    governor.parent.mkdir(parents=True)
    governor.write_text("powersave\n")
    (tmp_path / "sys/kernel").mkdir()
    (tmp_path / "sys/kernel/realtime").write_text("1\n")
    checks = check_machine(tmp_path)
    slow = named(checks, "CPU governor")
    assert slow.verdict is Verdict.WARNING
    assert "performance" in slow.remedy
    assert "real-time" in named(checks, "kernel").text
    assert {"real-time priority", "locked memory", "disk"} <= {c.subject for c in checks}
