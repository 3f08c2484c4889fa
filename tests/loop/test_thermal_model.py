"""Temperatures estimated from current, and what they lead to."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtee.commands import SetActive
from rtee.errors import ConfigError
from rtee.hand.config_schema import ThermalSettings
from rtee.hand.model import Hand
from rtee.log.dataclass_json import from_json, to_json
from rtee.loop.controller import Controller
from rtee.loop.measured import Measured
from rtee.loop.settings import LoopSettings
from rtee.loop.thermal import PLAUSIBLE, CurrentHeat, Thermal, ThermalLevel
from rtee.types import Event


def settled(current: float, nominal: float = 0.5, **options: float) -> tuple[float, CurrentHeat]:
    """Return the temperature after ten time constants at a current, and the estimator."""
    settings = ThermalSettings(nominal_current={"defaults": nominal}, **options)
    heat = CurrentHeat(settings, ["index"])
    found = [math.nan]
    for k in range(3001):
        found = list(heat.step(k * 0.1, [math.nan], [current]))
    return found[0], heat


def test_current_warms_by_its_square_and_settles_at_warn_at_the_nominal_one() -> None:
    assert settled(0.5)[0] == pytest.approx(60.0, abs=0.01)
    assert settled(-0.5)[0] == pytest.approx(60.0, abs=0.01)
    assert settled(0.25)[0] == pytest.approx(25.0 + 35.0 / 4, abs=0.01)
    assert settled(0.5, ambient=40.0, warn=70.0)[0] == pytest.approx(70.0, abs=0.01)
    assert settled(0.0)[0] == 25.0


@given(st.lists(st.floats(0.001, 20.0), min_size=2, max_size=30), st.floats(1.0, 200.0))
def test_estimates_do_not_depend_on_how_often_one_looks(steps: list[float], tau: float) -> None:
    settings = ThermalSettings(nominal_current={"index": 1.0}, time_constant=tau)
    often, once = CurrentHeat(settings, ["index"]), CurrentHeat(settings, ["index"])
    now = 5.0
    for heat in (often, once):
        heat.step(now, [math.nan], [0.0])
    for step in steps:
        now += step
        often.step(now, [math.nan], [1.2])
    once.step(now, [math.nan], [1.2])
    assert often.rise[0] == pytest.approx(once.rise[0], rel=1e-9)
    assert 0.0 <= often.rise[0] <= 1.44 * 35.0


def test_after_one_time_constant_63_percent_are_there_and_without_current_it_cools() -> None:
    heat = CurrentHeat(ThermalSettings(nominal_current={"index": 2.0}), ["index"])
    heat.step(0.0, [math.nan], [2.0])
    assert heat.step(30.0, [math.nan], [2.0])[0] == pytest.approx(25 + 35 * (1 - math.exp(-1)))
    assert heat.step(1e4, [math.nan], [math.nan])[0] == pytest.approx(25.0)


def test_a_measured_temperature_goes_before_an_estimate_and_no_nominal_current_gives_none() -> None:
    heat = CurrentHeat(ThermalSettings(nominal_current={"index": 2.0}), ["index", "middle"])
    heat.step(0.0, [41.0, math.nan], [2.0, 2.0])
    found = heat.step(30.0, [41.0, math.nan], [2.0, 2.0])
    assert found[0] == 41.0
    assert math.isnan(found[1])
    assert math.isnan(CurrentHeat(ThermalSettings(), ["index"]).step(0.0, [math.nan], [9.0])[0])
    assert list(heat.step(40.0, [41.0, 3.0], [])) == [41.0, 3.0]


def test_a_huge_current_is_too_hot_not_a_broken_sensor() -> None:
    temperature, heat = settled(50.0)
    assert temperature == PLAUSIBLE[1]
    thermal = Thermal(ThermalSettings(), 1)
    changes = [c for k in range(20) for c in thermal.step(k * 0.1, [temperature])]
    assert [change.level for change in changes] == [ThermalLevel.DISABLE]
    assert "estimated from its current" in changes[0].event("index", 0.0, estimated=True).text
    assert heat.rise[0] > 0


def test_a_nominal_current_of_an_unknown_actuator_is_a_mistake(hand: Hand) -> None:
    settings = LoopSettings(thermal=ThermalSettings(nominal_current={"indexx": 0.5}))
    with pytest.raises(ConfigError, match="unknown actuator 'indexx'"):
        Controller(hand, settings)


def test_an_estimate_derates_and_releases_through_the_controller(hand: Hand) -> None:
    thermal = ThermalSettings(nominal_current={"defaults": 0.5}, time_constant=10.0)
    settings = LoopSettings(rate=50.0, thermal=thermal)
    controller, n = Controller(hand, settings), len(hand.actuators)
    controller.apply(SetActive(dict.fromkeys(hand.actuator_names, True)), 0.0)
    rest, unmeasured = hand.rest.tolist(), [math.nan] * n
    efforts = []
    for tick in range(1000):
        current = [0.8] + [0.1] * (n - 1)
        measured = Measured(rest, unmeasured, unmeasured, [True] * n, [-1] * n, current)
        controller.step(tick * settings.period, measured)
        efforts.append(controller.reference_effort[0])
        if controller.outbox.disable:
            break
    events = [item for item in controller.outbox.items if isinstance(item, Event)]
    assert [event.severity for event in events] == ["warning", "warning", "error"]
    assert all("estimated" in event.text for event in events)
    assert controller.outbox.disable == {0}
    assert min(efforts) == pytest.approx(0.1 * efforts[0])


def test_nominal_currents_are_kept_in_recordings() -> None:
    settings = LoopSettings(thermal=ThermalSettings(nominal_current={"index": 0.1, "thumb": 2.5}))
    assert from_json(to_json(settings), LoopSettings) == settings


@pytest.mark.parametrize("broken", [-60.0, 200.0])
def test_a_sensor_that_breaks_changes_no_effort_before_it_counts_as_broken(broken: float) -> None:
    settings = ThermalSettings()
    thermal = Thermal(settings, 1)
    hot = settings.derate + 0.75 * (settings.disable - settings.derate)
    for k in range(20):
        thermal.step(0.1 * k, [hot])
    assert thermal.factor == [pytest.approx(0.25)]
    for k in range(20, 40):
        thermal.step(0.1 * k, [broken])
        assert thermal.factor == [pytest.approx(0.25)]
    assert thermal.level == [ThermalLevel.INVALID]
