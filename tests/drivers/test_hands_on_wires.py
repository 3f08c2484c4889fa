"""Whole hands with real drivers on emulated wires: cables that are pulled, runs that end."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import replace
from typing import Any

import anyio
import anyio.to_thread
import numpy as np
import pytest

from rtee.buses.faults import Faults
from rtee.buses.pool import BusPool
from rtee.buses.simulated import Simulation
from rtee.drivers.objects import ObjectInHand
from rtee.drivers.qb_softhand.codec import Command as QbCommand
from rtee.drivers.registry import find_driver
from rtee.drivers.robotiq_2f.codec import Command
from rtee.errors import BusTimeout, GoalRejected
from rtee.hand.config_schema import Behaviour
from rtee.loop import supervisor
from rtee.loop.clock import Clock
from rtee.loop.handloop import HandLoop, bring_to_rest, drive
from rtee.loop.observer import Observer
from rtee.loop.supervisor import Supervisor
from rtee.running.prepare import RunOptions, prepare
from rtee.sample import TickRecord
from rtee.testing.session import open_files
from rtee.types import Event, Goal, Lifecycle, Named, Reference, Result

pytestmark = pytest.mark.anyio
RATE = 200.0
SET_INPUTS = QbCommand.SET_INPUTS


class Wired(Observer):
    """A hand and what plays its device."""

    def __init__(self, loop: HandLoop, pool: BusPool) -> None:
        self.loop = loop
        self.device: Supervisor = next(iter(loop.devices.values()))
        self.results: list[Result] = []
        self.events: list[Event] = []
        self._pool = pool
        loop.add_observer(self)

    @property
    def emulator(self) -> Any:
        return self._pool.played(self.device.spec.owner)

    @property
    def wire(self) -> Simulation:
        return self._pool.simulation(self.device.spec.owner)

    @property
    def position(self) -> float:
        return float(self.loop.snapshot().position[0])

    def on_result(self, result: Result) -> None:
        self.results.append(result)

    def on_event(self, event: Event) -> None:
        self.events.append(event)

    async def result(self) -> Result:
        await until(lambda: bool(self.results))
        return self.results.pop(0)


async def until(true: Callable[[], bool], within: float = 30.0) -> None:
    with anyio.fail_after(within):
        while not true():  # noqa: ASYNC110 - what is waited for has no event
            await anyio.sleep(0.005)


@asynccontextmanager
async def on_wires(
    *names: str, reconnect_active: bool = False, **options: Any
) -> AsyncIterator[list[Wired]]:
    """Run hands on one clock, active; options are those of all of them."""
    async with BusPool() as pool, AsyncExitStack() as stack:
        found = []
        for name in names:
            ready = prepare(name, RunOptions(emulated=True, ideal=True, rate=RATE, **options))
            devices = [
                (
                    replace(d, reconnect_active=reconnect_active),
                    find_driver(d.spec.driver)(d.spec, pool),
                )
                for d in ready.devices
            ]
            loop = HandLoop(ready.hand, ready.library, ready.settings, devices)
            await stack.enter_async_context(loop)
            await loop.ready()
            found.append(Wired(loop, pool))
        async with anyio.create_task_group() as running:
            running.start_soon(drive, [one.loop for one in found], Clock(RATE))
            await until(
                lambda: all(one.device.connection.states > 2 and one.device.active for one in found)
            )
            yield found
            running.cancel_scope.cancel()
        # Links that freeze, break and come back, fingers that slip: nothing of it is a lie.
        assert not [e.text for one in found for e in one.events if e.kind == "implausible"]


async def test_a_cable_pulled_in_the_middle_of_an_action_concerns_its_hand_alone() -> None:
    async with on_wires("robotiq_2f_85", "onrobot_3fg15") as (gripper, other):
        start = gripper.position
        gripper.loop.submit(Goal(Named("PinchTight", ("finger_1", "finger_2")), speed=0.4))
        other.loop.submit(Goal(Named("PinchTight", ("finger_1", "finger_2"))))
        await until(lambda: gripper.position > start + 0.1)
        gripper.wire.unplug()
        broken = await gripper.result()
        assert (broken.aborted, broken.reached) == (True, False)
        assert "device 'gripper': it is lost" in broken.reason
        assert not other.results, "it went on meanwhile"
        assert (await other.result()).reached
        [status] = other.loop.statuses()
        assert (status.lifecycle, status.errors) == (Lifecycle.ACTIVE, 0)

        moves, at = gripper.emulator.moves, gripper.emulator.axis.target
        gripper.wire.replug()
        await until(lambda: gripper.device.lifecycle is Lifecycle.INACTIVE)
        assert gripper.loop.statuses()[0].reconnects == 1
        await gripper.loop.recover()
        await until(lambda: gripper.device.active)
        here = gripper.emulator.axis.position
        exchanges = gripper.loop.statuses()[0].exchanges
        await until(lambda: gripper.loop.statuses()[0].exchanges > exchanges + 20)
        assert gripper.emulator.moves == moves, "not a word of motion after it came back"
        assert gripper.emulator.axis.target == at
        assert gripper.emulator.axis.position == pytest.approx(here, abs=1.0)
        gripper.loop.submit(Goal(Named("open")))
        assert (await gripper.result()).reached


async def test_emulated_hands_that_name_the_same_port_do_not_meet() -> None:
    async with on_wires("robotiq_2f_85", "qb_softhand", "robotiq_2f_140") as hands:
        ports = [one.device.spec.options["port"] for one in hands]
        assert ports == ["/dev/ttyUSB0"] * 3
        assert len({one.wire for one in hands}) == 3
        hands[0].loop.submit(Goal(Named("Grasp")))
        assert (await hands[0].result()).reached
        assert hands[2].emulator.moves == 0


async def test_a_hundred_cables_pulled_leave_no_task_and_no_file(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(supervisor, "BACKOFF", (0.005, 0.01))
    async with on_wires("robotiq_2f_85") as (gripper,):
        files, tasks, moves = open_files(), len(asyncio.all_tasks()), gripper.emulator.moves
        for _ in range(100):
            gripper.wire.unplug()
            await until(lambda: gripper.device.lifecycle is Lifecycle.UNCONFIGURED)
            gripper.wire.replug()
            await until(lambda: gripper.device.lifecycle is Lifecycle.INACTIVE)
            await gripper.loop.recover()
        assert gripper.loop.statuses()[0].reconnects == 100
        assert gripper.emulator.moves == moves
        assert len(asyncio.all_tasks()) == tasks
        assert open_files() == files


@pytest.mark.parametrize("behaviour", list(Behaviour))
async def test_the_last_frame_is_the_configured_one(behaviour: Behaviour) -> None:
    async with on_wires("robotiq_2f_85") as (gripper,):
        start = gripper.position
        gripper.loop.submit(Goal(Named("PinchTight", ("finger_1", "finger_2")), speed=0.5))
        await until(lambda: gripper.position > start + 0.1)
        assert await bring_to_rest(gripper.loop, behaviour, "the end") == [("gripper", True)]
        last = Command.from_registers(gripper.emulator.output)
        position = gripper.emulator.axis.position
    match behaviour:
        case Behaviour.HOLD:
            assert last.go
            # A byte of position is 0.4 % of the way; meanwhile it moved on a little.
            assert abs(last.position - position) < 30
        case Behaviour.STOP | Behaviour.DISABLE:
            assert (last.activate, last.go) == (True, False)
        case Behaviour.OPEN:
            assert last.go
            assert abs(last.position - position) <= 2
            assert position < 3 + 0.02 * 227, "at rest, within the tolerance of a goal"


async def test_a_grip_survives_the_end_of_the_run_and_the_next_one_drops_nothing() -> None:
    async with on_wires("robotiq_2f_85", object_in_hand="50mm") as (gripper,):
        gripper.loop.submit(Goal(Named("PinchTight", ("finger_1", "finger_2"))))
        assert (await gripper.result()).grasped
        await bring_to_rest(gripper.loop, Behaviour.HOLD, "the end")
        moves, effort = gripper.emulator.moves, gripper.emulator.axis.effort
        assert effort > 20.0
        gripper.wire.unplug()
        await until(lambda: gripper.device.lifecycle is Lifecycle.UNCONFIGURED)
        gripper.wire.replug()
        await until(lambda: gripper.device.lifecycle is Lifecycle.INACTIVE)
        gripper.device.muted = False
        await gripper.loop.recover()
        exchanges = gripper.loop.statuses()[0].exchanges
        await until(lambda: gripper.loop.statuses()[0].exchanges > exchanges + 20)
        assert gripper.emulator.moves == moves
        assert gripper.emulator.axis.effort == pytest.approx(effort, rel=0.01)


async def test_a_hand_told_by_positions_alone_keeps_its_grip_too() -> None:
    # Clearly before its fingers meet each other.
    async with on_wires("qb_softhand", object_in_hand="0.4") as (hand,):
        hand.loop.submit(Goal(Named("Grasp")))
        assert (await hand.result()).grasped
        hand.wire.unplug()
        await until(lambda: hand.device.lifecycle is Lifecycle.UNCONFIGURED)
        hand.wire.replug()
        await until(lambda: hand.device.lifecycle is Lifecycle.INACTIVE)
        axis, frames = hand.emulator.axes[0], dict(hand.emulator.frames)
        effort = axis.effort
        assert effort > 200.0
        await hand.loop.recover()
        exchanges = hand.loop.statuses()[0].exchanges
        await until(lambda: hand.loop.statuses()[0].exchanges > exchanges + 20)
        assert hand.emulator.frames[SET_INPUTS] == frames[SET_INPUTS]
        assert axis.effort == effort
        hand.loop.submit(Goal(Named("open")))
        assert (await hand.result()).reached


@pytest.mark.parametrize(("name", "kept"), [("wsg50", True), ("allegro", False)])
async def test_a_grip_when_a_device_that_took_no_reference_comes_back_active(
    name: str, kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its reference starts where it is measured, which only an Allegro Hand follows at once."""
    async with on_wires(name, object_in_hand="0.4", home=True, reconnect_active=True) as (hand,):
        hand.loop.submit(Goal(Named("Grasp")))
        assert (await hand.result()).stalled

        def grip() -> float:
            return float(np.nanmax(np.abs(hand.loop.snapshot().effort)))

        before = grip()
        assert before > 0.1

        async def refused(_: Reference) -> None:
            raise BusTimeout(name, "noise")

        with monkeypatch.context() as deaf:
            deaf.setattr(hand.device.connection._driver, "move", refused)
            await until(lambda: not hand.device.active)
        await until(lambda: hand.device.active)
        exchanges = hand.loop.statuses()[0].exchanges
        await until(lambda: hand.loop.statuses()[0].exchanges > exchanges + 50)
        now = hand.loop.snapshot()
        assert now.reference_position == pytest.approx(now.position, abs=1e-3)
        assert grip() == (pytest.approx(before) if kept else pytest.approx(0.0, abs=0.05))


