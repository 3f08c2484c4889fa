"""Touch sensors: whose values reach the tick, which finger feels them, and when they are stale."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from rtee.buses.pool import BusPool
from rtee.drivers.base import Driver
from rtee.drivers.capabilities import Capabilities
from rtee.drivers.kinematic.driver import KinematicDriver
from rtee.hand.config_schema import TouchSection
from rtee.hand.model import Hand
from rtee.sample import ActuatorState
from rtee.touch import STALE_AFTER, TouchReading, TouchSensor
from rtee.types import DeviceSpec, Goal, Named, OnContact, Reference

from .hands import Rig, device, running

pytestmark = pytest.mark.anyio

SENSORS = (TouchSensor("pad", 4, link="index_2"), TouchSensor("raw", 2, unit="counts"))


class Skin(KinematicDriver):
    """Has taxels, which measure what a test writes there."""

    rig: Rig | None = None

    def declare(self, sensors: Sequence[TouchSensor]) -> Skin:
        self.capabilities = replace(self.capabilities, touch=tuple(sensors))
        self.reading: TouchReading | None = None
        return self

    def press(self, values: Sequence[float], stamp: float) -> None:
        self.reading = TouchReading(np.array(values, dtype=np.float64), stamp)

    async def sense(self) -> ActuatorState:
        return replace(await super().sense(), touch=self.reading)


def skin(hand: Hand, sensors: Sequence[TouchSensor] = SENSORS, **options: object) -> tuple:
    one = device(hand, **options)
    return one, Skin(one.spec, BusPool()).declare(sensors)


async def test_a_new_reading_comes_once_with_the_next_tick(hand: Hand) -> None:
    one, driver = skin(hand)
    async with running(hand, None, [(one, driver)]) as rig:
        await rig.run(0.01)
        assert not rig.watcher.records[-1].touch
        driver.press([0.5, 0.25, 0.0, 0.25, 7.0, 9.0], rig.clock.now())
        await rig.run(0.01)
        last = rig.watcher.records[-1].touch["dummy"]
        seen = {id(r.touch["dummy"]) for r in rig.watcher.records if r.touch}
        assert len(seen) == 1, "the same state until there is a new one"
        assert last.of("raw").tolist() == [7.0, 9.0]
        assert last.totals.tolist() == [1.0, 16.0]
        assert (last.sensors[0].finger, last.stale) == ("index", False)
        # Counts are not forces: only the pad is felt, and the thumb has no sensor.
        felt = rig.watcher.records[-1].channels["dummy/contact_force"]
        assert felt[0] == 1.0
        assert math.isnan(felt[1])
        driver.press([0.0] * 6, rig.clock.now())
        await rig.run(0.01)
        assert rig.watcher.records[-1].channels["dummy/contact_force"][0] == 0.0


async def test_what_is_too_old_is_stale_and_felt_no_more(hand: Hand) -> None:
    one, driver = skin(hand, objects={"index": 0.4})
    async with running(hand, None, [(one, driver)]) as rig:
        driver.press([1.0, 0.0, 0.0, 0.0, 0.0, 0.0], rig.clock.now())
        rig.loop.submit(Goal(Named("Trig", ("index",))))
        await rig.run(STALE_AFTER - 0.1)
        assert not rig.watcher.records[-1].touch["dummy"].stale
        await rig.run(0.2)
        assert rig.watcher.records[-1].touch["dummy"].stale
        assert math.isnan(rig.watcher.records[-1].channels["dummy/contact_force"][0])
        await rig.run(1.0)
        assert "grasp_lost" not in rig.watcher.kinds(), (
            "a silent sensor does not say that it is lost"
        )


@pytest.mark.parametrize(("force", "grasped"), [(2.0, ("index",)), (0.0, ())])
async def test_taxels_decide_what_is_grasped(
    hand: Hand, force: float, grasped: tuple[str, ...]
) -> None:
    one, driver = skin(hand, objects={"index": 0.4})
    async with running(hand, None, [(one, driver)]) as rig:
        rig.loop.submit(Goal(Named("Trig", ("index",))))
        while not rig.watcher.results:
            driver.press([force / 4] * 4 + [900.0] * 2, rig.clock.now())
            await rig.run(0.01)
        assert rig.watcher.results[0].stalled
        assert rig.watcher.results[0].grasped_fingers == grasped


async def test_a_finger_stops_where_its_taxels_touch(hand: Hand) -> None:
    one, driver = skin(hand)
    async with running(hand, None, [(one, driver)]) as rig:
        rig.loop.submit(Goal(Named("Trig", ("index",)), on_contact={"": OnContact.STOP}))
        while not rig.watcher.results:
            touches = driver.plants[0].position > 0.5
            driver.press([0.3 if touches else 0.0] * 4 + [0.0] * 2, rig.clock.now())
            await rig.run(0.005)
        assert rig.watcher.results[0].touched == ("index",)
        assert rig.watcher.results[0].position["index_base"] == pytest.approx(0.55, abs=0.1)


async def test_a_scale_makes_counts_newtons(hand: Hand) -> None:
    scaled = replace(
        hand, touch={"raw": TouchSection("thumb_2", positions=((0, 0, 0), (0, 0, 0.01)), scale=0.5)}
    )
    one, driver = skin(scaled)
    async with running(scaled, None, [(one, driver)]) as rig:
        driver.press([0.0] * 4 + [3.0, math.nan], rig.clock.now())
        await rig.run(0.01)
        state = rig.watcher.records[-1].touch["dummy"]
        assert state.sensors[1].unit == "N"
        assert state.of("raw")[0] == 1.5
        felt = rig.watcher.records[-1].channels["dummy/contact_force"]
        assert felt.tolist() == [0.0, 1.5], "a taxel that measured nothing hides nothing"


async def test_a_hand_without_fingers_feels_nothing_and_measures_all(hand: Hand) -> None:
    bare = replace(hand, fingers=())
    one, driver = skin(bare)
    async with running(bare, None, [(one, driver)]) as rig:
        driver.press([1.0] * 6, rig.clock.now())
        await rig.run(0.01)
        assert rig.watcher.records[-1].touch["dummy"].totals.tolist() == [4.0, 2.0]
        assert not rig.watcher.records[-1].channels


@pytest.mark.parametrize(
    "wrong",
    [{"taxels": 0}, {"taxels": 4, "grid": (2, 3)}, {"taxels": 2, "position": np.zeros((3, 3))}],
)
def test_a_sensor_is_about_its_taxels(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="'pad'"):
        TouchSensor("pad", **wrong)  # type: ignore[arg-type]


async def test_values_that_no_sensor_has_are_told_and_left_out(hand: Hand) -> None:
    one, driver = skin(hand)
    async with running(hand, None, [(one, driver)]) as rig:
        driver.press([1.0] * 5, rig.clock.now())
        await rig.run(0.1)
        assert not rig.watcher.records[-1].touch
        [event] = [e for e in rig.watcher.events if e.kind == "touch_refused"]
        assert "5 touch values" in event.text


async def test_a_place_with_other_taxels_is_told_and_left_out(hand: Hand) -> None:
    wrong = replace(hand, touch={"pad": TouchSection("index_2", grid=(3, 3))})
    one, driver = skin(wrong)
    async with running(wrong, None, [(one, driver)]) as rig:
        driver.press([1.0] * 6, rig.clock.now())
        await rig.run(0.01)
        assert not rig.watcher.records[-1].touch["dummy"].sensors[0].placed
        [event] = [e for e in rig.watcher.events if e.kind == "touch_refused"]
        assert "has 4 taxels, hand.yaml places 9" in event.text


class Board(Driver):
    """A touch board: it measures and moves nothing."""

    def __init__(self, spec: DeviceSpec, buses: BusPool) -> None:
        super().__init__(spec, buses)
        self.capabilities = Capabilities(measures=frozenset(), touch=SENSORS[:1])
        self.reading: TouchReading | None = None
        self.broken = False

    async def sense(self) -> ActuatorState:
        if self.broken:
            raise OSError("gone")
        return ActuatorState.measured([], 0.0, touch=self.reading)

    async def move(self, reference: Reference) -> None:
        raise AssertionError("there is nothing to move")


async def test_a_device_without_actuators_only_measures(hand: Hand) -> None:
    hands, board = device(hand), device(hand, "board", ())
    driver = Board(board.spec, BusPool())
    kinematic = KinematicDriver(hands.spec, BusPool())
    async with running(hand, None, [(hands, kinematic), (board, driver)]) as rig:
        driver.reading = TouchReading(np.array([0.0, 2.0, 0.0, 0.0]), rig.clock.now())
        rig.loop.submit(Goal(Named("Trig", ("index",))))
        await rig.run(0.05)
        assert rig.watcher.records[-1].touch["board"].totals.tolist() == [2.0]
        driver.broken = True
        result = await rig.result()
        assert result.reached, "the loss of a sensor ends no motion"
        assert "device_lost" in rig.watcher.kinds()
        await rig.run(STALE_AFTER)
        assert rig.watcher.records[-1].touch["board"].stale
