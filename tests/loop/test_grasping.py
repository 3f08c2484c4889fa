"""Stalled, grasped, lost; less effort after a while; heat."""

from __future__ import annotations

import math
from dataclasses import replace

import anyio
import numpy as np
import pytest

from rtee.actions.openings import Meeting, Openings, fingerprint_of
from rtee.buses.pool import BusPool
from rtee.drivers.kinematic.driver import KinematicDriver
from rtee.errors import BusTimeout, GoalRejected
from rtee.hand.config_schema import GraspSettings, ThermalSettings
from rtee.hand.model import Hand
from rtee.loop.settings import LoopSettings
from rtee.loop.thermal import Thermal, ThermalLevel
from rtee.sample import ActuatorState
from rtee.types import Goal, Lifecycle, Named, Reference

from .hands import device, running

pytestmark = pytest.mark.anyio
INDEX = ("index_base", "index_tip")


async def test_an_object_gives_stalled_and_grasped_in_less_than_a_second(hand: Hand) -> None:
    async with running(hand, objects={"index": 0.4}) as rig:
        result = await rig.do("Trig", "index")
        assert result.stalled
        assert result.grasped
        assert result.succeeded
        assert not result.reached
        assert result.grasped_fingers == ("index",)
        assert result.duration < 1.0
        assert result.position["index_base"] == pytest.approx(0.6)


async def test_no_object_gives_reached_and_not_grasped(hand: Hand) -> None:
    async with running(hand) as rig:
        result = await rig.do("PinchTight", "index", "thumb")
        assert (result.reached, result.stalled, result.grasped) == (True, False, False)
        assert result.grasped_fingers == ()


async def test_one_finger_may_hold_while_the_other_arrives(hand: Hand) -> None:
    async with running(hand, objects={"thumb_base": 0.5}) as rig:
        result = await rig.do("PinchTight", "index", "thumb")
        assert result.stalled
        assert result.grasped_fingers == ("thumb",)
        assert result.position["index_base"] == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("by", ["goal", "jog"])
async def test_a_goal_that_is_preempted_tells_what_it_held(hand: Hand, by: str) -> None:
    async with running(hand, objects={"index": 0.4}) as rig:
        rig.loop.submit(Goal(Named("fist"), speed=0.1))
        await rig.run(4.0)
        assert not rig.watcher.results, "the thumb is on its way"
        if by == "goal":
            rig.loop.submit(Goal(Named("open")))
        else:
            rig.loop.jog({"index_base": 0.0})
        result = await rig.result()
        assert result.preempted
        assert result.grasped
        assert result.grasped_fingers == ("index",)


async def test_how_far_fingers_came_counts_until_they_are_opened_by_any_means(hand: Hand) -> None:
    async with running(hand) as rig:
        library = rig.loop.library
        action = library.find("Trig", ("index",))
        meeting = Meeting("Trig", ("index",), fingerprint_of(hand, action), {})
        library._openings = None, Openings(hand, meetings=(meeting,))
        assert (await rig.do("Trig", "index")).reached
        rig.loop.jog({"index_base": 0.0, "index_tip": 0.0})
        await rig.run(2.0)
        rig.driver.place_object("index", 0.4)
        result = await rig.do("Trig", "index")
        assert (result.outcome, result.grasped_fingers) == ("held", ("index",))
        # From elsewhere, the fingers may have met one another, whoever moved them there.
        rig.loop.jog({"index_base": 0.0, "index_tip": 0.0, "thumb_base": 0.8})
        await rig.run(2.0)
        result = await rig.do("Trig", "index")
        assert (result.outcome, result.grasped_fingers) == ("closed", ())


async def test_blocked_without_effort_is_stalled_but_not_grasped(hand: Hand) -> None:
    settings = LoopSettings(grasp=GraspSettings(effort=0.95))
    async with running(hand, settings, objects={"index": 0.9}, full_effort_at=1.0) as rig:
        result = await rig.do("Trig", "index")
        assert (result.stalled, result.grasped) == (True, False)