async def test_an_object_taken_away_is_told() -> None:
    async with on_wires("robotiq_2f_85", object_in_hand="50mm") as (gripper,):
        gripper.loop.submit(Goal(Named("PinchTight", ("finger_1", "finger_2"))))
        assert (await gripper.result()).grasped
        gripper.wire.call(gripper.emulator.remove_object)
        await until(lambda: "grasp_lost" in [event.kind for event in gripper.events])
        gripper.loop.submit(Goal(Named("open")))
        assert (await gripper.result()).reached
        gripper.wire.call(lambda: gripper.emulator.place_object(ObjectInHand.parse("40mm")))
        gripper.loop.submit(Goal(Named("PinchTight", ("finger_1", "finger_2"))))
        assert (await gripper.result()).grasped


@pytest.mark.parametrize("lost", [True, False], ids=["lost", "late"])
async def test_opening_over_a_link_that_freezes_is_no_grasp(lost: bool) -> None:
    """Frozen while the set-point passes the object: the last word is about a closing target."""
    async with on_wires("robotiq_2f_85", object_in_hand="50mm") as (gripper,):
        for early in (0.02, 0.06, 0.1):
            gripper.loop.submit(Goal(Named("PinchTight", ("finger_1", "finger_2"))))
            assert (await gripper.result()).grasped
            held = gripper.position
            gripper.loop.submit(Goal(Named("open")))
            reference = gripper.loop.controller.reference_position
            await until(lambda at=held + early, now=reference: now[0] < at)  # type: ignore[misc]
            gripper.wire.faults = Faults(drop=1.0) if lost else Faults(delay=1.0, delay_time=0.12)
            await anyio.sleep(0.12)
            gripper.wire.faults = Faults()
            opened = await gripper.result()
            assert (opened.reached, opened.grasped, opened.stalled) == (True, False, False)


