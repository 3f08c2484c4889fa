"""The SoftHand's driver against its emulator, bytes and all."""

from __future__ import annotations

import contextlib
import time
from typing import Any

import anyio
import numpy as np
import pytest
import serial

from rtee import monotonic
from rtee.buses.pool import BusPool
from rtee.buses.simulated import SimulatedLine
from rtee.drivers.qb_softhand.codec import Command, Frame
from rtee.drivers.qb_softhand.driver import QbSoftHandDriver
from rtee.drivers.qb_softhand.emulator import QbOptions, QbSoftHandEmulator
from rtee.errors import ConfigError, DeviceFault, HandshakeError, NotConnected
from rtee.types import ActuatorSpec, DeviceSpec, JointKind, Reference
from tests.drivers.objects import obstruct
from tests.drivers.use import connecting

ONE = ("qbhand_synergy_joint",)
TWO = ("qbhand2m_synergy_joint", "qbhand2m_manipulation_joint")

pytestmark = pytest.mark.anyio


def device(
    names: tuple[str, ...] = ONE, *, name: str = "qb", emulator: dict[str, Any] | None = None,
    **options: Any,
) -> DeviceSpec:  # fmt: skip
    return DeviceSpec(
        name=name,
        hand="qbhand",
        driver="qb_softhand",
        actuators=tuple(
            ActuatorSpec(n, JointKind.REVOLUTE, -1.0, 1.0, 100.0, 20.0, 400.0, 100.0, 0.0)
            for n in names
        ),
        options={
            "port": "/dev/qb",
            "motors": len(names),
            "deadline": 0.3,
            "emulator": {"speed": 500_000.0, **(emulator or {})},
            **options,
        },
        emulated=True,
    )


connected = connecting(QbSoftHandDriver)


def hand(pool: BusPool, name: str = "qb") -> QbSoftHandEmulator:
    found = pool.played(f"qbhand/{name}")
    assert isinstance(found, QbSoftHandEmulator)
    return found


async def settle(made: QbSoftHandDriver, goal: list[float]) -> np.ndarray:
    end = monotonic.now() + 5.0
    while True:
        state = await made.sense()
        if np.abs(state.position - goal).max() < 3e-4 or monotonic.now() > end:
            return state.position
        await made.move(Reference.at(goal))
        await anyio.sleep(0.002)


@pytest.mark.parametrize(("names", "goal"), [(ONE, [0.5]), (TWO, [0.6, 0.3])])
@pytest.mark.parametrize("generation", ["legacy", "modern"])
async def test_moves_and_senses(names: tuple[str, ...], goal: list[float], generation: str) -> None:
    spec = device(names, emulator={"generation": generation})
    async with BusPool() as pool, connected(pool, spec) as made:
        assert made.capabilities.identity["parameters"] == "13"
        assert Command.ACTIVATE not in hand(pool).frames
        await made.activate()
        assert Command.SET_INPUTS not in hand(pool).frames
        assert await settle(made, goal) == pytest.approx(goal, abs=1e-3)
        await made.sense()
        spent = []
        for _ in range(5):  # on a busy computer a frame may be repeated
            before = sum(hand(pool).frames.values())
            await made.sense()
            await made.move(Reference.at(goal))
            await made.sense()
            spent.append(sum(hand(pool).frames.values()) - before)
        assert min(spent) == (3 if len(names) == 1 else 5)


async def test_attaches_to_an_active_hand_without_a_word_of_motion() -> None:
    async with BusPool() as pool:
        async with connected(pool, device()) as first:
            await first.activate()
            await settle(first, [0.4])
        before = dict(hand(pool).frames)
        async with connected(pool, device()) as second:
            await second.activate()
            assert (await second.sense()).position == pytest.approx([0.4], abs=1e-3)
        for command in (Command.SET_INPUTS, Command.ACTIVATE):
            assert hand(pool).frames.get(command, 0) == before.get(command, 0)


async def test_the_limit_the_hand_tells_is_its_scale() -> None:
    spec = device(emulator={"limit": 16_000})
    async with BusPool() as pool, connected(pool, spec) as made:
        await made.activate()
        await settle(made, [0.5])
        assert hand(pool).axes[0].position == pytest.approx(8_000, abs=10)


async def test_an_object_shows_in_current_and_effort() -> None:
    async with BusPool() as pool, connected(pool, device()) as made:
        await made.activate()
        obstruct(hand(pool).axes[0], 0.4 * hand(pool).options.limit, 3.0)
        end = monotonic.now() + 5.0
        state = await made.sense()
        while state.current[0] < 1.495 and monotonic.now() < end:
            await made.move(Reference.at([0.9]))
            await anyio.sleep(0.002)
            state = await made.sense()
        assert state.position[0] == pytest.approx(0.4 + 500 / 19_000, abs=0.01)
        assert state.current[0] == pytest.approx(1.5, abs=0.01)
        assert state.effort[0] == pytest.approx(100.0, rel=0.01)


