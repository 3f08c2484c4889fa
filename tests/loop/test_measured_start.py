"""References start from fresh, plausible measurements only; else they brake where they are."""

from __future__ import annotations

import random
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest

from rtee.buses.pool import BusPool
from rtee.commands import BeginStream, EndStream, StreamSample
from rtee.drivers.kinematic.driver import KinematicDriver
from rtee.errors import GoalRejected
from rtee.hand.config_schema import Behaviour
from rtee.hand.model import Hand
from rtee.loop.handloop import bring_to_rest
from rtee.loop.settings import LoopSettings
from rtee.sample import ActuatorState
from rtee.types import Goal, Lifecycle, Named, Reference

from .hands import Rig, device, running
from .test_shutdown import stopped

pytestmark = pytest.mark.anyio

RATE = 250.0
LEAP = np.array([0.4, 0.4, 0.4, 0.01])  # [rad, rad, rad, m]: possible within the allowance
MEASUREMENTS: dict[str, Callable[[ActuatorState, ActuatorState], ActuatorState]] = {
    "invalid": lambda now, _: replace(now, position=np.full_like(now.position, np.nan)),
    "one invalid": lambda now, _: replace(now, position=np.array([np.inf, *now.position[1:]])),
    "frozen": lambda now, then: replace(now, position=then.position),
    "frozen at zero": lambda now, _: replace(now, position=np.zeros_like(now.position)),
    "old": lambda now, then: replace(then, fresh=False, stamp=now.stamp),
    "repeated": lambda _, then: then,
    "random": lambda now, _: replace(
        now, position=np.array([random.Random(now.stamp).uniform(0.0, 1.5) for _ in now.position])
    ),
    "leaped": lambda now, _: replace(now, position=now.position + LEAP),
    "far outside": lambda now, _: replace(now, position=np.full_like(now.position, 1e6)),
}


class Wrong(KinematicDriver):
    """Measures something else than what is there, once it is told to."""

    def __init__(self, *arguments: object) -> None:
        super().__init__(*arguments)  # type: ignore[arg-type]
        self.how = ""
        self.then: ActuatorState | None = None
        self.sent: list[Reference] = []

    async def sense(self) -> ActuatorState:
        now = await super().sense()
        if not self.how:
            self.then = now
            return now
        assert self.then is not None
        return MEASUREMENTS[self.how](now, self.then)

    async def move(self, reference: Reference) -> None:
        self.sent.append(reference)
        await super().move(reference)


def sample(stamp: float, now: float, where: dict[str, float]) -> StreamSample:
    nothing = dict.fromkeys(where, np.nan)
    return StreamSample("s", stamp, now, where, {}, where, nothing)


async def _stop(rig: Rig) -> None:
    assert dict(await stopped(rig)) == {"dummy": True}


async def _hold(rig: Rig) -> None:
    rig.loop.hold("a test")


async def _cancel(rig: Rig) -> None:
    rig.loop.cancel("")


async def _keep(rig: Rig) -> None:
    await bring_to_rest(rig.loop, Behaviour.HOLD, "a test")


async def _goal(rig: Rig) -> None:
    rig.loop.submit(Goal(Named("open")))


async def _stream(rig: Rig) -> None:
    rig.loop._pending.append(BeginStream("s", 50.0, 0.2))
    for stamp in range(5):
        where = {"index_base": 0.3, "thumb_base": 0.2}
        rig.loop._pending.append(sample(0.02 * stamp, rig.loop.now(), where))
        await rig.run(0.02)
    rig.loop._pending.append(EndStream("s", ""))


PATHS: dict[str, Callable[[Rig], Awaitable[None]]] = {
    "stop": _stop,
    "hold": _hold,
    "cancel": _cancel,
    "keep": _keep,
    "goal": _goal,
    "stream": _stream,
}


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("how", [how for how in MEASUREMENTS if how != "leaped"])
async def test_no_wrong_measurement_becomes_a_reference(hand: Hand, how: str, path: str) -> None:
    one = device(hand, rate=RATE)
    driver = Wrong(one.spec, BusPool())
    async with running(hand, LoopSettings(rate=RATE), [(one, driver)]) as rig:
        rig.loop.submit(Goal(Named("fist"), speed=0.5))
        await rig.run(0.2)
        driver.how = how
        await rig.run(0.2)
        before = len(rig.watcher.records) - 1
        sent = len(driver.sent) - 1
        await PATHS[path](rig)
        await rig.run(0.5)
        top = np.array([actuator.velocity for actuator in hand.actuators]) / RATE
        steps = np.diff([r.reference_position for r in rig.watcher.records[before:]], axis=0)
        # The others of "one invalid" may start where they are measured.
        judged = slice(0, 1) if how == "one invalid" else slice(None)
        assert (np.abs(steps) <= top * (1 + 1e-6))[:, judged].all()
        # What the device receives jumps as little, but for the moments in which it is told to stop.
        got = np.diff([reference.position for reference in driver.sent[sent:]], axis=0)
        assert len(got) == 0 or (np.abs(got) <= 0.05 * RATE * top).all()
        if path not in ("goal", "keep"):
            assert not rig.loop.controller.moving, "it has braked"


