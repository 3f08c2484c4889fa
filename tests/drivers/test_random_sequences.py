"""Random goals, stops, faults and reconnections: what must hold of a hand, whatever happens to it.

Each seed is a sequence of its own, on the real drivers and emulated devices in simulated time.
"""

from __future__ import annotations

import asyncio
import math
import random
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field, replace

import anyio
import anyio.abc
import numpy as np
import pytest
from msgspec import structs

from rtee import monotonic
from rtee.actions.types import Action
from rtee.buses.faults import Faults
from rtee.buses.pool import BusPool
from rtee.buses.simulated import Simulation
from rtee.buses.simulated_time import SimulatedTimeLoop
from rtee.commands import StreamTargets
from rtee.drivers.base import Driver
from rtee.drivers.registry import find_driver
from rtee.errors import BusTimeout, RteeError
from rtee.hand.config_schema import Behaviour
from rtee.loop.clock import Clock
from rtee.loop.handloop import HandLoop, bring_to_rest, drive
from rtee.loop.observer import Observer
from rtee.loop.supervisor import Supervisor
from rtee.running.prepare import RunOptions, prepare
from rtee.sample import ActuatorState, FloatArray, TickRecord
from rtee.types import (
    Around,
    Fingers,
    FirstContact,
    Force,
    Goal,
    Intensity,
    Named,
    Opening,
    Reference,
    Result,
)

pytestmark = pytest.mark.anyio

RATE = 200.0
STEPS = 25
REMEMBERED = 0.8  # [s]: a reference starts at one of 0.25 s ago, and waits 0.5 s for an answer
WRONG: dict[str, Callable[[ActuatorState, ActuatorState], ActuatorState]] = {
    "": lambda now, _: now,
    "invalid": lambda now, _: replace(now, position=np.full_like(now.position, np.nan)),
    "old": lambda _, then: replace(then, fresh=False),
    "far outside": lambda now, _: replace(now, position=np.full_like(now.position, 1e6)),
}


class Witness:
    """Calls a driver in the loop's stead, and judges what the driver is told.

    Attributes:
        how: What is wrong with the measurements; a key of `WRONG`.
        deaf: Whether references get lost, though measurements arrive.
        faults: What should not have happened.
    """

    def __init__(self, driver: Driver, device: Supervisor) -> None:
        self.how, self.deaf = "", False
        self.faults: list[str] = []
        self.device = device
        self._actuators = device.spec.actuators
        self._measured: list[tuple[float, FloatArray]] = []
        self._then: ActuatorState | None = None
        self._given: tuple[float, FloatArray] | None = None
        self._begun = -math.inf
        self._known = self._stopping = False
        self._sense, self._move, self._stop = driver.sense, driver.move, driver.stop
        self._activate, self._disable = driver.activate, driver.disable
        for name in ("sense", "move", "stop", "activate", "disable"):
            setattr(driver, name, getattr(self, name))

    async def activate(self) -> None:
        self._given, self._known = None, False
        await self._activate()

    async def disable(self) -> None:
        await self._disable()
        self._given = None  # not if it failed: then the hand is still active, and has braked

    async def sense(self) -> ActuatorState:
        self._begun = monotonic.now()
        state = await self._sense()
        if np.isfinite(state.position).all():
            now = monotonic.now()
            self._measured = [m for m in self._measured if now - m[0] < REMEMBERED]
            self._measured.append((now, state.position))
        if self._then is None or not self.how:
            self._then = state
        told = WRONG[self.how](state, self._then)
        self._known |= bool(np.isfinite(told.position).all())
        return told

    async def stop(self) -> None:
        self._stopping = True
        try:
            await self._stop()
        finally:
            self._stopping = False

    async def move(self, reference: Reference) -> None:
        now, position = monotonic.now(), reference.position
        if self._stopping:
            self.faults.append(f"{now:.3f}: a reference while the device is being stopped")
        if self.deaf:
            raise BusTimeout(self.device.name, "lost")
        if not self._known:
            self.faults.append(f"{now:.3f}: a reference before the first measurement")
        for i, actuator in enumerate(self._actuators):
            if not (self._follows(i, position[i]) or self._was_at(i, now, position[i])):
                before = None if self._given is None else self._given[1][i]
                self.faults.append(f"{now:.3f}: {actuator.name} from {before} to {position[i]}")
        self._given = self._begun, position
        await self._move(reference)

    def _follows(self, i: int, position: float) -> bool:
        """Return whether the velocity limit allows a reference after the last one."""
        if self._given is None:
            return False
        link = self.device.connection
        # Exchanges of a disturbed line begin and end some ticks earlier or later.
        passed = min(self._begun - self._given[0], link.deadline) + (link.every + 4) / RATE
        most = self._actuators[i].velocity * passed * (1 + 1e-6)
        return bool(abs(position - self._given[1][i]) <= most)

    def _was_at(self, i: int, now: float, position: float) -> bool:
        """Return whether the actuator was measured there, truly, a moment ago."""
        actuator = self._actuators[i]
        span = actuator.upper - actuator.lower
        near = 0.02 * (span if math.isfinite(span) else 1.0) + 3 * actuator.velocity / RATE
        return any(
            abs(where[i] - position) <= near
            for stamp, where in self._measured
            if now - stamp <= REMEMBERED
        )


