"""A servo gets another id, and keeps it."""

from __future__ import annotations

import pytest

from rtee.buses.faults import Faults
from rtee.buses.pool import BusPool
from rtee.buses.simulated import SimulatedLine
from rtee.drivers.feetech import table
from rtee.drivers.feetech.emulator import FeetechEmulator, FeetechProperties
from rtee.drivers.feetech.identity import recognise, set_id
from rtee.drivers.feetech.servo import FeetechServoProperties
from rtee.drivers.feetech.table import FAMILIES, FamilyName
from rtee.errors import ConfigError, DriverError, NotConnected
from tests.drivers.use import set_id_command

pytestmark = pytest.mark.anyio


def line(family: FamilyName, ids: tuple[int, ...], model: int = 0) -> FeetechEmulator:
    servo = FeetechServoProperties(model=model, reboot_time=0.0)
    return FeetechEmulator(FeetechProperties(family, ids, servo))


def test_models_are_recognised_in_the_order_of_their_family() -> None:
    found = [recognise(bytes.fromhex(text)) for text in ("05 04", "09 03", "04 05", "03 09")]
    assert [None if one is None else one.name for one in found] == [
        "SCS0009",
        "STS3215",
        None,
        None,
    ]


@pytest.mark.parametrize("family", ["scs", "sts", "hls"])
@pytest.mark.parametrize("share", [0.0, 0.1])
async def test_an_id_is_stored_and_locked(family: FamilyName, share: float) -> None:
    servos = line(family, (1, 7))
    with SimulatedLine([servos], wire_time=False, faults=Faults(drop=share, seed=3)) as wire:
        async with BusPool() as pool:
            model = await set_id(pool, wire.address, 1_000_000, 1, 5)
    assert model.family == family
    servos.power_cycle(0.0)
    assert [servo.number for servo in servos.ordered] == [5, 7]
    assert servos.ordered[0].get(FAMILIES[family].lock) == 1
    assert servos.ordered[0].get(table.TORQUE) == 0


async def test_what_cannot_be_done_is_told_and_changes_nothing() -> None:
    servos = line("scs", (1, 2))
    with SimulatedLine([servos], wire_time=False) as wire:
        async with BusPool() as pool:
            with pytest.raises(ConfigError, match="a servo 2 is already"):
                await set_id(pool, wire.address, 1_000_000, 1, 2)
            with pytest.raises(NotConnected, match="no servo 9 answers"):
                await set_id(pool, wire.address, 1_000_000, 9, 3)
    assert [servo.number for servo in servos.ordered] == [1, 2]
    with SimulatedLine([line("sts", (1,), model=0x1234)], wire_time=False) as wire:
        async with BusPool() as pool:
            with pytest.raises(DriverError, match=r"unknown model \(34 12\)"):
                await set_id(pool, wire.address, 1_000_000, 1, 3)


@pytest.mark.heavy
def test_the_one_servo_on_a_line_gets_its_id_by_the_command() -> None:
    servos = line("scs", (1,))
    with SimulatedLine([servos], wire_time=False) as wire:
        assert set_id_command("4", "--port", wire.address) == "SCS0009: 1 is now 4\n"
        assert "has the id 4 already" in set_id_command("4", "--port", wire.address, status=2)
    assert servos.ordered[0].number == 4
    with SimulatedLine([line("scs", (1, 2))], wire_time=False) as wire:
        text = set_id_command("4", "--port", wire.address, status=2)
        assert f"there are servos 1, 2 at {wire.address}; connect only one" in text
        assert set_id_command("4", "--port", wire.address, "--from", "2") == "SCS0009: 2 is now 4\n"
    with SimulatedLine([], wire_time=False) as wire:
        text = set_id_command("4", "--port", wire.address, status=2)
        assert f"there is no servo at {wire.address} (feetech at 1000000 baud, dynamixel" in text
        text = set_id_command("4", "--port", wire.address, "--from", "2", status=1)
        assert "no servo 2 answers (feetech at" in text
        assert "--baudrate must be one of" in set_id_command(
            "4", "--port", wire.address, "--baudrate", "9601", status=2
        )
    with SimulatedLine([line("scs", (1,))], wire_time=False) as wire:
        text = set_id_command(
            "4", "--port", wire.address, "--from", "1", "--new-baudrate", "1000000", status=2
        )
        assert "Feetech servos keep their rate" in text
    set_id_command("254", "--port", "/dev/null", status=2)
