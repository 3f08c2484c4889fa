"""The loop's controller on a simulation without a clock: the same ends, the same recordings."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")

from rtee.actions.build import generic
from rtee.actions.library import ActionLibrary
from rtee.buses.pool import BusPool
from rtee.drivers.kinematic.driver import KinematicDriver
from rtee.drivers.mujoco.options import SimOptions
from rtee.drivers.mujoco.scene import TipsClosing, make_simulation
from rtee.errors import UnknownAction
from rtee.hand.catalog import hand_names
from rtee.hand.load import hand_folder, load_configured
from rtee.hand.model import Hand
from rtee.log import Recorder, RecorderSettings, Recording, read
from rtee.log.check import check
from rtee.loop.settings import loop_settings
from rtee.trials.bench import bench, recorder_for
from rtee.trials.grasp_placement import Places
from rtee.trials.headless import HeadlessHand
from rtee.types import Around, DeviceSpec, Force, Goal, Intensity, Named, Reference

pytestmark = pytest.mark.anyio


def start(
    name: str, rate: float = 200.0, folder: Path | None = None, **options: object
) -> HeadlessHand:
    hand, config = load_configured(name)
    library = ActionLibrary.load(hand, hand_folder(name)[0] / "actions")
    settings = loop_settings(config, rate=rate)
    names = hand.actuator_names
    simulation = make_simulation(hand, SimOptions(**options), names, settings.period)
    observers = []
    if folder is not None:
        recorder = Recorder(
            hand, RecorderSettings(folder, queue_time=1e6), rate=rate, loop=settings
        )
        recorder.open()
        observers.append(recorder)
    return HeadlessHand(hand, library, settings, simulation, observers)


def a_little(hand: Hand, share: float = 0.2) -> dict[str, float]:
    """Return a posture on the way to which nothing touches."""
    upper = np.where(np.isfinite(hand.upper), hand.upper, 1.0)
    position = hand.rest + share * (upper - hand.rest)
    return dict(zip(hand.actuator_names, position.tolist(), strict=True))


async def kinematic_end(hand: Hand, goal: dict[str, float]) -> np.ndarray:
    spec = DeviceSpec("dummy", hand.name, "kinematic", hand.actuators)
    driver = KinematicDriver(spec, BusPool())
    clock = [0.0]
    driver.now = lambda: clock[0]
    await driver.configure()
    await driver.activate()
    reference = Reference.at([goal[name] for name in hand.actuator_names])
    for _ in range(2000):
        clock[0] += 0.005
        state = await driver.sense()
        await driver.move(reference)
    return state.position


@pytest.mark.samples("robotiq_2f_85", "schunk_svh", "qb_softhand")
@pytest.mark.parametrize("name", hand_names())
async def test_the_same_goal_ends_where_the_kinematic_hand_ends(name: str) -> None:
    headless = start(name)
    goal = a_little(headless.hand)
    headless.library.add(generic(headless.hand, "a_little", goal))
    result = headless.do(Goal(Named("a_little")))
    assert result.reached, result
    headless.wait(0.3)
    kinematic = await kinematic_end(headless.hand, goal)
    assert headless.simulation.position == pytest.approx(kinematic, abs=0.02)


def test_a_timed_action_runs_through() -> None:
    # Without an object its fingertips meet the palm before they are closed.
    headless = start("robotiq_3f", object="cylinder:0.045x0.12")
    result = headless.do(Goal(Named("timed_wide_grasp")))
    assert result.succeeded
    assert result.grasped


@pytest.mark.parametrize(
    ("name", "action", "elements"),
    [
        ("ability_hand", "PinchTight", ("thumb", "middle")),  # the thumb is pushed back
        ("ability_hand", "Trig", ("index",)),  # it meets the palm
        ("schunk_svh", "MultiPinchTight_3", ("index", "middle", "ring")),
    ],
)
def test_an_empty_hand_closes_on_itself(name: str, action: str, elements: tuple[str, ...]) -> None:
    headless = start(name)
    for _ in range(2):  # the second time, from where its fingers push one another
        result = headless.do(Goal(Named(action, elements)))
        assert result.outcome == "closed"
        assert result.grasped_fingers == ()


def test_a_finger_that_meets_those_of_the_action_before_holds_nothing() -> None:
    headless = start("schunk_svh")
    headless.do(Goal(Named("MultiPinchTight_3", ("thumb", "ring", "pinky"))))
    assert headless.do(Goal(Named("Trig", ("thumb",)))).outcome == "closed"


def test_a_pinch_that_an_object_stops_before_the_fingers_meet_holds_it() -> None:
    headless = start("schunk_svh", object="sphere:0.02", carrier="lift")
    simulation, action = headless.simulation, headless.library.find("PinchTight", ("thumb", "ring"))
    (place,) = Places(simulation, headless.hand, action).find(1)
    simulation.reset()
    around = simulation.surroundings
    around.place(around.base_pose @ place.pose)
    result = headless.do(Goal(Named(action.name, action.elements)))
    assert result.outcome == "held"
    assert set(result.grasped_fingers) == {"thumb", "ring"}


def test_the_lag_of_fingers_is_learned_to_be_kept() -> None:
    headless = start("schunk_svh")
    headless.do(Goal(Named("Grasp")))
    lags = [learned.lag for learned in headless.controller.learned_motion.values()]
    assert lags
    assert all(0.0 < lag < 0.5 for lag in lags)


def test_an_unknown_action_is_refused() -> None:
    with pytest.raises(UnknownAction):
        start("robotiq_2f_85").do(Goal(Named("Wave")))


def test_a_recording_at_simulated_time_says_when_it_was_made(tmp_path: Path) -> None:
    ready = bench("robotiq_2f_85")
    settings = ready.settings
    simulation = make_simulation(
        ready.hand, SimOptions(), ready.hand.actuator_names, settings.period
    )
    before = time.time_ns()
    with recorder_for(ready, tmp_path) as recorder:
        headless = HeadlessHand(ready.hand, ready.library, settings, simulation, [recorder])
        headless.do(Goal(Named("Grasp")))
        duration = headless.time
    recording = read(next(tmp_path.glob("*.mcap")))
    assert before <= recording.start <= time.time_ns()
    assert recording.duration == pytest.approx(duration, abs=2 * settings.period)
    walls = [entry.wall for entry in [*recording.commands, *recording.goals, *recording.results]]
    assert walls
    assert all(recording.start <= wall <= recording.end for wall in walls)


def test_two_runs_are_recorded_bit_for_bit_alike(tmp_path: Path) -> None:
    recordings: list[Recording] = []
    for run in ("one", "two"):
        headless = start("robotiq_2f_85", folder=tmp_path / run)
        headless.do(Goal(Named("Grasp"), goal_id="first"))
        headless.wait(0.2)
        for recorder in headless.observers:
            recorder.close()
        recordings.append(read(next((tmp_path / run).glob("*.mcap"))))
    first, second = recordings
    for name in ("position", "velocity", "effort"):
        one, two = getattr(first.actuator_states, name), getattr(second.actuator_states, name)
        assert len(one) > 50
        assert one.tobytes() == two.tobytes()
    assert [e.value for e in first.results] == [e.value for e in second.results]


def test_a_recording_at_simulated_time_can_be_computed_anew(tmp_path: Path) -> None:
    first = start("robotiq_2f_85", folder=tmp_path, object="sphere:0.03")
    (recorder,) = first.observers
    first.do(Goal(Named("Grasp"), goal_id="first"))
    first.start(Goal(Named("open"), goal_id="second"))  # ends as pre-empted
    first.wait(0.05)
    first.do(Goal(Named("Grasp"), Intensity(0.5), goal_id="third"))
    # As a trial at another place of the object: a hand of its own in the same recording.
    ready = bench("robotiq_2f_85")
    first.simulation.reset()
    again = HeadlessHand(
        first.hand,
        ready.library,
        loop_settings(load_configured("robotiq_2f_85")[1], rate=200.0),
        first.simulation,
        [recorder],
        ticks=first.ticks,
    )
    again.do(Goal(Named("Grasp"), goal_id="again"))
    recorder.close()
    recording = read(next(tmp_path.glob("*.mcap")))
    assert recording.actuator_states.tick[0] == 0
    found = check(recording)
    assert found.same, found
    assert (found.goals, found.missing) == (4, 0)
    assert found.ticks == again.ticks


@pytest.mark.parametrize(("name", "width"), [("onrobot_rg2", 30), ("robotiq_2f_85", 50)])
def test_an_object_stands_where_the_gripper_closes_on_it(name: str, width: int) -> None:
    """What is measured is what is held: links beside the fingertips' pads don't meet it first."""
    hand, config = load_configured(name)
    library = ActionLibrary.load(hand, hand_folder(name)[0] / "actions")
    settings = loop_settings(config, rate=500.0)
    options = SimOptions(object=f"box:{width}e-3x{width}e-3x0.05")
    closing = TipsClosing.of(hand, library)
    simulation = make_simulation(
        hand, options, hand.actuator_names, settings.period, closing=closing
    )
    headless = HeadlessHand(hand, library, settings, simulation)
    result = headless.do(
        Goal(Named("PinchTight", ("finger_1", "finger_2")), Around(width / 1e3), effort=Force(20.0))
    )
    assert (result.grasped, result.within) == (True, True)
    assert result.opening == pytest.approx(width / 1e3, abs=1e-3)