class Notes(Observer):
    def __init__(self) -> None:
        self.results: Counter[str] = Counter()
        self.records: list[TickRecord] = []

    def on_result(self, result: Result) -> None:
        self.results[result.goal_id] += 1

    def on_tick(self, record: TickRecord) -> None:
        self.records.append(record)


@dataclass
class Play:
    """One hand, and what is done to it."""

    loop: HandLoop
    chance: random.Random
    notes: Notes
    witnesses: list[Witness]
    wires: list[Simulation]
    group: anyio.abc.TaskGroup
    actions: list[Action]
    goals: list[str] = field(default_factory=list)

    def submit(self, goal: Goal) -> None:
        self.loop.submit(goal)
        self.goals.append(goal.goal_id)

    async def goal(self) -> None:
        action = self.chance.choice(self.actions)
        what = Named(action.name, tuple(getattr(action, "elements", ())))
        to = Intensity(self.chance.choice((1.0, 0.5, 0.0)))
        speed, timeout = self.chance.choice((1.0, 0.5, 1e-3)), self.chance.choice((None, 0.05, 1.0))
        self.submit(Goal(what, to, speed=speed, timeout=timeout))

    async def open(self) -> None:
        self.submit(Goal(Named("open")))

    async def grasp(self) -> None:
        names = self.loop.hand.finger_names
        width = self.chance.uniform(0.0, 0.08)
        to = self.chance.choice((FirstContact(), Opening(width), Around(width)))
        fingers = Fingers(tuple(self.chance.sample(names, min(2, len(names)))))
        goal = Goal(fingers, to)
        if isinstance(to, Around):
            goal = replace(goal, effort=Force(self.chance.uniform(1.0, 30.0)))
        self.submit(goal)

    async def cancel(self) -> None:
        self.loop.cancel("")

    async def hold(self) -> None:
        self.loop.hold("held")

    async def jog(self) -> None:
        spec = self.chance.choice(self.loop.hand.actuators)
        velocity = self.chance.choice((None, 0.1))
        self.loop.jog({spec.name: self.chance.uniform(spec.lower, spec.upper)}, velocity)

    async def stream(self) -> None:
        specs = self.chance.sample(self.loop.hand.actuators, 1)
        name, streams = f"s{self.chance.random()}", self.loop.streams
        streams.begin(name, 50.0, 0.1)

        async def play() -> None:
            begun, phase = monotonic.now(), self.chance.random()
            for k in range(self.chance.choice((10, 50))):
                share = 0.5 + 0.5 * math.sin(0.1 * k + phase)
                where = {s.name: s.lower + share * (s.upper - s.lower) for s in specs}
                try:
                    if streams.admit():
                        streams.sample(StreamTargets(name, begun + 0.02 * k, where))
                except RteeError:
                    return
                await anyio.sleep(0.02)

        self.group.start_soon(play)

    async def two_stops(self) -> None:
        self.group.start_soon(self.loop.stop)
        await anyio.sleep(self.chance.choice((0.0, 0.004, 0.05)))
        await self.stop()

    async def stop_and_goal(self) -> None:
        self.group.start_soon(self.loop.stop)
        await anyio.sleep(self.chance.choice((0.0, 0.004, 0.01)))
        await self.goal()

    async def stop(self) -> None:
        """Stop; from then on the hand brakes, and stands still until somebody asks again."""
        controller, records = self.loop.controller, self.notes.records
        await self.loop.stop()
        begun, first = monotonic.now(), len(records) - 1
        await anyio.sleep(1.0)
        still = [record for record in records[first:] if record.stamp > begun + 0.8]
        for i, spec in enumerate(self.loop.hand.actuators):
            moved = np.ptp([record.reference_position[i] for record in still])
            if controller.active[i] and moved > 1e-9:
                self.witnesses[0].faults.append(f"{spec.name} moves on by {moved} after a stop")

    async def recover(self) -> None:
        await self.loop.recover()

    async def recover_meanwhile(self) -> None:
        async def recover() -> None:
            try:
                await self.loop.recover()
            except RteeError:
                pass

        self.group.start_soon(recover)

    async def disable(self) -> None:
        await self.loop.disable()

    async def lose_client(self) -> None:
        self.loop.client_lost("somebody")

    async def unplug(self) -> None:
        for wire in self.wires:
            if wire.plugged:
                wire.unplug()

    async def replug(self) -> None:
        for wire in self.wires:
            wire.faults = Faults()
            if not wire.plugged:
                wire.replug()

    async def disturb(self) -> None:
        faults = self.chance.choice(
            (
                Faults(drop=0.3),
                Faults(corrupt=0.3, noise=0.2),
                Faults(duplicate=0.3, split=0.5),
                Faults(delay=0.5, delay_time=0.12),
                Faults(drop=1.0),
            )
        )
        for wire in self.wires:
            wire.faults = faults

    async def power_cycle(self) -> None:
        for wire in self.wires:
            wire.power_cycle()

    async def measure_wrongly(self) -> None:
        self.chance.choice(self.witnesses).how = self.chance.choice([*WRONG])

    async def lose_references(self) -> None:
        self.chance.choice(self.witnesses).deaf = True

    async def measure_rightly(self) -> None:
        for witness in self.witnesses:
            witness.how, witness.deaf = "", False

    async def pause(self) -> None:
        """Let the loop miss its ticks, as if the process had been stopped."""
        loop = asyncio.get_running_loop()
        assert isinstance(loop, SimulatedTimeLoop)
        loop._time += self.chance.choice((0.05, 0.3, 0.9, 2.0, 20.0))

    async def suspend(self) -> None:
        """Suspend the computer: its clock stands still meanwhile."""
        loop = asyncio.get_running_loop()
        assert isinstance(loop, SimulatedTimeLoop)
        loop.suspended += self.chance.choice((0.3, 2.0, 3600.0))

    async def set_grip(self) -> None:
        await self.loop.set_gains({"grip_effort": self.chance.choice((0.0, 0.5, 1.0))})


