"""Forces in newtons as they go over emulated wires: the registers of each device's sheet."""

from __future__ import annotations

import math
import struct
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any

import anyio
import pytest

from rtee.buses.pool import BusPool
from rtee.drivers.onrobot_3fg.codec import Fingers
from rtee.drivers.registry import find_driver
from rtee.drivers.schunk_svh.channels import CHANNELS
from rtee.errors import GoalRejected
from rtee.loop.clock import Clock
from rtee.loop.handloop import HandLoop, drive
from rtee.running.prepare import RunOptions, prepare
from rtee.types import Around, Force, Goal, Named, Result

pytestmark = pytest.mark.anyio
RATE = 200.0


class Wires:
    """A hand whose frames are kept as they go out."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []
        self.loop: HandLoop

    def trace(self, bus: str, direction: str, data: bytes, stamp: float) -> None:
        if direction == "tx":
            self.sent.append(bytes(data))

    async def grasp(self, width: float, force: float, action: str = "", *e: str) -> Result:
        self.sent.clear()
        goal = Goal(Named(action, e), Around(width), effort=Force(force))
        with anyio.fail_after(30.0):
            return await self.loop.execute(goal)


@asynccontextmanager
async def on_wires(name: str, **options: Any) -> AsyncIterator[Wires]:
    wires = Wires()
    async with BusPool(wire_time=False, trace=wires.trace) as pool, AsyncExitStack() as stack:
        ready = prepare(name, RunOptions(emulated=True, ideal=True, rate=RATE, **options))
        devices = [(d, find_driver(d.spec.driver)(d.spec, pool)) for d in ready.devices]
        loop = HandLoop(ready.hand, ready.library, ready.settings, devices)
        wires.loop = await stack.enter_async_context(loop)
        await loop.ready()
        async with anyio.create_task_group() as running:
            running.start_soon(drive, [loop], Clock(RATE))
            with anyio.fail_after(30.0):
                while not all(device.active for device in loop.devices.values()):  # noqa: ASYNC110
                    await anyio.sleep(0.005)
            yield wires
            running.cancel_scope.cancel()


@pytest.mark.samples("robotiq_2f_85-*", "robotiq_hand_e-*-64.0-*")
@pytest.mark.parametrize(
    ("name", "width", "force", "register"),
    [
        ("robotiq_2f_85", 0.04, 20.0, 0),
        ("robotiq_2f_85", 0.04, 60.0, 47),
        ("robotiq_2f_85", 0.04, 200.0, 213),
        # A Hand-E has 20 to 130 N.
        ("robotiq_hand_e", 0.03, 20.0, 0),
        ("robotiq_hand_e", 0.03, 64.0, 102),
        ("robotiq_hand_e", 0.03, 130.0, 255),
    ],
)
async def test_a_two_finger_gripper_gets_the_force_register_of_its_manual(
    name: str, width: float, force: float, register: int
) -> None:
    async with on_wires(name, object_in_hand="0.4") as wires:
        result = await wires.grasp(width, force, "Grasp")
        assert result.grasped
        assert result.force == pytest.approx(force)
        assert result.force_source == "effort limit"
        # Of the output block the fifth byte is the speed, the sixth the force.
        closing = [frame[-4:-2] for frame in wires.sent if len(frame) > 12]
        assert {pair[1] for pair in closing} == {register}


async def test_a_three_finger_gripper_gets_the_force_register_of_its_manual() -> None:
    async with on_wires("robotiq_3f") as wires:
        await wires.grasp(0.05, 24.0, "Grasp")
        # 15 to 60 N over 255 counts; the force of all fingers is the sixth of the 16 bytes.
        blocks = [frame[-18:-2] for frame in wires.sent if len(frame) > 20]
        assert {block[5] for block in blocks} == {51}
        with pytest.raises(GoalRejected, match=r"at least 15 N .* the nearest is 15 N"):
            await wires.grasp(0.05, 5.0, "Grasp")


async def test_the_3fg_gets_a_share_of_what_it_gives_at_the_diameter() -> None:
    async with on_wires("onrobot_3fg15", object_in_hand="0.5") as wires:
        with pytest.raises(GoalRejected, match="the nearest is"):
            await wires.grasp(0.08, 500.0, "Grasp")
        await wires.grasp(0.08, 40.0, "Grasp")
        library = wires.loop.library
        opening = library.openings.of(library.find("Grasp"))
        closed = opening.intensity_at(0.08)
    # The gripper's position is linear in the diameter, from 150 to 34.6 mm.
    gives = 240.0 * Fingers().leverage(0.150 - closed * (0.150 - 0.0346))
    grips = [
        struct.unpack(">4H", frame[at : at + 8])
        for frame in wires.sent
        for at in (len(frame) - 10, len(frame) - 8)
        if at > 0
    ]
    [found] = {force for force, diameter, kind, control in grips if (kind, control) == (0, 1)}
    assert found == pytest.approx(1000.0 * 40.0 / gives, rel=0.05)


@pytest.mark.parametrize(
    ("name", "width", "force", "most"),
    [("onrobot_rg2", 0.03, 12.5, 40.0), ("onrobot_rg6", 0.05, 90.0, 120.0)],
)
async def test_an_rg_gets_the_width_and_the_force_that_were_asked_for(
    name: str, width: float, force: float, most: float
) -> None:
    async with on_wires(name, object_in_hand=f"{width}m") as wires:
        with pytest.raises(GoalRejected, match=f"at most {most:.0f} N"):
            await wires.grasp(width, most + 1.0, "Grasp")
        result = await wires.grasp(width, force, "Grasp")
        assert result.grasped
        assert result.opening == pytest.approx(width, abs=0.001)
        assert result.force == pytest.approx(force, rel=0.01)
    commands = [
        struct.unpack(">3H", frame[-6:]) for frame in wires.sent if frame[-8:-6] == b"\x03\x06"
    ]
    assert {command[0] for command in commands if command[2] == 1} >= {round(10 * force)}
    # The last goes on to where the fingertips meet: the force ends the way, not the width.
    assert commands[-1][1] * 1e-4 < width + 2 * 0.0049


@pytest.mark.parametrize("force", [5.0, 33.0, 80.0])
async def test_a_wsg_grasps_with_the_force_limit_that_was_asked_for(force: float) -> None:
    async with on_wires("wsg50", object_in_hand="0.04m") as wires:
        with pytest.raises(GoalRejected, match="at least 5 N"):
            await wires.grasp(0.04, 4.0, "Grasp")
        result = await wires.grasp(0.04, force, "Grasp")
        assert result.grasped
        assert result.force == pytest.approx(force, rel=0.01)
        assert result.force_source == "device"
    limits = [frame for frame in wires.sent if frame[3:4] == b"\x32"]
    assert {frame[6:10] for frame in limits} >= {struct.pack("<f", force)}
    assert any(frame[3:4] == b"\x25" for frame in wires.sent)


@pytest.mark.samples("60.0-40")
@pytest.mark.parametrize(("force", "percent"), [(15.0, 10), (60.0, 40), (150.0, 100)])
async def test_an_egu_grips_with_the_percentage_that_gives_the_force(
    force: float, percent: int
) -> None:
    async with on_wires("schunk_egu", object_in_hand="0.04m") as wires:
        with pytest.raises(GoalRejected, match="at most 150 N"):
            await wires.grasp(0.04, 151.0, "Grasp")
        result = await wires.grasp(0.04, force, "Grasp")
        assert result.grasped
        assert result.force == pytest.approx(force, rel=0.02)
        assert result.opening == pytest.approx(0.04, abs=0.003)
    # The last four bytes of the image are the percentage; bit 12 of its first four is the grip.
    images = [frame[-18:-2] for frame in wires.sent if len(frame) == 25]
    grips = {struct.unpack("<I", image[12:])[0] for image in images if image[1] & 0x10}
    assert grips == {percent}


def test_the_3fg_gives_more_force_at_lower_angles_of_its_fingers() -> None:
    fingers = Fingers()
    low = fingers.raw_diameter(math.radians(30.0))
    shares = [fingers.leverage(diameter) for diameter in (0.04, 0.06, 0.10, 0.14, low)]
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)


@pytest.mark.heavy
async def test_the_svh_gets_the_currents_that_give_the_force() -> None:
    async with on_wires("schunk_svh", home=True) as wires:
        await wires.grasp(0.03, 2.0, "PinchTight", "index", "thumb")
        hand = wires.loop.hand
        limits = wires.loop.controller.reference_effort
        name = "left_hand_Index_Finger_Proximal"
        channel = next(c for c in CHANNELS if name.endswith(c.name))
        current = channel.to_current(limits[hand.actuator_index(name)])
        assert 0.0 < current < 350.0
        # The limits of a current controller stand after ``wmn`` in the settings of its channel.
        wanted = struct.pack("<ff", -current, current)
        assert any(wanted in frame for frame in wires.sent)


async def test_a_force_that_a_device_cannot_limit_is_refused() -> None:
    async with on_wires("qb_softhand") as wires:
        with pytest.raises(GoalRejected, match=r"takes no effort limit.* the nearest is the same"):
            await wires.grasp(0.05, 10.0, "Grasp")
