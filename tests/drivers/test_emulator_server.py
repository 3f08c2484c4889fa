"""A played device: what other software finds, and what typing does to it."""

from __future__ import annotations

import contextlib
import socket
import time
from pathlib import Path

import can
import pytest
import serial

from rtee.buses.emulator import Emulator
from rtee.buses.simulated import SimulatedLine
from rtee.buses.simulated_zmq import SimulatedZmq
from rtee.drivers.emulator_server import Player
from rtee.errors import BusBroken, ConfigError, RteeError

STATUS = bytes.fromhex("09 03 07 D0 00 03 04 0E")


def asked(address: str, request: bytes, count: int) -> bytes:
    with serial.Serial(address, 115200, timeout=1.0) as port:
        port.write(request)
        return bytes(port.read(count))


def test_a_pty_at_a_path_of_ones_own(tmp_path: Path) -> None:
    link = tmp_path / "gripper"
    with Player("robotiq_2f", {"position": 77}, link=link) as player:
        assert player.address == str(link)
        assert asked(str(link), STATUS, 11)[7] == 77
    assert not link.exists()
    assert not link.is_symlink()


def test_a_path_that_is_taken_is_left_alone(tmp_path: Path) -> None:
    link = tmp_path / "gripper"
    link.write_text("mine")
    with pytest.raises(ConfigError, match="cannot make this link"):
        Player("robotiq_2f", link=link).__enter__()
    assert link.read_text() == "mine"


def test_a_link_of_somebody_else_is_left_alone(tmp_path: Path) -> None:
    link = tmp_path / "ttyHand"
    link.symlink_to("ttyUSB0")
    with pytest.raises(ConfigError, match="cannot make this link"):
        Player("robotiq_2f", link=link).__enter__()
    assert str(link.readlink()) == "ttyUSB0"


def test_a_link_that_was_taken_over_stays(tmp_path: Path) -> None:
    link = tmp_path / "gripper"
    with Player("robotiq_2f", link=link) as first, Player("robotiq_2f", link=link):
        first.command("unplug")
        assert asked(str(link), STATUS, 11)
    assert not link.is_symlink()


def test_a_network_device_speaks_modbus_tcp_and_a_raw_port_does_not() -> None:
    request = bytes.fromhex("00 02 00 00 00 06 41 03 01 00 00 04")
    with Player("onrobot_3fg", tcp=0) as player:
        assert player.address.startswith("tcp://127.0.0.1:")
        assert sent(player.address, request).startswith(bytes.fromhex("00 02 00 00 00 0B 41 03"))
    with Player("robotiq_2f", tcp=0, raw=True) as player:
        assert player.address.startswith("socket://")
        assert sent(player.address, STATUS).startswith(bytes.fromhex("09 03 06"))


def test_a_device_with_frames_of_its_own_is_at_a_socket() -> None:
    with Player("wsg50", tcp=0) as player:
        assert player.address.startswith("socket://")
        answer = sent(player.address, bytes.fromhex("AA AA AA 43 03 00 00 00 00 B8 10"))
        assert answer.startswith(bytes.fromhex("AA AA AA 43 06 00 00 00"))


def sent(address: str, request: bytes) -> bytes:
    host, _, port = address.split("//")[1].partition(":")
    with socket.create_connection((host, int(port)), timeout=2.0) as connection:
        connection.sendall(request)
        return connection.recv(100)


def test_typing_makes_faults() -> None:
    with Player("robotiq_2f", {"activated": True}) as player:
        assert player.command("fault overcurrent") == ""
        assert "fault 14" in player.command("state")
        assert "faults: overcurrent" in player.command("state")
        assert player.command("clear") == ""
        assert "closed: 0%\nfaults: none" in player.command("state")
        assert "did you mean 'overcurrent'" in player.command("fault overcurrrent")
        assert player.command("wire drop=0.5 noise=0.1") == ""
        assert player.simulation.faults.drop == 0.5
        assert "unknown wire fault 'drip'" in player.command("wire drip=1")
        for share in ("much", "5", "-1", "nan"):
            assert "should look like drop=0.05" in player.command(f"wire drop={share}")
        assert player.simulation.faults.drop == 0.5
        assert player.command("unplug") == ""
        assert not player.simulation.plugged
        assert player.command("replug").startswith("at /")
        assert player.command("power") == ""
        assert "activated False" in player.command("state")
        assert "faults: activation_failed" in player.command("help")
        assert player.command("  ") == ""


