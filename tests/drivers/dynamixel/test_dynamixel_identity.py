"""A servo gets another id and another rate, and keeps them."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest

from rtee.buses.faults import Faults
from rtee.buses.pool import BusPool
from rtee.buses.simulated import SimulatedLine
from rtee.drivers.dynamixel import table
from rtee.drivers.dynamixel.emulator import DynamixelEmulator, DynamixelProperties
from rtee.drivers.dynamixel.identity import set_id
from rtee.drivers.dynamixel.servo import EmulatedDynamixel
from rtee.errors import ConfigError, NotConnected
from tests.drivers.use import set_id_command

pytestmark = pytest.mark.anyio


def line(*ids: int) -> DynamixelEmulator:
    return DynamixelEmulator(DynamixelProperties(ids=ids))


@pytest.mark.parametrize("share", [0.0, 0.1])
async def test_id_and_rate_are_stored_without_torque(share: float) -> None:
    servos = line(1, 7)
    servos.ordered[0].set(table.TORQUE, 1)
    with SimulatedLine([servos], wire_time=False, faults=Faults(drop=share, seed=3)) as wire:
        async with BusPool() as pool:
            model = await set_id(pool, wire.address, 57_600, 1, 5, 57_600)
    assert model.name == "XL330-M288"
    servos.power_cycle(0.0)
    assert [servo.number for servo in servos.ordered] == [5, 7]
    assert servos.ordered[0].get(table.TORQUE) == 0


class OnlyAtItsRate(DynamixelEmulator):
    """A servo that understands the line at its own rate alone, as a real one does."""

    def feed(self, data: bytes, now: float) -> list[bytes]:
        own = table.BAUD_RATES[self.ordered[0].get(table.BAUD_RATE)]
        return super().feed(data, now) if own == self.baudrate else []

    def _show_rate(self) -> None:
        pass


@pytest.fixture
async def at_its_rate(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[tuple[OnlyAtItsRate, str]]:
    """Return a servo that comes from the factory, and where it is."""
    from rtee.buses.dynamixel import DynamixelBus

    servo = OnlyAtItsRate(DynamixelProperties(ids=(1,)))
    opened = DynamixelBus._open

    async def open_at_rate(self: DynamixelBus) -> None:
        await opened(self)
        servo.baudrate = self.line.baudrate  # a pty carries none

    monkeypatch.setattr(DynamixelBus, "_open", open_at_rate)
    with SimulatedLine([servo], wire_time=False) as wire:
        yield servo, wire.address


async def test_a_servo_from_the_factory_gets_the_rate_of_its_hand(
    at_its_rate: tuple[OnlyAtItsRate, str],
) -> None:
    servo, address = at_its_rate
    async with BusPool() as pool:
        await set_id(pool, address, 57_600, 1, 3, 4_000_000)
        made: EmulatedDynamixel = servo.ordered[0]
        assert (made.number, made.get(table.BAUD_RATE)) == (3, 6)
        with pytest.raises(NotConnected, match="no servo 3 answers"):
            await set_id(pool, address, 57_600, 3, 4)
        await set_id(pool, address, 4_000_000, 3, 3, 1_000_000)
        assert (made.number, made.get(table.BAUD_RATE)) == (3, 3)


async def test_what_cannot_be_done_is_told_and_changes_nothing() -> None:
    servos = line(1, 2)
    with SimulatedLine([servos], wire_time=False) as wire:
        async with BusPool() as pool:
            with pytest.raises(ConfigError, match="a servo 2 is already"):
                await set_id(pool, wire.address, 57_600, 1, 2)
            with pytest.raises(NotConnected, match="no servo 9 answers"):
                await set_id(pool, wire.address, 57_600, 9, 3)
    assert [servo.number for servo in servos.ordered] == [1, 2]


def test_the_one_servo_on_a_line_gets_its_id_by_the_command() -> None:
    servos = line(1)
    with SimulatedLine([servos], wire_time=False) as wire:
        assert set_id_command("4", "--port", wire.address) == "XL330-M288: 1 is now 4\n"
        said = set_id_command(
            "5", "--port", wire.address, "--from", "4", "--new-baudrate", "4000000"
        )
        assert said == "XL330-M288: 4 is now 5, at 4000000 baud\n"
        assert "has the id 5 already" in set_id_command("5", "--port", wire.address, status=2)
        said = set_id_command("253", "--port", wire.address, status=2)
        assert "the id of a dynamixel servo must be at most 252" in said
        only = ("--port", wire.address, "--family", "feetech")
        assert "there is no servo" in set_id_command("6", *only, status=2)
    assert servos.ordered[0].number == 5
    assert servos.ordered[0].get(table.BAUD_RATE) == 6
