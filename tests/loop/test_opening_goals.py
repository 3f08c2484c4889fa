"""Goals in millimetres and newtons: refusals, best action, results, and replays bit for bit."""

from __future__ import annotations

import math
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rtee.actions import openings
from rtee.actions.library import ActionLibrary, load_actions
from rtee.actions.openings import FILE_NAME
from rtee.actions.types import Generic, Posture
from rtee.buses.pool import BusPool
from rtee.drivers.capabilities import GripForce
from rtee.drivers.kinematic.driver import KinematicDriver
from rtee.errors import ActionError, GoalRejected, UnknownAction
from rtee.hand.load import load_configured
from rtee.log.plans import encode_plan, plan_of
from rtee.loop.clock import ManualClock
from rtee.loop.forces import DeviceForces
from rtee.loop.grip import EFFORT, LIMIT, TIPS, Grip
from rtee.loop.handloop import HandLoop
from rtee.loop.observer import Observer
from rtee.loop.plan import Plan
from rtee.loop.planning import FoundActions, make_plan
from rtee.loop.settings import loop_settings
from rtee.messages.goals import goal_of
from rtee.messages.schema import message_type
from rtee.types import (
    Around,
    Fingers,
    FirstContact,
    Goal,
    Named,
    OnContact,
    Opening,
    Stage,
)

from .hands import Rig, Watcher, device

CONFIG = Path(__file__).parents[2] / "config"
NAN = float("nan")


def plan(name: str, goal: Goal, devices: DeviceForces | None = None) -> Plan:
    hand, config = load_configured(CONFIG / name)
    library = ActionLibrary.load(hand, CONFIG / name / "actions")
    return make_plan(goal, hand, library, loop_settings(config), devices=devices or DeviceForces())


def grasp(width: float, force: float | None = None, **more: Any) -> Goal:
    return goal_of(**{"action": "Grasp", "grasp": True, "opening": width, "force": force, **more})


def test_actions_for_a_moment_leave_nothing_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(openings, "_MOST_KNOWN", 5)
    library = load_actions(CONFIG / "robotiq_2f_85")
    found = library.openings
    posture = library.find("Grasp").waypoints[-1]
    for number in range(20):
        assert found.find(Generic(f"grasp_at_{number}", posture)) is None
        assert found.of(library.find("Grasp")).action == "Grasp"
    assert len(found._known) <= 5


def test_goals_leave_nothing_behind() -> None:
    hand, config = load_configured(CONFIG / "robotiq_2f_85")
    library = ActionLibrary.load(hand, CONFIG / hand.name / "actions")

    def size(times: int) -> int:
        for _ in range(times):
            make_plan(Goal(Named("open")), hand, library, loop_settings(config))
        return len(library.openings._known)

    assert size(1) == size(2)


@pytest.mark.anyio
async def test_no_goal_waits_for_a_file(monkeypatch: pytest.MonkeyPatch) -> None:
    hand, config = load_configured(CONFIG / "robotiq_2f_85")
    library = ActionLibrary.load(hand, CONFIG / hand.name / "actions")
    one = device(hand, rate=1000.0)
    driver = KinematicDriver(one.spec, BusPool())
    async with HandLoop(hand, library, loop_settings(config), [(one, driver)]) as loop:
        await loop.ready()

        def read(*_: object) -> None:
            raise AssertionError("a file is read while the loop runs")

        monkeypatch.setattr("rtee.actions.openings.read_openings", read)
        loop.submit(grasp(0.03))


def test_an_action_is_found_once_until_something_changes(tmp_path: Path) -> None:
    folder = tmp_path / "robotiq_2f_85"
    shutil.copytree(CONFIG / folder.name, folder)
    hand, config = load_configured(folder)
    library = ActionLibrary.load(hand, folder / "actions")
    settings, found, devices = loop_settings(config), FoundActions(), DeviceForces()

    def planned(goal: Goal) -> Plan:
        fresh = make_plan(goal, hand, library, settings, devices=devices)
        plan = make_plan(goal, hand, library, settings, devices=devices, found=found)
        assert plan == fresh
        return plan

    before = planned(grasp(0.03)).grip
    assert before is not None
    assert planned(grasp(0.05, 20.0)).grip is before
    # Another posture of the same action.
    rest = dict(zip(hand.actuator_names, hand.rest.tolist(), strict=True))
    wave, other = Goal(Named("wave")), rest | {"finger_joint": 0.3}
    with pytest.raises(UnknownAction):
        planned(wave)
    library.add(Generic("wave", Posture(rest, hand.actuator_names)))
    assert planned(wave).legs[0].targets == {0: 0.0}
    library.add(Generic("wave", Posture(other, hand.actuator_names)), replace_same=True)
    assert planned(wave).legs[0].targets == {0: 0.3}
    library.remove("wave")
    with pytest.raises(UnknownAction):
        planned(wave)
    # Openings made anew, and devices that state their force.
    tables = Path(library.folder.parent / FILE_NAME) if library.folder else Path()
    os.utime(tables, ns=(0, tables.stat().st_mtime_ns + 1))
    assert planned(grasp(0.03)).grip is not before
    devices = DeviceForces(grips={0: GripForce((0.1, 1.0), (20.0,), (235.0,))})
    grip = planned(grasp(0.03)).grip
    assert grip is not None
    assert grip.sheet is devices.grips[0]
    tables.unlink()
    with pytest.raises(ActionError, match="are not known"):
        planned(grasp(0.03))