async def test_what_play_leaves_of_many_actuators_is_reached(hand: Hand) -> None:
    short = {"index_base": 0.995, "index_tip": 0.995, "thumb_base": 0.99}
    async with running(hand, objects=short, full_effort_at=1.0) as rig:
        result = await rig.do("fist")
        assert (result.outcome, result.error > 0.01) == ("reached", True)
        assert not (await rig.do("fist", tolerance=0.002)).reached


async def test_slow_motion_is_no_stall(hand: Hand) -> None:
    async with running(hand, LoopSettings(rate=100.0, goal_timeout=100.0)) as rig:
        rig.loop.submit(Goal(Named("Trig", ("index",)), speed=0.01))
        result = await rig.result(within=90)
        assert result.reached
        assert not result.stalled


async def test_only_free_motion_teaches_by_how_much_an_actuator_lags(hand: Hand) -> None:
    lags = []
    async with running(hand, objects={"index": 0.6}) as rig:
        # What is stopped falls behind by ever more on the way to its posture, and then stays behind
        # while the reference goes to and fro beyond the object.
        for intensity in (0.5, 1.0, 0.7, 1.0, 0.65, 1.0):
            result = await rig.do("Trig", "index", intensity=intensity)
            assert result.stalled == (intensity > 0.6)
            learned = rig.loop.controller.learned_motion
            lags += [learned[name].lag for name in INDEX]
    # The device's time constant of 0.03 s, and what braking adds to it.
    assert min(lags) > 0.025
    assert max(lags) < 0.05


async def test_closing_on_an_object_completes_every_step_of_a_timed_action(hand: Hand) -> None:
    async with running(hand, objects={"index": 0.4, "thumb_base": 0.5}) as rig:
        result = await rig.do("drill")
        assert result.stalled
        assert result.grasped
        assert not result.timed_out
        assert "index" in result.grasped_fingers
        assert "let_go" in {f.inner for f in rig.watcher.feedback}


async def test_losing_the_object_is_told_within_200_ms(hand: Hand) -> None:
    async with running(hand, objects={"index": 0.4}) as rig:
        assert (await rig.do("Trig", "index")).grasped
        await rig.run(1.0)
        assert "grasp_lost" not in rig.watcher.kinds()
        rig.driver.remove_object("index")
        await rig.run(0.2)
        lost = [e for e in rig.watcher.events if e.kind == "grasp_lost"]
        assert lost
        assert lost[0].source == "index"
        told = len(lost)
        await rig.run(1.0)
        assert rig.watcher.kinds().count("grasp_lost") <= max(told, len(INDEX))


async def test_losing_it_is_told_though_the_effort_was_reduced_meanwhile(hand: Hand) -> None:
    async with running(hand, objects={"index": 0.4}) as rig:
        await rig.do("Trig", "index")
        await rig.run(4.0)
        assert "grasp_lost" not in rig.watcher.kinds()
        rig.driver.remove_object()
        await rig.run(0.2)
        assert "grasp_lost" in rig.watcher.kinds()


async def test_opening_is_no_loss(hand: Hand) -> None:
    async with running(hand, objects={"index": 0.4}) as rig:
        await rig.do("Trig", "index")
        assert (await rig.do("open")).reached
        await rig.run(0.5)
        assert "grasp_lost" not in rig.watcher.kinds()


async def test_effort_steps_down_to_the_grip_effort(hand: Hand) -> None:
    settings = LoopSettings(grasp=GraspSettings(grip_effort=0.3, grip_after=1.0))
    async with running(hand, settings, objects={"index": 0.4}) as rig:
        await rig.do("Trig", "index")
        assert rig.driver.plants[0].max_effort == 2.0
        await rig.run(0.9)
        assert rig.driver.plants[0].max_effort == 2.0
        await rig.run(0.3)
        assert rig.driver.plants[0].max_effort == pytest.approx(0.6)
        assert rig.driver.plants[0].effort == pytest.approx(0.6)
        assert rig.driver.plants[2].max_effort == 3.0
        await rig.do("open")
        assert rig.driver.plants[0].max_effort == 2.0