@pytest.mark.parametrize("path", ["stop", "hold", "cancel", "keep"])
async def test_a_glitch_that_looks_possible_becomes_no_reference(hand: Hand, path: str) -> None:
    """One wrong answer, as of a disturbed encoder, right before the hand is stopped."""
    one = device(hand, rate=RATE)
    driver = Wrong(one.spec, BusPool())
    async with running(hand, LoopSettings(rate=RATE), [(one, driver)]) as rig:
        rig.loop.submit(Goal(Named("fist"), speed=0.5))
        await rig.run(0.4)
        driver.how = "leaped"
        before = len(rig.watcher.records) - 1
        await rig.run(1 / RATE)
        await PATHS[path](rig)
        driver.how = ""
        await rig.run(0.5)
        assert "implausible" not in rig.watcher.kinds(), "it might have been true"
        top = np.array([actuator.velocity for actuator in hand.actuators]) / RATE
        steps = np.diff([r.reference_position for r in rig.watcher.records[before:]], axis=0)
        assert (np.abs(steps) <= top * (1 + 1e-6)).all()
        got = np.diff([reference.position for reference in driver.sent[-60:]], axis=0)
        assert (np.abs(got) <= 0.05 * RATE * top).all()


@pytest.mark.parametrize("ends", [False, True], ids=["goes on", "ends"])
@pytest.mark.parametrize("how", ["invalid", "one invalid", "old", "far outside"])
async def test_an_unmeasured_device_gets_no_reference_until_it_is_measured(
    hand: Hand, how: str, ends: bool
) -> None:
    one = device(hand, rate=RATE)
    driver = Wrong(one.spec, BusPool())
    async with running(hand, LoopSettings(rate=RATE), [(one, driver)]) as rig:
        await rig.loop.disable()
        await rig.run(0.05)
        for plant in driver.plants:  # moved by hand meanwhile
            plant.position = plant.spec.upper
        driver.how = how
        driver.sent.clear()
        await rig.loop.recover()
        with suppress(GoalRejected):
            rig.loop.jog({hand.actuator_names[0]: hand.actuators[0].lower})
        await rig.run(0.3)
        assert next(iter(rig.loop.devices.values())).lifecycle is Lifecycle.ACTIVE
        assert driver.sent == []
        if ends:
            assert await bring_to_rest(rig.loop, Behaviour.HOLD, "a test") == [("dummy", True)]
            assert driver.sent == []
            return
        driver.how = ""
        await rig.run(1.5)  # half a second until what was far outside is believed again
        upper = [actuator.upper for actuator in hand.actuators]
        assert driver.sent[0].position == pytest.approx(upper)
        assert driver.sent[-1].position == pytest.approx(upper), "not moved by what came too early"


@pytest.mark.parametrize("how", ["invalid", "one invalid", "old", "repeated"])
async def test_a_record_says_fresh_of_what_was_measured_only(hand: Hand, how: str) -> None:
    one = device(hand, rate=RATE)
    driver = Wrong(one.spec, BusPool())
    async with running(hand, LoopSettings(rate=RATE), [(one, driver)]) as rig:
        assert rig.loop.snapshot().fresh.all()
        driver.how = how
        await rig.run(0.01)
        expected = [how == "one invalid" and i > 0 for i in range(len(hand.actuators))]
        assert rig.loop.snapshot().fresh.tolist() == expected
        driver.how = ""
        await rig.run(0.01)
        assert rig.loop.snapshot().fresh.all()


async def test_a_finger_that_presses_with_force_stops_pressing(hand: Hand) -> None:
    """What keeps an encoder still may be an object, which the effort shows."""
    async with running(hand, LoopSettings(rate=RATE), objects={"index_base": 0.5}) as rig:
        rig.loop.submit(Goal(Named("Trig", ("index",))))
        await rig.run(0.6)
        assert rig.loop.snapshot().reference_position[0] > 1.0
        await _stop(rig)
        await rig.run(0.05)
        assert rig.loop.snapshot().reference_position[0] == pytest.approx(0.75, abs=0.02)