def test_spellings_of_actions_do_not_add_up() -> None:
    hand, config = load_configured(CONFIG / "robotiq_2f_85")
    library = ActionLibrary.load(hand, CONFIG / hand.name / "actions")
    found, most = FoundActions(), 0
    for n in range(300):
        goal = Goal(Named("Grasp" + "_" * n))
        make_plan(goal, hand, library, loop_settings(config), found=found)
        most = max(most, len(found._found[3]))
    assert most <= 64


@pytest.mark.parametrize(
    ("asked", "reason"),
    [
        ({"width": NAN}, "the width must be 0 m or more, not nan"),
        ({"width": -0.01}, "the width must be 0 m or more"),
        ({"width": 0.2}, r"opens 0.0 to 86.0 mm, not 200.0 mm; the nearest is 86.0 mm"),
        (
            {"width": 0.2, "action": ""},
            r"no action of 'robotiq_2f_85' holds .* nearest is 86.0 mm, by",
        ),
        ({"force": 900.0}, r"at most 222 N at an opening of 30 mm, not 900 N; the nearest is"),
        ({"force": NAN}, "the force must be above 0 N, not nan"),
        ({"force": 0.0}, "the force must be above 0 N"),
        ({"force": math.inf}, "the force must be above 0 N, not inf"),
        ({"tip_speed": 9.0}, "opens and closes at .* mm/s at most"),
        ({"tip_speed": NAN}, "the speed must be above 0 m/s"),
        ({"narrower": NAN}, "the tolerance 'narrower' must be 0 m or more"),
        ({"intensity": 0.5}, "an intensity or an opening, not both"),
        ({"stage": Stage.GRASP}, "a stage or an opening, not both"),
        ({"elements": ("ring",), "action": ""}, "unknown finger 'ring'"),
        ({"width": None, "grasp": False, "force": 10.0}, "a force needs the opening"),
        ({"width": None, "grasp": False, "tip_speed": 0.1}, "a speed in m/s needs the opening"),
        ({"width": None}, "a grasp needs the width of the object"),
        ({"force": 30.0, "effort": {"finger_joint": 1.0}}, "efforts or a force, not both"),
    ],
)
def test_what_cannot_be_is_refused_with_the_nearest_that_can(
    asked: dict[str, Any], reason: str
) -> None:
    with pytest.raises(GoalRejected, match=reason):
        plan("robotiq_2f_85", grasp(**{"width": 0.03, **asked}))


def test_an_action_without_an_opening_is_refused_with_the_command_that_makes_one() -> None:
    with pytest.raises(ActionError, match="`rtee openings schunk_svh --save`"):
        plan("schunk_svh", Goal(Named("Trig", ("index",)), Opening(0.03)))


def test_an_opening_is_a_single_way_to_its_intensity() -> None:
    found = plan("robotiq_2f_85", Goal(Named("Grasp"), Opening(0.04)))
    [leg] = found.legs
    assert found.grip is not None
    assert found.grip.opening([leg.targets[0]]) == pytest.approx(0.04, abs=1e-4)
    assert not found.effort


def test_a_grasp_opens_by_a_margin_then_closes_with_the_effort_of_the_force() -> None:
    found = plan("robotiq_2f_85", grasp(0.03, 50.0, tip_speed=0.05))
    opens, closes = found.legs
    assert found.grip is not None
    assert found.grip.opening([opens.targets[0]]) == pytest.approx(0.04, abs=1e-4)
    assert closes.targets[0] > 0.8
    # By virtual work: 50 N times the slope of the opening, 111 mm/rad.
    assert found.effort[0] == pytest.approx(50.0 * 0.1126, rel=0.02)
    assert 0.0 < found.speed < 1.0


