"""The fixture `rtee_simulated_hand`: loss and recovery on simulated time."""

from __future__ import annotations

import math

import pytest

import rtee
from rtee.errors import ConfigError, GoalRejected, MessageError, NoHand
from rtee.testing.simulated import StartSimulatedHand
from rtee.types import Goal, Named


def test_a_part_is_pulled_out_and_the_cable_too(rtee_simulated_hand: StartSimulatedHand) -> None:
    hand = rtee_simulated_hand("robotiq_2f_85", object="50mm")
    held = hand.grasp("50mm", force="40N")
    assert (held.grasped, held.within) == (True, True)
    hand.take_away()
    hand.wait(2.0)
    assert "grasp_lost" in [event.kind for event in hand.events]
    hand.unplug()
    hand.wait(1.0)
    assert hand.status()[0].lifecycle == "unconfigured"
    with pytest.raises(GoalRejected):
        hand.open()
    hand.plug("gripper")
    hand.wait(5.0)
    hand.recover()
    assert hand.open().reached
    with pytest.raises(ConfigError, match="unknown fault 'rust'"):
        hand.fault("rust")


def test_a_state_is_the_one_that_a_client_gets(rtee_simulated_hand: StartSimulatedHand) -> None:
    hand = rtee_simulated_hand("robotiq_2f_85", object="50mm")
    assert hand.state().opening is None, "no goal has told which fingers count"
    result = hand.grasp("50mm", force="40N")
    state = hand.state()
    assert state.opening == pytest.approx(result.opening, abs=1e-3)
    assert state.positions == pytest.approx(result.position, abs=0.01)
    assert list(state.observation()) == list(rtee.load_hand("robotiq_2f_85").observation_features)
    assert len(state.joints) == 6


def test_a_hand_that_has_ended_says_so() -> None:
    with rtee.simulated("robotiq_2f_85") as hand:
        pass
    for call in (hand.open, hand.stop, lambda: hand.wait(1.0), lambda: hand.unplug()):
        with pytest.raises(NoHand, match="the simulated hand 'robotiq_2f_85' has ended"):
            call()
    hand.close()


def test_only_simulated_time_passes(rtee_simulated_hand: StartSimulatedHand) -> None:
    hand = rtee_simulated_hand("robotiq_2f_85")
    before = hand.state().stamp
    hand.wait(3.0)
    assert hand.state().stamp - before == pytest.approx(3.0, abs=0.01)
    assert hand.do("PinchTight", "finger_1", "finger_2", intensity=0.5, effort=0.5).reached


@pytest.mark.parametrize(("thing", "touched"), [(None, False), ("0.4", True)])
def test_a_fresh_hand_touches_what_is_there_alone(
    rtee_simulated_hand: StartSimulatedHand, thing: str | None, touched: bool
) -> None:
    """Its motors move with less than they need, as long as their friction is unknown."""
    hand = rtee_simulated_hand("heri_ii", object=thing)
    result = hand.touch(tip_speed="40mm/s")
    assert bool(result.touched) == touched
    # Its tips meet the object, at 0.4 of the way, 8 mm apart.
    assert result.opening == pytest.approx(0.008 if touched else 0.003, abs=0.002)


def test_a_mistake_is_raised_by_its_type(rtee_simulated_hand: StartSimulatedHand) -> None:
    with pytest.raises(ConfigError, match="an object 500 mm wide does not fit the fingers"):
        rtee_simulated_hand("robotiq_2f_85", object="500mm")


def test_a_wrong_argument_is_a_sentence(rtee_simulated_hand: StartSimulatedHand) -> None:
    hand = rtee_simulated_hand("robotiq_2f_85")
    with pytest.raises(GoalRejected, match=r"a complete goal is a Goal\(…\), not 'grasp'"):
        hand.execute("grasp")  # type: ignore[arg-type]
    with pytest.raises(MessageError, match="action: a string expected, not None"):
        hand.execute(Goal(Named(None)))  # type: ignore[arg-type]
    for seconds in ("long", None, -1.0, math.inf):
        with pytest.raises(GoalRejected, match="the time to wait must"):
            hand.wait(seconds)  # type: ignore[arg-type]
    for call in (hand.unplug, hand.fault, hand.recover):
        with pytest.raises(ConfigError, match="'3'; valid: "):
            call(3)  # type: ignore[operator]
    assert hand.execute(Goal(Named("open"))).reached
