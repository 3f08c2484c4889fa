"""The touch board's driver against its emulator: readings, silence, errors, other boards."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import Any

import anyio
import numpy as np
import pytest

from rtee import monotonic
from rtee.buses.pool import BusPool
from rtee.drivers.orca_touch import driver as module
from rtee.drivers.orca_touch.driver import OrcaTouchDriver
from rtee.drivers.orca_touch.emulator import OrcaTouchEmulator, OrcaTouchProperties
from rtee.errors import BusTimeout, ConfigError, HandshakeError
from rtee.sample import ActuatorState
from rtee.testing import actuator
from rtee.types import DeviceSpec

pytestmark = pytest.mark.anyio

SPEC = DeviceSpec("board", "orca", "orca_touch", (), rate=200.0, emulated=True)


@asynccontextmanager
async def connected(**options: Any) -> AsyncIterator[tuple[OrcaTouchDriver, OrcaTouchEmulator]]:
    async with BusPool() as pool:
        driver = OrcaTouchDriver(replace(SPEC, options=options), pool)
        await driver.configure()
        emulator = pool.played(SPEC.owner)
        assert isinstance(emulator, OrcaTouchEmulator)
        yield driver, emulator
        await driver.close()


async def sensed(
    driver: OrcaTouchDriver, wanted: Callable[[ActuatorState], bool], within: float = 10.0
) -> ActuatorState:
    """Sense until a state is as wanted."""
    with anyio.fail_after(within):
        while True:
            state = await driver.sense()
            if wanted(state):
                return state
            await anyio.sleep(0.002)


def asked(board: OrcaTouchEmulator, text: str) -> bytes:
    return b"".join(board.feed(bytes.fromhex(text), 0.0))


def test_the_encoders_send_without_being_asked_to() -> None:
    board = OrcaTouchEmulator(OrcaTouchProperties(encoders=True))
    [frame] = board.step(1.0)
    assert frame == bytes.fromhex("AA A9 00 23 00 00" + "00" * 34 + "8A")
    assert OrcaTouchEmulator().step(1.0) == []


def test_the_resultants_can_be_read() -> None:
    board = OrcaTouchEmulator()
    press(board, "index", 2.0)
    answer = asked(board, "55 AA 00 03 00 05 A8 00 51")
    assert answer[:8] == bytes.fromhex("AA 55 00 03 00 05 A8 00")
    # Module 6 is the tip of the index finger; its z is 20 counts of 0.1 N.
    table = answer[8:-1]
    assert table[36:42] == bytes([0, 0, 0, 0, 20, 0])
    assert sum(table) == 20


def press(emulator: OrcaTouchEmulator, finger: str, force: float, taxel: int | None = None) -> None:
    """Press a finger pad straight down by `force` newtons, on one taxel or on all alike."""
    forces = np.zeros_like(emulator.forces[finger])
    at = slice(None) if taxel is None else taxel
    forces[at, 2] = force / (len(forces) if taxel is None else 1)
    emulator.forces[finger] = forces


def pressed(state: ActuatorState) -> bool:
    return state.touch is not None and bool(state.touch.values.any())


async def test_taxels_and_resultants_in_newtons() -> None:
    async with connected() as (driver, emulator):
        sensors = driver.capabilities.touch
        assert [(s.name, s.taxels, s.unit) for s in sensors] == [
            ("thumb", 51, "N"),
            ("index", 87, "N"),
            ("middle", 87, "N"),
            ("ring", 87, "N"),
            ("pinky", 51, "N"),
        ]
        emulator.forces["index"][3] = (-0.5, 0.2, 4.0)
        press(emulator, "pinky", 15.0, taxel=50)
        state = await sensed(driver, lambda s: pressed(s) and s.touch.values[-1] > 0.0)
        assert state.position.shape == (0,)
        assert state.touch is not None
        assert state.touch.values[51 + 3] == pytest.approx(4.0)
        assert state.touch.values[-1] == pytest.approx(15.0)
        assert state.touch.values.sum() == pytest.approx(19.0)
        resultants = state.extras["resultants"].reshape(5, 3)
        assert resultants[1] == pytest.approx([-0.5, 0.2, 4.0])
        assert 0.0 <= monotonic.now() - state.touch.stamp < 5.0


async def test_resultants_alone_make_one_value_of_each_tip() -> None:
    properties = {"taxels": {"thumb": 51, "ring": 87}, "encoders": True}
    async with connected(content="resultants", emulator=properties) as (driver, emulator):
        assert [(s.name, s.taxels) for s in driver.capabilities.touch] == [
            ("thumb", 1),
            ("ring", 1),
        ]
        press(emulator, "ring", 8.7)
        emulator.angles[5] = 4096
        state = await sensed(driver, pressed)
        assert state.touch is not None
        assert state.touch.values == pytest.approx([0.0, 8.7], abs=0.06)
        state = await sensed(driver, lambda s: s.extras["joint_encoders"][5] > 1.0)
        assert state.extras["joint_encoders"][5] == pytest.approx(np.pi / 2)


async def test_an_error_of_the_board_is_told_and_its_data_are_not_taken() -> None:
    async with connected() as (driver, emulator):
        await sensed(driver, lambda s: s.touch is not None)
        emulator.inject("error")
        press(emulator, "index", 5.0)
        state = await sensed(driver, lambda s: bool(s.warnings))
        assert "0x01" in state.warnings[0]
        assert not pressed(state)
        emulator.clear()
        assert (await sensed(driver, pressed)).warnings == ()


async def test_a_board_that_was_reset_is_started_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_SILENT", 0.1)
    monkeypatch.setattr(module, "_AGAIN", 0.05)
    async with connected() as (driver, emulator):
        await sensed(driver, lambda s: s.touch is not None)
        emulator.power_cycle(0.0)
        press(emulator, "thumb", 5.0)
        await sensed(driver, pressed)
        assert emulator.streaming


async def test_a_board_that_stays_silent_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_SILENT", 0.05)
    monkeypatch.setattr(module, "_WITHIN", 0.05)
    async with connected() as (driver, emulator):
        emulator.inject("silent")
        with pytest.raises(BusTimeout):
            await sensed(driver, lambda _: False)


async def test_a_board_without_fingertips_is_refused() -> None:
    with pytest.raises(HandshakeError, match="no fingertip is connected"):
        async with connected(emulator={"taxels": {}}):
            pass


def test_it_drives_no_actuators() -> None:
    spec = replace(SPEC, actuators=(actuator("index", 0.0, 1.0),))
    with pytest.raises(ConfigError, match="actuators: \\[\\]"):
        OrcaTouchDriver(spec, BusPool())