@pytest.mark.parametrize("device", ["dynamixel", "feetech"])
@pytest.mark.parametrize(
    ("ids", "what"),
    [
        ([300], "'ids.0' of the emulated device: input should be less than or equal to 25"),
        ([1, 254], "'ids.1' of the emulated device: input should be less than or equal to 25"),
        ([-1], "'ids.0' of the emulated device: input should be greater"),
        ([1, 2, 1], "two of the servos have the same id"),
    ],
)
def test_a_line_has_servos_with_ids_that_they_can_have(
    device: str, ids: list[int], what: str
) -> None:
    with pytest.raises(ConfigError, match=what):
        Player(device, {"ids": ids})


@pytest.mark.parametrize("device", ["dynamixel", "feetech"])
def test_an_empty_line_has_no_faults(device: str) -> None:
    with Player(device, {"ids": []}) as player:
        assert player.command("fault overload") == ""
        assert player.emulator.faults == {"overload"}


def test_mistakes_are_named() -> None:
    with pytest.raises(ConfigError, match="there is no emulator for 'robotik'"):
        Player("robotik")
    with pytest.raises(ConfigError, match="unknown property 'modell'"):
        Player("robotiq_2f", {"modell": "2f_85"})
    with pytest.raises(ConfigError, match="'unit' of the emulated device: input should be less"):
        Player("robotiq_2f", {"unit": 999})
    with pytest.raises(ConfigError, match="'rate' of the emulated device: input should be great"):
        Player("xbot2", {"rate": 0})
    with pytest.raises(ConfigError, match="'allegro' is a device on a CAN bus"):
        Player("allegro")
    with pytest.raises(ConfigError, match="'qb_softhand' is not a device on a CAN bus"):
        Player("qb_softhand", can="x")
    with pytest.raises(ConfigError, match="its own driver can"):
        Player("heri_ethercat")
    with pytest.raises(ConfigError, match="give one of"):
        Player("robotiq_2f", tcp=0, can="x")
    with pytest.raises(ConfigError, match="'xbot2' is a server on the network: give --tcp PORT"):
        Player("xbot2", link=Path("there"))
    with pytest.raises(ConfigError, match="cannot be set to 115200 baud; possible: 921600"):
        Player("schunk_svh", baudrate=115200)
    with pytest.raises(ConfigError, match=r"'wsg50' at 1 baud: should be greater .* 1200"):
        Player("wsg50", tcp=0, baudrate=1)
    with pytest.raises(ConfigError, match=r"'allegro' at 9600 baud: should be greater .* 10000"):
        Player("allegro", can="x", baudrate=9600)
    with pytest.raises(ConfigError, match=r"'baudrate' of .*: input should be less .* 12000000"):
        Player("robotiq_2f", baudrate=12_000_001)


@pytest.mark.parametrize(
    ("name", "properties", "sentence"),
    [
        ("orca_touch", {"taxels": {"thumb": -1}}, "property 'taxels.thumb' of .* greater"),
        ("orca_touch", {"taxels": {"thumb": 70_000}}, "property 'taxels.thumb' of .* less"),
        ("orca_touch", {"taxels": {"pinkie": 51}}, "property 'taxels.pinkie' of .* 'pinky'"),
        ("xbot2", {"lower": 1.0, "upper": 1.0}, "properties of .*: lower, 1, is not below upper"),
    ],
)
def test_properties_that_no_device_has_are_refused(
    name: str, properties: dict[str, object], sentence: str
) -> None:
    with pytest.raises(ConfigError, match=sentence):
        Player(name, properties)


def test_a_hand_with_two_wires_is_played_on_either() -> None:
    with Player("linkerhand") as line:
        request, answer = "27 04 00 00 00 06 77 0E", "27 04 0C" + " 00 FF" * 6
        assert asked(line.address, bytes.fromhex(request), 17).hex(" ").upper().startswith(answer)
    # The virtual interface joins those who name its channel in this process.
    with (
        Player("linkerhand", can="two_wires", interface="virtual"),
        can.Bus("two_wires", interface="virtual") as bus,
    ):
        bus.send(can.Message(arbitration_id=0x27, data=b"\x33", is_extended_id=False))
        heard = bus.recv(5.0)
        assert heard is not None
        assert bytes(heard.data) == bytes([0x33, *[25] * 6])


def test_a_list_is_asked_for_in_the_form_it_is_written() -> None:
    assert Player("dynamixel", {"ids": [1, 2]}).emulator.servos.keys() == {1, 2}  # type: ignore[attr-defined]
    with pytest.raises(ConfigError, match=r"should be a valid list, such as \[1, 2, 3\]"):
        Player("dynamixel", {"ids": "1,2"})
    with pytest.raises(ConfigError, match=r"a mapping, such as \{name: value\}"):
        Player("dynamixel", {"servo": 3})