def test_the_sheet_of_a_device_comes_before_the_geometry() -> None:
    sheet = GripForce((2.0, 24.0), (20.0,), (235.0,))
    devices = DeviceForces(grips={0: sheet})
    assert plan("robotiq_2f_85", grasp(0.03, 20.0), devices).effort == {0: pytest.approx(2.0)}
    with pytest.raises(GoalRejected, match=r"at least 20 N .*not 10 N; the nearest is 20 N"):
        plan("robotiq_2f_85", grasp(0.03, 10.0), devices)


class WithSheet(KinematicDriver):
    """A kinematic device whose data sheet has a force."""

    SHEET = GripForce((2.0, 24.0), (20.0,), (235.0,))

    def __init__(self, *arguments: object) -> None:
        super().__init__(*arguments)  # type: ignore[arg-type]
        self.capabilities = replace(self.capabilities, grip={"finger_joint": self.SHEET})


@pytest.mark.anyio
@pytest.mark.parametrize(
    "goal",
    [
        Goal(Named("Grasp"), FirstContact()),
        Goal(Named("Grasp"), on_contact={"": OnContact.SQUEEZE}),
        grasp(0.03),
    ],
)
async def test_goals_that_feel_contacts_know_the_sheet_of_the_device(goal: Goal) -> None:
    hand, config = load_configured(CONFIG / "robotiq_2f_85")
    library = ActionLibrary.load(hand, CONFIG / "robotiq_2f_85" / "actions")
    settings, clock = loop_settings(config), ManualClock(config.loop.rate)
    one = device(hand, rate=settings.rate)
    driver = WithSheet(one.spec, BusPool())
    driver.now = clock.now
    loop, plans = HandLoop(hand, library, settings, [(one, driver)], now=clock.now), list[Plan]()

    class Plans(Observer):
        def on_plan(self, plan: Plan, stamp: float) -> None:
            plans.append(plan)

    loop.add_observer(Plans())
    async with loop:
        await loop.ready()
        for _ in range(5):
            await clock.settle()
            loop.tick(clock.next())
        loop.submit(goal)
        loop.tick(clock.next())
        light = loop.controller.reference_effort[0]
    assert [plan.grip and plan.grip.sheet for plan in plans] == [WithSheet.SHEET]
    full = hand.actuators[0].effort
    assert light < 0.5 * full if isinstance(goal.to, FirstContact) else light == full, (
        "a touch is light on any device"
    )


@pytest.mark.anyio
async def test_goals_follow_what_a_device_says_of_itself_later() -> None:
    """A device may know its abilities only once it is connected again."""
    hand, config = load_configured(CONFIG / "robotiq_2f_85")
    library = ActionLibrary.load(hand, CONFIG / "robotiq_2f_85" / "actions")
    settings, clock = loop_settings(config), ManualClock(config.loop.rate)
    one = device(hand, rate=settings.rate)
    driver = KinematicDriver(one.spec, BusPool())
    driver.now = clock.now
    async with HandLoop(hand, library, settings, [(one, driver)], now=clock.now) as loop:
        await loop.ready()
        for _ in range(5):
            await clock.settle()
            loop.tick(clock.next())
        loop.submit(grasp(0.03, 100.0))
        for refuses, reason in (({"max_effort": "too weak"}, "too weak"), ({}, "no effort limit")):
            accepts = frozenset({"position"})
            driver.capabilities = replace(driver.capabilities, accepts=accepts, refuses=refuses)
            with pytest.raises(GoalRejected, match=reason):
                loop.submit(grasp(0.03, 100.0))


@pytest.mark.anyio
@pytest.mark.samples("10")
@pytest.mark.parametrize("every", [1, 10])
async def test_a_plate_thinner_than_a_stall_is_felt_however_seldom_a_device_is_read(
    every: int,
) -> None:
    folder = CONFIG / "schunk_egu"
    hand, config = load_configured(folder)
    settings = loop_settings(config)
    # Its motor stops 0.4 mm before the end, nearer than the tolerance of a stall.
    there = {hand.actuators[0].name: 0.99}
    options = {"objects": there, "full_effort_at": 0.002, "every": every}
    one = device(hand, rate=settings.rate, **options)  # type: ignore[arg-type]
    clock, watcher = ManualClock(settings.rate), Watcher()
    driver = KinematicDriver(one.spec, BusPool())
    driver.now = clock.now
    library = ActionLibrary.load(hand, folder / "actions")
    loop = HandLoop(hand, library, settings, [(one, driver)], now=clock.now)
    loop.add_observer(watcher)
    async with loop:
        await loop.ready()
        rig = Rig(loop, clock, watcher)
        await rig.run(0.05)
        loop.submit(grasp(0.002, force=20.0))
        result = await rig.result()
    assert (result.reached, result.grasped) == (False, True)


