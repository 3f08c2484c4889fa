"""What is said to be true of a hand: from what was told of it, and by how old that is."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from rtee import monotonic
from rtee.messages.state import State
from rtee.remote.monitoring import HandStatus
from rtee.remote.truth import _OLDER, HeldObject, Tone, Truth
from rtee.types import DeviceStatus, Event, Lifecycle, LoopStatistics, Result, Shortfall

NOTHING = np.full(1, np.nan)
STATE = State(
    tick=0,
    stamp=0.0,
    wall_ns=0,
    names=("a",),
    **dict.fromkeys(("position", "velocity", "effort", "current", "temperature"), NOTHING),
    **dict.fromkeys(("reference_position", "reference_velocity", "reference_effort"), NOTHING),
    grasped=np.full(1, -1, np.int8),
    fresh=np.ones(1, bool),
    joint_names=("a",),
    joint_position=NOTHING,
    channels={},
)
PRESSED = replace(STATE, opening=0.0314, force=10.1, force_error=0.5, force_source="tip forces")
ACTIVE = DeviceStatus("line", "svh", Lifecycle.ACTIVE)
WEAK = Result("1", "Grasp", grasped=True, force_asked=20.0, shortfall=Shortfall.EFFORT_LIMIT)
HELD = Result("1", "Grasp", grasped=True, grasped_fingers=("index", "thumb"))


def status(**given: object) -> HandStatus:
    words = dict.fromkeys(("holder", "goal_id", "action", "recording", "recording_trouble"), "")
    fields = {"hand": "svh", "grip_effort": 0.4, "devices": (ACTIVE,)} | words | given
    return HandStatus(statistics=LoopStatistics(100.0), **fields)  # type: ignore[arg-type]


@pytest.fixture
def truth() -> Truth:
    found = Truth("svh")
    found.on_status(status())
    found.on_state(STATE)
    return found


def test_what_is_held_is_said_with_its_evidence(truth: Truth) -> None:
    assert truth.held().text == "not known whether something is held"
    truth.on_result(HELD)
    assert truth.held() == ("holding · by index, thumb", Tone.GOOD)
    truth.on_state(PRESSED)
    assert truth.held().text == "holding · 31.4 mm · 10.1 ± 0.5 N (tip sensors)"
    truth.on_event(Event("grasp_lost", "index", "index lost what it held", 0.0, "warning"))
    assert truth.held().tone is Tone.BAD
    assert truth.held().text.startswith("part lost by index ")
    truth.on_result(Result("2", "Open", reached=True))
    assert truth.held() == ("empty", Tone.PLAIN)


def test_a_force_that_is_less_than_the_requested_one_is_said_while_it_holds(truth: Truth) -> None:
    truth.on_result(WEAK)
    truth.on_state(PRESSED)
    words = "holding · 31.4 mm · 10.1 ± 0.5 N of 20.0 N asked (tip sensors)"
    assert truth.held() == (words, Tone.WARN)
    truth.on_state(replace(PRESSED, force=0.0, force_error=0.0))
    truth.on_state(replace(PRESSED, grasped=np.ones(1, np.int8)))  # something else, by the device
    assert truth.held().text == "holding · 31.4 mm · 10.1 ± 0.5 N (tip sensors)"


def test_what_sensors_feel_counts_without_a_result_and_against_one(truth: Truth) -> None:
    truth.on_state(PRESSED)  # a page that was opened while the hand held
    assert truth.grip is HeldObject.HOLDING
    truth.on_state(replace(PRESSED, force=0.0, force_error=0.0))
    assert truth.grip is HeldObject.LOST
    truth.on_state(replace(STATE, grasped=np.ones(1, np.int8)))  # the device's own word
    assert truth.grip is HeldObject.HOLDING
    truth.on_state(STATE)
    assert truth.grip is HeldObject.LOST
    truth.on_result(Result("2", "Open", reached=True))
    truth.on_state(replace(PRESSED, force_source="effort"))  # an estimate is no evidence
    assert truth.grip is HeldObject.EMPTY


def test_a_force_that_may_be_the_hands_own_is_no_object(truth: Truth) -> None:
    truth.on_state(replace(PRESSED, opening=0.0))
    assert truth.grip is HeldObject.UNKNOWN
    truth.on_result(Result("1", "PinchTight", unknown=True))
    truth.on_state(replace(PRESSED, opening=0.002))
    assert truth.held().text == "not known whether something is held"
    # Moved by other means than a goal of which a result would tell.
    truth.on_status(status(goal_id="2", action="Grasp"))
    truth.on_status(status())
    truth.on_state(PRESSED)
    assert truth.grip is HeldObject.HOLDING


def test_what_was_held_is_not_known_while_something_moves(truth: Truth) -> None:
    truth.on_result(HELD)
    truth.on_status(status(goal_id="1"))  # asked for before the result came
    assert truth.held().tone is Tone.GOOD
    truth.on_status(status(goal_id="2", action="Open"))
    assert truth.held().text == "moving"
    assert truth.doing().text == "running Open"


@pytest.mark.parametrize("kind", ["device_lost", "device_fault"])
def test_a_lost_device_takes_back_what_was_said(truth: Truth, kind: str) -> None:
    truth.on_result(HELD)
    truth.on_event(Event(kind, "line", "is lost", 0.0, "error"))
    truth.on_status(status(devices=(replace(ACTIVE, lifecycle=Lifecycle.UNCONFIGURED),)))
    assert truth.held() == ("no data from line", Tone.BAD)
    assert truth.link() == ("device 'line' is unconfigured", Tone.BAD)
    truth.on_status(status())  # connected again: what is in the hand now is not known
    assert truth.held().text == "not known whether something is held"


def test_homing_is_no_trouble(truth: Truth) -> None:
    truth.on_event(Event("device_busy", "line", "device 'line' is homing a, 1 of 2", 0.0))
    homing = replace(ACTIVE, lifecycle=Lifecycle.INACTIVE, message="homing b, 2 of 2")
    truth.on_status(status(devices=(homing,)))
    assert truth.homing
    assert truth.link() == ("device 'line' is inactive: homing b, 2 of 2", Tone.WARN)
    assert truth.held() == ("moves by itself: keep clear", Tone.WARN)
    truth.on_status(status(devices=(replace(homing, message="no answer"),)))
    assert not truth.homing
    assert truth.held().tone is Tone.BAD


def test_what_is_old_is_called_so(truth: Truth, monkeypatch: pytest.MonkeyPatch) -> None:
    truth.on_result(HELD)
    assert truth.link() == ("svh: connected", Tone.GOOD)
    now = monotonic.now()
    monkeypatch.setattr(monotonic, "now", lambda: now + 3.2)
    assert truth.held() == ("no data", Tone.BAD)
    assert "no data for 3.2 s: STOP cannot reach the hand" in truth.link().text
    truth.on_gone("the hand has ended")
    assert truth.link().text.startswith("not connected: the hand has ended · no data for 3.2 s")
    assert truth.state is STATE, "the last picture stays"
    assert math.isinf(Truth().age)


def test_a_stop_stays_to_be_read_until_something_moves(truth: Truth) -> None:
    truth.on_event(Event("stop", "svh", "svh: stopped by gui; confirmed", 0.0, "info"))
    truth.on_status(status())
    assert truth.doing().text.endswith("stopped by gui; confirmed")
    truth.on_status(status(goal_id="3", action="Open"))
    assert truth.doing() == ("running Open", Tone.PLAIN)


def test_a_status_from_before_a_stop_does_not_hide_it(
    truth: Truth, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The bar said nothing of a stop, if a status that was older came after it."""
    now = monotonic.now()
    monkeypatch.setattr(monotonic, "now", lambda: now)
    running = status(action="close", goal_id="7")
    truth.on_status(running)
    truth.on_event(Event("stop", "svh", "svh: stopped by gui; confirmed", 0.0, "info"))
    truth.on_status(running)
    assert not truth.moving
    assert "stopped by gui" in truth.doing().text
    assert truth.turn.why.endswith("stopped")
    truth.on_status(status(action="close", goal_id="8"))
    assert truth.doing().text == "running close"

    # The word of a stop may itself be late: then it is the next goal that runs, and goes on.
    truth.on_event(Event("stop", "svh", "svh: stopped by gui; confirmed", 0.0, "info"))
    now += _OLDER
    truth.on_state(STATE)
    truth.on_status(status(action="close", goal_id="8"))
    assert truth.doing().text == "running close"


