from __future__ import annotations

import fcntl
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtee.actions.build import full_posture, generic
from rtee.actions.describe import described
from rtee.actions.fingerprints import Fingerprints
from rtee.actions.types import (
    ActionKind,
    ActionReference,
    Primitive,
    PrimitiveKind,
)
from rtee.errors import ConfigError
from rtee.gui.colours import GOOD, WARN, line_colour, line_dash, link_colours, ramp, rgb
from rtee.gui.history import LONGEST, POINTS, StateHistory, nice_range
from rtee.gui.panels.actions import grouped
from rtee.gui.panels.header import device_line
from rtee.gui.panels.recordings import files_in
from rtee.gui.panels.table import table
from rtee.gui.trial_results import Tried, key_of, line, tried_in, verdict
from rtee.gui.trial_results import table as tried_table
from rtee.gui.wording import outcome, short_names, units
from rtee.hand.load import load_hand, load_model
from rtee.hand.model import Hand
from rtee.messages.state import State
from rtee.remote.hand_info import info_fields, info_of
from rtee.remote.model import from_info
from rtee.trials.result import Trial, TrialResult
from rtee.trials.store import write_results
from rtee.types import DeviceStatus, Lifecycle, Result, Shortfall

WEAK = Result(
    "1",
    "a",
    grasped=True,
    grasped_fingers=("index",),
    force=1.1,
    force_error=0.3,
    force_source="tip forces",
    force_asked=4.0,
    shortfall=Shortfall.END_OF_MOTION,
)


@pytest.fixture(scope="module")
def hand() -> Hand:
    return load_hand("schunk_svh")


def _state(stamp: float, value: float, n: int = 2, m: int = 3) -> State:
    full = np.full(n, value)
    return State(
        tick=0,
        stamp=stamp,
        wall_ns=0,
        names=tuple("ab"[:n]),
        position=full,
        velocity=full,
        effort=full,
        current=full,
        temperature=full,
        grasped=np.zeros(n, dtype=np.int8),
        fresh=np.ones(n, dtype=bool),
        reference_position=full + 1.0,
        reference_velocity=full,
        reference_effort=full,
        joint_names=tuple("xyz"[:m]),
        joint_position=np.full(m, value),
        channels={},
    )


def test_names_lose_what_all_begin_with() -> None:
    assert short_names(["left_hand_Pinky", "left_hand_Ring_Finger"]) == ("Pinky", "Ring_Finger")
    assert short_names(["palm_a", "palm_b", "thumb"]) == ("palm_a", "palm_b", "thumb")
    assert short_names(["joint_1", "joint_12"]) == ("1", "12")
    assert short_names(["left_", "left_x"]) == ("left_", "left_x")
    assert short_names(["alone"]) == ("alone",)
    assert short_names(["same", "same"]) == ("same", "same")


def test_actions_stand_by_kind_and_name(hand: Hand) -> None:
    posture = full_posture(hand, {hand.actuator_names[1]: 0.1})
    poke = generic(hand, "poke", {hand.actuator_names[0]: hand.actuators[0].upper})
    trig = [Primitive(PrimitiveKind.TRIG, (finger,), (posture,)) for finger in ("index", "thumb")]
    groups = grouped([poke, *trig])
    assert list(groups) == [(ActionKind.PRIMITIVE, "Trig"), (ActionKind.GENERIC, "poke")]
    assert groups[ActionKind.PRIMITIVE, "Trig"] == trig


@pytest.mark.parametrize("ignored", [(), ("motor_thumb",)])
def test_a_hand_that_describes_itself_has_the_same_actuators(ignored: tuple[str, ...]) -> None:
    """Its passive and ignored joints are told by their absence alone."""
    known = load_hand("heri_ii")
    srdf = known.urdf.path.with_suffix(".srdf")
    hand = load_model(known.urdf.path, srdf, name="heri_ii", ignore=ignored)
    info = info_of(info_fields(hand, {}))
    again = from_info(info)
    assert again.actuator_names == hand.actuator_names
    assert again.joint_names == hand.joint_names
    u = 0.5 * (hand.lower + hand.upper)
    assert np.allclose(again.transmission.joints(u), hand.transmission.joints(u))


def test_a_use_is_described_as_people_write_it() -> None:
    assert described(ActionReference("Trig", ("thumb",), 0.3)) == "Trig thumb × 0.3"
    assert described(ActionReference("fist")) == "fist"