async def test_masked_actuators_keep_their_reference() -> None:
    async with BusPool() as pool, connected(pool, device(TWO)) as made:
        await made.activate()
        await settle(made, [0.5, 0.2])
        await made.move(Reference.at([0.9, 0.0], mask=[False, True]))
        assert made._closure == pytest.approx((0.5, 0.0))


async def test_stop_holds_and_release_deactivates() -> None:
    spec = device(emulator={"speed": 5_000.0})
    async with BusPool() as pool, connected(pool, spec) as made:
        await made.activate()
        await made.move(Reference.at([1.0]))
        await anyio.sleep(0.1)
        await made.stop()
        where = (await made.sense()).position[0]
        await anyio.sleep(0.05)
        assert 0.0 < where < 0.5
        assert (await made.sense()).position[0] == pytest.approx(where, abs=0.01)
        await made.disable()
        for _ in range(100):
            if not hand(pool).active:
                break
            await anyio.sleep(0.005)
        assert not hand(pool).active


async def test_lost_activation_is_a_fault_that_recovers_where_it_stands() -> None:
    spec = device(status_every=1)
    async with BusPool() as pool, connected(pool, spec) as made:
        await made.activate()
        where = await settle(made, [0.3])
        hand(pool).inject("low_supply")
        with pytest.raises(DeviceFault, match="motors inactive"):
            await made.sense()
        with pytest.raises(DeviceFault, match="supply"):
            await made.recover()
        hand(pool).clear()
        await made.recover()
        assert (await made.sense()).position == pytest.approx(where, abs=1e-3)


async def test_the_watchdog_of_firmware_that_has_one_is_armed() -> None:
    spec = device(watchdog=0.1, emulator={"watchdog": True})
    async with BusPool() as pool, connected(pool, spec) as made:
        await made.activate()
        assert made.capabilities.watchdog
        assert hand(pool).watchdog == pytest.approx(0.1)
        await anyio.sleep(0.25)
        with pytest.raises(DeviceFault):
            await made._check()


async def test_two_hands_share_a_line() -> None:
    specs = [device(name="left"), device(name="right", device=2)]
    async with BusPool() as pool, contextlib.AsyncExitStack() as stack:
        drivers = [await stack.enter_async_context(connected(pool, spec)) for spec in specs]
        assert len(pool.buses) == 1
        for made, goal in zip(drivers, (0.2, 0.7), strict=True):
            await made.activate()
            await settle(made, [goal])
        assert hand(pool, "left").axes[0].position == pytest.approx(0.2 * 19_000, abs=20)
        assert hand(pool, "right").axes[0].position == pytest.approx(0.7 * 19_000, abs=20)


async def test_another_number_is_named() -> None:
    spec = device(emulator={"device": 7})
    async with BusPool() as pool:
        with pytest.raises(HandshakeError, match=r"number 7; set 'device: 7'"):
            async with connected(pool, spec):
                pass


async def test_a_hand_that_was_late_is_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    answers, asked = QbSoftHandEmulator.answers, list[int]()

    def late(emulator: QbSoftHandEmulator, frame: Frame, now: float) -> list[bytes]:
        asked.append(frame.command)
        # Until every hand is asked who it is, which is done only after this one was silent.
        return list(answers(emulator, frame, now)) if Command.PING in asked else []

    monkeypatch.setattr(QbSoftHandEmulator, "answers", late)
    async with BusPool() as pool, connected(pool, device()) as made:
        assert made.capabilities.identity["number"] == "1"
    assert asked[0] == Command.GET_ACTIVATE


async def test_another_number_of_motors_is_named() -> None:
    spec = device(emulator={"motors": 2})
    async with BusPool() as pool:
        with pytest.raises(HandshakeError, match="motors: 2"):
            async with connected(pool, spec):
                pass


@pytest.mark.parametrize(
    ("properties", "sentence"),
    [
        ({"control_mode": 1}, r"one with control mode 1 \(PWM\); set both modes to 0"),
        ({"control_mode": 2}, r"control mode 2 \(current\)"),
        ({"input_mode": 3}, r"input mode 3 \(EMG\)"),
    ],
)
async def test_a_hand_that_takes_no_positions_is_named(
    properties: dict[str, int], sentence: str
) -> None:
    async with BusPool() as pool:
        with pytest.raises(HandshakeError, match=sentence):
            async with connected(pool, device(emulator=properties)):
                pass