def test_devices_that_cannot_limit_an_effort_refuse_a_force() -> None:
    with pytest.raises(GoalRejected, match=r"takes no effort limit: none; the nearest is"):
        plan("robotiq_2f_85", grasp(0.03, 30.0), DeviceForces(refused={0: "none"}))
    with pytest.raises(
        GoalRejected, match=r"cannot be limited: its device cannot limit the effort"
    ):
        plan("robotiq_2f_85", grasp(0.03, 30.0), DeviceForces(unlimited=frozenset({0})))


def test_without_fingers_the_best_action_for_the_width_is_taken() -> None:
    found = plan("schunk_svh", Goal(Fingers(), Around(0.03)))
    assert "thumb" in found.elements
    only = plan("schunk_svh", Goal(Fingers(("ring", "thumb")), Around(0.03)))
    assert (only.action, set(only.elements)) == ("PinchTight", {"ring", "thumb"})
    with pytest.raises(GoalRejected, match=r"no action of index of 'schunk_svh'|no action of"):
        plan("schunk_svh", Goal(Fingers(("index",)), Around(0.03)))


def chosen(hand: str, width: float) -> tuple[str, ...]:
    return plan(hand, Goal(Fingers(), Around(width))).elements


def test_tips_that_stay_apart_are_not_taken_for_an_object_as_narrow() -> None:
    # Index and middle finger come as near as 9.6 mm, and can press on 10 mm only weakly.
    assert set(chosen("amazing_hand", 0.01)) == {"thumb", "index"}
    assert set(chosen("ability_hand", 0.012)) == {"thumb", "middle", "ring"}  # not thumb and pinky


@pytest.mark.parametrize("width", [0.026, 0.03, 0.035, 0.04, 0.045])
def test_a_finger_that_lags_behind_its_neighbour_is_left_out_for_a_small_object(
    width: float,
) -> None:
    # The middle finger is 18 mm behind the index finger, which would meet the object alone.
    assert set(chosen("qb_softhand", width)) == {"thumb", "index"}
    assert len(chosen("qb_softhand", 0.05)) == 3  # which turns by less
    assert len(chosen("robotiq_3f", width)) == 3  # whose two fingers arrive together


def test_a_recorded_plan_tells_opening_and_force_as_before() -> None:
    hand, _ = load_configured(CONFIG / "robotiq_2f_85")
    sheet = GripForce((2.0, 24.0), (20.0, 10.0), (235.0, 200.0), (0.0, 0.8))
    goal = grasp(0.03, 50.0, tip_speed=0.05)
    made = plan("robotiq_2f_85", goal, DeviceForces(grips={0: sheet}))
    data = encode_plan(made, hand.actuator_names, time=1.0, wall=2)
    read = plan_of(message_type("rtee_msgs/Plan").decode(data), goal, hand.actuator_names)
    assert read == made


def grip(hand_name: str = "robotiq_2f_85") -> Grip:
    found = plan(hand_name, grasp(0.03, 50.0)).grip
    assert found is not None
    return found


def test_the_force_is_estimated_from_the_best_that_is_measured() -> None:
    found = grip()
    at = [found.position_at(found.intensity_at(0.03))[0]]
    effort = [found.efforts(50.0, found.intensity_at(0.03))[0]]
    force, error, source = found.force(at, [NAN], effort, [50.0, 52.0], True)
    # Two sides press equally, but for what the object weighs, which one of them bears.
    assert (force, error, source) == (pytest.approx(51.0), pytest.approx(0.05 * 51.0 + 1.0), TIPS)
    force, error, source = found.force(at, effort, effort, [], True)
    assert (force, source) == (pytest.approx(50.0, rel=1e-6), EFFORT)
    assert error == pytest.approx(0.15 * 50.0)
    force, _, source = found.force(at, [NAN], effort, [NAN, NAN], True)
    assert (force, source) == (pytest.approx(50.0, rel=1e-6), LIMIT)
    assert math.isnan(found.force(at, [NAN], effort, [], False)[0])