async def test_a_device_without_effort_limits_is_eased_off_by_its_position(hand: Hand) -> None:
    class NoEffort(KinematicDriver):
        def __init__(self, *arguments: object) -> None:
            super().__init__(*arguments)  # type: ignore[arg-type]
            accepts = frozenset({"position"})
            self.capabilities = replace(self.capabilities, accepts=accepts)

    settings = LoopSettings(grasp=GraspSettings(grip_effort=0.4, grip_after=0.5))
    one = device(hand, objects={"index": 0.4})
    async with running(hand, settings, [(one, NoEffort(one.spec, BusPool()))]) as rig:
        with pytest.raises(GoalRejected, match="takes no effort limit"):
            rig.loop.submit(Goal(Named("Trig", ("index",)), effort={"index_base": 1.0}))
        await rig.do("Trig", "index")
        await rig.run(0.2)
        assert rig.driver.plants[0].target == 1.5
        await rig.run(1.5)
        assert rig.driver.plants[0].target == pytest.approx(0.6 + 0.4 * 0.9, abs=0.01)
        assert rig.driver.plants[0].position == pytest.approx(0.6)


async def test_effort_limits_of_a_goal_are_sent_with_its_first_set_point(hand: Hand) -> None:
    async with running(hand, objects={"index": 0.4}) as rig:
        rig.loop.submit(Goal(Named("Trig", ("index",)), effort={"index_base": 0.5}))
        rig.loop.tick(rig.clock.next())
        await rig.clock.settle()
        assert rig.driver.plants[0].max_effort == 0.5
        assert rig.driver.plants[1].max_effort == 2.0
        result = await rig.result()
        assert result.grasped
        assert rig.driver.plants[0].effort == 0.5
        record = rig.loop.snapshot()
        assert record.reference_effort.tolist() == [0.5, 2.0, 3.0, 40.0]
        await rig.do("Trig", "index", intensity=0.1)
        assert rig.driver.plants[0].max_effort == 2.0


class OwnWord(KinematicDriver):
    """Says by itself whether it holds something, and measures no effort."""

    word: int | None = None

    async def sense(self) -> ActuatorState:
        state = await super().sense()
        words = tuple(None if self.word is None else bool(self.word) for _ in state.position)
        return replace(state, effort=state.effort * math.nan, grasped=words)


async def test_the_devices_own_word_counts_short_of_the_end(hand: Hand) -> None:
    one = device(hand, objects={"index": 0.4})
    driver = OwnWord(one.spec, BusPool())
    async with running(hand, None, [(one, driver)]) as rig:
        rig.loop.submit(Goal(Named("Trig", ("index",))))
        await rig.run(0.35)
        driver.word = 1
        result = await rig.result()
        assert result.grasped
        assert result.duration < 0.45
        driver.word = 0  # which means nothing while its target still moves
        await rig.run(0.8)
        assert "grasp_lost" in rig.watcher.kinds()


async def test_the_devices_own_word_does_not_count_at_the_end_of_the_range(hand: Hand) -> None:
    one = device(hand)
    driver = OwnWord(one.spec, BusPool())
    async with running(hand, None, [(one, driver)]) as rig:
        rig.loop.submit(Goal(Named("Trig", ("index",))))
        await rig.run(0.9)
        driver.word = 1
        result = await rig.result()
        assert (result.reached, result.grasped) == (True, False)


async def test_opening_a_grip_is_no_grasp_by_a_word_that_still_stands(hand: Hand) -> None:
    one = device(hand, objects={"index": 0.4})
    driver = OwnWord(one.spec, BusPool())
    async with running(hand, None, [(one, driver)]) as rig:
        rig.loop.submit(Goal(Named("Trig", ("index",))))
        await rig.run(0.35)
        driver.word = 1
        assert (await rig.result()).grasped
        rig.loop.submit(Goal(Named("open")))
        await rig.run(0.1)
        driver.word = 0
        result = await rig.result()
        assert (result.reached, result.grasped) == (True, False)