def test_what_makes_older_statements_old(truth: Truth) -> None:
    truth.on_result(HELD)
    for happens, why in (
        (lambda: truth.on_event(Event("grasp_lost", "index", "lost", 0.0, "warning")), "part lost"),
        (lambda: truth.on_event(Event("stop", "svh", "svh: stopped", 0.0, "info")), "stopped"),
        (lambda: truth.on_status(status(goal_id="2", action="Open")), "Open"),
        (lambda: truth.on_event(Event("device_lost", "line", "is lost", 0.0)), "device lost"),
        (lambda: truth.on_gone("the hand has ended"), "not connected"),
    ):
        before = truth.turn
        happens()
        assert truth.turn is not before
        assert truth.turn.why.endswith(why)
    ended = truth.turn
    truth.on_gone("no hand is running")
    assert truth.turn is ended


def test_a_full_disk_and_hot_actuators_are_said_beside_what_runs(truth: Truth) -> None:
    truth.on_status(status(goal_id="2", action="Open", recording_trouble="the disk is full"))
    assert truth.doing() == ("running Open · recording: the disk is full", Tone.WARN)
    truth.on_status(status())
    truth.on_event(Event("thermal", "index", "index is hot and gets less effort", 0.0, "warning"))
    assert truth.doing() == ("index is hot and gets less effort", Tone.WARN)
    truth.on_event(Event("thermal", "index", "index is cool again", 0.0, "info"))
    assert truth.doing() == ("", Tone.PLAIN)


def test_windows_are_told_apart(truth: Truth) -> None:
    assert truth.control("gui-1-a", ["gui-1-b"]).text == "control: free"
    for holder, words in (("gui-1-a", "this window"), ("gui-1-b", "another window (b)")):
        truth.on_status(status(holder=holder))
        assert truth.control("gui-1-a", ["gui-1-b"]).text == f"control: {words}"
    truth.on_status(status(holder="arm"))
    assert truth.control("gui-1-a", ["gui-1-b"]) == ("control: arm", Tone.WARN)
