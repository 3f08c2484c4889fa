"""The pure controller: what comes between two ticks is never lost."""

from __future__ import annotations

import json
import math

import pytest

from rtee.actions.library import ActionLibrary
from rtee.commands import Cancel, SetActive
from rtee.errors import LogError
from rtee.hand.config_schema import ProfileKind, ProfileSettings
from rtee.hand.model import Hand
from rtee.loop.controller import Controller
from rtee.loop.measured import Measured
from rtee.loop.planning import make_plan
from rtee.loop.settings import LoopSettings
from rtee.loop.snapshot import _MOVED, capture, restore, to_bytes
from rtee.types import Goal, Intensity, Named, Result

START = 0.1


def test_a_goal_between_permission_and_tick_starts_where_the_hand_is(
    hand: Hand, library: ActionLibrary
) -> None:
    settings = LoopSettings(rate=100.0)
    controller = Controller(hand, settings)
    n = len(hand.actuators)
    controller.apply(SetActive(dict.fromkeys(hand.actuator_names, True)), 0.0)
    controller.accept(make_plan(Goal(Named("Trig", ("index",))), hand, library, settings), 0.0)
    position = [min(START, actuator.upper) for actuator in hand.actuators]
    unmeasured = [math.nan] * n
    for tick in range(500):
        measured = Measured(position, unmeasured, unmeasured, [True] * n, [-1] * n)
        controller.step(tick * settings.period, measured)
        if tick == 0:
            assert controller.reference_position == pytest.approx(position, abs=0.01)
        position = list(controller.reference_position)
    results = [item for item in controller.outbox.items if isinstance(item, Result)]
    assert [result.reached for result in results] == [True]


def test_a_state_in_which_the_hand_brakes_goes_on_as_it_did(
    hand: Hand, library: ActionLibrary
) -> None:
    pytest.importorskip("ruckig")
    settings = LoopSettings(rate=100.0, profile=ProfileSettings(ProfileKind.JERK_LIMITED))
    controller = Controller(hand, settings)
    n = len(hand.actuators)
    controller.apply(SetActive(dict.fromkeys(hand.actuator_names, True)), 0.0)
    controller.accept(make_plan(Goal(Named("Trig", ("index",))), hand, library, settings), 0.0)
    unmeasured = [math.nan] * n

    def step(each: Controller, tick: int, position: list[float]) -> list[float]:
        measured = Measured(position, unmeasured, unmeasured, [True] * n, [-1] * n)
        each.step(tick * settings.period, measured)
        return list(each.reference_position)

    position = [actuator.rest for actuator in hand.actuators]
    for tick in range(12):
        position = step(controller, tick, position)
    controller.apply(Cancel(""), 0.13)
    position = step(controller, 12, position)
    assert controller.moving
    again = Controller(hand, settings)
    restore(again, json.loads(to_bytes(capture(controller)))["nodes"])
    for tick in range(13, 30):
        place = position
        position = step(controller, tick, place)
        assert step(again, tick, place) == position


def test_a_goal_for_a_moving_hand_is_planned_once(
    hand: Hand, library: ActionLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    jerk_limited = pytest.importorskip("rtee.loop.profiles.jerk_limited", exc_type=ImportError)
    settings = LoopSettings(rate=100.0, profile=ProfileSettings(ProfileKind.JERK_LIMITED))
    controller = Controller(hand, settings)
    controller.apply(SetActive(dict.fromkeys(hand.actuator_names, True)), 0.0)
    n, profile, planned = len(hand.actuators), jerk_limited.JerkLimited, list[object]()
    plan, unmeasured = profile._plan, [math.nan] * n
    monkeypatch.setattr(profile, "_plan", lambda each: (planned.append(each), plan(each)))
    for tick in range(20):
        if tick in (1, 10):
            goal = Goal(Named("Trig", ("index",)), Intensity(1.0 if tick == 1 else 0.1))
            plan_of = make_plan(goal, hand, library, settings)
            assert controller.moving == (tick == 10)
            planned.clear()
            controller.accept(plan_of, tick * settings.period)
            assert len(planned) == 1
        position = list(controller.reference_position)
        measured = Measured(position, unmeasured, unmeasured, [True] * n, [-1] * n)
        controller.step(tick * settings.period, measured)


def test_a_state_from_a_file_calls_back_nothing_but_what_a_controller_does(hand: Hand) -> None:
    settings = LoopSettings(rate=100.0)
    nodes = json.loads(to_bytes(capture(Controller(hand, settings))))["nodes"]
    restore(Controller(hand, settings), nodes)
    for before, now in _MOVED.items():  # the modules that earlier recordings name
        nodes = json.loads(json.dumps(nodes).replace(f"{now}:", f"{before}:", 1))
    restore(Controller(hand, settings), nodes)
    places = [place for place, (kind, *_) in enumerate(nodes) if kind == "method"]
    assert places
    for place in places:
        _, owner, name = nodes[place]
        for tampered in (["method", owner, "__init__"], ["method", [0], "accept"]):
            nodes[place] = tampered
            with pytest.raises(LogError, match="invalid state"):
                restore(Controller(hand, settings), nodes)
        nodes[place] = ["method", owner, name]