class FreezingLink(KinematicDriver):
    frozen = False

    async def sense(self) -> ActuatorState:
        self._answer()
        return await super().sense()

    async def move(self, reference: Reference) -> None:
        self._answer()
        await super().move(reference)

    def _answer(self) -> None:
        if self.frozen:
            raise BusTimeout("kinematic", "frozen")


class FreezingWord(FreezingLink):
    """Takes its word back at a new target and says it again once the target stands still."""

    effort = False

    def __init__(self, *arguments: object) -> None:
        super().__init__(*arguments)  # type: ignore[arg-type]
        self._taken = 0.0

    async def sense(self) -> ActuatorState:
        state = await super().sense()
        plant, words = self.plants[-1], (False,) * len(self.plants)
        stands = plant.position == plant.obstacle and plant.target > plant.position
        if stands and self.now() - self._taken > 0.015:
            words = (*words[:-1], True)
        effort = state.effort if self.effort else state.effort * math.nan
        return replace(state, effort=effort, grasped=words)

    async def move(self, reference: Reference) -> None:
        if not self.frozen and float(reference.position[-1]) != self.plants[-1].target:
            self._taken = self.now()
        await super().move(reference)


@pytest.mark.samples("0.04-False", "0.2-True")
@pytest.mark.parametrize("effort", [False, True])
@pytest.mark.parametrize("duration", [0.04, 0.08, 0.12, 0.2])
async def test_opening_over_a_link_that_freezes_is_no_grasp(
    hand: Hand, duration: float, effort: bool
) -> None:
    """The first word after the silence is about a target from before it: a closing one."""
    for early in (0.0005, 0.002, 0.004, 0.008, 0.012):
        one = device(hand, objects={"thumb_slide": 0.4}, every=10)
        driver = FreezingWord(one.spec, BusPool())
        driver.effort = effort
        async with running(hand, None, [(one, driver)]) as rig:
            grasp = await rig.do("slide")
            assert grasp.grasped
            rig.loop.submit(Goal(Named("open")))
            while rig.loop.controller.reference_position[-1] > 0.016 + early:
                await rig.run(0.001)
            driver.frozen = True
            await rig.run(duration)
            driver.frozen = False
            result = await rig.result()
            assert (result.reached, result.grasped, result.stalled) == (True, False, False)
            again = await rig.do("slide")
            assert again.grasped, "what was let go can be held again"


async def test_a_grip_that_does_not_open_is_no_grasp(hand: Hand) -> None:
    one = device(hand, objects={"index": 0.4})
    driver = OwnWord(one.spec, BusPool())
    async with running(hand, None, [(one, driver)]) as rig:
        rig.loop.submit(Goal(Named("Trig", ("index",))))
        await rig.run(0.35)
        driver.word = 1
        assert (await rig.result()).grasped
        for plant in driver.plants[:2]:
            plant.spec = replace(plant.spec, velocity=0.0)  # it is jammed
        result = await rig.do("open")
        assert (result.stalled, result.grasped, result.succeeded) == (True, False, False)


async def test_silence_is_no_stall(hand: Hand) -> None:
    one = device(hand, every=10)
    driver = FreezingLink(one.spec, BusPool())
    async with running(hand, None, [(one, driver)]) as rig:
        await rig.do("Trig", "index")
        rig.loop.submit(Goal(Named("open")))
        await rig.run(0.1)
        where = driver.plants[0].position
        driver.frozen = True
        for plant in driver.plants:
            plant.spec = replace(plant.spec, velocity=0.0)  # no target came: it stood
        await rig.run(0.22)
        driver.frozen = False
        await rig.run(0.04)
        assert driver.plants[0].position == where
        for plant, spec in zip(driver.plants, one.spec.actuators, strict=True):
            plant.spec = spec  # and needs a moment to move on
        result = await rig.result()
        assert (result.reached, result.stalled) == (True, False)


class FeelingTips(KinematicDriver):
    """Measures the forces at the fingertips, of index and thumb."""

    tips = (math.nan, math.nan)

    async def sense(self) -> ActuatorState:
        return replace(await super().sense(), extras={"contact_force": np.array(self.tips)})


