"""The imagined hand moves, meets objects, warms up and breaks as told."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from rtee.buses.pool import BusPool
from rtee.drivers.kinematic.driver import KinematicDriver
from rtee.drivers.registry import find_driver
from rtee.errors import BusBroken, CommandRejected, ConfigError, DeviceFault
from rtee.types import ActuatorSpec, DeviceSpec, JointKind, Reference

pytestmark = pytest.mark.anyio

BEND = ActuatorSpec("bend", JointKind.REVOLUTE, 0.0, 2.0, 4.0, 40.0, 800.0, 3.0, 0.0, ("index",))
SPREAD = ActuatorSpec(
    "spread", JointKind.REVOLUTE, -1.0, 0.2, 4.0, 40.0, 800.0, math.inf, 0.0, ("index", "ring")
)


class Time:
    def __init__(self) -> None:
        self.seconds = 50.0

    def __call__(self) -> float:
        return self.seconds


def make(**options: object) -> tuple[KinematicDriver, Time]:
    spec = DeviceSpec(
        "dummy", "test", "kinematic", (BEND, SPREAD), options=options, source="hand.yaml:4"
    )
    driver = KinematicDriver(spec, BusPool())
    driver.now = clock = Time()
    return driver, clock


async def active(**options: object) -> tuple[KinematicDriver, Time]:
    driver, clock = make(**options)
    await driver.configure()
    await driver.activate()
    return driver, clock


def test_it_is_found_by_name() -> None:
    assert find_driver("kinematic") is KinematicDriver


async def test_it_follows_as_a_first_order_lag() -> None:
    driver, clock = await active(time_constant=0.1)
    await driver.move(Reference.at([0.1, 0.0]))
    for k in range(1, 50):
        clock.seconds = 50.0 + k * 0.01
        state = await driver.sense()
        assert state.position[0] == pytest.approx(0.1 * (1 - math.exp(-k * 0.1)))
        assert state.stamp == clock.seconds
        assert state.fresh


async def test_it_arrives() -> None:
    driver, clock = await active()
    for target in (0.3, 0.0):
        await driver.move(Reference.at([target, 0.0]))
        for _ in range(1000):
            clock.seconds += 0.001
            state = await driver.sense()
        assert (state.position[0], state.velocity[0]) == (target, 0.0)


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan])
async def test_a_gain_without_sense_is_refused(value: float) -> None:
    driver, clock = await active()
    with pytest.raises(CommandRejected, match="time_constant must be above 0 s"):
        await driver.set_gains({"time_constant": value})
    clock.seconds += 0.1
    await driver.sense()


async def test_how_often_it_is_asked_changes_nothing() -> None:
    often, first = await active()
    seldom, second = await active()
    for driver in (often, seldom):
        await driver.move(Reference.at([0.05, -0.05]))
    for k in range(100):
        first.seconds = 50.0 + (k + 1) * 0.001
        await often.sense()
    second.seconds = 50.1
    assert (await seldom.sense()).position == pytest.approx((await often.sense()).position)


async def test_it_keeps_velocity_and_position_limits() -> None:
    driver, clock = await active(time_constant=0.001)
    await driver.move(Reference.at([9.0, -9.0], max_velocity=[1.0, 100.0]))
    before = (await driver.sense()).position
    for _ in range(500):
        clock.seconds += 0.01
        state = await driver.sense()
        speed = (state.position - before) / 0.01
        assert speed == pytest.approx(state.velocity)
        assert abs(speed[0]) <= 1.0 + 1e-9
        assert abs(speed[1]) <= 4.0 + 1e-9
        before = state.position
    assert before.tolist() == [2.0, -1.0]


async def test_only_what_is_commanded_moves() -> None:
    driver, clock = await active()
    await driver.move(Reference.at([1.0, -0.5], mask=[False, True]))
    clock.seconds += 5.0
    state = await driver.sense()
    assert state.position[0] == 0.0
    assert state.position[1] == pytest.approx(-0.5, abs=1e-6)


async def test_an_object_stops_a_finger_and_gives_effort() -> None:
    driver, clock = await active(objects={"index": 0.5}, full_effort_at=0.2)
    for target, effort in ((0.9, 0.0), (1.05, 0.75), (1.1, 1.5), (2.0, 3.0)):
        await driver.move(Reference.at([target, 0.0]))
        clock.seconds += 5.0
        state = await driver.sense()
        assert state.position[0] == pytest.approx(min(target, 1.0))
        assert state.effort[0] == pytest.approx(effort)
    await driver.move(Reference.at([2.0, -1.0], max_effort=[0.7, 0.4]))
    clock.seconds += 5.0
    state = await driver.sense()
    assert state.effort.tolist() == [0.7, -0.4]
    assert state.position[1] == -0.5
    driver.remove_object("index")
    clock.seconds += 5.0
    assert (await driver.sense()).position.tolist() == pytest.approx([2.0, -1.0])


async def test_an_object_behind_the_finger_is_not_met() -> None:
    driver, clock = await active(start={"bend": 1.5})
    driver.place_object("bend", 0.5)
    await driver.move(Reference.at([0.0, 0.0]))
    clock.seconds += 5.0
    assert (await driver.sense()).position[0] == pytest.approx(0.0, abs=1e-6)


async def test_an_object_at_rest_lets_no_finger_close() -> None:
    """The one bends upwards, the other downwards; both are free to go the other way."""
    driver, clock = await active(objects={"index": 0.0})
    await driver.move(Reference.at([2.0, -1.0], max_effort=[0.7, 0.4]))
    clock.seconds += 5.0
    state = await driver.sense()
    assert state.position.tolist() == [0.0, 0.0]
    assert state.effort.tolist() == [0.7, -0.4]
    await driver.move(Reference.at([0.0, 0.2]))
    clock.seconds += 5.0
    assert (await driver.sense()).position[1] == pytest.approx(0.2)


async def test_what_turns_without_end_has_no_place_for_an_object() -> None:
    turn = replace(BEND, name="turn", kind=JointKind.CONTINUOUS, lower=-math.inf, upper=math.inf)
    driver = KinematicDriver(DeviceSpec("dummy", "test", "kinematic", (turn, BEND)), BusPool())
    with pytest.raises(ConfigError, match="'turn' turns endlessly"):
        driver.place_object("turn", 0.0)
    driver.place_object("index", 0.0)
    driver.now = clock = Time()
    await driver.configure()
    await driver.activate()
    await driver.move(Reference.at([3.0, 2.0]))
    clock.seconds += 5.0
    assert (await driver.sense()).position == pytest.approx([3.0, 0.0], abs=1e-6)


async def test_temperature_follows_effort() -> None:
    options = {"temperatures": True, "ambient": 20.0, "heating": 50.0, "thermal_time": 10.0}
    driver, clock = await active(objects={"bend": 0.5}, **options)
    assert "temperature" in driver.capabilities.measures
    await driver.move(Reference.at([2.0, 0.0]))
    clock.seconds += 1.0
    await driver.sense()
    for _ in range(1000):
        clock.seconds += 0.1
        state = await driver.sense()
    assert state.temperature[0] == pytest.approx(70.0, abs=0.1)
    assert state.temperature[1] == pytest.approx(20.0)


async def test_without_temperatures_none_are_measured() -> None:
    driver, _ = await active()
    state = await driver.sense()
    assert all(math.isnan(x) for x in [*state.temperature, *state.current])
    assert "temperature" not in driver.capabilities.measures


async def test_stop_and_release() -> None:
    driver, clock = await active()
    await driver.move(Reference.at([2.0, 0.0]))
    clock.seconds += 0.1
    await driver.stop()
    at = (await driver.sense()).position[0]
    assert 0.0 < at < 1.0
    clock.seconds += 1.0
    assert (await driver.sense()).position[0] == at
    await driver.move(Reference.at([2.0, 0.0]))
    await driver.disable()
    clock.seconds += 1.0
    assert (await driver.sense()).position[0] == at


async def test_activation_moves_nothing_whatever_was_commanded_before() -> None:
    driver, clock = await active()
    await driver.move(Reference.at([2.0, 0.0]))
    await driver.disable()
    clock.seconds += 1.0
    await driver.activate()
    clock.seconds += 1.0
    assert (await driver.sense()).position.tolist() == [0.0, 0.0]


async def test_it_breaks_and_mends() -> None:
    driver, _ = await active()
    driver.unplug()
    for call in (driver.sense, driver.configure, driver.activate):
        with pytest.raises(BusBroken):
            await call()
    with pytest.raises(BusBroken):
        await driver.move(Reference.at([0.0, 0.0]))
    await driver.stop()
    await driver.disable()
    driver.plug()
    await driver.configure()
    driver.fail("overload")
    with pytest.raises(DeviceFault, match="overload"):
        await driver.sense()
    await driver.recover()
    await driver.sense()
    await driver.close()
    await driver.close()


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"time_constan": 1.0}, "did you mean 'time_constant'"),
        ({"time_constant": 0.0}, "time_constant"),
        ({"start": {"bned": 1.0}}, "did you mean 'bend'"),
        ({"objects": {"middle": 0.5}}, "unknown name 'middle'"),
        ({"objects": {"bend": 1.5}}, "0 to 1 of the travel"),
    ],
)
def test_wrong_options_are_named_with_file_and_line(
    options: dict[str, object], reason: str
) -> None:
    with pytest.raises(ConfigError, match=reason) as caught:
        make(**options)
    assert "hand.yaml:4" in str(caught.value) or "of the travel" in reason