OFTEN: dict[Callable[[Play], Awaitable[None]], int] = {
    Play.goal: 8,
    Play.open: 3,
    Play.grasp: 3,
    Play.cancel: 2,
    Play.hold: 2,
    Play.jog: 3,
    Play.stream: 3,
    Play.stop: 3,
    Play.two_stops: 2,
    Play.stop_and_goal: 3,
    Play.recover: 3,
    Play.recover_meanwhile: 3,
    Play.disable: 1,
    Play.lose_client: 1,
    Play.unplug: 1,
    Play.replug: 4,
    Play.disturb: 2,
    Play.power_cycle: 1,
    Play.measure_wrongly: 2,
    Play.lose_references: 2,
    Play.measure_rightly: 4,
    Play.pause: 2,
    Play.suspend: 1,
    Play.set_grip: 1,
}


async def played(name: str, seed: int) -> tuple[list[str], Counter[str], list[str]]:
    """Play a random sequence; return what should not have happened, results and goals."""
    chance, notes = random.Random(f"{name} {seed}"), Notes()
    async with BusPool() as pool:
        held = chance.choice((None, "0.5"))
        ideal = chance.random() < 0.5
        options = RunOptions(emulated=True, ideal=ideal, rate=RATE, object_in_hand=held, home=True)
        ready = prepare(name, options)
        lost = {key: chance.choice([*Behaviour]) for key in ("on_link_lost", "on_client_lost")}
        idle = chance.choice((None, 1.5))
        safety = structs.replace(ready.settings.safety, idle_disable=idle, **lost)
        devices = [(d, find_driver(d.spec.driver)(d.spec, pool)) for d in ready.devices]
        settings = structs.replace(ready.settings, safety=safety)
        loop = HandLoop(ready.hand, ready.library, settings, devices)
        loop.add_observer(notes)
        found = list(zip(loop.devices.values(), devices, strict=True))
        witnesses = [Witness(driver, device) for device, (_, driver) in found]
        async with loop:
            await loop.ready()
            wires = [pool.simulation(device.spec.owner) for device in loop.devices.values()]
            async with anyio.create_task_group() as group:
                group.start_soon(drive, [loop], Clock(RATE))
                actions = list(ready.library)
                play = Play(loop, chance, notes, witnesses, wires, group, actions)
                for step in chance.choices([*OFTEN], [*OFTEN.values()], k=STEPS):
                    try:
                        await step(play)
                    except RteeError:  # refused, as a lost device cannot be moved
                        pass
                    await anyio.sleep(chance.choice((0.0, 0.003, 0.02, 0.1, 0.3, 0.8)))
                await bring_to_rest(loop, chance.choice([*Behaviour]), "the end")
                group.cancel_scope.cancel()
    return [fault for each in witnesses for fault in each.faults], notes.results, play.goals


HANDS = (
    "robotiq_2f_85",
    "robotiq_3f",
    "qb_softhand",
    "heri_ii",
    "ability_hand",
    "inspire_rh56",
    "linkerhand_o6",
    "onrobot_rg2",
    "schunk_svh",
)

TWICE = ("robotiq_2f_85", "heri_ii", "inspire_rh56")
"""Hands with two sequences at each commit: on Modbus, on a network, on a line of frames."""


@pytest.mark.samples("*-0", *(f"{name}-1" for name in TWICE))
@pytest.mark.parametrize("seed", range(30))
@pytest.mark.parametrize("name", HANDS)
async def test_a_hand_never_jumps_always_stops_and_ends_every_goal_once(
    name: str, seed: int
) -> None:
    faults, results, goals = await played(name, seed)
    assert faults == []
    assert {goal: results[goal] for goal in goals} == dict.fromkeys(goals, 1)