@pytest.mark.parametrize(
    ("tips", "grasped"),
    [
        ((math.nan, math.nan), ("index", "thumb")),
        ((0.0, 0.0), ()),
        ((0.0, 3.0), ("thumb",)),
        ((2.0, 0.05), ("index",)),
        ((math.nan, 0.0), ("index",)),
    ],
)
async def test_where_tips_are_measured_they_decide(
    hand: Hand, tips: tuple[float, float], grasped: tuple[str, ...]
) -> None:
    one = device(hand, objects={"index": 0.4, "thumb_base": 0.5})
    driver = FeelingTips(one.spec, BusPool())
    driver.tips = tips
    async with running(hand, None, [(one, driver)]) as rig:
        result = await rig.do("PinchTight", "index", "thumb")
        assert result.stalled
        assert (result.grasped, result.grasped_fingers) == (bool(grasped), grasped)


async def test_what_no_tip_feels_any_more_is_lost(hand: Hand) -> None:
    one = device(hand, objects={"index": 0.4})
    driver = FeelingTips(one.spec, BusPool())
    driver.tips = (2.0, 0.0)
    async with running(hand, None, [(one, driver)]) as rig:
        assert (await rig.do("Trig", "index")).grasped_fingers == ("index",)
        for _ in range(10):  # contacts chatter
            driver.tips = (0.0, 0.0)
            await rig.run(0.05)
            driver.tips = (2.0, 0.0)
            await rig.run(0.01)
        assert "grasp_lost" not in rig.watcher.kinds()
        driver.tips = (0.0, 0.0)
        await rig.run(0.2)
        assert "grasp_lost" in rig.watcher.kinds()


async def test_ten_minutes_on_a_rigid_object_stay_cool_and_hold(hand: Hand) -> None:
    settings = LoopSettings(rate=10.0, grasp=GraspSettings(grip_effort=0.4))
    options = {"temperatures": True, "heating": 90.0, "thermal_time": 60.0}
    async with running(hand, settings, objects={"index": 0.4}, **options) as rig:
        assert (await rig.do("Trig", "index", intensity=1.0)).grasped
        await rig.run(600.0)
        assert max(rig.loop.snapshot().temperature) < settings.thermal.warn
        assert rig.driver.plants[0].position == pytest.approx(0.6)
        assert rig.driver.plants[0].effort == pytest.approx(0.8)
        assert "thermal" not in rig.watcher.kinds()


async def test_heat_warns_then_derates_then_disables(hand: Hand) -> None:
    settings = LoopSettings(
        rate=50.0,
        grasp=GraspSettings(grip_after=1e6),
        thermal=ThermalSettings(warn=50.0, derate=60.0, disable=70.0),
    )
    options = {"temperatures": True, "heating": 5000.0, "thermal_time": 400.0}
    async with running(hand, settings, objects={"index_base": 0.4}, **options) as rig:
        await rig.do("Trig", "index")
        efforts: list[float] = []
        for k in range(400):
            await rig.run(0.2)
            if k == 300:
                rig.driver.plants[0].temperature = 85.0  # heat from elsewhere
            efforts.append(rig.loop.snapshot().reference_effort[0])
            if rig.loop.devices["dummy"].lifecycle is Lifecycle.INACTIVE:
                break
        thermal = [e for e in rig.watcher.events if e.kind == "thermal"]
        assert [e.severity for e in thermal] == ["warning", "warning", "error"]
        assert "less effort" in thermal[1].text
        assert "disabled" in thermal[2].text
        assert efforts[0] == 2.0
        assert min(efforts) < 1.0
        assert rig.driver.plants[0].effort == 0.0
        await rig.run(1.0)
        with pytest.raises(GoalRejected, match="is inactive"):
            rig.loop.submit(Goal(Named("open")))