@pytest.mark.parametrize(
    ("result", "words"),
    [
        (Result("1", "a", reached=True), "reached"),
        (
            Result("1", "a", stalled=True, grasped=True, grasped_fingers=("index",)),
            "held by index",
        ),
        (Result("1", "a", reached=True, touched=("thumb", "index")), "touched by thumb, index"),
        (Result("1", "a", cancelled=True, touched=("thumb",)), "cancelled"),
        (Result("1", "a", cancelled=True), "cancelled"),
        (Result("1", "a", preempted=True), "pre-empted by another goal"),
        (Result("1", "a", timed_out=True), "timed out"),
        (Result("1", "a", stalled=True), "stalled"),
        (Result("1", "a", aborted=True, reason="the link is lost"), "aborted: the link is lost"),
        (
            replace(WEAK, shortfall=Shortfall.NONE, opening=0.03, opening_error=0.0013),
            "held by index at 30.0 ± 1.3 mm with 1.1 ± 0.3 N, by the tip forces",
        ),
        (
            WEAK,
            "held by index with 1.1 ± 0.3 N of 4.0 N asked, by the tip forces: the fingers are at"
            " the end of their motion",
        ),
    ],
)
def test_a_result_is_said_in_words(result: Result, words: str) -> None:
    assert outcome(result)[0] == words


def test_a_force_that_is_less_than_the_requested_one_is_no_plain_success() -> None:
    assert WEAK.succeeded
    assert outcome(replace(WEAK, shortfall=Shortfall.NONE))[1] == GOOD
    assert outcome(WEAK)[1] == WARN


def test_a_device_line_says_fault_and_hint_and_escapes_them() -> None:
    status = DeviceStatus(
        "arm<1>",
        "schunk_svh",
        Lifecycle.FAULT,
        fault_code=7,
        fault_name="overcurrent",
        hint="recover it",
    )
    line = device_line(status)
    assert "arm&lt;1&gt;" in line
    assert "fault 7 (overcurrent); recover it" in line


def test_a_table_escapes_names() -> None:
    assert "&lt;b&gt;" in table(("name", "n"), [["<b>", "1"]])


def test_history_keeps_the_newest_and_thins() -> None:
    history = StateHistory(2, 3, rate=100.0)
    assert [len(line) for line in history.window("position", (0, 1), 10.0)] == [0, 0, 0]
    size = history._values["position"].nbytes
    for i in range(7000):
        history.add(_state(0.01 * i, float(i)), np.full(3, 2.0 * i))
    time, first = history.window("position", (0,), LONGEST)
    assert POINTS // 2 <= len(time) <= POINTS
    assert time[-1] <= 0.0
    assert time[0] >= -LONGEST
    assert first[0] >= 999.0, "what is older has been overwritten"
    assert history._values["position"].nbytes == size
    _, reference = history.window("reference", (1,), 1.0)
    _, joint = history.window("joint_position", (2,), 1.0)
    assert np.array_equal(reference, joint + 1.0)
    _, speed = history.window("joint_velocity", (2,), 1.0)
    assert np.array_equal(speed, 2.0 * joint)


def test_history_begins_anew_with_the_clock_of_the_hands_computer() -> None:
    history = StateHistory(2, 3)
    for stamp in (9000.0, 9000.01, 20.0, 20.01):
        history.on_result(Result(f"{stamp}", "Grasp", reached=True, duration=0.005))
        history.add(_state(stamp, stamp), np.zeros(3))
    time, value = history.window("position", [0], 10.0)
    assert time == pytest.approx([-0.01, 0.0])
    assert value == pytest.approx([20.0, 20.01])
    assert [span.goal_id for span in history.spans(10.0)] == ["20.01"]


def test_actions_are_spans_of_the_time_in_the_plots() -> None:
    history = StateHistory(1, 1)
    history.add(_state(10.0, 0.0, 1, 1), np.zeros(1))
    history.on_goal("a", "Grasp")
    history.add(_state(12.0, 0.0, 1, 1), np.zeros(1))
    assert [(s.name, s.start, s.end) for s in history.spans(10.0)] == [("Grasp", -2.0, 0.0)]
    history.on_result(Result("a", "Grasp", reached=True, duration=1.5))
    history.on_goal("a", "Grasp")  # asked for before it ended
    history.add(_state(13.0, 0.0, 1, 1), np.zeros(1))
    history.on_goal("", "")
    assert [(s.start, s.end, s.outcome) for s in history.spans(10.0)] == [(-2.5, -1.0, "reached")]
    assert history.spans(1.0) == []


def test_thinning_keeps_the_same_points_as_time_goes_on() -> None:
    history = StateHistory(1, 1, rate=100.0)
    for i in range(1000):
        history.add(_state(0.01 * i, float(i), 1, 1), np.zeros(1))
    before = set(history.window("position", (0,), 9.0)[1].tolist())
    history.add(_state(10.0, 1000.0, 1, 1), np.zeros(1))
    after = set(history.window("position", (0,), 9.0)[1].tolist())
    assert len(after - before) <= 1