def test_clients_of_the_universal_controller_find_the_gripper_at_register_0() -> None:
    """They write from register 0 and read input registers from 0, by Modbus TCP."""
    from pymodbus.client import ModbusTcpClient

    with Player("robotiq_2f", {"activation_time": 0.0}, tcp=0) as player:
        host, _, port = player.address.partition("//")[2].partition(":")
        client = ModbusTcpClient(host, port=int(port), timeout=5)
        assert client.connect()
        assert not client.write_registers(0, [0x0100, 0, 0], device_id=9).isError()
        time.sleep(0.01)
        assert client.read_input_registers(0, count=3, device_id=9).registers[0] == 0x3100
        assert not client.write_registers(0, [0x0900, 0x0080, 0xFFFF], device_id=9).isError()
        told = client.read_input_registers(0, count=3, device_id=9).registers
        assert told[1] & 0xFF == 0x80, "the request is echoed"
        assert client.read_holding_registers(0, count=2, device_id=9).registers == [0x0900, 0x0080]
        assert client.read_holding_registers(0x07D0, count=3, device_id=9).registers[1] == told[1]
        client.close()


def three_free_ports() -> int:
    """Return the first of three free ports below those that the system hands out."""
    for base in range(20_000, 30_000, 3):
        with contextlib.suppress(OSError), contextlib.ExitStack() as stack:
            for port in range(base, base + 3):
                stack.enter_context(socket.socket()).bind(("127.0.0.1", port))
            return base
    raise AssertionError("no three ports are free")


def test_a_zeromq_server_has_three_ports_side_by_side() -> None:
    zmq = pytest.importorskip("zmq")
    base = three_free_ports()
    with (
        Player("xbot2", {"joints": ["claw"]}, tcp=base) as player,
        zmq.Context() as context,
        context.socket(zmq.REQ) as service,
    ):
        assert player.address == f"tcp://127.0.0.1:{base}"
        service.linger, service.rcvtimeo = 0, 2000
        service.connect(f"tcp://127.0.0.1:{base + 1}")
        service.send(b"type: joint_names\n")
        assert b"claw" in service.recv()


def test_a_zeromq_server_whose_port_was_taken_meanwhile_can_be_plugged_in_later() -> None:
    pytest.importorskip("zmq")
    with SimulatedZmq() as simulation:
        simulation.unplug()
        port = int(simulation.endpoints.command.rpartition(":")[2])
        with socket.create_server(("127.0.0.1", port)):
            with pytest.raises(BusBroken, match="cannot listen there"):
                simulation.replug()
            assert not simulation.plugged
        simulation.replug()
        assert simulation.plugged


class Fragile(Emulator):
    def feed(self, data: bytes, now: float) -> list[bytes]:
        raise ValueError("a mistake of its author")

    def power_cycle(self, now: float) -> None:
        pass


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_an_emulator_that_fails_leaves_nobody_waiting() -> None:
    with SimulatedLine([Fragile()], name="fragile") as line:
        with serial.Serial(line.address) as port:
            port.write(b"x")
            assert line._thread is not None
            line._thread.join()
        with pytest.raises(RteeError, match="'fragile' is no longer emulated"):
            line.power_cycle()


@pytest.mark.parametrize(
    ("name", "request_", "answer"),
    [
        ("qb_softhand", "3A 3A 01 02 00 00", "3A 3A 01 02 00 00"),
        ("ability_hand", "7E 50 A0 10 7E", "7E 10" + " 00" * 70 + " F0 7E"),
        (
            "linkerhand",
            "27 04 00 1E 00 06 17 08",
            "27 04 0C 00 06 00 01 00 01 00 52 00 10 00 10 89 B0",
        ),
        ("inspire_rh56", "EB 90 01 04 11 E8 03 01 02", "90 EB 01 04 11 E8 03 01 02"),
        ("feetech", "FF FF 01 02 01 FB", "FF FF 01 02 00 FC"),
        ("dynamixel", "FF FF FD 00 01 03 00 01 19 4E", "FF FF FD 00 01 07 00 55 00 B0 04"),
    ],
)
def test_hands_answer_at_their_own_rate(name: str, request_: str, answer: str) -> None:
    with Player(name) as player:
        expected = bytes.fromhex(answer)
        assert asked(player.address, bytes.fromhex(request_), len(expected)) == expected