async def test_what_is_recovered_too_hot_is_disabled_again(hand: Hand) -> None:
    settings = LoopSettings(rate=50.0)
    async with running(hand, settings, temperatures=True, thermal_time=1e6) as rig:
        plant = rig.driver.plants[0]

        async def recovered() -> Lifecycle:
            async with anyio.create_task_group() as group:
                group.start_soon(rig.loop.recover)
                await rig.run(0.2)
            assert rig.loop.devices["dummy"].lifecycle is Lifecycle.ACTIVE
            await rig.run(3.0)
            return rig.loop.devices["dummy"].lifecycle

        plant.temperature = 90.0
        await rig.run(2.0)
        assert rig.loop.devices["dummy"].lifecycle is Lifecycle.INACTIVE
        assert await recovered() is Lifecycle.INACTIVE
        thermal = [e for e in rig.watcher.events if e.kind == "thermal"]
        assert [e.severity for e in thermal] == ["error", "error"]
        plant.temperature = 75.0
        assert await recovered() is Lifecycle.ACTIVE, "it has cooled"


def test_what_does_not_follow_when_it_is_too_hot_is_disabled_again_and_again() -> None:
    thermal = Thermal(ThermalSettings(60, 70, 80), 1)
    changes = [c for k in range(41) for c in thermal.step(k * 0.1, [90.0], [True])]
    assert [change.level for change in changes] == [ThermalLevel.DISABLE] * 4


def test_a_broken_sensor_is_invalid_and_trips_nothing() -> None:
    thermal = Thermal(ThermalSettings(60, 70, 80), 2)
    levels = []
    for k in range(100):
        changes = thermal.step(k * 0.1, [-886.0 if k > 10 else 30.0, math.nan])
        levels += [change.level for change in changes]
    assert levels == [ThermalLevel.INVALID]
    assert thermal.factor == [1.0, 1.0]
    levels += [c.level for k in range(100, 120) for c in thermal.step(k * 0.1, [40.0, math.nan])]
    assert levels == [ThermalLevel.INVALID, ThermalLevel.OK]


class StuckSensor(KinematicDriver):
    """The first actuator's temperature is always the same, and none."""

    async def sense(self) -> ActuatorState:
        state = await super().sense()
        temperature = state.temperature.copy()
        temperature[0] = -886.0
        return replace(state, temperature=temperature)


async def test_a_stuck_sensor_is_named_and_the_hand_goes_on(hand: Hand) -> None:
    one = device(hand, rate=50.0, temperatures=True)
    driver = StuckSensor(one.spec, BusPool())
    async with running(hand, LoopSettings(rate=50.0), [(one, driver)]) as rig:
        await rig.run(2.0)
        assert (await rig.do("Trig", "index")).reached
        [status] = rig.loop.statuses()
        assert status.lifecycle is Lifecycle.ACTIVE
        assert status.message == "the temperature sensor of index_base is invalid"
        assert rig.loop.snapshot().reference_effort[0] == 2.0
        assert [e.severity for e in rig.watcher.events if e.kind == "thermal"] == ["warning"]


def test_a_single_spike_changes_nothing() -> None:
    thermal = Thermal(ThermalSettings(60, 70, 80), 1)
    for k in range(100):
        assert not thermal.step(k * 0.1, [95.0 if k % 5 == 0 else 40.0])


def test_levels_are_left_with_hysteresis() -> None:
    thermal = Thermal(ThermalSettings(60, 70, 80), 1)
    for k in range(10):
        thermal.step(k * 0.1, [61.0])
    assert thermal.level == [ThermalLevel.WARN]
    for k in range(10, 30):
        assert not thermal.step(k * 0.1, [59.0])
    changes = [c for k in range(30, 50) for c in thermal.step(k * 0.1, [57.0])]
    assert [c.level for c in changes] == [ThermalLevel.OK]
    assert changes[0].event("index", 3.0).text == "index is cool again: 57 °C"


def test_derating_is_linear_and_never_quite_nothing() -> None:
    thermal = Thermal(ThermalSettings(60, 70, 80), 1)
    for k in range(10):
        thermal.step(k * 0.1, [75.0])
    assert thermal.factor[0] == pytest.approx(0.5)
    thermal.step(1.1, [79.9])
    assert thermal.factor[0] == pytest.approx(0.1)