@pytest.mark.parametrize(
    "values", [[0.0], [0.03, 1.17], [-250.0, 1.0], [1e-9, 2e-9], [36.5, 36.6, np.nan]]
)
def test_a_range_holds_its_values_and_is_round(values: list[float]) -> None:
    low, high = nice_range([np.array(values)], 0.1)
    known = [v for v in values if np.isfinite(v)]
    assert low <= min(known)
    assert high >= max(known)
    assert high - low >= 0.0999
    assert high - low <= 3.1 * max(max(known) - min(known), 0.1)


def test_a_range_of_nothing_is_still_a_range() -> None:
    assert nice_range([np.full(3, np.nan)], 0.1) == (0.0, 0.1)
    assert nice_range([], 5.0) == (0.0, 5.0)


def test_units_are_those_of_the_actuators() -> None:
    assert units("position", {"revolute", "continuous"}) == "rad"
    assert units("effort", ["prismatic"]) == "N"
    assert units("velocity", ["prismatic", "revolute"]) == "rad/s | m/s"
    assert units("temperature", ["prismatic", "revolute"]) == "°C"


def test_lines_of_one_colour_differ_in_their_dashes() -> None:
    looks = {(line_colour(i), line_dash(i)) for i in range(28)}
    assert len(looks) == 28


def test_fingers_have_their_colours(hand: Hand) -> None:
    colours = link_colours(hand)
    assert set(colours) == set(hand.urdf.links)
    assert len(set(colours.values())) == len(hand.fingers) + 1
    assert rgb("#0072b2") == (0, 114, 178)
    assert ramp(-1.0) == ramp(0.0) != ramp(1.0) == ramp(2.0)


def test_only_recordings_of_the_hand_are_offered_the_complete_ones_first(tmp_path: Path) -> None:
    for day in ("1", "2", "3"):
        (tmp_path / f"svh_2026010{day}T000000000Z_000.mcap").write_bytes(b"")
    (tmp_path / "other_20260101T000000000Z_000.mcap").write_bytes(b"")
    (tmp_path / "notes.json").write_text("{}")
    with (tmp_path / "svh_20260103T000000000Z_000.mcap").open() as written:
        fcntl.flock(written, fcntl.LOCK_EX)
        found = files_in(tmp_path, "svh")
    assert [name[:12] for name in found] == ["svh_20260102", "svh_20260101", "svh_20260103"]
    assert files_in(tmp_path / "nowhere", "svh") == {}


def test_trials_are_found_by_action_and_counted(hand: Hand, tmp_path: Path) -> None:
    file = tmp_path / "trials.yaml"
    results = [
        TrialResult(Trial("Trig", ("index",), "sphere:0.01"), False, reason="it slipped <out>"),
        TrialResult(Trial("Trig", ("index",), "sphere:0.03"), True),
        TrialResult(Trial("fist", (), "drill"), True),
    ]
    write_results(file, Fingerprints("0"), results)
    tried = tried_in(file.read_text() + "present: '0'\n")
    found = tried.results
    posture = full_posture(hand, {hand.actuator_names[1]: 0.1})
    trig = Primitive(PrimitiveKind.TRIG, ("index",), (posture,))
    assert line(found[key_of(trig)]) == "in simulation: held 1 of 2 objects"
    assert line(found["fist", ()]) == "in simulation: held 1 of 1 object"
    picture = tried_table(found[key_of(trig)])
    assert picture.index("sphere:0.03") < picture.index("sphere:0.01"), "what was held comes first"
    assert "it slipped &lt;out&gt;" in picture
    assert not tried.outdated
    assert tried_in(file.read_text() + "present: '1'\n").outdated == {
        result.trial.key for result in results
    }
    earlier = re.sub(r"(?m)^method: .*\n", "", file.read_text())
    assert tried_in(earlier + "present: '0'\n").outdated, "made before methods were numbered"
    assert line(found["fist", ()], outdated=True) == "in simulation: held 1 of 1 object, outdated"
    assert tried_in("") == Tried()
    with pytest.raises(ConfigError, match="not results of trials"):
        tried_in("trials: [1]")


@pytest.mark.parametrize("held", [-1, 11])
def test_more_variations_held_than_there_were_are_no_results(tmp_path: Path, held: int) -> None:
    file = tmp_path / "trials.yaml"
    varied = TrialResult(Trial("fist", (), "drill", variations=10), True, survived=9)
    write_results(file, Fingerprints("0"), [varied])
    assert verdict(*tried_in(file.read_text()).results["fist", ()]).startswith("held, 9 of 10")
    with pytest.raises(ConfigError, match=f"{held} of 10 variations"):
        tried_in(file.read_text().replace("held: 9", f"held: {held}"))