async def test_a_hand_that_also_limits_its_current_is_driven() -> None:
    async with BusPool() as pool, connected(pool, device(emulator={"control_mode": 3})) as made:
        await made.activate()


async def test_silence_is_named() -> None:
    async with BusPool() as pool:
        with pytest.raises(NotConnected, match="no SoftHand answers"):
            async with connected(pool, device(emulator={"boot_time": 1e5})):
                pass


def test_the_number_of_actuators_is_checked() -> None:
    with pytest.raises(ConfigError, match="1 motor"):
        QbSoftHandDriver(device(TWO, motors=1), BusPool())


def test_a_client_that_knows_only_the_sheet_drives_the_emulator() -> None:
    """Raw bytes over a real terminal, read until silence as the older libraries do."""
    emulated = QbSoftHandEmulator(QbOptions(speed=1e6))
    with SimulatedLine([emulated], name="qb") as line, serial.Serial(line.address) as port:

        def ask(text: str, count: int) -> bytes:
            port.reset_input_buffer()
            port.write(bytes.fromhex(text))
            # A single byte is asked for where silence is expected.
            port.timeout = 0.05 if count == 1 else 2.0
            return port.read(count)

        assert ask("3A3A01020000", 6) == bytes.fromhex("3A3A01020000")
        assert ask("3A3A0103800383", 1) == b""
        assert ask("3A3A01028181", 7) == bytes.fromhex("3A3A0103810382")
        assert ask("3A3A010682251C0000BB", 1) == b""
        assert ask("3A3A01028383", 10) == bytes.fromhex("3A3A010683251C0000BA")
        time.sleep(0.3)
        assert ask("3A3A01028484", 12) == bytes.fromhex("3A3A010884251C00000000BD")
        assert ask("3A3A00028484", 12) == bytes.fromhex("3A3A010884251C00000000BD")
        assert ask("3A3A02028484", 1) == b""
        assert ask("3A3A01028485", 1) == b""
        assert b"SoftHand" in ask("3F0D0A", 30)
        assert ask("3A3A0103800080", 1) == b""
        assert ask("3A3A01028181", 7) == Frame(1, 129, b"\x00").to_bytes()


def answers(hand: QbSoftHandEmulator, text: str, now: float = 0.0) -> str:
    return b"".join(hand.feed(bytes.fromhex(text), now)).hex(" ").upper()


def test_the_vendors_library_takes_the_mask_as_it_is_answered() -> None:
    """Its API 7 knows 00 and 03 alone; some firmware with one motor answers 01."""
    hand = QbSoftHandEmulator()
    assert answers(hand, "3A3A01028181") == "3A 3A 01 03 81 03 82", "active from the factory"
    answers(hand, "3A3A0103800080")
    assert answers(hand, "3A3A01028181") == "3A 3A 01 03 81 00 81"
    answers(hand, "3A3A0103800383")
    assert answers(hand, "3A3A01028181") == "3A 3A 01 03 81 03 82"
    old = QbSoftHandEmulator(QbOptions(activation_mask=True, startup_active=False))
    assert answers(old, "3A3A01028181") == "3A 3A 01 03 81 00 81"
    answers(old, "3A3A0103800383")
    assert answers(old, "3A3A01028181") == "3A 3A 01 03 81 01 80"
    two = QbSoftHandEmulator(QbOptions(motors=2))
    answers(two, "3A3A0103800181")
    assert answers(two, "3A3A01028181") == "3A 3A 01 03 81 01 80"


def test_a_hand_holds_where_it_stands_from_power_up_as_from_the_factory() -> None:
    hand = QbSoftHandEmulator()
    hand.axes[0].position = 4000.0
    hand.power_cycle(0.0)
    hand.step(0.5)
    assert answers(hand, "3A3A01028383", 0.6) == "3A 3A 01 06 83 0F A0 00 00 2C"
    assert hand.axes[0].position == 4000.0


def test_accelerations_are_answered() -> None:
    hand = QbSoftHandEmulator(QbOptions(speed=1000.0))
    assert answers(hand, "3A3A01028B8B") == "3A 3A 01 08 8B 00 00 00 00 00 00 8B"
    answers(hand, "3A3A010682251C0000BB", 0.1)
    told = bytes.fromhex(answers(hand, "3A3A01028B8B", 0.2))
    assert int.from_bytes(told[5:7], "big", signed=True) == 10_000, "1000 ticks/s after 0.1 s"
    two = QbSoftHandEmulator(QbOptions(motors=2))
    assert answers(two, "3A3A01028B8B") == "3A 3A 01 0A 8B 00 00 00 00 00 00 00 00 8B"