class Words(Observer):
    def __init__(self) -> None:
        self.seen: list[int] = []

    def on_tick(self, record: TickRecord) -> None:
        word = int(record.grasped.max())
        if not self.seen or self.seen[-1] != word:
            self.seen.append(word)


@pytest.mark.samples("2f")
@pytest.mark.parametrize(
    ("name", "action"), [("robotiq_2f_85", "Grasp"), ("robotiq_3f", "Grasp")], ids=["2f", "3f"]
)
async def test_what_is_held_is_held_all_the_time(name: str, action: str) -> None:
    """Though set-points move on after the contact, and the effort is reduced later."""
    async with on_wires(name, object_in_hand="0.5") as (gripper,):
        words = Words()
        gripper.loop.add_observer(words)
        gripper.loop.submit(Goal(Named(action)))
        assert (await gripper.result()).grasped
        tick = gripper.loop.snapshot().tick
        await until(lambda: gripper.loop.snapshot().tick > tick + 2.5 * RATE)
        assert words.seen == [0, 1]
        gripper.loop.submit(Goal(Named("open")))
        assert (await gripper.result()).reached
        assert words.seen == [0, 1, 0]


@pytest.mark.parametrize("driver", ["devices", "heri_ethercat"])
async def test_heri_ii_closes_with_the_effort_of_the_goal(driver: str) -> None:
    async with on_wires("heri_ii", object_in_hand="0.2", driver=driver) as (hand,):
        names = hand.loop.hand.actuator_names
        # From elsewhere, its fingers could have met each other.
        hand.loop.submit(Goal(Named("open")))
        assert (await hand.result()).reached
        hand.loop.submit(Goal(Named("Grasp"), effort=dict.fromkeys(names, 1.2)))
        assert (await hand.result()).grasped
        assert hand.loop.snapshot().effort.max() == pytest.approx(1.2, rel=0.02)
        hand.loop.submit(Goal(Named("Grasp")))
        assert (await hand.result()).grasped
        assert hand.loop.snapshot().effort.max() > 2.0


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("dagana", "'control' is 'position'"),
        ("qb_softhand", "from a stored parameter, not from commands"),
    ],
)
async def test_a_refused_effort_limit_says_what_cannot_be_done(name: str, reason: str) -> None:
    async with on_wires(name) as (hand,):
        actuator = hand.loop.hand.actuators[0]
        effort = {actuator.name: 0.5 * min(actuator.effort, 1.0)}
        with pytest.raises(GoalRejected, match=f"takes no effort limit: .*{reason}"):
            hand.loop.submit(Goal(Named("Grasp"), effort=effort))


@pytest.mark.parametrize("name", ["heri_ii", "dagana"])
async def test_closing_on_nothing_behind_xbot2_is_no_grasp(name: str) -> None:
    """The emulated joints go as far as the hand's."""
    async with on_wires(name) as (hand,):
        hand.loop.submit(Goal(Named("Grasp")))
        result = await hand.result()
        assert (result.reached, result.stalled, result.grasped) == (True, False, False)
