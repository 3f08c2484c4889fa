"""What no actuator can do is not believed; what honest devices measure is, however late."""

from __future__ import annotations

import random
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.buses.pool import BusPool
from rtee.drivers.kinematic.driver import KinematicDriver
from rtee.drivers.plausibility import MARGIN, Plausibility
from rtee.hand.model import Hand
from rtee.loop.settings import LoopSettings
from rtee.sample import ActuatorState
from rtee.types import ActuatorSpec, Event, Goal, JointKind, Mechanism, Named

from .hands import device, running

SPEC = ActuatorSpec("motor", JointKind.REVOLUTE, 0.0, 1.5, 2.0, 20.0, 400.0, 1.0, 0.0)


class Liar(KinematicDriver):
    """Says that it is anywhere, for as long as it lies."""

    lies = 0
    most = 1.0

    async def sense(self) -> ActuatorState:
        state = await super().sense()
        if not self.lies:
            return state
        self.lies -= 1
        chance = random.Random(self.lies)
        spec = self.plants[0].spec
        position = np.array(
            [self.most * chance.uniform(spec.lower, spec.upper), *state.position[1:]]
        )
        return replace(state, position=position)


@pytest.mark.anyio
@pytest.mark.parametrize("rate", [100.0, 1000.0])
async def test_a_device_that_answers_anything_reaches_nothing(hand: Hand, rate: float) -> None:
    one = device(hand, rate=rate)
    driver = Liar(one.spec, BusPool())
    async with running(hand, LoopSettings(rate=rate), [(one, driver)]) as rig:
        driver.lies = 10**9
        result = await rig.do("Trig", "index")
        assert (result.reached, result.aborted, result.succeeded) == (False, True, False)
        assert result.reason == "the measured position of index_base is not plausible"
        told = [event for event in rig.watcher.events if event.kind == "implausible"]
        assert [(event.source, event.severity) for event in told] == [("index_base", "warning")]
        assert "it moved" in told[0].text
        assert rig.loop.statuses()[0].message == result.reason
        assert (await rig.do("open")).aborted
        assert (await rig.do("Trig", "thumb")).reached, "others are believed"
        driver.lies = 0
        await rig.run(1.0)
        assert rig.watcher.events[-1].text.endswith("is plausible again")
        assert rig.loop.statuses()[0].message == ""
        assert (await rig.do("open")).reached


@pytest.mark.anyio
@pytest.mark.parametrize("seed", range(1, 6))
async def test_no_answer_by_chance_counts_as_reached(hand: Hand, seed: int) -> None:
    one = device(hand)
    driver = Liar(one.spec, BusPool())
    async with running(hand, None, [(one, driver)]) as rig:
        driver.lies = seed * 10**6
        for action in (("Trig", "index"), ("open",), ("Trig", "index")):
            result = await rig.do(*action)
            assert (result.reached, result.aborted) == (False, True)


class SlowLiar(KinematicDriver):
    """Says every tenth of a second that it is anywhere, and the same in between."""

    seed = 0

    async def sense(self) -> ActuatorState:
        state = await super().sense()
        chance = random.Random(self.seed + int(state.stamp / 0.1))
        spec = self.plants[0].spec
        position = chance.uniform(spec.lower, spec.upper)
        return replace(state, position=np.array([position, *state.position[1:]]))


@pytest.mark.anyio
@pytest.mark.samples("0-*", "1-*")
@pytest.mark.parametrize("every", [1, 20], ids=["repeated", "measured rarely"])
@pytest.mark.parametrize("seed", range(4))
async def test_no_plausible_answer_by_chance_counts_as_reached(
    hand: Hand, seed: int, every: int
) -> None:
    one = device(hand, rate=200.0, every=every)
    driver = SlowLiar(one.spec, BusPool())
    driver.seed = seed * 10**6
    async with running(hand, LoopSettings(rate=200.0), [(one, driver)]) as rig:
        result = await rig.do("Trig", "index", timeout=9.0, tolerance=0.05)
        assert (result.reached, result.succeeded) == (False, False)


@pytest.mark.anyio
@pytest.mark.parametrize("every", [1, 20])
async def test_an_honest_device_that_is_measured_rarely_arrives(hand: Hand, every: int) -> None:
    one = device(hand, rate=200.0, every=every)
    driver = KinematicDriver(one.spec, BusPool())
    async with running(hand, LoopSettings(rate=200.0), [(one, driver)]) as rig:
        for action in (("Trig", "index"), ("open",)):
            assert (await rig.do(*action)).reached


@pytest.mark.anyio
async def test_a_glitch_is_told_and_ends_nothing(hand: Hand) -> None:
    one = device(hand)
    driver = Liar(one.spec, BusPool())
    async with running(hand, None, [(one, driver)]) as rig:
        await rig.do("Trig", "index")
        rig.loop.submit(Goal(Named("open")))
        await rig.run(0.3)
        driver.lies, driver.most = 1, 5.0
        result = await rig.result()
        assert (result.reached, result.aborted) == (True, False)
        assert "implausible" in rig.watcher.kinds()


