"""Programs that others wrote for Feetech servos talk to the emulated ones.

`make device-peers` installs them, as `make test` does.
"""

from __future__ import annotations

import math
from typing import Any

import pytest

from rtee.buses.simulated import SimulatedLine
from rtee.drivers.feetech import table
from rtee.drivers.feetech.emulator import FeetechEmulator, FeetechProperties
from rtee.drivers.feetech.table import FamilyName
from tests.drivers.peers.running import environment

OPEN = {n: math.radians(-35.0 if n % 2 else 35.0) for n in range(1, 9)}
"""The AmazingHand's open pose [rad], by id."""

_PATIENT = 2500.0
"""Half of the time that the vendor's SDK waits for an answer [ms]; 16 of its own."""


def servos(family: FamilyName, ids: tuple[int, ...], **more: Any) -> FeetechEmulator:
    return FeetechEmulator(FeetechProperties(family, ids, **more))


def settle(line: SimulatedLine, seconds: float = 2.0) -> None:
    """Let the servos get where they are going, without waiting for it."""
    for emulator in line.emulators:
        assert isinstance(emulator, FeetechEmulator)
        for servo in emulator.ordered:
            line.call(lambda servo=servo: servo.axis.advance(seconds))


def test_the_amazing_hands_own_client_opens_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(environment("rustypot"))
    rustypot = pytest.importorskip("rustypot", reason="rustypot is not installed")
    hand = servos("scs", tuple(range(1, 9)), sync_read=True)
    with SimulatedLine([hand], wire_time=False) as line:
        client = rustypot.Scs0009PyController(line.address, 1_000_000, 0.5)
        assert [n for n in range(1, 10) if client.ping(n)] == list(range(1, 9))
        # It reads words of a model's number in the other order: 05 04 for 1284.
        assert client.read_model(1)[0] in (1284, 1029)
        ids = list(OPEN)
        client.sync_write_torque_enable(ids, [1] * 8)
        for number, angle in OPEN.items():
            client.write_goal_speed(number, 7.0)
            client.write_goal_position(number, angle)
        settle(line)
        for number, angle in OPEN.items():
            [found] = client.read_present_position(number)
            assert found == pytest.approx(angle, abs=0.006)
        together = client.sync_read_present_position(ids)
        assert list(together) == pytest.approx(list(OPEN.values()), abs=0.006)
        one, two = hand.ordered[:2]
        assert (one.get(table.GOAL_POSITION), two.get(table.GOAL_POSITION)) == (391, 630)
        assert one.get(table.GOAL_SPEED) == 1368
        client.sync_write_torque_enable(ids, [0] * 8)
        assert client.read_torque_enable(3)[0] == 0
        client.close()


@pytest.mark.parametrize(
    ("family", "end", "model", "center"), [("sts", 0, 777, 2048), ("scs", 1, 1284, 511)]
)
def test_the_vendors_sdk_finds_reads_and_moves_servos(
    family: FamilyName, end: int, model: int, center: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(environment("feetech-servo-sdk"))
    sdk = pytest.importorskip("scservo_sdk", reason="feetech-servo-sdk is not installed")
    made = servos(family, (1, 2))
    with SimulatedLine([made], wire_time=False) as line:
        port = sdk.PortHandler(line.address)
        assert port.openPort()
        port.setBaudRate(1_000_000)
        packets = sdk.PacketHandler(end)
        assert packets.ping(port, 3)[1] != 0
        # It takes a late answer for that to its next request: no answer may come too late.
        monkeypatch.setattr(sdk.port_handler, "LATENCY_TIMER", _PATIENT)
        assert packets.ping(port, 1) == (model, 0, 0)
        assert packets.read2ByteTxRx(port, 2, 56) == (center, 0, 0)
        assert packets.write1ByteTxRx(port, 1, 40, 1) == (0, 0)
        assert packets.write2ByteTxRx(port, 1, 42, center + 100) == (0, 0)
        settle(line)
        position = lambda: packets.read2ByteTxRx(port, 1, 56)  # noqa: E731
        assert position()[0] == center + 100
        made.inject("overload")
        assert position()[2] == 0x20
        if family == "sts":
            group = sdk.GroupSyncRead(port, packets, 56, 4)
            assert group.addParam(1)
            assert group.addParam(2)
            assert group.txRxPacket() == 0
            assert [group.getData(n, 56, 2) for n in (1, 2)] == [center + 100, center]
        port.closePort()