@pytest.mark.anyio
async def test_what_is_moved_by_hand_may_be_anywhere(hand: Hand) -> None:
    one = device(hand)
    driver = KinematicDriver(one.spec, BusPool())
    async with running(hand, None, [(one, driver)]) as rig:
        await rig.loop.disable()
        await rig.run(0.1)
        driver.plants[0].position = 1.4
        await rig.run(0.1)
        await rig.loop.recover()
        await rig.run(0.1)
        assert (await rig.do("Trig", "index")).reached
        assert "implausible" not in rig.watcher.kinds()


def watched() -> tuple[Plausibility, list[Event]]:
    told: list[Event] = []
    ends = Mechanism(SPEC.lower, SPEC.upper, SPEC.effort)
    return Plausibility([SPEC], told.append, [ends]), told


def test_a_hand_may_stand_wherever_its_mechanism_reaches() -> None:
    told: list[Event] = []
    narrow = replace(SPEC, upper=0.3)  # in hand.yaml
    ends = Mechanism(SPEC.lower, SPEC.upper, SPEC.effort)
    plausible = Plausibility([narrow], told.append, [ends])
    plausible.step(0.0, [1.4], [True], [True], [0.0])
    assert not told
    assert plausible.start(0, 0.0, 0.0) == 1.4
    plausible.forget([0])
    plausible.step(0.01, [1.6], [True], [True], [0.0])
    assert [event.kind for event in told] == ["implausible"]
    assert plausible.start(0, 0.01, 0.0) is None


@given(
    st.floats(0.1, 0.5 * MARGIN),
    st.lists(
        st.tuples(st.sampled_from([0.001, 0.01, 0.1, 0.4]), st.floats(0.0, 0.05)), max_size=100
    ),
)
def test_motion_is_believed_however_sparse_and_late_it_is_measured(
    times_faster: float, samples: list[tuple[float, float]]
) -> None:
    """Up to half the margin; measured by the device, found at a tick up to 50 ms later."""
    plausible, told = watched()
    measured_at = found_at = 0.0
    for interval, late in samples:
        measured_at += interval
        found_at = max(found_at + 0.001, measured_at + late)
        phase = times_faster * SPEC.velocity * measured_at % (2 * SPEC.upper)
        plausible.step(found_at, [min(phase, 2 * SPEC.upper - phase)], [True], [True], [0.0])
    assert not told


def test_what_is_not_measured_anew_leaves_the_time_for_its_way() -> None:
    plausible, told = watched()
    for tick in range(1000):
        fresh = tick % 500 == 0
        here = 1.0 if tick >= 500 else 0.0
        plausible.step(tick * 0.001, [here], [fresh], [True], [0.0])
    assert not told
    plausible.step(1.0, [0.0], [True], [True], [0.0])
    plausible.step(1.001, [1.4], [True], [True], [0.0])
    assert len(told) == 1


def test_a_silence_is_no_interval_between_measurements() -> None:
    plausible, _ = watched()
    for tick in range(100):
        plausible.step(tick * 0.001, [0.5], [True], [True], [0.0])
    plausible.step(5.0, [1.2], [True], [True], [0.0])  # somebody has moved it meanwhile
    assert plausible.leaping([0], 5.1)
    assert not plausible.leaping([0], 5.7), "as if it were measured every five seconds"


def test_far_outside_of_the_limits_is_told_but_may_come_back() -> None:
    plausible, told = watched()
    for tick in range(2000):
        position = max(3.0 - tick * 0.002, 0.5)
        plausible.step(tick * 0.001, [position], [True], [True], [0.0])
        assert plausible.broken([0]) is None
        if tick > 0 and position > SPEC.upper + 0.5 * SPEC.upper:
            assert plausible.doubted([0])
    assert not plausible.doubted([0])
    assert "far outside of its limits" in told[0].text
    assert [event.severity for event in told] == ["warning", "info"]


def test_an_encoder_looks_frozen_only_by_what_is_measured() -> None:
    """While a device was silent, it may have stood still without a reference to follow."""
    plausible, _ = watched()
    for tick in range(100):
        plausible.step(tick * 0.001, [0.5], [True], [True], [0.5])
    silent = [0.5 + tick * 0.002 for tick in range(200)]
    for tick, reference in enumerate(silent):
        plausible.step(0.1 + tick * 0.001, [0.5], [False], [True], [reference])
    plausible.step(0.3, [0.5], [True], [True], [silent[-1]])
    assert plausible.start(0, 0.3, silent[-1]) == 0.5
    for tick in range(100):
        plausible.step(0.3 + tick * 0.001, [0.5], [True], [True], [silent[-1] + tick * 0.002])
    assert plausible.start(0, 0.399, silent[-1] + 0.2) is None, "it was measured all the time"
